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

Reader = Callable[[bytes, Float], Float]
"""From a file and readings, shape (B, 3), to the force that the target makes of them."""


def _px4(content: bytes, reading: Float) -> Float:
    rows = [line.split("\t") for line in content.decode().splitlines() if not line.startswith("#")]
    values = {row[2]: float(row[3]) for row in rows}
    offset = np.array([values[f"CAL_ACC0_{axis}OFF"] for axis in "XYZ"])
    return (reading - offset) * np.array([values[f"CAL_ACC0_{axis}SCALE"] for axis in "XYZ"])


def _ardupilot(content: bytes, reading: Float) -> Float:
    rows = [line.split(",") for line in content.decode().splitlines() if not line.startswith("#")]
    values = {name: float(value) for name, value in rows}
    offset = np.array([values[f"INS_ACCOFFS_{axis}"] for axis in "XYZ"])
    return (reading - offset) * np.array([values[f"INS_ACCSCAL_{axis}"] for axis in "XYZ"])


def _kalibr(content: bytes, reading: Float) -> Float:
    accelerometers = yaml.safe_load(content)["imu0"]["accelerometers"]
    return np.linalg.solve(accelerometers["M"], (reading - accelerometers["b"]).T).T


def _imucal(content: bytes, reading: Float) -> Float:
    record = json.loads(content)
    matrix = np.array(record["K_a"]) @ np.array(record["R_a"])
    return np.linalg.solve(matrix, (reading - record["b_a"]).T).T


def _ros(content: bytes, reading: Float) -> Float:
    file = yaml.safe_load(content)
    return reading @ np.reshape(file["SM"], (3, 3)).T - file["bias"]


def _c_header(content: bytes, reading: Float) -> Float:
    arrays = re.findall(r"static const double \w+[^=]+= \{(.*?)\};", content.decode(), re.DOTALL)
    matrix, bias = (np.array([float(v) for v in re.findall(r"[-\d.e]+", text)]) for text in arrays)
    return reading @ matrix.reshape(3, 3).T - bias


def _numpy(content: bytes, reading: Float) -> Float:
    with np.load(io.BytesIO(content)) as file:
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
    """Temperature slopes are refused, or a warning tells that they are dropped."""
    try:
        export = cls().export(with_slopes)
    except UsageError:
        return
    assert any("temperature" in warning for warning in export.warnings), "nothing tells of the slopes"


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
    force = read(export.content, scale * READING)
    exact = result.model.specific_force(scale * READING)
    if not any("misalignments" in warning for warning in export.warnings):
        np.testing.assert_allclose(force, exact, rtol=1e-12, atol=1e-12)
        return
    diagonal = (scale * READING - result.D_a) * Triad.of(result.K_a).scale
    np.testing.assert_allclose(force, diagonal, rtol=1e-7, atol=1e-7)
