"""What every exporter is, and what all formats share: the origin of the numbers, their units, and what a format drops.

A format is one file: a frozen dataclass derived from `Exporter` and entered in `EXPORTERS`. Help, completion, the
documentation and the contract tests follow from the class.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from accelcal_cli.errors import UsageError
from accelcal_cli.registry import Registry
from accelcal_cli.schema import Checked, from_mapping, setting

if TYPE_CHECKING:  # the help of `accelcal export` does not wait for numpy
    from accelcal_cli.arrays import Float
    from accelcal_cli.calibration.result import Calibration, Temperature
    from accelcal_cli.sensor.model import ErrorModel
    from accelcal_cli.sensor.triad import Triad
    from accelcal_cli.sensor.vehicle import VehicleCorrection

NEAR_ONE = (0.5, 2.0)
"""Scale factors of readings that are specific force already, in m/s^2 or in g."""

Slopes = Literal["none", "bias", "all"]
"""Which slopes with temperature a file holds: none, those of the bias, or those of the scale factors as well."""

CELSIUS = (-70.0, 150.0)
"""Temperatures of a sensor in degrees Celsius; in kelvin, or in units of a converter, they are others."""


@dataclass(frozen=True)
class Export:
    """A file in another tool's format, and what a user should know before using it."""

    content: bytes
    warnings: tuple[str, ...] = ()

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all; OutputError where it cannot be written."""
        from accelcal_cli.output.files import whole_file

        with whole_file(str(path), binary=True) as file:
            file.write(self.content)

    def __str__(self) -> str:
        """The content; what is no text as far as it can be shown."""
        return self.content.decode(errors="replace")


@dataclass(frozen=True)
class Exporter(Checked, ABC):
    """Base of all exporters; the fields of a subclass are the options of `accelcal export` that it takes.

    Fields are made with `schema.setting`, which holds their help and range. An option that several formats take has
    one name, one type and one help text in all of them. The first line of the docstring is the one-line help.
    """

    name: ClassVar[str]
    suffix: ClassVar[str]
    """Usual ending of a file of this format."""
    binary: ClassVar[bool] = False
    """Whether the content is no text, so that it cannot go to a terminal."""
    slopes: ClassVar[Slopes] = "none"
    """Which slopes with temperature the format has a place for."""

    def export(self, result: Calibration) -> Export:
        """Return a result in this format; whether its verdict allows that is the caller's concern.

        Raises:
            UsageError: the format cannot hold this result.
        """
        return Export(self.content(result), self.warnings(result))

    @abstractmethod
    def content(self, result: Calibration) -> bytes:
        """Return the file, which begins with its `header`.

        Raises:
            UsageError: the format cannot hold this result.
        """

    def header(self, result: Calibration) -> list[str]:
        """Return lines that every file holds: where its numbers come from, and which temperature slopes it lacks."""
        return [*origin(result), *(f"Warning: {text}." for text in self._slopes_left_out(result))]

    def warnings(self, result: Calibration) -> tuple[str, ...]:
        """Return what the file leaves out, a sentence each: here slopes with temperature that it does not hold."""
        return self._slopes_left_out(result)

    def held(self, result: Calibration) -> Slopes:  # noqa: ARG002  # of some formats it depends on the result
        """Return which slopes the file of a result with slopes holds."""
        return self.slopes

    def why_no_slopes(self, result: Calibration) -> str:  # noqa: ARG002  # of other formats
        """Return why the file holds no slopes at all."""
        if self.slopes == "none":
            return "this format has no temperature slopes"
        limits = f"{CELSIUS[0]:g} to {CELSIUS[1]:g}"
        return (
            f"temperature slopes are left out, because the temperatures are not degrees Celsius of {limits}"
        )

    def _slopes_left_out(self, result: Calibration) -> tuple[str, ...]:
        drift, held = result.temperature, self.held(result)
        if drift is None or held == "all":
            return ()
        ends = f"{drift.low:.4g} or {drift.high:.4g} degrees"
        size = f"{left_at_the_ends(result, drift, held):.2g} m/s^2 at 1 g at {ends}"
        if held == "bias":
            return (
                "this format has temperature slopes of the bias only: those of the scale factors are left out, an "
                f"error of up to {size}",
            )
        held_at = f"the numbers hold at {drift.reference:.4g} degrees, with an error of up to {size}"
        return (f"{self.why_no_slopes(result)}: {held_at}",)


EXPORTERS: Registry[Exporter] = Registry(
    Exporter, "accelcal_cli.exporters", "export format", "accelcal.exporters"
)


def export(result: Calibration | str | Path, to: str, *, force: bool = False, **options: Any) -> Export:
    """Return a result in the format of another tool.

    Args:
        result: the calibration, or its file; to: name of the format, one of `EXPORTERS.names()`.
        force: use a result although its verdict is undetermined.
        options: of the format, see its class.

    Raises:
        ConfigError: no such format or option. UsageError: the format cannot hold this result.

    Examples:
        >>> from accelcal_cli import calibrate, export, simulate
        >>> result = calibrate(simulate("mems", positions=24).output)
        >>> file = export(result, "c-header")
        >>> "accel" in str(file)
        True
    """
    from accelcal_cli.calibration.result import Calibration, load_result

    exporter = from_mapping(EXPORTERS.get(to), options, f"--to {to}")
    calibration = result if isinstance(result, Calibration) else load_result(result)
    calibration.check_determined("result" if isinstance(result, Calibration) else str(result), force=force)
    return exporter.export(calibration)


INSTANCE = "number of the accelerometer in the target, from 0; without it that of the vehicle's log, else 0"


def left_at_the_ends(result: Calibration, drift: Temperature, held: Slopes) -> float:
    """Return the largest error of the force, m/s^2 at 1 g, at the coldest or warmest pose without slopes not held."""
    import numpy as np

    span = max(drift.high - drift.reference, drift.reference - drift.low)
    bias = 0.0 if held == "bias" else float(np.linalg.norm(result.model.K_A @ drift.bias))
    scale = result.g * float(np.linalg.norm(result.model.K_A @ np.diag(drift.scale) @ result.K_a, 2))
    return (scale + bias) * span * metres_per_unit(result)


@dataclass(frozen=True)
class DriverExporter(Exporter):
    """Base of the formats of targets that correct what a driver makes of the sensor's output, in m/s^2."""

    instance: int | None = setting(None, INSTANCE, low=0)
    driver_scale: float | None = setting(
        None, "output units that the target's driver takes for 1 m/s^2", above=0
    )

    def in_metres(self, result: Calibration) -> ErrorModel:
        """Return the error model of readings that are in m/s^2 before they are corrected.

        Readings in g are multiplied by 9.80665 on both sides; others by what the driver makes of them.

        Raises:
            UsageError: the readings are neither, and no driver scale says what the target makes of them; or a driver
                scale that is not that of these readings.
        """
        from accelcal_cli.sensor.model import ErrorModel

        unit = self.driver_unit(result)
        return ErrorModel(result.K_a * (unit / metres_per_unit(result)), result.D_a * unit)

    def driver_unit(self, result: Calibration) -> float:
        """Return what the driver makes of one unit of the readings, m/s^2.

        Raises:
            UsageError: see `in_metres`.
        """
        from accelcal_cli.sensor.model import sensitivity

        metres = metres_per_unit(result)
        scale = sensitivity(result.K_a) / metres
        if self.driver_scale is not None:
            near = scale / self.driver_scale
            if not (NEAR_ONE[0] < near.min() and near.max() < NEAR_ONE[1]):
                raise UsageError(
                    f"--driver-scale {self.driver_scale:g}: the calibrated readings are {scale.mean():.6g} per m/s^2; "
                    f"expected a number within a factor of {NEAR_ONE[1]:g} of that"
                )
            return 1.0 / self.driver_scale
        if not is_force(result):
            raise UsageError(
                f"--to {self.name} needs readings in m/s^2, and these are in output units, {scale.mean():.6g} per "
                f"m/s^2; state with --driver-scale how many the driver takes for 1 m/s^2"
            )
        return metres


