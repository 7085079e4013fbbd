"""A result applied to a log: calibrated specific force beside the readings, or in their place.

Roll and pitch of a body at rest from its calibrated specific force, and their one-sigma.

At rest the specific force points up. With x forward, y to the left and z up a level body has f = (0, 0, g), and

    roll = atan2(f_y, f_z),   pitch = atan2(-f_x, sqrt(f_y^2 + f_z^2)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.known_attitudes import covariance_of_twelve
from accelcal_cli.calibration.observability import gauge_chain
from accelcal_cli.calibration.result import Calibration, load_result
from accelcal_cli.errors import DataError, UsageError, did_you_mean
from accelcal_cli.io.columns import Columns, choose
from accelcal_cli.io.reader import InputTable, Selection, TextTable, open_table
from accelcal_cli.io.rewrite import Change, rewrite
from accelcal_cli.io.stream import Frame, is_frame
from accelcal_cli.notices import Notice
from accelcal_cli.sensor.model import STANDARD_GRAVITY
from accelcal_cli.sensor.poses import AXES

if TYPE_CHECKING:
    import polars

UNITS = {"m/s^2": 1.0, "g": 1.0 / STANDARD_GRAVITY, "mg": 1000.0 / STANDARD_GRAVITY}
"""Units of the specific force, and how many of each are 1 m/s^2."""

LOOKED_AT, USUAL = 10_000, (0.5, 2.0)
"""Readings at the start of a log whose median specific force is looked at, and the multiples of g it usually is."""

TILT = ("roll", "pitch", "sigma_roll", "sigma_pitch")


@dataclass(frozen=True)
class ColumnOptions:
    """What to write.

    Attributes:
        unit: of the specific force: m/s^2, g or mg; that of the result when None.
        replace: in place of the readings; else in columns after all others.
        prefix: name of the new columns before x, y, z.
        tilt: also roll, pitch and their one-sigma in degrees.
        noise: one-sigma of a reading, m/s^2 (units of g when g = 1), for the sigma of the tilt.
    """

    unit: str | None = None
    replace: bool = False
    prefix: str = "f"
    tilt: bool = False
    noise: float = 0.0

    def __post_init__(self) -> None:
        """Refuse an unknown unit, a noise that is none, and a prefix that would break the header."""
        if self.unit is not None and self.unit not in UNITS:
            raise UsageError(
                f'--unit "{self.unit}": unknown{did_you_mean(self.unit, UNITS)}; expected one of {", ".join(UNITS)}'
            )
        if not (math.isfinite(self.noise) and self.noise >= 0):
            raise UsageError(f"--noise {self.noise:g}: expected zero or more")
        if not self.prefix.replace("_", "a").isalnum():
            raise UsageError(f'--prefix "{self.prefix}": expected letters, digits and underscores')

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the new columns."""
        return (*(self.prefix + axis for axis in AXES), *(TILT if self.tilt else ()))


class Correction:
    """New columns from readings, and what the first of them looked like."""

    def __init__(self, result: Calibration, options: ColumnOptions) -> None:
        """Take over the model, the temperature slopes and the options."""
        own = result.unit
        self.g, self.factor = result.g, UNITS[options.unit or own] / UNITS[own]
        self.result = result
        self.tilt = Tilt.of(result, options.noise) if options.tilt else None
        self.first: float | None = None

    def __call__(self, numbers: Float) -> Float:
        """Return the new columns, shape (B, k), of output, shape (B, 3), or with temperature, shape (B, 4)."""
        force = self.result.apply(numbers[:, :3], numbers[:, 3] if numbers.shape[1] > 3 else None)
        if self.first is None and len(force):
            self.first = float(np.median(np.linalg.norm(force[:LOOKED_AT], axis=1))) / self.g
        scaled = force if self.factor == 1.0 else force * self.factor
        return scaled if self.tilt is None else np.concatenate([scaled, self.tilt.columns(force)], axis=1)

    def warnings(self) -> tuple[Notice, ...]:
        """Return what the first readings say against the result, once they have come."""
        if self.first is None or USUAL[0] <= self.first <= USUAL[1]:
            return ()
        text = f"The first readings come out as {self.first:.3g} g (median), not 1 g."
        return (Notice("unit", "warning", text, "Give them in the unit of those that were calibrated."),)


