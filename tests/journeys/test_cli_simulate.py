"""`accelcal simulate`."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from accelcal_cli.sensor.model import ErrorModel


def table(text):
    header, *rows = text.splitlines()
    return header.split(","), np.array([[float(cell) for cell in row.split(",")] for row in rows])


def test_twelve_positions_are_the_edges(run):
    outcome = run("simulate", "--positions", "12", "--attitude", "--noise", "0")
    header, rows = table(outcome.out)
    assert outcome.err == ""
    assert header == ["Nx", "Ny", "Nz", "fx", "fy", "fz"]
    np.testing.assert_allclose(np.linalg.norm(rows[:, 3:], axis=1), 9.80665)
    assert ((np.abs(rows[:, 3:]) > 1).sum(axis=1) == 2).all()
    assert len(np.unique(rows[:, 3:].round(6), axis=0)) == 12


def test_the_truth_explains_the_readings(run, tmp_path):
    outcome = run(
        "simulate", "--sensor", "mems", "--noise", "0", "--attitude", "--g", "9.8", "--truth", "t.yaml"
    )
    rows = table(outcome.out)[1]
    true = yaml.safe_load((tmp_path / "t.yaml").read_text())
    model = ErrorModel(np.array(true["K_a"]), np.array(true["D_a"]))
    np.testing.assert_allclose(rows[:, :3], model.output(rows[:, 3:]), rtol=1e-12)
    np.testing.assert_allclose(rows[:, 3:], 9.8 * np.array(true["directions"]), rtol=1e-12)
    K = np.array(true["K_a_lower"])
    assert np.array_equal(K, np.tril(K))
    np.testing.assert_allclose(K @ K.T, model.K @ model.K.T, rtol=1e-9, atol=1e-6)


def test_samples_are_labelled_and_scatter_by_the_stated_noise(run):
    header, rows = table(run("simulate", "--positions", "20", "--samples", "500", "--noise", "0.01").out)
    assert header[0] == "pose"
    assert rows.shape == (10_000, 4)
    force = rows[:, 1:].reshape(20, 500, 3) / 5.65e5
    assert 0.0095 < force.std(axis=1).mean() < 0.0105


def test_a_seed_repeats_and_another_differs(run):
    arguments = ("simulate", "--sensor", "mems", "--scheme", "random", "--positions", "30", "--seed")
    first = run(*arguments, "1").out
    assert run(*arguments, "1").out == first
    assert run(*arguments, "2").out != first


@pytest.mark.parametrize(
    ("scheme", "count"),
    [("faces", 6), ("edges", 12), ("faces-edges", 12), ("icosahedron", 12), ("turns", 24), ("fibonacci", 17)],
)
def test_schemes(run, scheme, count):
    outcome = run("simulate", "--scheme", scheme, "--positions", str(count), "-o", "data.csv")
    assert (outcome.code, outcome.out) == (0, "")
    assert len(Path("data.csv").read_text().splitlines()) == count + 1


def test_a_sensor_of_ones_own(run, tmp_path):
    (tmp_path / "mine.yaml").write_text("K_a: [[2, 0, 0], [0, 2, 0], [0, 0, 2]]\nD_a: [1, 2, 3]\n")
    rows = table(
        run("simulate", "--sensor", "mine.yaml", "--scheme", "faces", "--positions", "6", "--g", "1").out
    )[1]
    np.testing.assert_allclose(rows[0], [3, 2, 3])
