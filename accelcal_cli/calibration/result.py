"""The result of a calibration: one frozen record that carries its units, its uncertainty and its origin.

The parts of a calibration's record: sigma, dilution of precision, poses.

Plain values to arrays and back, for records that go through JSON and YAML.

From the plain values of a record back to the parts of a calibration, each checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import (
    ALIGNED,
    BIAS,
    MISALIGNMENT,
    PARAMETERS,
    SCALE,
    UNDETERMINED,
    Verdict,
)
from accelcal_cli.calibration.settings import LARGEST
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.sensor.model import GAUGES, ErrorModel

SCHEMA = "accelcal/calibration/1"
"""Name and version of the record; a reader refuses what it does not know."""


@dataclass(frozen=True, eq=False)
class Temperature:
    """How a sensor changes with temperature; the other parameters of a result hold at `reference`.

    Attributes:
        reference: T_0; low, high: of the poses, in the unit of the temperature column.
        scale: k_i, relative change of the scale factors per degree, shape (3,).
        bias: b_i, change of the bias per degree, output units, shape (3,).
        sigma_scale, sigma_bias: their one-sigma, shape (3,).
        dop: dilution of precision of the slopes, taken as force at half the range, shape (6,).
    """

    reference: float
    low: float
    high: float
    scale: Float
    bias: Float
    sigma_scale: Float
    sigma_bias: Float
    dop: Float

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Temperature:
        """Return the slopes of a record.

        Raises:
            KeyError, TypeError, ValueError: a part is missing or of another kind.
        """
        reference, low, high = (float(record[key]) for key in ("reference", "low", "high"))
        scale, bias = (array(record[key], (3,), whole=True) for key in ("scale", "bias"))
        sigma_scale, sigma_bias = (array(record[key], (3,)) for key in ("sigma_scale", "sigma_bias"))
        dop = array(record["dop"], (6,))
        return cls(reference, low, high, scale, bias, sigma_scale, sigma_bias, dop)

    def at_reference(self, output: Float, degrees: Float, D: Float) -> Float:
        """Return readings as they would be at the reference temperature, shape (B, 3).

        Args:
            output: readings, shape (B, 3); degrees: their temperature, shape (B,).
            D: D_a at the reference temperature, shape (3,).
        """
        t = (degrees - self.reference)[:, None]
        brought: Float = (output - D - self.bias * t) / (1.0 + self.scale * t) + D
        return brought


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated accelerometer. Units: f in m/s^2 (units of g when g = 1), N in output units.

    Attributes:
        K_a: pulse-equivalent matrix, shape (3, 3), output units per m/s^2, in `gauge`.
        D_a: bias, shape (3,), output units.
        K_A: inverse matrix, shape (3, 3); f_0 = K_A D_a, shape (3,), m/s^2.
        gauge: lower, upper, symmetric or full.
        sigma: one-sigma of K_a and D_a.
        dop: dilution of precision.
        verdict: good, weak or undetermined; `reasons` says why in sentences.
        suggestions: poses that would mend it.
        cautions: sentences about residuals and search that do not change the verdict, which is of the poses.
        cost_search: L after the search, cost: L after the polish (the same without one), (m/s^2)^4.
        rms, rms_before: of |f| - g after and before, m/s^2; `before` says what the readings were taken for.
        s: standard deviation of one pose's modulus, m/s^2, with known attitudes of one axis; NaN without freedom.
        freedom: J - 9 degrees of freedom, J - 15 with slopes with temperature, 3 J - 12 with known attitudes.
        noise_ratio, noise_chance: s over what the scatter within the poses predicts, and the chance of so large a
            ratio; None where nothing tells them.
        covariance: of the nine parameters in gauge `lower`, (m/s^2)^2, shape (9, 9); NaN where they have no sigma.
        information: J^T J of the nine parameters, shape (9, 9): what the poses say of them; never without a number.
        nominal_scale, nominal_bias: what the engineering view is relative to, output units per m/s^2 and output
            units, shape (3,): the stated nominal sensor, or round numbers and no bias.
        poses: J.
        evaluations: of the cost, search and polish together.
        runs, runs_agreeing: searches made, and how many ended in the best one's minimum.
        poses_fit: residuals pose by pose (all up to 1000 poses, the worst 20 of more).
        outliers: numbers of the poses that do not fit, from 0.
        convergence: best cost so far against evaluations, of the best run, thinned.
        optimizer: its name; settings: everything needed to repeat the run.
        g: local gravity, m/s^2, or 1.
        data: source, sha256, columns of the readings.
        notes: sentences about the data and the search that a user should know.
        version: of accelcal; schema: SCHEMA.
        temperature: slopes with temperature, when the readings determine them.
    """

    K_a: Float
    D_a: Float
    K_A: Float
    f_0: Float
    gauge: str
    sigma: Sigma
    dop: Dop
    verdict: str
    reasons: tuple[str, ...]
    suggestions: tuple[str, ...]
    cautions: tuple[str, ...]
    cost_search: float
    cost: float
    rms: float
    rms_before: float
    before: str
    s: float
    freedom: int
    noise_ratio: float | None
    noise_chance: float | None
    covariance: Float
    information: Float
    nominal_scale: Float
    nominal_bias: Float
    poses: int
    evaluations: int
    runs: int
    runs_agreeing: int
    poses_fit: tuple[PoseFit, ...]
    outliers: tuple[int, ...]
    convergence: tuple[tuple[int, float], ...]
    optimizer: str
    settings: dict[str, Any]
    g: float
    data: dict[str, Any]
    notes: tuple[str, ...]
    version: str
    schema: str = SCHEMA
    temperature: Temperature | None = None

    @property
    def model(self) -> ErrorModel:
        """The sensor in the result's gauge."""
        return ErrorModel(self.K_a, self.D_a)

    @property
    def unit(self) -> str:
        """Unit of the specific force: g when the readings were calibrated against g = 1."""
        return "g" if self.g == 1.0 else "m/s^2"

    @property
    def held(self) -> NDArray[np.bool_]:
        """Which of the nine parameters were not estimated but taken as zero, shape (9,)."""
        return np.zeros(9, dtype=bool) if self.settings.get("misalignment", True) else ALIGNED

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which of the nine parameters are not determined, shape (9,).

        Definition: in an undetermined result, dilution of precision above 25, or no sigma.
        """
        if self.verdict != "undetermined":
            return np.zeros(9, dtype=bool)
        poor: NDArray[np.bool_] = np.array(list(self.dop.parameters.values())) > UNDETERMINED
        return poor | np.isnan(np.diagonal(self.covariance))

    def check_determined(self, name: str, *, force: bool = False) -> None:
        """Refuse to be used where the poses left parameters undetermined, unless forced.

        Raises:
            UsageError: the verdict is undetermined; `name` is named in the message.
        """
        if self.verdict == "undetermined" and not force:
            why = f" ({self.reasons[0].rstrip('.')})" if self.reasons else ""
            raise UsageError(
                f"{name}: its verdict is undetermined{why}; calibrate anew, or use it with --force"
            )

    def record(self) -> dict[str, Any]:
        """Return the record as plain mappings, lists, numbers and text; NaN and inf become None."""
        record: dict[str, Any] = plain(self)
        return record

    @classmethod
    def from_record(cls, record: Mapping[str, Any], where: str) -> Calibration:
        """Return the calibration of a record.

        Raises:
            DataError: not a record of this schema, or a part missing.
        """
        if record.get("schema") != SCHEMA:
            raise DataError(f'{where}: schema is {record.get("schema")!r}; expected "{SCHEMA}"')
        record = {"temperature": None, "cautions": [], **record}
        missing = [f.name for f in fields(cls) if f.name not in record]
        if missing:
            raise DataError(f"{where}: not a whole calibration result; missing: {', '.join(missing)}")
        return cls(**{f.name: checked(f.name, record[f.name], where) for f in fields(cls)})


@dataclass(frozen=True, eq=False)
class Sigma:
    """One-sigma of the parameters; NaN where the poses do not determine them.

    Attributes:
        K_a: shape (3, 3), output units per m/s^2.
        D_a: shape (3,), output units.
    """

    K_a: Float
    D_a: Float


@dataclass(frozen=True)
class Dop:
    """Dilution of precision: the error of a parameter, as m/s^2 at 1 g, over the noise of one pose in m/s^2.

    Attributes:
        misalignment, scale, bias: the largest of each kind.
        worst: the largest of all.
        parameters: each of the nine by its name.
    """

    misalignment: float
    scale: float
    bias: float
    worst: float
    parameters: dict[str, float]

    @classmethod
    def of(cls, dop: Float) -> Dop:
        """Return the record of the dilution of precision of the nine parameters, shape (9,)."""
        misalignment, scale, bias = (float(dop[kind].max()) for kind in (MISALIGNMENT, SCALE, BIAS))
        return cls(
            misalignment, scale, bias, float(dop.max()), dict(zip(PARAMETERS, dop.tolist(), strict=True))
        )


@dataclass(frozen=True)
class PoseFit:
    """One pose. Units: m/s^2 (units of g when g = 1).

    Attributes:
        pose: its number, from 0; where: its line or label in the input.
        residual: |f| - g; with known attitudes |f| - |reference|.
        studentised: residual over its standard deviation, by the s of the other poses; with known attitudes by the s
            of all poses.
        leverage: part of its own residual that the fit absorbs.
        left_out: the residual that a fit without the pose would leave.
        residual_before: |f| - g before calibration.
        direction: unit vector of the specific force, gauge `lower`.
    """

    pose: int
    where: str
    residual: float
    studentised: float
    leverage: float
    left_out: float
    residual_before: float
    direction: tuple[float, float, float]


MOST = 2**53
"""Largest count: up to here floats hold every whole number."""


def plain(value: Any) -> Any:
    """Return a value as plain mappings, lists, numbers and text; NaN and inf become None."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float):  # numpy's too, which YAML does not know
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    return value


