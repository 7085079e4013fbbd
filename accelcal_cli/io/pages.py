"""The time of the rows of a log that is written page by page, each page with the time of its first row.

Between the beginnings of two pages that follow each other the rows are evenly spaced: so the rate is that of the
sensor, not the nominal one. Where pages are missing the rows keep the nominal rate, and there is a gap. A clock that is
set back while it logs goes on from where it was.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.arrays import Float, Int

CONTIGUOUS = (0.5, 1.5)
"""Parts of the nominal length of a page by which the next one may begin later and still follow it."""


class PageClock:
    """Turns the times of pages into those of rows, batch by batch.

    Attributes:
        rate: nominal, rows per second, Hz.
        origin: time of the first row, s; None before the first page.
        gaps: pages before which others are missing; longest: the longest gap, s.
        set_back: how often the clock was set back.
    """

    def __init__(self, rate: float) -> None:
        """Start before the first page."""
        self.rate = rate
        self.origin: float | None = None
        self.gaps, self.longest, self.set_back = 0, 0.0, 0
        self._shift = 0.0
        self._expected: float | None = None  # when the next page begins if none is missing

    def steps(self, start: Float, count: Int, following: float | None) -> tuple[Float, Float]:
        """Return when pages begin, s after the first row, and the step of their rows, s, shape (P,) each.

        Args:
            start: time of the first row of each page, s, NaN where it is unknown, shape (P,), in the order of the file.
            count: rows of each page, shape (P,).
            following: time of the first row of the page after these; None where it is not known.
        """
        nominal = count / self.rate
        begin = np.append(start, np.nan if following is None else following) + self._shift
        for k in np.flatnonzero(np.isnan(begin)).tolist():
            begin[k] = begin[k - 1] + nominal[k - 1] if k else self._expected or 0.0
        self._join(begin, float(nominal[0]))
        length = np.diff(begin)
        back = length < CONTIGUOUS[0] * nominal
        if back.any():
            missing = np.where(back, nominal - length, 0.0)
            self.set_back += int(np.count_nonzero(back))
            begin[1:] += np.cumsum(missing)
            self._shift += float(missing.sum())
            length += missing
        late = length > CONTIGUOUS[1] * nominal
        if late.any():
            self.gaps += int(np.count_nonzero(late))
            self.longest = max(self.longest, float((length - nominal)[late].max()))
        if self.origin is None:
            self.origin = float(begin[0])
        self._expected = float(begin[-1])
        return begin[:-1] - self.origin, np.where(late, nominal, length) / count

    def _join(self, begin: Float, nominal: float) -> None:
        """Let pages, which begin at `begin`, shape (P + 1,), follow those before; `nominal`: length of the first, s."""
        if self._expected is None:
            return
        lead = self._expected - float(begin[0])
        if lead > (1.0 - CONTIGUOUS[0]) * nominal:
            begin += lead
            self._shift += lead
            self.set_back += 1
        elif -lead > (CONTIGUOUS[1] - 1.0) * nominal:
            self.gaps += 1
            self.longest = max(self.longest, -lead)

    def notes(self) -> tuple[str, ...]:
        """Say what was uneven."""
        if not self.set_back:
            return ()
        times = "once" if self.set_back == 1 else f"{self.set_back:,} times"
        return (f"the clock of the logger was set back {times}; the rows follow each other all the same",)


def fill_times(out: Float, begin: Float, step: Float) -> None:
    """Fill `out`, shape (P, rows of a page), with the times of the rows of pages as `PageClock.steps` tells them."""
    np.multiply(step[:, None], np.arange(out.shape[1]), out=out)
    out += begin[:, None]


def plural(number: int, what: str) -> str:
    """Return a number of things: ``1 block``, ``2 blocks``."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"
