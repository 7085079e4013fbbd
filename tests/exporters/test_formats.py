"""Every format, applied as its target would, gives the specific force of the result."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
import subprocess

import numpy as np
import pytest
import yaml
from simulated import MEMS, readings, rotation

from accelcal_cli.calibration.apply import ColumnOptions, Correction
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import ConfigError, UsageError
from accelcal_cli.exporters.base import EXPORTERS
from accelcal_cli.io.readings import Readings, read_readings
from accelcal_cli.notices import Notice
from accelcal_cli.schema import from_mapping
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import STANDARD_GRAVITY, ErrorModel
from accelcal_cli.sensor.triad import Triad

G = 9.8
COUNTS = ErrorModel(415.0 * MEMS.K, 415.0 * MEMS.D + 120.0)
READING = np.array([[0.3, -4.0, 8.9], [1.0, 9.7, -0.2], [-5.0, 5.0, -6.0]])


def result(model=MEMS, g=G, gauge="lower"):
    settings = Settings(optimizer="levenberg-marquardt", g=g, gauge=gauge)
    return calibrate(readings(poses.turns(), model=model, g=g, sigma=1e-4 * g), settings)


@pytest.fixture(scope="module")
def metres():
    return result()


@pytest.fixture(scope="module")
def in_g():
    return result(ErrorModel(MEMS.K, MEMS.D / G), 1.0)


@pytest.fixture(scope="module")
def counts():
    return result(COUNTS)


@pytest.fixture(scope="module")
def turned():
    """Known attitudes, mounted at random."""
    turn = rotation(4)
    u = G * poses.turns()
    output = ErrorModel(MEMS.K @ turn, MEMS.D).output(u)
    return calibrate(Readings.from_array(output, reference=u), Settings(g=G, attitudes="known"))


def export(found, name, **options):
    return from_mapping(EXPORTERS.get(name), options, name).export(found)


def text(made):
    return made.content.decode()


def diagonal(K, D, reading):
    return (reading - D) * Triad.of(K).scale


def parameters(made, separator):
    rows = [line.split(separator) for line in text(made).splitlines() if not line.startswith("#")]
    return {
        row[-3] if separator == "\t" else row[0]: float(row[-2] if separator == "\t" else row[1])
        for row in rows
    }


def autopilot(values, offset, scale, reading):
    """(reading - offset) * scale, axis by axis: PX4's Accelerometer::Correct and ArduPilot's backend."""
    off = np.array([values[offset.format(axis)] for axis in "XYZ"])
    return (reading - off) * np.array([values[scale.format(axis)] for axis in "XYZ"])


AUTOPILOTS = {
    "px4": ("\t", "CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE"),
    "ardupilot": (",", "INS_ACCOFFS_{}", "INS_ACCSCAL_{}"),
}


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_an_autopilot_gets_the_diagonal_model(metres, name):
    separator, offset, scale = AUTOPILOTS[name]
    made = export(metres, name)
    force = autopilot(parameters(made, separator), offset, scale, READING)
    np.testing.assert_allclose(force, diagonal(metres.K_a, metres.D_a, READING), rtol=1e-7, atol=1e-7)
    exact = metres.model.specific_force(READING) @ Triad.of(metres.K_a).axes.T
    told = float(made.warnings[0].split("and up to ")[1].split()[0])
    lengths = np.linalg.norm(exact, axis=1)
    assert (np.linalg.norm(force - exact, axis=1) <= 1.05 * told * lengths / G + 1e-6).all()


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_readings_in_g_are_metres_to_an_autopilot(in_g, name):
    separator, offset, scale = AUTOPILOTS[name]
    values = parameters(export(in_g, name), separator)
    force = autopilot(values, offset, scale, READING * STANDARD_GRAVITY)
    np.testing.assert_allclose(
        force, STANDARD_GRAVITY * diagonal(in_g.K_a, in_g.D_a, READING), rtol=1e-7, atol=1e-6
    )


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_counts_need_the_scale_of_the_driver(counts, name):
    separator, offset, scale = AUTOPILOTS[name]
    with pytest.raises(UsageError, match="--driver-scale"):
        export(counts, name)
    values = parameters(export(counts, name, driver_scale=417.7), separator)
    raw = READING * 415.0
    force = autopilot(values, offset, scale, raw / 417.7)
    np.testing.assert_allclose(force, diagonal(counts.K_a, counts.D_a, raw), rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize("name", AUTOPILOTS)
@pytest.mark.parametrize("driver_scale", [1.0, 9.81, 4150.0])
def test_a_driver_scale_of_other_readings_is_refused(counts, name, driver_scale):
    with pytest.raises(UsageError, match=f"--driver-scale {driver_scale:g}: the calibrated readings are 41"):
        export(counts, name, driver_scale=driver_scale)


def test_warnings_stand_in_the_comments(metres):
    doubtful = dataclasses.replace(metres, warnings=(Notice("residuals", "warning", "The sensor moved."),))
    for name in ("px4", "ardupilot", "kalibr", "ros", "c-header"):
        assert "warning: The sensor moved." in text(export(doubtful, name))


def numbers(made):
    return [line for line in text(made).splitlines() if not line.startswith("#")]


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_an_autopilot_gets_the_same_numbers_in_every_gauge(metres, name):
    for gauge in ("upper", "symmetric", "full"):
        other = export(result(gauge=gauge), name)
        for line, expected in zip(numbers(other), numbers(export(metres, name)), strict=True):
            assert line.replace("\t", ",").split(",")[0] == expected.replace("\t", ",").split(",")[0]
        np.testing.assert_allclose(
            list(parameters(other, AUTOPILOTS[name][0]).values()),
            list(parameters(export(metres, name), AUTOPILOTS[name][0]).values()),
            rtol=1e-6,
            atol=1e-8,
        )


def test_no_diagonal_leaves_a_smaller_rms_error(metres):
    from scipy.optimize import minimize
    from scipy.spatial.transform import Rotation

    u = poses.fibonacci(2000)

    def rms(values):
        frame = Rotation.from_rotvec(values[3:]).as_matrix()
        error = (G * u @ metres.K_a.T) * values[:3] - G * u @ frame.T
        return np.sqrt((error**2).sum(axis=1).mean())

    start = np.concatenate([1.0 / np.diagonal(metres.K_a), np.zeros(3)])
    least = minimize(
        rms, start, method="Nelder-Mead", options={"maxiter": 6000, "fatol": 1e-12, "xatol": 1e-8}
    )
    told = float(text(export(metres, "px4")).split("can leave: ")[1].split()[0])
    assert told == pytest.approx(least.fun, rel=5e-3)
    triad = Triad.of(metres.K_a)
    assert triad.rms * G == pytest.approx(least.fun, rel=1e-3)
    np.testing.assert_allclose(triad.scale, least.x[:3], rtol=1e-4)
    for gauge in ("lower", "symmetric"):
        K = metres.model.in_gauge(gauge).K
        assert np.linalg.norm(K / np.diagonal(K)[:, None] - np.eye(3)) / np.sqrt(3) >= triad.rms


def test_instances_have_their_names(metres):
    assert "CAL_ACC2_XOFF" in text(export(metres, "px4", instance=2))
    assert "INS_ACC2OFFS_X" in text(export(metres, "ardupilot", instance=1))
    assert text(export(metres, "kalibr", instance=1)).count("imu1:") == 1
    for name, instance in (("px4", 4), ("ardupilot", 3)):
        with pytest.raises(
            ConfigError, match=f"instance: {instance} is too large; expected at most {instance - 1}"
        ):
            export(metres, name, instance=instance)


def test_parameters_that_an_autopilot_would_refuse_are_told():
    odd = result(ErrorModel(MEMS.K, MEMS.D + 5.0))
    assert any("3.5 m/s^2" in warning for warning in export(odd, "ardupilot").warnings)


@pytest.mark.parametrize("which", ["metres", "in_g", "counts"])
def test_kalibr_has_the_whole_model_in_gauge_lower(which, request):
    found = request.getfixturevalue(which)
    imu = yaml.safe_load(text(export(found, "kalibr")))["imu0"]
    M, b = np.array(imu["accelerometers"]["M"]), np.array(imu["accelerometers"]["b"])
    assert (np.triu(M, 1) == 0).all()
    assert imu["model"] == "scale-misalignment"
    raw, factor = (
        (READING * 415, 1.0) if which == "counts" else (READING, STANDARD_GRAVITY if which == "in_g" else 1.0)
    )
    force = np.linalg.solve(M, (raw * factor - b).T).T
    np.testing.assert_allclose(force, factor * found.model.in_gauge("lower").specific_force(raw), rtol=1e-12)
    assert [key for key, value in imu.items() if value is None] == [
        "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_noise_density", "gyroscope_random_walk",
        "update_rate", "rostopic",
    ]  # fmt: skip
    assert "PLACEHOLDERS" in text(export(found, "kalibr"))


@pytest.mark.parametrize(("which", "unit"), [("metres", "m/s^2"), ("in_g", "g"), ("counts", "a.u.")])
def test_imucal_corrects_with_two_matrices(which, unit, request):
    found = request.getfixturevalue(which)
    record = json.loads(text(export(found, "imucal")))
    K, R, b = (np.array(record[key]) for key in ("K_a", "R_a", "b_a"))
    raw = READING * (415 if which == "counts" else 1)
    force = (np.linalg.inv(R) @ np.linalg.inv(K) @ (raw - b).T).T
    np.testing.assert_allclose(force, found.model.specific_force(raw), rtol=1e-12, atol=1e-12)
    assert (record["cal_type"], record["_format_version"]) == ("Ferraris", "2.0.0")
    assert (record["acc_unit"], record["from_acc_unit"]) == (found.unit, unit)
    np.testing.assert_array_equal(record["K_g"], np.eye(3))


@pytest.mark.parametrize(
    ("which", "unit"), [("metres", "m/s^2"), ("in_g", "g"), ("counts", "a.u."), ("turned", "m/s^2")]
)
def test_imucal_itself_loads_and_applies_the_file(which, unit, request, tmp_path):
    imucal = pytest.importorskip("imucal")
    management = pytest.importorskip("imucal.management")
    found = request.getfixturevalue(which)
    path = tmp_path / "calibration.json"
    path.write_bytes(export(found, "imucal").content)
    info = management.load_calibration_info(path)
    assert isinstance(info, imucal.FerrarisCalibrationInfo)
    raw = READING * (415 if which == "counts" else 1)
    gyroscope = np.array([[1.0, -2.0, 3.0]] * len(raw))
    force, rate = info.calibrate(raw, gyroscope, acc_unit=unit, gyr_unit="deg/s")
    np.testing.assert_allclose(force, found.model.specific_force(raw), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(rate, gyroscope)
    np.testing.assert_allclose(np.linalg.norm(info.R_a, axis=1), 1.0, rtol=1e-12)
    assert info.acc_unit == found.unit


@pytest.mark.parametrize("which", ["metres", "in_g", "counts"])
def test_ros_subtracts_the_bias_after_the_matrix(which, request):
    found = request.getfixturevalue(which)
    file = yaml.safe_load(text(export(found, "ros")))
    raw = READING * (415 if which == "counts" else 1)
    force = raw @ np.reshape(file["SM"], (3, 3)).T - file["bias"]
    metres_per_unit = STANDARD_GRAVITY if which == "in_g" else 1.0
    np.testing.assert_allclose(
        force, metres_per_unit * found.model.specific_force(raw), rtol=1e-12, atol=1e-12
    )


# Temperature: what `accelcal apply` makes of readings, and what the target of a file does

SCALE_SLOPES, BIAS_SLOPES = np.array([4e-4, -3e-4, 2e-4]), np.array([3e-3, -2e-3, 5e-3])


def drifting(factor=1.0, g=G, kelvin=0.0):
    """A result with slopes, of readings `factor` per m/s^2; with g = 1 they are in units of g."""
    model = ErrorModel(factor * MEMS.K, factor * MEMS.D * (g / G))
    u = np.concatenate([poses.turns(), poses.fibonacci(24)])
    degrees = np.repeat([12.0, 40.0], 24)
    t = (degrees - 26.0)[:, None]
    N = (1 + SCALE_SLOPES * t) * (g * u @ model.K.T) + model.D + factor * (g / G) * BIAS_SLOPES * t
    N += 1e-4 * factor * g * np.random.default_rng(3).standard_normal(N.shape)
    return calibrate(
        Readings.from_array(N, temperature=degrees + kelvin),
        Settings(optimizer="levenberg-marquardt", g=g),
    )


@pytest.fixture(scope="module")
def warm():
    return drifting()


def applied(found, reading, degrees):
    """The force of `accelcal apply`, which has the temperature as fourth column."""
    return Correction(found, ColumnOptions())(np.column_stack([reading, np.full(len(reading), degrees)]))


def thermal(name, values, degrees):
    """What the autopilot subtracts before its offset at a temperature, m/s^2."""
    if name == "px4":
        t = np.clip(degrees, values["TC_A0_TMIN"], values["TC_A0_TMAX"]) - values["TC_A0_TREF"]
        return sum(t**p * np.array([values[f"TC_A0_X{p}_{i}"] for i in range(3)]) for p in range(4))

    def polynomial(temperature):
        t = np.clip(temperature, values["INS_TCAL1_TMIN"], values["INS_TCAL1_TMAX"]) - 35.0
        coefficients = [np.array([values[f"INS_TCAL1_ACC{p}_{axis}"] for axis in "XYZ"]) for p in (1, 2, 3)]
        return 1e-6 * sum(t ** (p + 1) * row for p, row in enumerate(coefficients))

    return polynomial(degrees) - polynomial(values["INS_ACC1_CALTEMP"])


@pytest.mark.parametrize("name", AUTOPILOTS)
@pytest.mark.parametrize("degrees", [14.0, 39.0])
@pytest.mark.parametrize("kind", ["metres", "in_g", "counts"])
def test_an_autopilot_follows_the_bias_with_temperature(name, degrees, kind):
    """Beside the scale slopes, whose size the file tells, it comes to what apply gives at any temperature."""
    separator, offset, scale = AUTOPILOTS[name]
    found = drifting(*{"metres": (1.0, G), "in_g": (1.0, 1.0), "counts": (415.0, G)}[kind])
    options = {"driver_scale": 417.7} if kind == "counts" else {}
    made = export(found, name, **options)
    values = parameters(made, separator)
    drift, still = found.temperature, dataclasses.replace(found.temperature, scale=np.zeros(3))
    raw = READING * {"metres": 1.0, "in_g": 1 / G, "counts": 415.0}[kind]
    metres = {"metres": 1.0, "in_g": STANDARD_GRAVITY, "counts": 1 / 417.7}[kind]
    force = autopilot(values, offset, scale, raw * metres - thermal(name, values, degrees))
    without = drift.at_reference(raw, np.full(3, degrees), found.D_a)
    by_bias = still.at_reference(raw, np.full(3, degrees), found.D_a)
    to_metres = STANDARD_GRAVITY if kind == "in_g" else 1.0
    np.testing.assert_allclose(force, to_metres * diagonal(found.K_a, found.D_a, by_bias), atol=1e-5)
    assert np.abs(force - to_metres * diagonal(found.K_a, found.D_a, raw)).max() > 0.02
    (told,) = (w for w in made.warnings if "slopes of the bias only" in w)
    bound = float(told.split("up to ")[1].split()[0])
    left = to_metres * (applied(found, raw, degrees) - found.model.specific_force(by_bias))
    np.testing.assert_allclose(applied(found, raw, degrees), found.model.specific_force(without), rtol=1e-12)
    lengths = np.linalg.norm(READING, axis=1) / G
    assert (np.linalg.norm(left, axis=1) <= 1.05 * bound * lengths).all()
    assert told in text(made)


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_an_autopilot_measures_in_degrees_celsius(name):
    made = export(drifting(kelvin=273.0), name)
    assert "TC_A" not in text(made)
    assert "TCAL" not in text(made)
    (told,) = (w for w in made.warnings if "degrees Celsius" in w)
    assert "the numbers hold at 299 degrees" in told
    assert told in text(made)


def test_thermal_parameters_have_the_number_of_their_instance(warm):
    assert {"TC_A2_TREF", "CAL_ACC2_XOFF"} <= set(parameters(export(warm, "px4", instance=2), "\t"))
    second = parameters(export(warm, "ardupilot", instance=1), ",")
    assert {"INS_TCAL2_ENABLE", "INS_ACC2_CALTEMP", "INS_ACC2OFFS_X"} <= set(second)
    assert second["INS_ACC2_CALTEMP"] == pytest.approx(26.0)


def test_px4_is_told_the_device(warm, metres):
    nameless, named = export(warm, "px4"), export(warm, "px4", device_id=1310988)
    assert any("--device-id" in warning for warning in nameless.warnings)
    assert not any("--device-id" in warning for warning in named.warnings)
    values = parameters(named, "\t")
    assert values["CAL_ACC0_ID"] == values["TC_A0_ID"] == 1310988
    assert "TC_A0_ID\t1310988\t6\n" in text(named)
    assert "TC_A" not in text(export(metres, "px4", device_id=1310988))


def test_a_format_without_slopes_tells_what_is_left(warm):
    for name in ("kalibr", "ros", "imucal"):
        (told,) = (w for w in export(warm, name).warnings if "no temperature slopes" in w)
        assert told in text(export(warm, name))
        bound = float(told.split("up to ")[1].split()[0])
        left = applied(warm, READING, 40.0) - warm.model.specific_force(READING)
        assert np.linalg.norm(left, axis=1).max() <= 1.1 * bound


def test_numpy_has_the_slopes(warm, metres):
    with np.load(io.BytesIO(export(warm, "numpy").content)) as file:
        t = 40.0 - file["temperature_reference"]
        plain = (READING - file["D_a"] - file["bias_slope"] * t) / (1 + file["scale_slope"] * t)
        np.testing.assert_allclose(plain @ file["K_A"].T, applied(warm, READING, 40.0), rtol=1e-12)
        np.testing.assert_array_equal(file["temperature_range"], [12.0, 40.0])
        np.testing.assert_array_equal(file["slope_covariance"], warm.temperature.covariance)
    with np.load(io.BytesIO(export(metres, "numpy").content)) as file:
        assert "scale_slope" not in file


WARM_PROGRAM = """
#include <stdio.h>
#include "calibration.h"
int main(void) {{
    const double readings[3][3] = {{{rows}}}, degrees[2] = {{14.0, 39.0}};
    double force[3];
    for (int k = 0; k < 2; k++) {{
        for (int j = 0; j < 3; j++) {{
            accelcal_apply_at(readings[j], degrees[k], force);
            printf("%.17g %.17g %.17g\\n", force[0], force[1], force[2]);
        }}
    }}
    return 0;
}}
"""


@pytest.mark.parametrize("language", ["c", "c++"])
def test_the_c_header_follows_temperature(warm, tmp_path, language):
    force = compiled(export(warm, "c-header"), WARM_PROGRAM, tmp_path, language)
    expected = np.concatenate([applied(warm, READING, degrees) for degrees in (14.0, 39.0)])
    np.testing.assert_allclose(force, expected, rtol=1e-12, atol=1e-12)
    assert np.abs(expected - np.tile(warm.model.specific_force(READING), (2, 1))).max() > 0.05


PROGRAM = """
#include <stdio.h>
#include "calibration.h"
int main(void) {{
    const double readings[3][3] = {{{rows}}};
    double force[3];
    for (int j = 0; j < 3; j++) {{
        accelcal_apply(readings[j], force);
        printf("%.17g %.17g %.17g\\n", force[0], force[1], force[2]);
    }}
    return 0;
}}
"""


def compiled(made, program, folder, language):
    """What a program with the header prints, as numbers, shape (B, 3)."""
    compiler = shutil.which("cc") if language == "c" else shutil.which("c++")
    if compiler is None:
        pytest.skip("no compiler")
    (folder / "calibration.h").write_bytes(made.content)
    rows = ", ".join("{" + ", ".join(map(repr, row)) + "}" for row in READING.tolist())
    source = folder / f"main.{'c' if language == 'c' else 'cc'}"
    source.write_text(program.format(rows=rows))
    flags = ["-Wall", "-Wextra", "-Werror", "-pedantic", *(["-std=c99"] if language == "c" else [])]
    subprocess.run([compiler, *flags, str(source), "-o", str(folder / "main")], check=True)
    printed = subprocess.run([folder / "main"], check=True, capture_output=True, text=True).stdout
    return np.array([[float(v) for v in line.split()] for line in printed.splitlines()])


@pytest.mark.parametrize("language", ["c", "c++"])
def test_the_c_header_compiles_and_applies(metres, tmp_path, language):
    force = compiled(export(metres, "c-header"), PROGRAM, tmp_path, language)
    np.testing.assert_allclose(force, metres.model.specific_force(READING), rtol=1e-12, atol=1e-12)
    assert '#define ACCELCAL_UNIT "m/s^2"' in text(export(metres, "c-header"))


def test_numpy_arrays(metres):
    with np.load(io.BytesIO(export(metres, "numpy").content)) as file:
        np.testing.assert_allclose(
            READING @ file["K_A"].T - file["f_0"],
            metres.model.specific_force(READING),
            rtol=1e-12,
            atol=1e-12,
        )
        np.testing.assert_array_equal(file["K_a"], metres.K_a)
        np.testing.assert_array_equal(file["D_a"], metres.D_a)
        assert (float(file["g"]), str(file["unit"])) == (G, "m/s^2")
        assert metres.data["sha256"] in str(file["origin"])


def test_an_unknown_format_is_refused(metres):
    with pytest.raises(ConfigError, match='unknown export format "px5" \\(did you mean "px4"'):
        export(metres, "px5")


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_the_misalignment_of_a_real_sensor_is_warned_of(shared_data, name):
    found = calibrate(
        read_readings(shared_data / "ctu_innalabs" / "static_24.csv"),
        Settings(optimizer="levenberg-marquardt", g=1.0),
    )
    made = export(found, name)
    for place in (made.warnings[0], text(made)):
        assert "mrad (0.053 rad)" in place
        assert "axes x and z miss 90 degrees" in place