def array(value: Any, shape: tuple[int, ...], *, whole: bool = False) -> Float:
    """Return nested lists as an array of a shape, None as NaN.

    Raises:
        ValueError, TypeError: another shape, no numbers, or None although it is to be `whole`.
    """
    found = np.array(
        [
            [math.nan if v is None else v for v in row]
            if isinstance(row, list)
            else (math.nan if row is None else row)
            for row in value
        ],
        dtype=float,
    )
    if found.shape != shape:
        raise ValueError(f"expected {' x '.join(map(str, shape))} numbers")
    if whole and not np.isfinite(found).all():
        raise ValueError("a number is missing")
    return found


def of_kind(value: Any, kinds: tuple[type, ...], words: str) -> Any:
    """Return a value of one of the kinds; a truth value is no number.

    Raises:
        ValueError: another kind.
    """
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise ValueError(f"{value!r} where {words} was expected")
    if kinds == (int,) and isinstance(value, int) and abs(value) > MOST:
        raise ValueError(f"a number beyond {MOST} where {words} was expected")
    return value


def check_size(value: Any, depth: int = 4) -> None:
    """Refuse a whole number that no float can be, in a value or in lists and mappings `depth` deep.

    Raises:
        OverflowError: there is one.
    """
    if isinstance(value, int):
        float(value)
    elif depth and isinstance(value, list | Mapping):
        for part in value.values() if isinstance(value, Mapping) else value:
            check_size(part, depth - 1)