@dataclass(frozen=True)
class Log:
    """A log and what is to become of it.

    Attributes:
        table: the log, open and not read yet.
        change: the new columns; formula: what they are made by.
        notes: what a user should know.
    """

    table: InputTable
    change: Change
    formula: Correction
    notes: tuple[str, ...]

    def write(self, file: IO[bytes], *, parquet: bool = False) -> None:
        """Write the changed log, in constant memory.

        Args:
            file: where to; with `parquet` a file that has a name.
            parquet: as Parquet instead of text.

        Raises:
            DataError: a reading that is wrong, by its line and column.
        """
        if isinstance(self.table, TextTable) and not parquet:
            rewrite(self.table, self.change, file)
            return
        from accelcal_cli.io.parquet import to_parquet, to_text

        (to_parquet if parquet else to_text)(self.table, self.change, file)


@overload
def apply(
    result: Calibration | str | Path,
    data: Frame | str | Path,
    *,
    columns: list[str] | None = ...,
    force: bool = ...,
    **options: Any,
) -> polars.DataFrame: ...


@overload
def apply(
    result: Calibration | str | Path, data: ArrayLike, *, force: bool = ..., **options: Any
) -> Float: ...


def apply(
    result: Calibration | str | Path,
    data: Frame | ArrayLike | str | Path,
    *,
    columns: list[str] | None = None,
    force: bool = False,
    **options: Any,
) -> polars.DataFrame | Float:
    """Apply a calibration to readings of any kind: what they mean as specific force.

    Args:
        result: the calibration, or its file.
        data: a log, in a file or a frame, or an array of outputs, shape (..., 3).
        columns: see `read_readings`.
        force: use a result although its verdict is undetermined.
        options: fields of `ColumnOptions`, of a log.

    Returns:
        The log as a frame of polars with the columns fx, fy, fz beside its own; the forces, shape (..., 3), of an
        array.

    Raises:
        UsageError: an undetermined result without `force`. DataError: a log that cannot be read.

    Examples:
        >>> from accelcal_cli import apply, calibrate, simulate
        >>> simulated = simulate("mems", positions=24)
        >>> result = calibrate(simulated.output)
        >>> apply(result, simulated.to_frame()).columns
        ['pose', 'Nx', 'Ny', 'Nz', 'fx', 'fy', 'fz']
        >>> apply(result, simulated.output).shape
        (24, 3)
    """
    calibration = result if isinstance(result, Calibration) else load_result(result)
    calibration.check_determined("result", force=force)
    if not (isinstance(data, str | Path) or is_frame(data)):
        return calibration.apply(cast(ArrayLike, data))
    from accelcal_cli.io.parquet import whole_frame

    table = open_table(cast(str | Path | Frame, data), hashed=False)
    try:
        log = prepare(calibration, table, columns, ColumnOptions(**options))
        return whole_frame(table, log.change)
    finally:
        table.close()


def prepare(
    result: Calibration,
    table: InputTable,
    wanted: list[str] | None,
    options: ColumnOptions,
    count: str | None = None,
) -> Log:
    """Return a log together with what the result makes of it.

    Args:
        result: the calibration; its verdict is the caller's concern.
        table: the log; `wanted` names its three output columns, or None.
        options: what to write.
        count: the column of counts, or "none"; None to go by the names.

    Raises:
        DataError, UsageError: no such columns, or a new one has the name of one that is there.
    """
    columns = choose(table, wanted, count=count)
    names = list(table.names or ())
    kept = [n for k, n in enumerate(names) if not (options.replace and k in columns.output)]
    taken = [name for name in options.names if name in kept]
    if taken:
        raise DataError(f'{table.name}: has a column "{taken[0]}" already; choose another --prefix')
    warm = () if result.temperature is None or columns.temperature is None else (columns.temperature,)
    places = columns.output if options.replace else ()
    formula = Correction(result, options)
    selection = Selection((*columns.output, *warm), carried=frozenset(warm))
    change = Change(selection, formula, options.names, places)
    return Log(table, change, formula, _notes(columns, result, used=bool(warm)))


