"""The time column of a log: numbers in some unit, dates and clocks in any style, and the rate that they tell.

`Clock` finds unit and rate from the times of the first rows. `StampReader` turns texts into seconds since the first:
dates with the year, day or month first, clocks with hours or from the minutes on, 64-bit counts. Whether the day or the
month comes first is told by the file: by a number above 12, by the lines above the table, or when the date changes.
`SoundTimes` leaves out single rows whose time is none or falls, where broken rows are to be left out.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import date
from typing import Self

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.io.columns import COUNTED, GUESSED
from accelcal_cli.io.reader import InputTable, shorten
from accelcal_cli.io.rows import MOST_BAD, SKIPPABLE, LineMap, RowBlock
from accelcal_cli.io.vocabulary import parse_unit

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Units of a time column, in seconds."""

SLOWEST = 1.0
"""Hz: no raw log is slower, so the time of one that seems slower is in a smaller unit."""

DAYS = ((20_000.0, 80_000.0), (650_000.0, 800_000.0))
"""Days since 1900 of spreadsheets, and since year 0 of MATLAB, for the years 1954 to 2119 and 1779 to 2190."""

FASTEST_DAYS = 2e-4
"""A step below this, from a time that can be a number of days, is one of days: of seconds it would be 5 kHz."""

UNEVEN = 0.05
"""Mean and median of the steps differ by less than this part where the rows come one by one."""

GAP = 5.0
"""A step that is so many medians long is a gap or the pause between two bursts."""

OFTEN = 0.01
"""Gaps are rarer than this part of the steps; pauses between bursts are not, or come at regular distances."""

REGULAR = 0.2
"""Distances, in rows, between the pauses of bursts differ by less than this part of their mean."""

HALF_DAY = 43_200.0

_UNIT = re.compile(
    r"(?:.*[\W_])?(?:(s|secs?|seconds?)|(ms|msecs?|millis|milliseconds?)|([uµμ]s|[uµμ]secs?|micros|microseconds?)"
    r"|(ns|nsecs?|nanos|nanoseconds?)|(mins?|minutes?|minuten)|(h|hours?|hrs?)|(days?|datenum|tage|jours))[\W_]*",
    re.IGNORECASE,
)
_MONTHS = {
    name: number
    for number, names in enumerate(
        (
            *(
                "jan",
                "feb fév",
                "mar mär mrz",
                "apr avr",
                "may mai",
                "jun juin",
                "jul juil",
                "aug aoû",
                "sep",
            ),
            *("oct okt", "nov", "dec dez déc"),
        ),
        1,
    )
    for name in names.split()
}
_STAMP = re.compile(
    r"(?:(?P<date>\d{4}[-/.]\d\d?[-/.]\d\d?|\d\d?[-/.]\d\d?[-/.]\d{4}|\d\d?[-/.]\d\d?[-/.]\d\d|\d{8}(?=[T _])"
    r"|\d\d?[- ./]?[^\W\d]{3,4}[a-z]*\.?[- ./,]*\d{2,4}|[^\W\d]{3,4}[a-z]*\.? \d\d?,? \d{4})(?:[T _,;-]+|$))?"
    r"(?P<clock>(?:(?:(?P<h>\d{1,3}):)?(?P<m>\d{1,2}):(?P<s>\d{1,2})|(?P<compact>\d{6}))(?:[.,:](?P<f>\d{1,9}))?)?"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?\s*(?P<zone>[zZ]|UTC|GMT|(?:UTC|GMT)?[+-]\d\d?(?::?\d\d)?)?"
)
_DURATION = re.compile(r"([-+]?\d+(?:\.\d+)?) ?(s|sec|ms|us|min|hr|h)")
_ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?(?:[zZ]|[+-]\d\d(?::?\d\d)?)?")
_ZONE = re.compile(r"(?:[zZ]|[+-]\d\d(?::?\d\d)?)$")


