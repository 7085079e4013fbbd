"""What the time column of a raw log says: its unit, the rate, and dates as seconds."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.errors import DataError
from accelcal_cli.sensor.cells import Rows, shorten
from accelcal_cli.streams import Float

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of a time column, in seconds."""

SLOWEST = 1.0
"""Hz: no raw log is slower, so a slower one is taken as being in a smaller unit of time."""

_UNIT = re.compile(
    r"(?:.*[\W_])?(?:(s|secs?|seconds?)|(ms|msecs?|millis|milliseconds?)|([uµμ]s|[uµμ]secs?|micros|microseconds?)"
    r"|(ns|nsecs?|nanos|nanoseconds?))[\W_]*",
    re.IGNORECASE,
)
_ZONE = re.compile(r"(?:[zZ]|[+-]\d\d(?::?\d\d)?)$")


@dataclass(frozen=True)
class Clock:
    """What the time column says.

    Attributes:
        rate: rows a second, Hz; None where nothing says it.
        unit: of the time column: s, ms, us or ns.
    """

    rate: float | None = None
    unit: str = "s"

    @property
    def period(self) -> float | None:
        """From row to row, in the unit of the time column; None where nothing says it."""
        return None if self.rate is None else 1.0 / (self.rate * UNITS[self.unit])

    @classmethod
    def of(cls, time: Float, unit: str | None = None) -> Self:
        """Tell the rate from the first rows, shape (n,), and the unit where it is not stated.

        Without a unit a step of exactly 1 counts rows and says nothing of time. A stated unit that makes the log
        slower than any is not believed.
        """
        steps = np.diff(time)
        steps = steps[steps > 0]
        if not len(steps) or (unit is None and (steps == 1).all()):
            return cls()
        step = float(np.median(steps))
        if unit is None or step * UNITS[unit] > 1 / SLOWEST:
            unit = next((unit for unit, size in UNITS.items() if step * size <= 1 / SLOWEST), "ns")
        return cls(1.0 / (step * UNITS[unit]), unit)


def unit_of(name: str) -> str | None:
    """Return the unit that the name of a time column ends in, as in ``timestamp_ms`` or ``time [us]``."""
    found = _UNIT.fullmatch(name.strip())
    return None if found is None else list(UNITS)[next(k for k, part in enumerate(found.groups()) if part)]


def dated(rows: Iterable[Rows], place: Callable[[int], str]) -> Iterator[Rows]:
    """Yield rows whose text is a date and a time with the seconds since the first row as one more column.

    Args:
        rows: blocks with text; place: how to name a row (from 0) and its column.
    """
    first, zone = np.zeros(0, dtype="datetime64[ns]"), ""
    for block in rows:
        text = [cell.replace(",", ".") for cell in block.texts[0]]
        if not len(first) and text:
            match = _ZONE.search(text[0][len("2026-03-01") :])
            zone = "" if match is None else match[0]
        stamps = _stamps([cell.removesuffix(zone) for cell in text], block.start, text, place)
        first = first if len(first) else stamps[:1]
        seconds = (stamps - first).astype(np.int64) / 1e9
        yield Rows(block.start, np.column_stack([block.numbers, seconds]))


def _stamps(
    cells: list[str], start: int, shown: list[str], place: Callable[[int], str]
) -> NDArray[np.datetime64]:
    """Return the cells as points in time, all in one time zone, ns."""
    if all(cell[:4].isdigit() for cell in cells):
        try:
            return _read(cells)
        except (ValueError, UserWarning):
            pass
    wrong = next(k for k, cell in enumerate(cells) if not _is_stamp(cell))
    raise DataError(
        f"{place(start + wrong)}: {shorten(shown[wrong])} is no time; expected numbers, or dates as "
        "2026-03-01T12:30:00.25, all in one time zone (--time none leaves it out)"
    )


def _read(cells: list[str]) -> NDArray[np.datetime64]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of a time zone, which numpy would drop
        return np.array(cells, dtype="datetime64[ns]")


def _is_stamp(cell: str) -> bool:
    try:
        return cell[:4].isdigit() and not np.isnat(_read([cell])[0])
    except (ValueError, UserWarning):
        return False
