"""The record of a calibration: parameters with units, uncertainty, verdict and origin; out to files and back.

A field of `Calibration` is a key of result files. `schema` writes and checks it by what the field declares, so that a
new field is one line, its docstring, and `older` for the files that were written before it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Literal

import numpy as np
from numpy.typing import ArrayLike

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.distributions import student_freedom, student_quantile
from accelcal_cli.calibration.observability import (
    ALIGNED,
    BIAS,
    MISALIGNMENT,
    PARAMETERS,
    ROWS_COLUMNS,
    SCALE,
    UNDETERMINED,
    engineering_chain,
    engineering_quantities,
    propagated,
)
from accelcal_cli.calibration.provenance import check_meta
from accelcal_cli.calibration.settings import LARGEST
from accelcal_cli.config import parse_mapping, read_text
from accelcal_cli.errors import ConfigError, DataError, UsageError
from accelcal_cli.notices import Notice
from accelcal_cli.schema import Limits, array, from_mapping, frozen, to_mapping
from accelcal_cli.sensor.model import OUTPUT_OF_1_G, ErrorModel, Gauge

if TYPE_CHECKING:
    import polars
    from matplotlib.axes import Axes

NEAR_G = 0.02
"""Local gravity is within this part of 9.80665 m/s^2, anywhere."""

SCHEMA = "accelcal/calibration/3"
"""Name and version of the record; a reader refuses what it does not know.

