"""Random streams: every run draws its own numbers, whatever its company."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import accelcal_cli
from accelcal_cli.rng import Purpose, Streams


@given(
    st.lists(st.integers(0, 1000), min_size=1, max_size=6, unique=True),
    st.integers(0, 2**63),
    st.integers(1, 20),
    st.integers(1, 5),
)
def test_a_run_draws_the_same_alone_and_in_any_company(runs, seed, rows, columns):
    batch = Streams(seed, runs)
    first, second = batch.uniform(rows, columns), batch.normal(rows, columns)
    for place, run in enumerate(runs):
        alone = Streams(seed, [run])
        assert alone.uniform(rows, columns)[0].tobytes() == first[place].tobytes()
        assert alone.normal(rows, columns)[0].tobytes() == second[place].tobytes()


@pytest.mark.parametrize("draw", ["uniform", "normal"])
def test_runs_seeds_and_purposes_differ(draw):
    def numbers(seed, run, purpose=0):
        return getattr(Streams(seed, [run], purpose), draw)(4, 3).tobytes()

    combinations = [(seed, run, purpose) for seed in (0, 1, 2) for run in (0, 1, 2) for purpose in (0, 1)]
    assert len({numbers(*combination) for combination in combinations}) == len(combinations)


def test_a_stream_goes_on():
    rng = Streams(0, [0, 1])
    assert rng.uniform(5, 2).tobytes() != rng.uniform(5, 2).tobytes()


def test_take_goes_on_where_the_runs_stand():
    """Runs that end leave the batch; the others draw on as if nothing had happened."""
    rng, whole = Streams(3, range(5)), Streams(3, range(5))
    rng.uniform(4, 2), whole.uniform(4, 2)
    part = rng.take(np.array([1, 4]))
    assert len(part) == 2
    assert part.uniform(4, 2).tobytes() == whole.uniform(4, 2)[[1, 4]].tobytes()


def _halves(u):
    """Two arrays of shape (R, K, ...): the first column doubled, and all."""
    return 2.0 * u[..., 0], u


def _sizes(u):
    return (np.broadcast_to(u.shape[1], u.shape[:2]),)


@pytest.mark.parametrize("runs", [1, 3, 20])
@given(st.lists(st.sampled_from(["ahead", "other", "uniform", "normal", "take"]), max_size=12))
def test_drawing_ahead_gives_the_numbers_of_single_draws(runs, order):
    """Whatever is drawn before, between and after."""
    ahead, single, left = Streams(5, range(runs)), Streams(5, range(runs)), np.arange(runs)
    for kind in ["ahead", "ahead", *order, "ahead"]:
        if kind in ("ahead", "other"):
            columns = 3 if kind == "ahead" else 2
            doubled, numbers = ahead.ahead(_halves, 100, columns)
            expected = single.uniform(100, columns)
            np.testing.assert_array_equal(doubled, 2.0 * expected[..., 0])
        elif kind == "take":
            kept = np.arange(0, len(left), 2)
            ahead, single, left = ahead.take(kept), single.take(kept), left[kept]
            continue
        else:
            numbers, expected = getattr(ahead, kind)(100, 3), getattr(single, kind)(100, 3)
        np.testing.assert_array_equal(numbers, expected)
        assert numbers.shape == expected.shape


def test_a_small_batch_draws_several_iterations_ahead_and_a_large_one_does_not():
    sizes = [int(Streams(0, range(runs)).ahead(_sizes, 100, 24)[0][0]) for runs in (1, 3, 20)]
    assert sizes[0] > sizes[1] > sizes[2] == 1


def test_what_a_part_draws_ahead_is_not_drawn_again():
    streams = Streams(0, range(3))
    streams.ahead(_halves, 4, 3)
    part = streams.take(np.array([1]))
    assert (part.ahead(_halves, 4, 3)[1][0] != streams.uniform(4, 3)[1]).all()


def test_shapes_and_statistics():
    rng = Streams(1, range(3))
    u, z = rng.uniform(20_000, 2), rng.normal(20_000, 2)
    assert u.shape == z.shape == (3, 20_000, 2)
    assert (u >= 0).all()
    assert (u < 1).all()
    n = u.size
    assert abs(u.mean() - 0.5) < 5 / np.sqrt(12 * n)
    assert abs(u.var() - 1 / 12) < 0.01 / 12
    assert abs(z.mean()) < 5 / np.sqrt(n)
    assert abs(z.var() - 1) < 0.02
    assert abs((z**3).mean()) < 0.05
    correlation = np.corrcoef(u.transpose(0, 2, 1).reshape(6, -1))
    assert np.abs(correlation - np.eye(6)).max() < 0.03


def test_the_population_axis_is_contiguous():
    assert Streams(0, [0]).uniform(100, 12).strides[1] == 8


@pytest.mark.parametrize("rows", [0, 1])
def test_few_rows(rows):
    assert Streams(0, [0, 1]).uniform(rows, 3).shape == (2, rows, 3)


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="negative"):
        Streams(-1, [0])


def test_what_a_part_has_drawn_is_not_drawn_again():
    """Also when the part is taken before the first draw."""
    streams = Streams(0, range(3))
    first = streams.take(np.array([1])).normal(4, 2)
    assert (streams.normal(4, 2)[1] != first[0]).all()


def test_purposes_differ():
    """All but two, which no command has together: SHIFT is another name of RAW_LOG."""
    shared = {name for name, purpose in Purpose.__members__.items() if purpose.name != name}
    assert shared == {"SHIFT"}


def test_every_stream_of_the_library_states_its_purpose_by_name():
    """A number, or a purpose of a module's own, could be another's."""
    package = Path(accelcal_cli.__file__).parent
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "Streams":
                stated = [*node.args[2:], *(key.value for key in node.keywords)]
                named = [ast.unparse(purpose).startswith("Purpose.") for purpose in stated]
                assert named in ([], [True]) or path.name == "rng.py", f"{path}:{node.lineno}"