@dataclass(frozen=True)
class Clock:
    """Rate and unit of the time column.

    Attributes:
        rate: rows per second, Hz; None where it is unknown.
        unit: of the time column, one of UNITS.
        pause: longest regular step where rows come in bursts or times are rounded, in the unit of the column; else 0.
    """

    rate: float | None = None
    unit: str = "s"
    pause: float = 0.0

    @property
    def period(self) -> float | None:
        """Time from row to row, in the unit of the time column; None where the rate is unknown."""
        return None if self.rate is None else 1.0 / (self.rate * UNITS[self.unit])

    @classmethod
    def of(cls, time: Float, unit: str | None = None) -> Self:
        """Return rate and unit, where it is not stated, from the times of the first rows, shape (n,).

        Without a unit a step of exactly 1 counts rows and gives no rate. A stated unit that would make the log
        slower than SLOWEST is ignored.
        """
        step, pause = _row_step(time)
        steps = np.diff(time)
        if not step or (unit is None and (steps[steps > 0] == 1).all() and not pause):
            return cls()
        if unit is None and step < FASTEST_DAYS and any(low < time[0] < high for low, high in DAYS):
            unit = "d"
        if unit is None or step * UNITS[unit] > 1 / SLOWEST:
            unit = next((unit for unit in GUESSED if step * UNITS[unit] <= 1 / SLOWEST), "ns")
        return cls(1.0 / (step * UNITS[unit]), unit, pause)

    def note(self) -> str:
        """Say what an uneven time column is taken for, "" for an even one."""
        if not self.pause or self.rate is None:
            return ""
        return (
            f"time steps are uneven, up to {self.pause * UNITS[self.unit]:.4g} s: the rate is that of rows over span, "
            f"{self.rate:.6g} rows per second"
        )


def _row_step(time: Float) -> tuple[float, float]:
    """Return the mean time from row to row without gaps, and the longest regular step where steps are uneven."""
    steps = np.diff(time)
    positive = steps[steps > 0]
    if not len(positive):
        return 0.0, 0.0
    median = float(np.median(positive))
    late = np.flatnonzero(steps > GAP * median)
    bursts = _recur(late, len(steps)) and steps[late].sum() > 0.5 * steps.sum()
    pauses = late if bursts else late[:0]
    gaps = np.setdiff1d(late, pauses)
    counted = np.delete(steps, gaps) if len(gaps) else steps
    changes = np.flatnonzero(counted > 0) if not len(pauses) else np.flatnonzero(counted > GAP * median)
    # From one change to another: what is before the first and after the last belongs to no whole step.
    first, last = (int(changes[0]), int(changes[-1])) if len(changes) > 1 else (-1, len(counted) - 1)
    mean = float(counted[first + 1 : last + 1].sum()) / (last - first)
    if abs(mean - median) <= UNEVEN * median:
        return median, 0.0
    return mean, float(counted.max())


def _recur(late: NDArray[np.intp], steps: int) -> bool:
    """Return whether long steps are the pauses between bursts: frequent, or at regular distances."""
    if len(late) < 3:
        return False
    apart = np.diff(late)
    return len(late) > OFTEN * steps or float(np.ptp(apart)) <= REGULAR * float(apart.mean())


def unit_of(name: str) -> str | None:
    """Return the unit that the name of a time column ends in, as in ``timestamp_ms`` or ``Zeit (min)``."""
    match = _UNIT.fullmatch(name.strip())
    if match is not None:
        return list(UNITS)[next(k for k, part in enumerate(match.groups()) if part)]
    brackets = re.search(r"[\[(]([^\])]*)[\])]", name)
    unit = parse_unit(brackets[1]) if brackets else None
    return unit if unit in UNITS else None


def is_counted(cell: str) -> bool:
    """Return whether a cell is a count of time too long for a 64-bit float."""
    return cell.isascii() and cell.isdigit() and len(cell) >= COUNTED


def seconds_of_dates(rows: Iterable[RowBlock], reader: StampReader) -> Iterator[RowBlock]:
    """Yield rows whose first text is a time with the seconds since the first row as one more column.

    Args:
        rows: blocks with text; reader: of the texts.
    """
    for block in rows:
        seconds = reader.seconds(list(block.texts[0]), block.start)
        yield RowBlock(block.start, np.column_stack([block.numbers, seconds]), block.texts[1:])