def or_nan(value: Any) -> float:
    """Return a number, NaN for None."""
    return math.nan if value is None else float(value)


def or_infinite(value: Any) -> float:
    """Return a number, infinity for None."""
    return math.inf if value is None else float(value)


SHAPES = {
    "K_a": (3, 3),
    "D_a": (3,),
    "K_A": (3, 3),
    "f_0": (3,),
    "covariance": (9, 9),
    "information": (9, 9),
    "nominal_scale": (3,),
    "nominal_bias": (3,),
}
WHOLE = ("K_a", "D_a", "K_A", "f_0", "information")
"""Arrays in which a missing number is a fault of the file."""

SENTENCES = ("reasons", "suggestions", "cautions", "notes")

CHOICES = {"gauge": GAUGES, "verdict": get_args(Verdict)}
NUMBERS_OR_NAN = ("s", "rms", "rms_before", "cost", "cost_search")

KINDS: dict[str, tuple[tuple[type, ...], str]] = {
    **dict.fromkeys(("freedom", "poses", "evaluations", "runs", "runs_agreeing"), ((int,), "a whole number")),
    **dict.fromkeys(
        ("reasons", "suggestions", "cautions", "notes", "outliers", "poses_fit"), ((list,), "a list")
    ),
    **dict.fromkeys(("data", "settings"), ((dict,), "a mapping")),
    **dict.fromkeys(("before", "optimizer", "version"), ((str,), "text")),
    **dict.fromkeys(("noise_ratio", "noise_chance"), ((int, float, type(None)), "a number")),
}


