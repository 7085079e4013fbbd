"""What every exporter has to do, as functions that raise AssertionError when it does not.

They take the class and build it with its defaults, so that a new file in `exporters/`, or one that another package
installs, is held to them without an edit here. READERS apply a file as its target does; a class without one is held to
everything but the round trip.
"""

from __future__ import annotations

import dataclasses
import inspect
import io
import json
import re
import typing
from collections.abc import Callable, Mapping

import numpy as np
import yaml

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.cli.export import command
from accelcal_cli.errors import UsageError
from accelcal_cli.exporters.base import EXPORTERS, Exporter
from accelcal_cli.notices import Notice
from accelcal_cli.sensor.triad import Triad

READING = np.array([[0.3, -4.0, 8.9], [1.0, 9.7, -0.2], [-5.0, 5.0, -6.0]])
"""Readings of a sensor in m/s^2, shape (3, 3)."""

TYPES = (int, float, str, bool)
"""Types that an option of the command line can have."""

Reader = Callable[[bytes, Float, float | None], Float]
"""From a file, readings, shape (B, 3), and their temperature to the force that the target makes of them."""


def _px4(content: bytes, reading: Float, degrees: float | None) -> Float:
    """Accelerometer::Correct after calc_thermal_offsets_3D."""
    rows = [line.split("\t") for line in content.decode().splitlines() if not line.startswith("#")]
    values = {row[2]: float(row[3]) for row in rows}
    types = {row[2]: row[4] for row in rows}
    assert all((kind == "6") == name.endswith(("_ENABLE", "_ID")) for name, kind in types.items())
    offset = np.array([values[f"CAL_ACC0_{axis}OFF"] for axis in "XYZ"])
    if degrees is not None and values.get("TC_A_ENABLE") == 1:
        low, high, reference = (values[f"TC_A0_{key}"] for key in ("TMIN", "TMAX", "TREF"))
        delta = min(max(degrees, low), high) - reference
        for power in range(4):
            offset = offset + delta**power * np.array([values[f"TC_A0_X{power}_{i}"] for i in range(3)])
    return (reading - offset) * np.array([values[f"CAL_ACC0_{axis}SCALE"] for axis in "XYZ"])


def _ardupilot(content: bytes, reading: Float, degrees: float | None) -> Float:
    """_rotate_and_correct_accel after TCal::correct_sensor."""
    rows = [line.split(",") for line in content.decode().splitlines() if not line.startswith("#")]
    values = {name: float(value) for name, value in rows}
    offset = np.array([values[f"INS_ACCOFFS_{axis}"] for axis in "XYZ"])
    if degrees is not None and values.get("INS_TCAL1_ENABLE") == 1:
        coefficients = [[values[f"INS_TCAL1_ACC{p}_{axis}"] for axis in "XYZ"] for p in (1, 2, 3)]

        def drift(temperature: float) -> Float:
            t = min(max(temperature, values["INS_TCAL1_TMIN"]), values["INS_TCAL1_TMAX"]) - 35.0
            return 1e-6 * sum(t ** (p + 1) * np.array(row) for p, row in enumerate(coefficients))

        reading = reading - drift(degrees) + drift(values["INS_ACC1_CALTEMP"])
    return (reading - offset) * np.array([values[f"INS_ACCSCAL_{axis}"] for axis in "XYZ"])


def _kalibr(content: bytes, reading: Float, _: float | None) -> Float:
    accelerometers = yaml.safe_load(content)["imu0"]["accelerometers"]
    return np.linalg.solve(accelerometers["M"], (reading - accelerometers["b"]).T).T


def _imucal(content: bytes, reading: Float, _: float | None) -> Float:
    record = json.loads(content)
    matrix = np.array(record["K_a"]) @ np.array(record["R_a"])
    return np.linalg.solve(matrix, (reading - record["b_a"]).T).T


def _ros(content: bytes, reading: Float, _: float | None) -> Float:
    file = yaml.safe_load(content)
    return reading @ np.reshape(file["SM"], (3, 3)).T - file["bias"]


def _c_header(content: bytes, reading: Float, degrees: float | None) -> Float:
    text = content.decode()
    found = re.findall(r"static const double accelcal_(\w+)[^=]+= \{(.*?)\};", text, re.DOTALL)
    arrays = {name: np.array([float(v) for v in re.findall(r"[-\d.e]+", cells)]) for name, cells in found}
    if degrees is not None:
        t = degrees - float(re.findall(r"#define ACCELCAL_TEMPERATURE (\S+)", text)[0])
        D = arrays["D_a"]
        reading = (reading - D - arrays["bias_slope"] * t) / (1.0 + arrays["scale_slope"] * t) + D
    return reading @ arrays["K_A"].reshape(3, 3).T - arrays["f_0"]


def _numpy(content: bytes, reading: Float, degrees: float | None) -> Float:
    with np.load(io.BytesIO(content)) as file:
        if degrees is not None:
            t = degrees - file["temperature_reference"]
            plain = (reading - file["D_a"] - file["bias_slope"] * t) / (1.0 + file["scale_slope"] * t)
            return plain @ file["K_A"].T
        return reading @ file["K_A"].T - file["f_0"]


READERS: Mapping[str, Reader] = {
    "ardupilot": _ardupilot,
    "c-header": _c_header,
    "imucal": _imucal,
    "kalibr": _kalibr,
    "numpy": _numpy,
    "px4": _px4,
    "ros": _ros,
}