def wrong_time(time: Float, row: int) -> int | None:
    """Return which single row is wrong where time falls at a row: this one or the one before it, None for neither."""
    if row + 1 < len(time) and time[row + 1] >= time[row - 1]:
        return row
    goes_on = row + 1 < len(time) and time[row + 1] >= time[row]
    return row - 1 if goes_on and (row == 1 or time[row] >= time[row - 2]) else None


@dataclass(eq=False)
class SoundTimes:
    """Leaves out single rows whose time, the last number of a block, is none or falls, and counts them as broken.

    Attributes:
        table: of the rows; rows: number in the table of each row that stays.
    """

    table: InputTable
    rows: LineMap = field(default_factory=LineMap)
    _before: Float = field(default_factory=lambda: np.empty(0))  # the last two times that were passed on
    _kept: int = 0

    def of(self, blocks: Iterable[RowBlock]) -> Iterator[RowBlock]:
        """Yield the blocks without such rows; the last two wait for the next block, by which they are judged."""
        held, at = None, np.empty(0, dtype=np.int64)
        for block in blocks:
            held = block if held is None else held.joined(block)
            at = np.append(at, block.start + np.arange(len(block.numbers)))
            held, at = self._sound(held, at, last=False)
            first = np.arange(len(at)) < len(at) - 2
            yield self._passed(held.only(first), at[first])
            held, at = held.only(~first), at[~first]
        if held is not None:
            yield self._passed(*self._sound(held, at, last=True))

    def _sound(self, block: RowBlock, at: Int, *, last: bool) -> tuple[RowBlock, Int]:
        time = block.numbers[:, -1]
        bad, known = np.isnan(time), np.flatnonzero(~np.isnan(time))
        times, skip = np.append(self._before, time[known]), len(self._before)
        for row in (np.flatnonzero(np.diff(times) < 0) + 1).tolist():
            wrong = row if last and row + 1 == len(times) else wrong_time(times, row)
            if wrong is not None and wrong >= skip:
                bad[known[wrong - skip]] = True
        for row in at[bad].tolist():
            self.table.leave_out(row)
        return block.only(~bad), at[~bad]

    def _passed(self, block: RowBlock, at: Int) -> RowBlock:
        start = self._kept
        self.rows.add_many(start + np.arange(len(at)), at)
        self._kept += len(at)
        self._before = np.append(self._before, block.numbers[:, -1])[-2:]
        return RowBlock(start, block.numbers, block.texts)


@dataclass(frozen=True)
class _Stamp:
    """The parts of a time: date as written or "", seconds of the clock, its period, offset of the zone in seconds."""

    date: str
    seconds: float
    period: float
    zone: float | None