def _notes(columns: Columns, result: Calibration, *, used: bool) -> tuple[str, ...]:
    notes = [note for note in columns.notes if "taken as x, y, z" in note]
    if result.temperature is not None and not used:
        held = result.temperature.reference
        notes.append(f"the log has no temperature column: its readings are taken to be at {held:.4g} degrees")
    return tuple(notes)


@dataclass(frozen=True)
class Tilt:
    """What a result says of the tilt.

    Attributes:
        moves: change of f, m/s^2, for a unit of each of n parameters and of f (4th: 1): shape (n, 3, 4).
        root: a root of their covariance, shape (n, m): covariance = root root^T.
        noise: one-sigma of a reading, m/s^2.
    """

    moves: Float
    root: Float
    noise: float

    @classmethod
    def of(cls, result: Calibration, noise: float = 0.0) -> Tilt:
        """Return the tilt of a result.

        Raises:
            UsageError: gauge `full` without known attitudes leaves the body frame open.
        """
        if result.gauge != "full":
            return cls(*_nine(result), noise)
        if result.settings.get("attitudes") != "known":
            raise UsageError(
                "--tilt: gauge full leaves the body frame open; calibrate in gauge lower or symmetric"
            )
        return cls(*_twelve(result), noise)

    def columns(self, f: Float) -> Float:
        """Return roll, pitch and their one-sigma in degrees, shape (B, 4), of forces f in m/s^2, shape (B, 3)."""
        x, y, z = f.T
        flat = y * y + z * z
        level, square = np.sqrt(flat), flat + x * x
        zero = np.zeros_like(x)
        with np.errstate(divide="ignore", invalid="ignore"):
            roll = np.stack([zero, z, -y], axis=1) / flat[:, None]
            pitch = np.stack([-level, x * y / level, x * z / level], axis=1) / square[:, None]
            spread = [self._sigma(direction, f) for direction in (roll, pitch)]
        angles: Float = np.stack([np.arctan2(y, z), np.arctan2(-x, level), *spread], axis=1)
        return np.rad2deg(angles)

    def _sigma(self, direction: Float, f: Float) -> Float:
        """Return the one-sigma, rad, of an angle with gradient `direction`, shape (B, 3)."""
        ones = np.concatenate([f, np.ones((len(f), 1))], axis=1)
        products = (direction[:, :, None] * ones[:, None, :]).reshape(len(f), 12)
        parts = products @ (self.moves.reshape(-1, 12).T @ self.root)
        noise = self.noise**2 * np.einsum("bi,bi->b", direction, direction)
        return np.asarray(np.sqrt(np.einsum("bm,bm->b", parts, parts) + noise))


def _nine(result: Calibration) -> tuple[Float, Float]:
    """Return moves and root of the nine parameters: f = K_A (N - D_a), so df = -K_A (dK_a f + dD_a)."""
    lower = result.model.in_gauge("lower").K
    chain = gauge_chain(result.K_a, lower, result.gauge, result.g)
    moves = np.zeros((9, 3, 4))
    moves[:6, :, :3] = -result.model.K_A @ chain.T.reshape(6, 3, 3)
    for i in range(3):
        moves[6 + i, :, 3] = -result.model.K_A[:, i] * lower[i, i]
    return moves, _root(result.covariance)


def _twelve(result: Calibration) -> tuple[Float, Float]:
    """Return moves and root of the twelve parameters of known attitudes: df = -K_A (dK_a f + dD_a) = -Y (f / g, 1)."""
    moves = np.zeros((12, 3, 4))
    for p in range(12):
        i, j = divmod(p, 4)
        moves[p, i, j] = -1.0 / result.g if j < 3 else -1.0
    return moves, _root(covariance_of_twelve(result))


def _root(covariance: Float) -> Float:
    """Return a root of a covariance: root root^T; NaN where it has no number."""
    if not np.isfinite(covariance).all():
        return np.full(covariance.shape, np.nan)
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