def describes_itself(cls: type[Exporter]) -> None:
    """One line of help, a suffix, and options that the command line can take and that mean the same everywhere."""
    assert (cls.__doc__ or "").splitlines()[0].endswith("."), "the docstring begins with one sentence"
    assert re.fullmatch(r"\.\w+", cls.suffix), "the suffix is a dot and a word"
    own = set(inspect.signature(command).parameters)
    others = [EXPORTERS.get(name) for name in EXPORTERS.names()]
    for field in dataclasses.fields(cls):
        assert field.name not in own, f"{field.name} is an option of the command itself"
        assert field.default is not dataclasses.MISSING, f"{field.name} has no default"
        assert field.metadata.get("doc"), f"{field.name} is not made with schema.setting"
        hint = typing.get_type_hints(cls)[field.name]
        assert {hint, *typing.get_args(hint)} & set(TYPES), f"{field.name}: {hint} is no type of an option"
        for other in others:
            for theirs in dataclasses.fields(other):
                if theirs.name == field.name:
                    assert typing.get_type_hints(other)[field.name] == hint, f"{field.name}: another type"
                    assert theirs.metadata["doc"] == field.metadata["doc"], f"{field.name}: another meaning"


def writes_the_same_bytes(cls: type[Exporter], result: Calibration) -> None:
    """A file is not empty, and the same whenever it is written."""
    content = cls().export(result).content
    assert content
    assert content == cls().export(result).content, "two exports differ"


def is_text_unless_binary(cls: type[Exporter], result: Calibration) -> None:
    """Text is UTF-8 and ends its last line; anything else calls itself binary."""
    content = cls().export(result).content
    if not cls.binary:
        assert "\0" not in content.decode()
        assert content.endswith(b"\n"), "the last line does not end"


def names_its_origin(cls: type[Exporter], result: Calibration) -> None:
    """Version, verdict and the sha256 of the readings stand in the file, and what speaks against the numbers."""
    doubtful = dataclasses.replace(result, warnings=(Notice("residuals", "warning", "The sensor moved."),))
    content = cls().export(doubtful).content
    parts = (
        result.data["sha256"],
        f"verdict {result.verdict}",
        f"accelcal {result.version}",
        "The sensor moved.",
    )
    for part in parts:
        assert any(part.encode(code) in content for code in ("utf-8", "utf-16-le", "utf-32-le")), f"no {part}"


def refuses_or_tells_what_it_cannot_hold(cls: type[Exporter], with_slopes: Calibration) -> None:
    """Temperature slopes that are not held are refused, or a warning and the file tell that they are left out."""
    try:
        export = cls().export(with_slopes)
    except UsageError:
        return
    if cls().held(with_slopes) == "all":
        return
    told = [warning for warning in export.warnings if "temperature slopes" in warning and "1 g at" in warning]
    assert told, "nothing tells of the slopes"
    text = re.sub(r"\s+", " ", export.content.decode())
    assert all(warning in text for warning in told), "the file does not tell of the slopes"


def gives_the_force(cls: type[Exporter], result: Calibration, scale: float, read: Reader) -> None:
    """A file, applied as its target does, gives the force of the result, within what its warnings tell.

    Args:
        result: a calibration with misalignments; scale: its readings per m/s^2. A format that cannot know what its
            target makes of such readings refuses them.
    """
    try:
        export = cls().export(result)
    except UsageError:
        if scale == 1.0:
            raise AssertionError("readings in m/s^2 are refused") from None
        return
    force = read(export.content, scale * READING, None)
    exact = result.model.specific_force(scale * READING)
    if not any("misalignments" in warning for warning in export.warnings):
        np.testing.assert_allclose(force, exact, rtol=1e-12, atol=1e-12)
        return
    diagonal = (scale * READING - result.D_a) * Triad.of(result.K_a).scale
    np.testing.assert_allclose(force, diagonal, rtol=1e-7, atol=1e-7)


def gives_the_force_at_other_temperatures(
    cls: type[Exporter], with_slopes: Calibration, read: Reader
) -> None:
    """A file, applied as its target does, follows temperature as far as it holds slopes, and else by what it tells.

    Args:
        with_slopes: a calibration with slopes, of readings in m/s^2.
    """
    drift, export, held = with_slopes.temperature, cls().export(with_slopes), cls().held(with_slopes)
    assert drift is not None
    still = read(export.content, READING, drift.reference if held == "all" else None)
    for degrees in (drift.low, drift.high):
        exact = with_slopes.model.specific_force(
            drift.at_reference(READING, np.full(len(READING), degrees), with_slopes.D_a)
        )
        force = read(export.content, READING, degrees)
        if held == "all":
            np.testing.assert_allclose(force, exact, rtol=1e-12, atol=1e-12)
            continue
        moved = exact - with_slopes.model.specific_force(READING)
        lengths = np.linalg.norm(exact, axis=1) / with_slopes.g
        told = next(w for w in export.warnings if "temperature slopes" in w)
        bound = float(re.findall(r"up to ([-\d.e]+) m/s\^2 at 1 g", told)[0])
        if held == "bias":
            by_bias = (READING - with_slopes.D_a - drift.bias * (degrees - drift.reference)) * Triad.of(
                with_slopes.K_a
            ).scale
            np.testing.assert_allclose(force, by_bias, rtol=1e-6, atol=1e-6)
            moved = moved - (force - still) @ Triad.of(with_slopes.K_a).axes
        else:
            np.testing.assert_array_equal(force, still)
        assert (np.linalg.norm(moved, axis=1) <= 1.1 * bound * np.maximum(lengths, 1.0)).all()
        assert np.linalg.norm(moved, axis=1).max() >= 0.1 * bound, "the bound says nothing"
