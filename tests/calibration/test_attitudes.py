"""Attitudes are counted, not rows, whatever the order of the rows and however many there are."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import readings

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.observability import CellCount, design, distinct, lessened
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses

FAST = Settings(optimizer="levenberg-marquardt", g=9.80665)


def near(u, each, angle, seed=1):
    rows = np.repeat(u, each, axis=0) + angle * Streams(seed, [0]).normal(len(u) * each, 3)[0]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", [0.0, 0.002, 0.01])
def test_noise_makes_no_attitudes(angle):
    rows = near(poses.faces(), 60, angle)
    count, one = distinct(rows[None], np.ones((1, 360), dtype=bool), np.zeros(1, dtype=bool))
    assert count.tolist() == [6]
    information = design(rows[one[0]]).T @ design(rows[one[0]])
    assert np.trace(information) == pytest.approx(12.0, rel=0.02)  # u^4 and u^2 of six directions
    cells = CellCount()
    for part in np.array_split(rows, 7):
        cells.add(part)
    many, same = cells.distinct()
    assert many == 6
    np.testing.assert_allclose(same, information, atol=0.2)


def test_the_order_of_the_rows_does_not_matter():
    rows = near(poses.fibonacci(40), 50, 0.005)
    order = np.argsort(Streams(2, [0]).uniform(1, len(rows))[0, 0])
    counts = []
    for part in (rows, rows[order], rows[::-1]):
        cells = CellCount()
        cells.add(np.ascontiguousarray(part))
        counts.append(cells.distinct()[0])
    assert counts == [40, 40, 40]


def test_a_label_is_an_attitude_of_its_own():
    rows = near(poses.faces(), 4, 0.0)
    real = np.ones((1, 24), dtype=bool)
    assert distinct(rows[None], real, np.array([True]))[0].tolist() == [24]
    assert distinct(rows[None], real, np.array([False]))[0].tolist() == [6]


def test_many_rows_of_a_few_attitudes_are_judged_as_the_few():
    """Six faces, sixty rows each, noise of 5 mg: misalignments are not determined, and the way out is named."""
    result = calibrate(readings(np.repeat(poses.faces(), 60, axis=0), sigma=0.05), FAST)
    assert result.verdict == "undetermined"
    assert result.attitudes == 6
    (notice,) = [notice for notice in result.warnings if notice.key == "few-attitudes"]
    assert "--no-misalignment" in notice.remedy


def test_many_rows_of_good_attitudes_are_good():
    result = calibrate(readings(np.repeat(poses.turns(), 20, axis=0), sigma=0.005), FAST)
    assert result.verdict == "good"
    assert result.attitudes == 18
    assert result.geometry.worst == pytest.approx(
        calibrate(readings(poses.turns(), sigma=0.005), FAST).geometry.worst, rel=0.05
    )


def test_slopes_take_the_same_part_of_attitudes_whatever_the_weights():
    """Alike weights take their share of what slopes take; unlike ones leave every direction some information."""
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(1, 36, 9))
    once = rows.swapaxes(1, 2) @ rows
    slope = rng.normal(size=(1, 36, 6))

    def taken(w):
        across = rows.swapaxes(1, 2) @ (w * slope)
        return across @ np.linalg.inv(slope.swapaxes(1, 2) @ (w * slope)) @ across.swapaxes(1, 2)

    alike = lessened(once, 3.0 * once, 3.0 * taken(np.ones((1, 36, 1))))
    np.testing.assert_allclose(alike, once - taken(np.ones((1, 36, 1))), rtol=1e-9, atol=1e-8)
    w = np.exp(2.0 * rng.normal(size=(1, 36, 1)))
    left = lessened(once, rows.swapaxes(1, 2) @ (w * rows), taken(w))
    assert 0 < np.linalg.eigvalsh(left).min() < np.linalg.eigvalsh(once).min()
