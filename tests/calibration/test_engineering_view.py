"""The engineer's nine quantities: derivatives, and standard deviations against Monte Carlo."""

from __future__ import annotations

import json

import numpy as np
import pytest
from simulated import noise, readings

from accelcal_cli.calibration import observability as engineering
from accelcal_cli.calibration.calibrate import calibrate, calibrate_many
from accelcal_cli.calibration.fleet import calibrate_fleet
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.fleet import read_fleet
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel, to_gauge
from accelcal_cli.views.calibration import engineering as engineering_view
from accelcal_cli.views.calibration import values

G = 9.8
UNITS = np.repeat([1.0, 1e3, 1e6 / G], 3)
"""Sizes of the units of a fleet's parameters: 1, mrad and micro-g."""
SKEWED = ErrorModel(
    np.array([[103.0, 0.0, 0.0], [8.0, 98.0, 0.0], [-30.0, 20.0, 96.0]]), np.array([300.0, -150.0, 80.0])
)
"""Misalignments of 0.08, 0.3 and 0.2 rad and a bias of a third of g: what first-order formulas would get wrong."""


def test_the_chain_is_the_derivative():
    K, D = SKEWED.K, SKEWED.D
    chain = engineering.engineering_chain(K, D, G)
    for p in range(9):
        slope = np.zeros(9)
        for step in (1e-5, -1e-5):
            parameters = np.zeros(9)
            parameters[p] = step
            E = np.zeros((3, 3))
            E[[0, 1, 2, 1, 2, 2], [0, 1, 2, 0, 0, 1]] = parameters[:6] / G
            moved = K @ np.linalg.inv(np.eye(3) + E)
            changed = engineering.engineering_quantities(moved, D + np.diagonal(K) * parameters[6:])
            changed[:3] = np.log(changed[:3])
            slope += changed / (2.0 * step)
        np.testing.assert_allclose(chain[:, p], slope, rtol=1e-6, atol=1e-8)


def test_sigma_is_the_scatter_of_many_calibrations():
    u, draws = poses.turns(), 600
    settings = Settings(optimizer="levenberg-marquardt", g=G)
    sets = [Readings.from_array(SKEWED.output(G * u + noise(24, 2e-3, seed))) for seed in range(draws)]
    found = calibrate_many(sets, settings)
    values = np.array([engineering.engineering_quantities(one.K_a, one.D_a) for one in found])
    values[:, :3] /= engineering.engineering_quantities(SKEWED.K, SKEWED.D)[:3]
    chain = engineering.engineering_chain(SKEWED.K, SKEWED.D, G)
    stated = np.sqrt(np.mean([engineering.propagated(chain, one.covariance) ** 2 for one in found], axis=0))
    np.testing.assert_allclose(stated, values.std(axis=0), rtol=0.1)  # three sigma of 600 draws
    np.testing.assert_allclose(values.mean(axis=0)[:3], 1.0, atol=4 * stated[0] / np.sqrt(draws))


@pytest.mark.parametrize("gauge", ["upper", "symmetric", "full"])
def test_no_quantity_depends_on_the_gauge(gauge):
    turned = to_gauge(SKEWED.K, gauge)
    np.testing.assert_allclose(
        engineering.engineering_quantities(turned, SKEWED.D),
        engineering.engineering_quantities(SKEWED.K, SKEWED.D),
        rtol=1e-12,
    )


def test_a_lost_parameter_takes_along_what_it_moves_alone():
    chain = engineering.engineering_chain(np.diag([2.0, 3.0, 4.0]), np.zeros(3), G)
    covariance = np.eye(9)
    covariance[3] = covariance[:, 3] = np.nan
    sigma = engineering.propagated(chain, covariance)
    assert np.flatnonzero(np.isnan(sigma)).tolist() == [3]


def test_faces_alone_leave_the_scale_factors_their_sigma():
    u = np.repeat(poses.faces(), 4, axis=0)
    found = calibrate(
        readings(u, sigma=1e-3),
        Settings(optimizer="levenberg-marquardt", g=G, misalignment=False),
    )
    sigma = engineering.propagated(engineering.engineering_chain(found.K_a, found.D_a, G), found.covariance)
    assert np.isfinite(sigma[:3]).all()


def test_a_fleet_states_the_same_quantities(tmp_path):
    """Values, and errors for the noise of a pose, as the engineering view of each sensor has them."""
    lines = ["sensor,ax,ay,az"]
    for seed in range(3):
        output = SKEWED.output(G * poses.turns() + noise(24, 2e-3, seed))
        lines += [f"S{seed}," + ",".join(map(repr, row)) for row in output.tolist()]
    (tmp_path / "fleet.csv").write_text("\n".join(lines) + "\n")
    records = {}
    settings = Settings(optimizer="levenberg-marquardt", g=G)
    fleet = calibrate_fleet(read_fleet([str(tmp_path / "fleet.csv")]), settings, records.__setitem__)
    for r, one in records.items():
        rows = engineering_view(one).rows
        for p in range(9):
            value, sigma = rows[p][1], rows[p][2] / one.coverage_factor
            if p < 3:
                value = (1.0 + value * 1e-6) * one.nominal_scale[p]
                sigma = sigma * 1e-6 * one.nominal_scale[p]
            gain = fleet.gain[r, p] * (one.nominal_scale[p] * (1 + rows[p][1] * 1e-6) if p < 3 else UNITS[p])
            assert fleet.parameters[r, p] == pytest.approx(value, rel=1e-9)
            assert gain * one.s == pytest.approx(sigma, rel=1e-9)


def test_csv_and_json_state_the_same_quantities():
    result = calibrate(readings(poses.turns(), sigma=1e-3), Settings(optimizer="levenberg-marquardt", g=G))
    table = {row[0]: row[1:] for row in engineering_view(result).rows}
    csv = {row[0]: row[1:] for row in values(result).rows}
    view = json.loads(json.dumps(result.record()))["engineering"]
    for kind, key, size in (
        ("scale factor error", "scale_error", 1e6),
        ("misalignment", "misalignment", 1e3),
    ):
        for k, name in enumerate(("x", "y", "z") if size == 1e6 else ("xy", "xz", "yz")):
            value, interval = table[f"{kind} {name}"][:2]
            row = csv[f"{kind.replace(' ', '_')}_{name}"]
            assert row[0] == pytest.approx(value, rel=1e-12)
            assert row[2] == pytest.approx(interval, rel=1e-12)
            assert view[key]["value"][k] * size == pytest.approx(value, rel=1e-12)
            assert view[key]["sigma"][k] * size == pytest.approx(row[1], rel=1e-12)
            assert view[key]["interval"][k] * size == pytest.approx(interval, rel=1e-12)
    for k, axis in enumerate("xyz"):
        assert csv[f"bias_{axis}"][0] == pytest.approx(table[f"bias {axis}"][0], rel=1e-12)
        assert view["bias"]["value"][k] / G * 1e6 == pytest.approx(table[f"bias {axis}"][0], rel=1e-12)
