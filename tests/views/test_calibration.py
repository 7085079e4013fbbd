"""What is shown of a calibration: the numbers of the record, in the paper's units and in an engineer's."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import DPSO, MEMS, noise, readings

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Nominal, Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import model as units
from accelcal_cli.sensor import poses
from accelcal_cli.views import calibration as tables
from accelcal_cli.views import quoted

G = 9.8


def _settings(**changes):
    return Settings(**{"optimizer": "levenberg-marquardt", "g": G, **changes})


@pytest.fixture(scope="module")
def result():
    return calibrate(readings(poses.turns(), sigma=1e-3), _settings(nominal=Nominal(scale=(5.6e5,) * 3)))


def _cells(table):
    return {row[0]: row[1:] for row in table.rows}


def test_every_table_has_as_many_cells_as_columns(result):
    for table in (*tables.parameter_tables(result), tables.fit(result), tables.every_pose(result)):
        assert table.title
        assert table.rows
        assert len(table.records()) == len(table.rows)
        for row in table.rows:
            for column, value in zip(table.columns, row, strict=True):
                assert isinstance(column.text(value), str)


def test_parameters_are_the_matrix_and_the_bias(result):
    rows = _cells(tables.parameters(result))
    for i, axis in enumerate("xyz"):
        values = rows[axis]
        np.testing.assert_array_equal(values[0:6:2], result.K_a[i])
        np.testing.assert_array_equal(values[1:6:2], result.interval.K_a[i])
        assert tuple(values[6:]) == (result.D_a[i], result.interval.D_a[i])


def test_the_engineering_view_by_hand(result):
    rows = _cells(tables.engineering(result))
    sigma = result.coverage_factor * result.engineering[1]
    lengths = np.linalg.norm(result.K_a, axis=1)
    value, one_sigma, unit, percent, _, second = rows["scale factor error y"]
    assert (unit, second) == ("ppm", "%")
    assert value == pytest.approx((lengths[1] / 5.6e5 - 1) * 1e6, rel=1e-9)
    assert percent == pytest.approx(value / 1e4, rel=1e-12)
    assert one_sigma == pytest.approx(sigma[1] * 1e6, rel=1e-9)
    value, one_sigma, unit, arcsec, _, second = rows["misalignment yz"]
    assert (unit, second) == ("mrad", "arcsec")
    cosine = result.K_a[1] @ result.K_a[2] / lengths[1] / lengths[2]
    assert value == pytest.approx(np.arcsin(cosine) * 1e3, rel=1e-9)
    assert arcsec == pytest.approx(value * 1e-3 * 180 * 3600 / np.pi, rel=1e-12)
    assert one_sigma == pytest.approx(sigma[5] * 1e3, rel=1e-9)
    value, one_sigma, unit, force, _, second = rows["bias y"]
    assert (unit, second) == ("micro-g", "m/s^2")
    assert force == pytest.approx(result.D_a[1] / lengths[1], rel=1e-9)
    assert value == pytest.approx(force / G * 1e6, rel=1e-9)
    assert one_sigma == pytest.approx(sigma[7] / G * 1e6, rel=1e-9)


def test_the_engineering_view_does_not_depend_on_the_gauge():
    data = readings(poses.turns(), sigma=1e-3)
    views = []
    for gauge in ("lower", "upper", "symmetric", "full"):
        table = tables.engineering(
            calibrate(data, _settings(gauge=gauge, nominal=Nominal(scale=(5.67e5,) * 3)))
        )
        views.append([row[1] for row in table.rows])
    np.testing.assert_allclose(views[1:], [views[0]] * 3, rtol=1e-7, atol=1e-4)  # ppm, mrad and micro-g


def test_a_result_in_units_of_g():
    data = Readings.from_array(MEMS.output(poses.turns() + noise(24, 1e-4, 1)))
    result = calibrate(data, _settings(g=1.0))
    value, _, unit, force, _, second = _cells(tables.engineering(result))["bias x"]
    assert (unit, second) == ("micro-g", "m/s^2")
    assert value == pytest.approx(result.D_a[0] / np.linalg.norm(result.K_a[0]) * 1e6, rel=1e-9)
    assert force == pytest.approx(value * 1e-6 * units.STANDARD_GRAVITY, rel=1e-9)
    assert dict(_cells(tables.fit(result)))["local gravity g"][1] == "g"


def test_the_observability_table_is_the_dilution(result):
    rows = _cells(tables.observability(result))
    assert list(rows) == list(result.geometry.parameters)
    for name, dop in result.geometry.parameters.items():
        assert rows[name][0] == dop
        assert rows[name][1] == "good"


def test_the_worst_poses_come_first():
    u, n = poses.turns(), noise(24, 1e-3, 2)
    n[7] += 0.3 * u[7]
    result = calibrate(Readings.from_array(DPSO.output(G * u + n)), _settings())
    rows = tables.worst_poses(result).rows
    assert rows[0][:2] == (8, "pose 8")
    assert rows[0][-1] == "outlier"
    sizes = [abs(row[3]) for row in rows]
    assert sizes == sorted(sizes, reverse=True)
    assert all(row[-1] == "" for row in rows[1:])


def test_the_fit_table_says_what_was_before_and_after(result):
    rows = _cells(tables.fit(result))
    assert float(rows["rms of |f| - g before"][0]) == pytest.approx(result.rms_before, rel=1e-5)
    assert float(rows["rms of |f| - g after"][0]) == pytest.approx(result.rms, rel=1e-5)
    assert rows["poses"][0] == "24"
    assert rows["degrees of freedom"][0] == "15"
    unpolished = calibrate(
        readings(poses.turns(), sigma=1e-3),
        Settings(g=G, polish=False, parameters={"iterations": 5}),
    )
    assert not any("polish" in row[0] for row in tables.fit(unpolished).rows)


def test_what_is_not_determined_is_not_shown_as_a_number():
    result = calibrate(readings(np.repeat(poses.faces(), 4, axis=0)), _settings())
    assert result.verdict == "undetermined"
    assert quoted.UNKNOWN in _cells(tables.engineering(result))["misalignment xy"]
    assert quoted.UNKNOWN in [value for row in tables.parameters(result).rows for value in row]
    assert {row[2] for row in tables.observability(result).rows} >= {"undetermined", "good"}
    empty = {row[0] for row in tables.values(result).rows if row[1] is None}
    below = {f"K_{i}{j}" for i in (1, 2, 3) for j in range(1, i + 1)}
    engineering = {f"{kind}_{axis}" for kind in ("scale_factor_error", "bias") for axis in "xyz"}
    engineering |= {f"misalignment_{pair}" for pair in ("xy", "xz", "yz")}
    assert empty == below | {"D_1", "D_2", "D_3"} | engineering


def test_nine_poses_have_values_without_sigma():
    result = calibrate(readings(poses.fibonacci(9), sigma=1e-3), _settings())
    assert result.verdict == "weak"
    for table in (tables.parameters(result), tables.engineering(result), tables.values(result)):
        assert quoted.UNKNOWN not in [cell for row in table.rows for cell in row]
    value, sigma, *_ = _cells(tables.engineering(result))["scale factor error x"]
    assert value == pytest.approx((result.K_a[0, 0] / result.nominal_scale[0] - 1) * 1e6)
    assert sigma is None


def test_the_values_for_csv_are_all_there(result):
    rows = {row[0]: row for row in tables.values(result).rows}
    assert [f"K_{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)] == list(rows)[:9]
    assert rows["K_21"][1] == result.K_a[1, 0]
    assert rows["D_3"][1:3] == (result.D_a[2], result.sigma.D_a[2])
    assert rows["cost"][1] == result.cost
    assert rows["verdict"][1] == "good"
    assert all(not isinstance(cell, np.generic) for row in rows.values() for cell in row)
