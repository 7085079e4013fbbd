"""Four real sensors against the numbers of an independent solver of the same cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import read_readings


@dataclass(frozen=True)
class Expected:
    """One row of the table beside the recordings: gauge lower, (11; 21 22; 31 32 33)."""

    file: str
    g: float
    poses: int
    K: tuple[float, ...]
    D: tuple[float, ...]
    cost: float
    rms: float

    @property
    def matrix(self):
        K = np.zeros((3, 3))
        K[np.tril_indices(3)] = self.K
        return K


RECORDINGS = {
    "xsens": Expected(
        "imu_tk_xsens/static_means.csv",
        9.81744,
        38,
        (414.441645, 1.477289, 412.122680, 3.832964, 8.841874, 414.507889),
        (33123.830748, 33275.155024, 32364.493739),
        1.40796808e-2,
        9.80341e-4,
    ),
    "imu0": Expected(
        "mikoff_mpu9150/imu0_static_means.csv",
        9.81,
        23,
        (1.00366706, 0.00045546, 1.00307871, 0.00561164, 0.00198516, 1.00633170),
        (0.10344547, 0.09662583, 0.34399053),
        4.37546083e-2,
        2.223056e-3,
    ),
    "imu1": Expected(
        "mikoff_mpu9150/imu1_static_means.csv",
        9.81,
        24,
        (1.00458482, -0.00009467, 1.00473874, 0.00239229, -0.00481136, 1.00936966),
        (0.08988208, 0.06984718, 0.33806652),
        5.17948672e-2,
        2.367727e-3,
    ),
    "innalabs": Expected(
        "ctu_innalabs/static_24.csv",
        1.0,
        24,
        (0.99368427, 0.01564804, 1.00307581, -0.05348848, -0.00337852, 1.00635152),
        (0.00085329, -0.00518180, 0.01355446),
        1.73922920e-5,
        4.256055e-4,
    ),
}

SEARCHES = {
    "de-pso": {},
    "levenberg-marquardt": {"optimizer": "levenberg-marquardt"},
    "de-pso without polish": {"polish": False},
}


def _agrees(result, expected, relative=1e-6, rounding=6e-9):
    """K relative to its row's scale factor, D relative to g times it; the table prints eight digits."""
    scale = np.diagonal(expected.matrix)
    assert (np.abs(result.K_a - expected.matrix) <= relative * scale[:, None]).all()
    assert (np.abs(result.D_a - expected.D) <= relative * expected.g * scale + rounding).all()


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("name", RECORDINGS)
def test_the_sensor_is_found(shared_data, name, search):
    expected = RECORDINGS[name]
    readings = read_readings(shared_data / expected.file)
    result = calibrate(readings, Settings(g=expected.g, **SEARCHES[search]))
    _agrees(result, expected)
    assert result.poses == expected.poses
    assert result.cost == pytest.approx(expected.cost, rel=1e-6)
    assert result.rms == pytest.approx(expected.rms, rel=1e-5)
    assert result.verdict == "good"
    assert result.rms < 0.1 * result.rms_before


@pytest.mark.parametrize(("name", "before"), [("imu0", 0.207), ("imu1", 0.218), ("innalabs", 15.5e-3)])
def test_what_they_were_before(shared_data, name, before):
    expected = RECORDINGS[name]
    result = calibrate(
        read_readings(shared_data / expected.file), Settings(g=expected.g, optimizer="levenberg-marquardt")
    )
    assert result.rms_before == pytest.approx(before, rel=0.01)


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_seed_and_every_gauge_find_the_same_sensor(shared_data, name):
    expected = RECORDINGS[name]
    readings = read_readings(shared_data / expected.file)
    for seed, gauge in enumerate(("upper", "symmetric", "full", "lower")):
        settings = Settings(g=expected.g, optimizer="levenberg-marquardt", seed=seed, gauge=gauge)
        result = calibrate(readings, settings)
        low = result.model.in_gauge("lower")
        scale = np.diagonal(expected.matrix)
        assert (np.abs(low.K - expected.matrix) <= 1e-6 * scale[:, None]).all()
        assert result.cost == pytest.approx(expected.cost, rel=1e-6)


def test_the_data_sheet_of_the_xsens(shared_data):
    """Scales 415, 413, 415 counts per m/s^2 and offsets 33123, 33276, 32360 counts: another view of the same unit."""
    result = calibrate(read_readings(shared_data / RECORDINGS["xsens"].file), Settings(g=9.81744))
    np.testing.assert_allclose(np.diagonal(result.K_a), [415, 413, 415], rtol=0.003)
    np.testing.assert_allclose(result.D_a, [33123, 33276, 32360], atol=5.0)


def test_a_pose_set_cut_to_a_few_is_not_called_good(shared_data):
    """The first eight poses of each recording are too few, and the verdict says so."""
    from accelcal_cli.io.readings import Readings

    for expected in RECORDINGS.values():
        output = read_readings(shared_data / expected.file).output()
        result = calibrate(
            Readings.from_array(output[:8]), Settings(g=expected.g, optimizer="levenberg-marquardt")
        )
        assert result.verdict == "undetermined"
        assert result.suggestions