Its poses are numbered from 1, as in tables and pictures; in memory they are numbered from 0."""

OLDER, FROM_ZERO = "accelcal/calibration/1", "accelcal/calibration/2"
"""The versions before it, which are read, too: see `_of_older`; the second numbered poses from 0."""

RESULTS = (".yaml", ".yml", ".json")
"""Endings of a result file; they choose its form."""

ENGINEERING = ("value", "sigma", "interval")
"""Keys of each kind in the engineering view of a record."""

Verdict = Literal["good", "weak", "suspect", "undetermined"]
"""Of a calibration: that of its poses, lowered by a warning and by what the search and the count of poses say."""

MOST = 2**53
"""Largest count: up to here floats hold every whole number."""

Count = Annotated[int, Limits(high=MOST)]
MaybeNan = Annotated[float, Limits(none=math.nan)]
MaybeInfinite = Annotated[float, Limits(none=math.inf)]
Vector = Annotated[Float, array(3)]
MaybeVector = Annotated[Float, array(3, none=math.nan)]
Matrix = Annotated[Float, array(3, 3)]
"""Numbers and arrays as a result file has them; those that may be missing are null there."""


@frozen(eq=False)
class Temperature:
    """How a sensor changes with temperature; the other parameters of a result hold at `reference`.

    Attributes:
        reference: T_0; low, high: of the poses, in the unit of the temperature column.
        scale: k_i, relative change of the scale factors per degree, shape (3,).
        bias: b_i, change of the bias per degree, output units, shape (3,).
        sigma_scale, sigma_bias: their one-sigma, shape (3,).
        interval_scale, interval_bias: half-widths of their 95 % intervals, shape (3,).
        dop: dilution of precision of the slopes, taken as force at half the range, shape (6,).
        covariance: of the nine parameters and the six slopes, all as force, (m/s^2)^2, shape (15, 15); NaN in files of
            earlier versions.
    """

    reference: float
    low: float
    high: float
    scale: Vector
    bias: Vector
    sigma_scale: MaybeVector
    sigma_bias: MaybeVector
    interval_scale: MaybeVector
    interval_bias: MaybeVector
    dop: Annotated[Float, array(6, none=math.nan)]
    covariance: Annotated[Float, array(15, 15, none=math.nan)] = field(
        default_factory=lambda: np.full((15, 15), np.nan)
    )

    def with_intervals(self, factor: float) -> Temperature:
        """Return the same slopes with the intervals of a coverage factor, NaN for none."""
        return replace(self, interval_scale=factor * self.sigma_scale, interval_bias=factor * self.sigma_bias)

    def at_reference(self, output: Float, degrees: Float, D: Float) -> Float:
        """Return readings as they would be at the reference temperature, shape (B, 3).

        Args:
            output: readings, shape (B, 3); degrees: their temperature, shape (B,).
            D: D_a at the reference temperature, shape (3,).
        """
        t = (degrees - self.reference)[:, None]
        return np.asarray((output - D - self.bias * t) / (1.0 + self.scale * t) + D)


@frozen(eq=False)
class Worn:
    """What GGIR says of a calibration with days of wear [vanhees2014], beside what the rest of a result says.

    Attributes:
        hours: of the recording; rest_hours: at rest; windows: at rest, of 10 s, the points of GGIR.
        low, high: least and greatest specific force of each axis at rest, parts of g, shape (3,).
        filled: whether each axis was beyond 0.3 g on both sides: without, GGIR does not calibrate.
        error_before, error_after: mean of | |a| - 1 g | over the windows, mg; before: of the readings as they are, NaN
            where their unit is not known.
    """

    hours: float
    rest_hours: float
    windows: Count
    low: Vector
    high: Vector
    filled: bool
    error_before: MaybeNan
    error_after: MaybeNan


@frozen(eq=False)
class Sigma:
    """One-sigma of the parameters, or the half-widths of their intervals; NaN where the poses do not determine them.

    Attributes:
        K_a: shape (3, 3), output units per m/s^2.
        D_a: shape (3,), output units.
    """

    K_a: Annotated[Float, array(3, 3, none=math.nan)]
    D_a: MaybeVector


NO_INTERVAL = Sigma(np.full((3, 3), np.nan), np.full(3, np.nan))


@frozen()
class Dop:
    """Dilution of precision: the error of a parameter, as m/s^2 at 1 g, over the noise of one pose in m/s^2.

    Attributes:
        misalignment, scale, bias: the largest of each kind.
        worst: the largest of all.
        parameters: each of the nine by its name.
    """

    misalignment: MaybeInfinite
    scale: MaybeInfinite
    bias: MaybeInfinite
    worst: MaybeInfinite
    parameters: Annotated[dict[str, float], Limits(none=math.inf)]

    @classmethod
    def of(cls, dop: Float) -> Dop:
        """Return the record of the dilution of precision of the nine parameters, shape (9,)."""
        misalignment, scale, bias = (float(dop[kind].max()) for kind in (MISALIGNMENT, SCALE, BIAS))
        return cls(
            misalignment, scale, bias, float(dop.max()), dict(zip(PARAMETERS, dop.tolist(), strict=True))
        )


@frozen()
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

    pose: Count
    where: str
    residual: MaybeNan
    studentised: MaybeNan
    leverage: MaybeNan
    left_out: MaybeNan
    residual_before: MaybeNan
    direction: tuple[float, float, float]


@frozen(eq=False)
class Calibration:
    """A calibrated accelerometer, which prints, draws, saves and applies itself.

    Units: f in m/s^2 (units of g when g = 1), N in output units.

    Attributes:
        K_a: pulse-equivalent matrix, shape (3, 3), output units per m/s^2, in `gauge`.
        D_a: bias, shape (3,), output units.
        K_A: inverse matrix, shape (3, 3); f_0 = K_A D_a, shape (3,), m/s^2.
        gauge: lower, upper, symmetric or full.
        sigma: one-sigma of K_a and D_a; interval: half-widths of their 95 % intervals, `coverage_factor` times sigma
            (Student's t, None without degrees of freedom), NaN for those that are not determined.
        dop: dilution of precision of the poses as they count; geometry: of their distinct attitudes, each counted once
            and all together as twelve, which the verdict on the poses rests on.
        verdict: good, weak, suspect or undetermined; `reasons` says in sentences what the poses leave open.
        suggestions: poses to add.
        warnings: what speaks against the readings, the fit or the search; one of severity `warning` makes it suspect.
        cost_search: L after the search, cost: L after the polish (the same without one), (m/s^2)^4.
        rms, rms_before: of |f| - g after and before, m/s^2; `before` says what the readings were taken for.
        s: standard deviation of one pose's modulus, m/s^2, with known attitudes of one axis; NaN without freedom.
        freedom: J - 9 degrees of freedom, J - 15 with slopes with temperature, 3 J - 12 with known attitudes.
        residual_noise_ratio, residual_noise_p: s over the noise expected from the scatter within the poses, and the
            p-value of that ratio; None where the readings do not tell.
        covariance: of the nine parameters in gauge `lower`, (m/s^2)^2, shape (9, 9); NaN where they have no sigma.
        shared_noise: standard deviation that the poses share beside the noise of their readings, m/s^2; None where
            their scatter is not known.
        information: J^T J of the nine parameters, shape (9, 9): what the poses say of them; never without a number.
        nominal_scale, nominal_bias: what the engineering view is relative to, output units per m/s^2 and output
            units, shape (3,): the stated nominal sensor, or round numbers and no bias.
        poses: J; attitudes: how many distinct ones they hold, None where they were not counted.
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
        worn: of days of wear, what GGIR says; else None.
        meta: what the user states of it, as serial, operator, temperature; date: when it was calculated, UTC, ISO 8601.
        g_source: where g comes from; empty in files of earlier versions.
    """

    K_a: Annotated[Float, array(3, 3, largest=LARGEST)]
    D_a: Vector
    K_A: Matrix
    f_0: Vector
    gauge: Gauge
    sigma: Sigma
    interval: Sigma
    dop: Dop
    geometry: Dop
    verdict: Verdict
    reasons: tuple[str, ...]
    suggestions: tuple[str, ...]
    warnings: tuple[Notice, ...]
    cost_search: MaybeNan
    cost: MaybeNan
    rms: MaybeNan
    rms_before: MaybeNan
    before: str
    s: MaybeNan
    freedom: Count
    residual_noise_ratio: float | None
    residual_noise_p: float | None
    covariance: Annotated[Float, array(9, 9, none=math.nan)]
    information: Annotated[Float, array(9, 9)]
    nominal_scale: MaybeVector
    nominal_bias: MaybeVector
    poses: Count
    attitudes: Count | None
    evaluations: Count
    runs: Count
    runs_agreeing: Count
    poses_fit: tuple[PoseFit, ...]
    outliers: tuple[Count, ...]
    convergence: tuple[tuple[int, float], ...]
    optimizer: str
    settings: dict[str, Any]
    g: Annotated[float, Limits(above=0)]
    data: dict[str, Any]
    notes: tuple[str, ...]
    version: str
    schema: str = SCHEMA
    temperature: Temperature | None = None
    coverage_factor: float | None = None
    shared_noise: float | None = None
    worn: Worn | None = None
    meta: dict[str, str] = field(default_factory=dict)
    date: str | None = None
    g_source: str = ""

    @property
    def sigma_freedom(self) -> float:
        """Degrees of freedom of sigma, whole or not, by its coverage factor; 0 without one."""
        return 0.0 if self.coverage_factor is None else student_freedom(0.975, self.coverage_factor)

    @property
    def model(self) -> ErrorModel:
        """The sensor in the result's gauge."""
        return ErrorModel(self.K_a, self.D_a)

    @property
    def unit(self) -> str:
        """Unit of the specific force: that of the readings where g was taken in it, as g = 1 is."""
        own = self.data.get("unit")
        near = own in ("g", "mg") and abs(self.g / OUTPUT_OF_1_G[own] - 1.0) < NEAR_G
        return str(own) if near else "g" if self.g == 1.0 else "m/s^2"

    @property
    def held(self) -> Bool:
        """Which of the nine parameters were not estimated but taken as zero, shape (9,)."""
        return np.zeros(9, dtype=bool) if self.settings.get("misalignment", True) else ALIGNED

    @property
    def lost(self) -> Bool:
        """Which of the nine parameters are not determined, shape (9,).

        Definition: in an undetermined result, dilution of precision above 25, or no sigma.
        """
        if self.verdict != "undetermined":
            return np.zeros(9, dtype=bool)
        poor: Bool = np.array([self.geometry.parameters[name] for name in PARAMETERS]) > UNDETERMINED
        return poor | np.isnan(np.diagonal(self.covariance))

    @property
    def lost_entries(self) -> Bool:
        """Which entries of K_a (rows 0 to 2) and D_a (row 3) are not determined, shape (4, 3)."""
        nine = self.lost
        lost = np.zeros((4, 3), dtype=bool)
        for p, (i, j) in enumerate(ROWS_COLUMNS[:6]):
            lost[i, j] = lost[j, i] = nine[p]
        lost[3] = nine[BIAS]
        lost[:3] &= self.K_a != 0  # a zero of the gauge is exact
        return lost

    @property
    def engineering(self) -> tuple[Float, Float]:
        """The engineering view: values and their one-sigma, shape (9,), in the order of PARAMETERS.

        Definition: sensitivities over nominal less 1; angles by which axes miss 90 degrees, rad; bias less nominal as
        force along its axis, m/s^2. None depends on the gauge. Sigma: of the whole covariance, NaN where there is none.
        """
        offset = self.D_a - self.nominal_bias
        values = engineering_quantities(self.K_a, offset)
        sigma = propagated(engineering_chain(self.model.in_gauge("lower").K, offset, self.g), self.covariance)
        size = values[SCALE] / self.nominal_scale
        values[SCALE], sigma[SCALE] = size - 1.0, size * sigma[SCALE]
        return values, sigma

    def interval_of(self, sigma: Float) -> Float:
        """Return the half-widths of the 95 % intervals of the nine, shape (9,), of their one-sigma; NaN for none."""
        factor = math.nan if self.coverage_factor is None else self.coverage_factor
        return np.where(self.lost, np.nan, factor * sigma)

    def with_intervals(self, factor: float) -> Calibration:
        """Return the same result with the 95 % intervals of a coverage factor, NaN for none."""
        lost = self.lost_entries
        interval = Sigma(
            np.where(lost[:3], np.nan, factor * self.sigma.K_a),
            np.where(lost[3], np.nan, factor * self.sigma.D_a),
        )
        slopes = None if self.temperature is None else self.temperature.with_intervals(factor)
        return replace(
            self,
            interval=interval,
            coverage_factor=None if math.isnan(factor) else factor,
            temperature=slopes,
        )

    def apply(self, output: ArrayLike, temperature: ArrayLike | None = None) -> Float:
        """Return the specific force that readings mean, in `unit`, shape (..., 3).

        Args:
            output: N, output units, shape (..., 3).
            temperature: of each reading, shape (...), in the unit of the readings that were calibrated; without it they
                are taken to be at the reference temperature.
        """
        numbers: Float = np.asarray(output, dtype=np.float64)
        if self.temperature is not None and temperature is not None:
            degrees = np.broadcast_to(np.asarray(temperature, dtype=np.float64), numbers.shape[:-1])
            flat = self.temperature.at_reference(numbers.reshape(-1, 3), degrees.ravel(), self.D_a)
            numbers = flat.reshape(numbers.shape)
        return self.model.specific_force(numbers)

    def save(self, path: str | Path) -> None:
        """Write the result file, JSON where the name ends in .json, else YAML; whole or not at all.

        Raises:
            OutputError: it cannot be written.
        """
        from accelcal_cli.output.files import whole_file
        from accelcal_cli.output.machine import result_text

        with whole_file(str(path), binary=True) as file:  # read back as UTF-8, whatever the terminal takes
            file.write(result_text(self, json=str(path).endswith(".json")).encode())

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Return the calibration of a result file, see `load_result`."""
        return load_result(path)

    def to_dict(self) -> dict[str, Any]:
        """Return the record that a result file holds, see `record`."""
        return self.record()

    def to_frame(self) -> polars.DataFrame:
        """Return the parameters as a frame of polars: parameter, value, sigma, half of the 95 % interval, unit."""
        from accelcal_cli.output.machine import frame
        from accelcal_cli.views.calibration import numbers

        return frame(numbers(self))

    def __str__(self) -> str:
        """The verdict, the parameters as they are quoted, and the fit, on at most fifteen lines."""
        from accelcal_cli.views.quoted import text

        return text(self)

    def _repr_pretty_(self, printer: Any, _: bool) -> None:
        """The same where IPython has no HTML."""
        printer.text(str(self))

    def _repr_html_(self) -> str:
        """The same as a table, for notebooks."""
        from accelcal_cli.views.quoted import html

        return html(self)

    def plot_residuals(self, axes: Axes | None = None) -> Axes:
        """Draw |f| - g of every kept pose before and after calibration with matplotlib."""
        from accelcal_cli.output.plot import residuals

        return residuals(self, axes)

    def plot_convergence(self, axes: Axes | None = None) -> Axes:
        """Draw the best cost so far against the evaluations with matplotlib."""
        from accelcal_cli.output.plot import search

        return search(self, axes)

    def plot_intervals(self, axes: Axes | None = None) -> Axes:
        """Draw the nine parameters with their 95 % intervals, in units of the largest of each kind."""
        from accelcal_cli.output.plot import intervals

        return intervals(self, axes)

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
        """Return the record as plain mappings, lists, numbers and text; NaN and inf become None.

        Beside the fields the engineering view, which follows from them and is not read again.
        """
        values, sigma = self.engineering
        columns = (np.where(self.lost | self.held, np.nan, values), sigma, self.interval_of(sigma))
        view = {
            key: {kind: column[part] for kind, column in zip(ENGINEERING, columns, strict=True)}
            for key, part in (("scale_error", SCALE), ("misalignment", MISALIGNMENT), ("bias", BIAS))
        }
        return {**_renumbered(to_mapping(self), 1), "engineering": to_mapping(view)}

    @classmethod
    def from_record(cls, record: Mapping[str, Any], where: str) -> Calibration:
        """Return the calibration of a record.

        Raises:
            DataError: not a record of this schema, a part missing or of another kind; `where` is named in the message.
        """
        older = record.get("schema") == OLDER
        if older:
            record = _of_older(record)
        elif record.get("schema") == FROM_ZERO:
            record = {**record, "schema": SCHEMA}
        elif record.get("schema") == SCHEMA:
            record = _renumbered(record, -1)
        else:
            raise DataError(f'{where}: schema is {record.get("schema")!r}; expected "{SCHEMA}"')
        place = f"{where}: not a calibration result"
        try:
            result = from_mapping(cls, record, place, extra=True)
            if result.meta:
                check_meta(result.meta, f"{place}: meta: ")
        except ConfigError as error:
            raise DataError(str(error)) from None
        for key, dop in (("dop", result.dop), ("geometry", result.geometry)):
            if set(dop.parameters) != set(PARAMETERS):
                raise DataError(f"{place}: {key}: parameters: expected {', '.join(PARAMETERS)}")
        if np.abs(result.K_a).max() < 1 / LARGEST or np.linalg.matrix_rank(result.K_a) < 3:
            raise DataError(f"{place}: K_a: is singular; expected an invertible matrix")
        if not older:
            return result
        freedom = result.freedom
        return result.with_intervals(student_quantile(0.975, freedom) if freedom > 0 else math.nan)


def _renumbered(record: Mapping[str, Any], by: int) -> dict[str, Any]:
    """Return a record with the numbers of its poses moved; what is no number stays, for the reader to refuse."""
    new, fits, outliers = dict(record), record.get("poses_fit"), record.get("outliers")
    if isinstance(fits, list):
        new["poses_fit"] = [
            {**fit, "pose": _moved(fit.get("pose"), by)} if isinstance(fit, Mapping) else fit for fit in fits
        ]
    if isinstance(outliers, list):
        new["outliers"] = [_moved(pose, by) for pose in outliers]
    return new


def _moved(pose: object, by: int) -> object:
    return pose + by if isinstance(pose, int) and not isinstance(pose, bool) else pose


AGAIN = "Calibrate the readings again."
OLD_RULE = Notice(
    "legacy",
    "note",
    "The result was written by an earlier version: its verdict is by the old rule, of the poses alone.",
    AGAIN,
)


def _of_older(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record of schema OLDER as one of SCHEMA; its intervals are still to come.

    A record that is none stays as wrong as it is, for the reader to say so.
    """
    new: dict[str, Any] = {
        "cautions": [],
        **record,
        "schema": SCHEMA,
        "coverage_factor": None,
        "attitudes": None,
    }
    new["geometry"] = new.get("dop")
    new["interval"] = {"K_a": [[None] * 3] * 3, "D_a": [None] * 3}
    for old, key in (("noise_ratio", "residual_noise_ratio"), ("noise_chance", "residual_noise_p")):
        if old in new:
            new[key] = new.pop(old)
    slopes = new.get("temperature")
    if isinstance(slopes, Mapping):
        new["temperature"] = {**slopes, "interval_scale": [None] * 3, "interval_bias": [None] * 3}
    said = new.pop("cautions")
    if isinstance(said, list):
        said = [{"key": "legacy", "severity": "note", "text": text, "remedy": AGAIN} for text in said]
        said.append(to_mapping(OLD_RULE))
    new["warnings"] = said
    return new


def load_result(path: str | Path, stdin: BinaryIO | None = None) -> Calibration:
    """Return the calibration of a result file, JSON or YAML whatever its name says; of `stdin` where it is given.

    Raises:
        ConfigError: unreadable, or neither JSON nor YAML.
        DataError: not the record of a calibration; the message names the key.
    """
    text = read_text(Path(path), stdin)
    try:
        record = parse_mapping(text, str(path))
    except ConfigError as error:
        raise ConfigError(f"{error}; the result file of a calibration was expected") from None
    return Calibration.from_record(record, str(path))


RECORD_HEAD = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s|#[^\n]*\n|---\s)*(?:\{|['\"]?(?:K_a|D_a|schema)['\"]?:)")
"""How the record of a calibration begins, as JSON or YAML in our order of keys or sorted; no table of readings does."""


def is_result(head: bytes) -> bool:
    """Return whether a file that begins so is a result file rather than readings."""
    return RECORD_HEAD.match(head) is not None