def checked(name: str, value: Any, where: str) -> Any:
    """Return a part of the result from the plain value of its record.

    Args:
        name: of the field of `Calibration`; value: as JSON or YAML have it.
        where: the file, for the message.

    Raises:
        DataError: another kind or shape, or a part missing.
    """
    try:
        check_size(value)
        return _rebuild(name, value)
    except OverflowError:
        raise DataError(
            f"{where}: not a calibration result: {name}: holds a number that is too large"
        ) from None
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise DataError(f"{where}: not a calibration result: {name}: {reason}") from None


def _rebuild(name: str, value: Any) -> Any:
    if name in SHAPES:
        return _matrix(name, value)
    if name in KINDS:
        of_kind(value, *KINDS[name])
    if name in SENTENCES:
        for entry in value:
            of_kind(entry, (str,), "text")
    if name == "sigma":
        return Sigma(array(value["K_a"], (3, 3)), array(value["D_a"], (3,)))
    if name in CHOICES and value not in CHOICES[name]:
        raise ValueError(f"{value!r} is not one of {', '.join(CHOICES[name])}")
    if name == "g" and not 0 < of_kind(value, (int, float), "a positive number") < math.inf:
        raise ValueError(f"{value!r} where a positive number was expected")
    if name == "temperature" and value is not None:
        return Temperature.from_record(value)
    if name == "dop":
        parameters = {key: or_infinite(v) for key, v in value["parameters"].items()}
        kinds = {kind: or_infinite(value[kind]) for kind in ("misalignment", "scale", "bias", "worst")}
        return Dop(**kinds, parameters=parameters)
    if name == "poses_fit":
        return tuple(_pose_fit(row) for row in value)
    if name == "convergence":
        return tuple((int(n), float(cost)) for n, cost in value)
    if name in NUMBERS_OR_NAN:
        return or_nan(value)
    return tuple(value) if isinstance(value, list) else value


def _pose_fit(row: Mapping[str, Any]) -> PoseFit:
    """Return one pose; a key too many or too few is a TypeError."""
    direction = array(row["direction"], (3,), whole=True)
    known: dict[str, Any] = {k: math.nan if v is None else v for k, v in row.items()}
    return PoseFit(**{**known, "direction": tuple(direction.tolist())})


def _matrix(name: str, value: Any) -> Float:
    found = array(value, SHAPES[name], whole=name in WHOLE)
    if name == "K_a" and not (np.abs(found) <= LARGEST).all():
        raise ValueError(f"holds a number beyond {LARGEST:g}")
    if name == "K_a" and not (np.abs(found).max() >= 1 / LARGEST and np.linalg.matrix_rank(found) == 3):
        raise ValueError("is singular; expected an invertible matrix")
    return found
