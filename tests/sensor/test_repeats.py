"""Averages of repeated readings, against the plain formulas on all rows at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from accelcal_cli.errors import DataError
from accelcal_cli.io import readings as repeats
from accelcal_cli.io.readings import LabelledMeans


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 6), st.integers(1, 15))
def test_blocks_do_not_matter(seed: int, rows: int, labels: int, block: int) -> None:
    rng = np.random.default_rng(seed)
    names = rng.integers(0, labels, rows).astype(str)
    values = rng.normal(1e6, 1.0, (rows, 4))  # an offset that would spoil sums of squares
    means = LabelledMeans("f", 4)
    for start in range(0, rows, block):
        means.add(names[start : start + block].tolist(), values[start : start + block])
    scatter = means.scatter()
    for label, k in means.index.items():
        own = values[names == label]
        np.testing.assert_allclose(means.mean[k], own.mean(axis=0), rtol=1e-14)
        if len(own) > 1:
            assert scatter is not None
            np.testing.assert_allclose(scatter[k], own[:, :3].std(axis=0, ddof=1), rtol=1e-8)


def test_means_of_raw_readings_pool_to_the_raw_readings() -> None:
    """Rows that are means with n and a standard deviation give what their raw readings would have given."""
    rng = np.random.default_rng(3)
    parts = [rng.normal(10, 2, (n, 3)) for n in (5, 1, 40)]
    means = LabelledMeans("f", 3)
    with np.errstate(all="raise"):
        for part in parts:
            spread = part.std(axis=0, ddof=1) if len(part) > 1 else np.full(3, np.nan)
            means.add(["up"], part.mean(axis=0)[None], np.array([len(part)]), spread[None])
    whole = np.concatenate(parts)
    count, scatter = means.count(), means.scatter()
    assert count is not None
    assert scatter is not None
    assert count.tolist() == [46]
    np.testing.assert_allclose(means.mean[0], whole.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(scatter[0], whole.std(axis=0, ddof=1), rtol=1e-12)


def test_means_without_spread_tell_it_by_their_own_scatter() -> None:
    """The variance of means of n readings is that of one reading over n."""
    rng = np.random.default_rng(4)
    means = LabelledMeans("f", 3)
    size = 20_000
    means.add(["up"] * size, rng.normal(0, 3 / np.sqrt(25), (size, 3)), np.full(size, 25.0))
    scatter = means.scatter()
    assert scatter is not None
    np.testing.assert_allclose(scatter[0], 3, rtol=0.05)


def test_equal_rows_scatter_not_at_all() -> None:
    means = LabelledMeans("f", 3)
    for _ in range(3):
        means.add(["up", "up"], np.full((2, 3), 0.1))
    assert means.mean[0].tolist() == [0.1, 0.1, 0.1]
    scatter = means.scatter()
    assert scatter is not None
    assert scatter[0].tolist() == [0, 0, 0]


def test_single_rows_keep_what_they_state() -> None:
    means = LabelledMeans("f", 3)
    means.add(["a", "b"], np.ones((2, 3)), np.array([1.0, 7.0]), np.array([[0.5] * 3, [0.1] * 3]))
    scatter = means.scatter()
    assert scatter is not None
    assert scatter.tolist() == [[0.5] * 3, [0.1] * 3]
    assert not means.repeated


def test_too_many_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(repeats, "MOST_LABELS", 3)
    with pytest.raises(DataError, match="f: more than 3 different position labels"):
        LabelledMeans("f", 3).add(["a", "b", "c", "d"], np.ones((4, 3)))
