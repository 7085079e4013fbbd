"""SVG by hand: elements, scales with round ticks, and the frame of a picture that stands inside a page.

A picture has no font, no file and no colour of its own: its parts have classes, and the style sheet of the page gives
them colours, so that one picture serves a light page, a dark page and paper. Marks with a key can be pointed at: their
`<title>` says what they are, and the script of the page shows it. Lengths are in the units of the view box, about a
pixel each.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

TICKS = 5
"""Ticks of a linear axis, about."""

MOST_DECADES = 6
"""Labelled decades of a logarithmic axis; of more every second, third, ... is left out."""

MINUS = "\u2212"


def number(value: float) -> str:
    """Return a length as SVG has it, to a hundredth.

    >>> number(3.0), number(-0.001), number(12.345)
    ('3', '0', '12.35')
    """
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def element(name: str, *content: str, **attributes: str | float | None) -> str:
    """Return an element; content is SVG already, attributes are text or lengths, None for one that is left out.

    A trailing underscore is dropped from a name, others become hyphens.

    >>> element("circle", cx=1.5, class_="dot", data_key="a<b")
    '<circle cx="1.5" class="dot" data-key="a&lt;b"/>'
    """
    said = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value) if isinstance(value, str) else number(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    inner = "".join(content)
    return f"<{name}{said}>{inner}</{name}>" if inner else f"<{name}{said}/>"


def words(x: float, y: float, text: str, *, anchor: str = "start", style: str = "") -> str:
    """Return text at a place; anchor is start, middle or end."""
    return element("text", escape(text), x=x, y=y, text_anchor=anchor, class_=style or None)


def line(x1: float, y1: float, x2: float, y2: float, style: str) -> str:
    """Return a straight line."""
    return element("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=style)


def cross(x: float, y: float, size: float, style: str) -> str:
    """Return a cross, the mark of an outlier."""
    a, b, c, d = (number(v) for v in (x - size, x + size, y - size, y + size))
    return element("path", d=f"M{a} {c}L{b} {d}M{a} {d}L{b} {c}", class_=style)


def mark(key: str, title: str, *content: str, style: str = "mark") -> str:
    """Return parts that belong together and can be pointed at; title says what they are."""
    return element("g", element("title", escape(title)), *content, class_=style, data_key=key)


def picture(name: str, width: float, height: float, alternative: str, *content: str, kind: str = "") -> str:
    """Return a picture to stand in a page.

    Args:
        name: unique in the page; width, height: of its view box.
        alternative: what it shows, for those who cannot see it.
        content: its parts; kind: what its marks are called, for the script of the page; empty where it has none.
    """
    title = element("title", escape(alternative), id=f"{name}-alt")
    box = f"0 0 {number(width)} {number(height)}"
    return element(
        "svg",
        title,
        *content,
        viewBox=box,
        role="img",
        aria_labelledby=f"{name}-alt",
        data_kind=kind or None,
    )


@dataclass(frozen=True)
class Scale:
    """An axis: numbers from `low` to `high` at places from `start` to `end`, linear or logarithmic."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, value: float) -> float:
        """Return the place of a value; beyond the ends the nearer end."""
        low, high, at = (self.low, self.high, value)
        if self.log:
            low, high, at = (math.log10(max(v, 1e-300)) for v in (low, high, value))
        part = (at - low) / (high - low) if high > low else 0.5
        return self.start + min(max(part, 0.0), 1.0) * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Return round numbers on the axis."""
        return _decades(self.low, self.high) if self.log else _round(self.low, self.high)


def around(
    values: Iterable[float], start: float, end: float, *, zero: bool = False, room: float = 0.06
) -> Scale:
    """Return a linear scale with all finite values and some room about them; with `zero` also 0."""
    known = [v for v in values if math.isfinite(v)] + ([0.0] if zero else [])
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    margin = room * (high - low) or max(abs(high), 1e-300) * room or 1.0
    return Scale(low - margin, high + margin, start, end)


def _round(low: float, high: float) -> list[float]:
    step = (high - low) / TICKS
    if not step > 0:
        return [low]
    power = 10.0 ** math.floor(math.log10(step))
    step = next((m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= step), 10.0 * power)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def _decades(low: float, high: float) -> list[float]:
    """Return powers of ten, with their doubles and fivefolds where there are few; round numbers where those are few."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    if last - first < 2:
        fine = [m * 10.0**k for k in range(first - 1, last + 1) for m in (1.0, 2.0, 5.0)]
        within = [t for t in fine if low <= t <= high]
        return within if len(within) > 2 else [t for t in _round(low, high) if t > 0]
    every = -(-(last - first + 1) // MOST_DECADES) or 1
    return [10.0**k for k in range(first, last + 1, max(every, 1))]


def label(value: float) -> str:
    """Return the number at a tick, with a minus that is as long as a plus.

    >>> label(-0.5), label(1e-12), label(20000.0), label(0.30000000000000004)
    ('−0.5', '1e−12', '20,000', '0.3')
    """
    if value == 0:
        return "0"
    size = abs(value)
    text = f"{value:,.10g}" if 1e-3 <= size < 1e6 else f"{value:.3g}".replace("e-0", "e-").replace("e+0", "e")
    return text.replace("+", "").replace("-", MINUS)


def down_axis(scale: Scale, left: float, right: float) -> str:
    """Return grid lines and numbers of an upright axis, the numbers left of `left`."""
    return "".join(
        line(left, scale(t), right, scale(t), "grid")
        + words(left - 5, scale(t) + 3.6, label(t), anchor="end")
        for t in scale.ticks()
    )


def across_axis(scale: Scale, top: float, bottom: float, ticks: Sequence[float] | None = None) -> str:
    """Return grid lines and numbers of a level axis, the numbers below `bottom`."""
    return "".join(
        line(scale(t), top, scale(t), bottom, "grid")
        + words(scale(t), bottom + 13, label(t), anchor="middle")
        for t in (scale.ticks() if ticks is None else ticks)
    )