@dataclass(eq=False)
class StampReader:
    """Turns texts of time into seconds since the first, block by block.

    Attributes:
        place: how to name a row (from 0) and its column; day_first: None until it is known.
        lenient: a cell that is no time is NaN.
    """

    place: Callable[[int], str]
    day_first: bool | None = None
    lenient: bool = False
    _iso: tuple[np.datetime64, str] | None = None  # the first time, and the zone of all
    _first: _Stamp | None = None
    _start: float = 0.0
    _days: dict[str, float] = field(default_factory=dict)  # seconds of midnight by date, from the first
    _last: float = 0.0
    _wrapped: float = 0.0
    _base: int | None = None
    _previous: str = ""

    @property
    def began(self) -> np.datetime64 | None:
        """Time of the first row where it is a date; None where it is another style, or no row has come."""
        return None if self._iso is None else self._iso[0]

    def seconds(self, cells: list[str], start: int) -> Float:
        """Return the times of a block in seconds since the first row, shape (B,).

        Raises:
            DataError: a cell that is no time of the style of the first, by its place.
        """
        if not cells:
            return np.zeros(0)
        if self._first is None and self._base is None and self._iso is None:
            self._begin(cells[0])
        if self._base is not None:
            seconds = self._counts(cells)
        elif self._iso is not None:
            seconds = self._dates(cells)
        else:
            seconds = np.array([self._second(cell, start + k) for k, cell in enumerate(cells)])
        wrong = np.flatnonzero(np.isnan(seconds))
        if len(wrong) and not self.lenient:
            few = SKIPPABLE if len(wrong) <= MOST_BAD * len(cells) else ""
            raise DataError(
                f"{self.place(start + int(wrong[0]))}: {shorten(cells[wrong[0]])} is not a time; expected numbers, or "
                f"dates as 2026-03-01T12:30:00.25, all in one time zone (--time none leaves it out){few}"
            )
        return seconds

    def _begin(self, cell: str) -> None:
        """Take the style of the first cell."""
        if is_counted(cell):
            self._base = int(cell)
        elif _ISO.fullmatch(cell.replace(",", ".")):
            zone = _ZONE.search(cell[len("2026-03-01") :])
            zoned = "" if zone is None else zone[0]
            try:
                self._iso = _read([cell.replace(",", ".").removesuffix(zoned)])[0], zoned
            except (ValueError, UserWarning):
                self._iso = None

    def _counts(self, cells: list[str]) -> Float:
        base = self._base or 0
        try:
            return np.array([int(cell) - base for cell in cells], dtype=np.float64)
        except ValueError:
            return np.array([int(cell) - base if is_counted(cell) else math.nan for cell in cells])

    def _dates(self, cells: list[str]) -> Float:
        first, zone = self._iso or (np.datetime64(0, "s"), "")
        bare = [cell.replace(",", ".").removesuffix(zone) for cell in cells]
        try:
            if not all(cell[:4].isdigit() for cell in bare):
                raise ValueError
            stamps = _read(bare)
            if np.isnat(stamps).any():
                raise ValueError
        except (ValueError, UserWarning):
            stamps = _read([cell if _is_iso(cell) else "NaT" for cell in bare])
        return np.where(np.isnat(stamps), math.nan, (stamps - first).astype(np.int64) / 1e9)

    def _second(self, cell: str, row: int) -> float:
        """Return the seconds of one cell since the first, NaN where it is no time."""
        stamp = _parse(cell)
        if stamp is None or (self._first is not None and not _alike(stamp, self._first)):
            return math.nan
        day = self._midnight(stamp.date, row) if stamp.date else 0.0
        if math.isnan(day):
            return day
        seconds = stamp.seconds - (stamp.zone or 0.0) + day
        if not stamp.date:
            if seconds + self._wrapped < self._last - stamp.period / 2:
                self._wrapped += stamp.period  # midnight, or the full hour of a clock without hours
            seconds += self._wrapped
        if self._first is None:
            self._first, self._start = stamp, seconds
        self._last = seconds
        return round(seconds - self._start, 9)

    def _midnight(self, text: str, row: int) -> float:
        """Return midnight of a date in seconds since that of the first date, NaN where it is no date."""
        known = self._days.get(text)
        if known is not None:
            self._previous = text
            return known
        if not (_is_date(text, True) or _is_date(text, False)):
            return math.nan
        if not self._days:
            self._settle(text)
            self._days[text] = 0.0
        else:
            first = next(iter(self._days))
            self._settle_change(self._previous, text, row)
            if not _is_date(text, self.day_first):
                return math.nan
            self._days[text] = 86400.0 * (_ordinal(text, self.day_first) - _ordinal(first, self.day_first))
        self._previous = text
        return self._days[text]

    def _settle(self, text: str) -> None:
        """Find the order of day and month where one date tells it."""
        orders = [order for order in (True, False) if _is_date(text, order)]
        if len(orders) == 1 or _ordinal(text, True) == _ordinal(text, False):
            self.day_first = orders[0] if self.day_first is None and len(orders) == 1 else self.day_first

    def _settle_change(self, before: str, text: str, row: int) -> None:
        """Find the order of day and month from a change of date: to the next day, or to one that has only one order."""
        if self.day_first is not None:
            return
        orders = [order for order in (True, False) if _is_date(before, order) and _is_date(text, order)]
        steps = {order: _ordinal(text, order) - _ordinal(before, order) for order in orders}
        if len(set(steps.values())) == 1:
            if len(steps) == 1:
                self.day_first = orders[0]
            return
        next_day = [order for order, step in steps.items() if step == 1]
        if len(next_day) != 1:
            raise DataError(
                f"{self.place(row)}: {shorten(text)} after {shorten(before)} may begin with the day or with the month; "
                "write dates as 2026-03-01, or leave time out with --time none"
            )
        self.day_first = next_day[0]