def is_mounted(result: Calibration) -> bool:
    """Whether the result knows how the sensor lies in the body: its attitudes were known."""
    return result.settings.get("attitudes") == "known"


BODY = {
    "lower": "x along the x sensor axis, y in the plane of the x and y sensor axes (gauge lower)",
    "upper": "z along the z sensor axis, y in the plane of the y and z sensor axes (gauge upper)",
    "symmetric": "as near as can be to the three sensor axes (gauge symmetric)",
    "full": "wherever the search ended (gauge full without known attitudes): only the length of the force counts",
}
"""Where the axes of the calibrated force lie, by gauge."""


def frame(result: Calibration) -> str:
    """Return a sentence that says which axes the force has that a whole matrix makes."""
    axes = "those of the reference fx, fy, fz" if is_mounted(result) else BODY[result.gauge]
    return f"Axes of the force: {axes}."


def origin(result: Calibration) -> list[str]:
    """Return lines that say where the numbers come from; every file holds them."""
    lines = [
        f"accelcal {result.version}, verdict {result.verdict}, {result.poses} poses, g = {result.g:.9g} {result.unit}, "
        f"gauge {result.gauge}",
        f"readings {result.data.get('source', '?')}, sha256 {result.data.get('sha256', '?')}",
        *(f"{key}: {value}" for key, value in result.meta.items()),
        *(f"{notice.severity}: {notice}" for notice in result.warnings),
    ]
    return [" ".join(line.split()) for line in lines]