def _read(cells: list[str]) -> NDArray[np.datetime64]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # about a time zone, which numpy would drop
        return np.array(cells, dtype="datetime64[ns]")


def _is_iso(cell: str) -> bool:
    try:
        return cell[:4].isdigit() and not np.isnat(_read([cell])[0])
    except (ValueError, UserWarning):
        return False


def _parse(cell: str) -> _Stamp | None:
    """Return the parts of a cell, None where it is no time."""
    if duration := _DURATION.fullmatch(cell.strip()):
        return _Stamp("", float(duration[1]) * UNITS[parse_unit(duration[2]) or "s"], math.inf, None)
    match = _STAMP.fullmatch(cell.strip())
    if match is None or not (match["clock"] or match["date"]) or (match["compact"] and not match["date"]):
        return None
    compact = match["compact"]
    h, m, s = (
        (compact[:2], compact[2:4], compact[4:])
        if compact
        else (match["h"], match["m"] or "0", match["s"] or "0")
    )
    if not (match["date"] or h or match["f"]):
        return None  # 12:30 alone may be hours and minutes
    hours = int(h or 0)
    if match["half"]:
        hours = hours % 12 + 12 * match["half"].lower().startswith("p")
    if int(m) > 59 or int(s) > 60:
        return None
    seconds = (
        3600.0 * hours
        + 60.0 * int(m)
        + int(s)
        + (int(match["f"]) / 10 ** len(match["f"]) if match["f"] else 0.0)
    )
    return _Stamp(match["date"] or "", seconds, 2 * HALF_DAY if h else 3600.0, _offset(match["zone"]))


def _offset(zone: str | None) -> float | None:
    """Return the seconds that a zone is before UTC, None where none is written."""
    if zone is None:
        return None
    digits = re.sub(r"[^\d+-]", "", zone)
    if not digits:
        return 0.0
    hours, minutes = digits[1:3], digits[3:] or "0"
    return (1 if digits[0] == "+" else -1) * (3600.0 * int(hours) + 60.0 * int(minutes))


def _alike(stamp: _Stamp, first: _Stamp) -> bool:
    """Return whether two times are of one style."""
    parts = [(bool(s.date), s.period, s.zone is None) for s in (stamp, first)]
    return parts[0] == parts[1] or (bool(stamp.date) and parts[0][2] == parts[1][2])


def _is_date(text: str, day_first: bool | None) -> bool:
    try:
        _ordinal(text, day_first)
    except ValueError:
        return False
    return True


def _ordinal(text: str, day_first: bool | None) -> int:
    """Return the number of a day; ValueError where there is no such date."""
    words = re.findall(r"\d+|[^\W\d_]+", text)
    if len(words) == 1 and len(text) == 8:
        year, month, day = int(text[:4]), int(text[4:6]), int(text[6:])
    elif any(word.isalpha() for word in words):
        month = _MONTHS.get(next(word for word in words if word.isalpha())[:3].lower(), 0)
        numbers = [word for word in words if word.isdigit()]
        day, year = int(numbers[0]), int(numbers[1])
        if len(numbers[0]) == 4:
            day, year = year, day
    elif len(words[0]) == 4:
        year, month, day = map(int, words)
    else:
        one, other, year = map(int, words)
        day, month = (one, other) if day_first in (True, None) else (other, one)
    return date(year + 2000 if year < 100 else year, month, day).toordinal()