def comment(lines: Iterable[str], mark: str = "#") -> str:
    """Return lines as comments."""
    return "".join(f"{mark} {line}\n" for line in lines)


def rows(matrix: Float) -> list[list[float]]:
    """Return a matrix as lists of plain numbers."""
    return [[float(v) for v in row] for row in (matrix if matrix.ndim == 2 else [matrix])]


def is_force(result: Calibration) -> bool:
    """Return whether the readings are specific force already, in the unit of the result."""
    from accelcal_cli.sensor.model import sensitivity

    scale = sensitivity(result.K_a)
    return bool(NEAR_ONE[0] < scale.min() and scale.max() < NEAR_ONE[1])


def metres_per_unit(result: Calibration) -> float:
    """Return how many m/s^2 one unit of the calibrated force is: 9.80665 for g, 1 for m/s^2."""
    from accelcal_cli.sensor.model import OUTPUT_OF_1_G, STANDARD_GRAVITY

    return STANDARD_GRAVITY / OUTPUT_OF_1_G[result.unit]


STRAIGHT = 1.0
"""Degrees between the axes of the log and the body frame up to which a mounting is not told of."""


@dataclass(frozen=True)
class DiagonalExporter(DriverExporter):
    """Base of the formats of targets that correct axis by axis, know no misalignments, and turn the board afterwards.

    They get the sensor's own triad of axes, and the mounting of known attitudes apart from it. Readings of a vehicle's
    log were corrected by its parameters already, which the log tells: the new ones replace these.
    """

    orientation: ClassVar[str]
    """The target's parameter of the board orientation, one of ORIENTATIONS."""
    slopes = "bias"

    def export(self, result: Calibration) -> Export:
        """Return the result in this format, as one of the driver's readings."""
        return super().export(self.of_driver(result))

    def of_driver(self, result: Calibration) -> Calibration:
        """Return the result as it is of the driver's readings, before a vehicle corrected them."""
        from dataclasses import replace

        import numpy as np

        correction, drift = self.correction(result), result.temperature
        if correction is None or correction.doubt:
            return result
        K, D = correction.of_driver(result.K_a, result.D_a)
        if drift is not None:
            scale = np.abs(np.array(correction.turn)).T @ drift.scale
            drift = replace(drift, bias=correction.undone(drift.bias), scale=scale)
        K_A = np.linalg.inv(K)
        return replace(result, K_a=K, D_a=D, K_A=K_A, f_0=K_A @ D, temperature=drift)

    def correction(self, result: Calibration) -> VehicleCorrection | None:
        """Return what a vehicle of this system had done to the readings, None where they are of no such log."""
        from accelcal_cli.sensor.vehicle import VehicleCorrection

        correction = VehicleCorrection.from_record(result.data.get("correction"))
        return correction if correction is not None and correction.system == self.name else None

    def number(self, result: Calibration) -> int:
        """Return the number of the accelerometer: as stated, or that of the log, or 0."""
        correction = self.correction(result)
        return self.instance if self.instance is not None else correction.instance if correction else 0

    def why_no_slopes(self, result: Calibration) -> str:
        """Return that the target has slopes of its own, or that temperatures are none."""
        correction = self.correction(result)
        if correction is not None and correction.thermal:
            return "the vehicle compensated temperature before, and goes on with it, so temperature slopes are left out"
        return super().why_no_slopes(result)

    def held(self, result: Calibration) -> Slopes:
        """Return that slopes of the bias are held where temperatures are degrees Celsius, as the target measures."""
        drift, correction = result.temperature, self.correction(result)
        if correction is not None and correction.thermal:
            return "none"
        return "bias" if drift and CELSIUS[0] <= drift.low and drift.high <= CELSIUS[1] else "none"

    def bias_slopes(self, result: Calibration) -> Float | None:
        """Return the slopes of the bias, m/s^2 per degree Celsius, shape (3,); None where the file holds none."""
        drift = result.temperature
        return None if drift is None or self.held(result) == "none" else drift.bias * self.driver_unit(result)

    def triad(self, result: Calibration) -> tuple[Float, Triad]:
        """Return the offset, m/s^2, shape (3,), and the triad of readings in m/s^2."""
        from accelcal_cli.sensor.triad import Triad

        model = self.in_metres(result)
        return model.D, Triad.of(model.K)

    def notes(self, result: Calibration) -> list[str]:
        """Return lines for the file: the error that is left, the mounting where it is known, and the warnings."""
        from accelcal_cli.sensor.triad import Triad

        triad, metres = Triad.of(result.K_a), result.g * metres_per_unit(result)
        mounting, correction = self._mounting(result, triad), self.correction(result)
        return [
            *([] if correction is None else [f"{correction.in_words()}."]),
            "Scales: of the sensor's own axes, with the least rms error over all directions that a scale for each axis "
            f"can leave: {triad.rms * metres:.3g} m/s^2 at 1 g, at most {triad.worst * metres:.3g} m/s^2.",
            *(f"Mounting, not in the numbers: {text}." for text in mounting),
            *(f"Warning: {text}." for text in self._left_out(result, triad)),
        ]

    def warnings(self, result: Calibration) -> tuple[str, ...]:
        """Return the misalignments, slopes with temperature, and the mounting that are left out."""
        from accelcal_cli.sensor.triad import Triad, angle

        triad = Triad.of(result.K_a)
        correction = self.correction(result)
        doubt = () if correction is None or not correction.doubt else (correction.in_words(),)
        turned = triad.mirrored or angle(triad.axes) > STRAIGHT
        mounting = self._mounting(result, triad) if turned else ()
        told = (f"the mounting is not in the numbers: {text}" for text in mounting)
        return (*doubt, *self._left_out(result, triad), *super().warnings(result), *told)

    def _mounting(self, result: Calibration, triad: Triad) -> tuple[str, ...]:
        return (triad.in_words(self.orientation),) if is_mounted(result) else ()

    def _left_out(self, result: Calibration, triad: Triad) -> tuple[str, ...]:
        from accelcal_cli.sensor.model import AXIS_PAIRS, MRAD, misalignment
        from accelcal_cli.sensor.poses import AXES

        if result.held.any():
            return ()
        missed, metres = misalignment(result.K_a), result.g * metres_per_unit(result)
        k = int(abs(missed).argmax())
        i, j = AXIS_PAIRS[k]
        size = abs(float(missed[k]))
        return (
            f"this format has no misalignments: axes {AXES[i]} and {AXES[j]} miss 90 degrees by {size * MRAD:.3g} "
            f"mrad ({size:.3f} rad), an error of {triad.rms * metres:.2g} m/s^2 rms over all directions and up to "
            f"{triad.worst * metres:.2g} m/s^2 at 1 g",
        )
