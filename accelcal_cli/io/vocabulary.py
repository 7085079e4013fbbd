"""What the names and units of columns mean: acceleration, turning rate, time, temperature, and which axis.

`parse_unit` reads a unit however it is written, `name_unit` the one that a name ends in, `describe` the quantity and
the axis of a name behind any prefix. They are the words of tables in English, German and French; which columns are
taken is decided in `columns.py`.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

Quantity = Literal[
    "acceleration", "gravity-free", "gravity", "turning", "magnetic", "time", "temperature", "other"
]

AXES = "xyz"

_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]")
_ALL_BRACKETS = re.compile(r"[\[(][^\])]*[\])]")
_INDEX = re.compile(r"\[([012])\]\s*$")  # accelerometer_m_s2[0]
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_UNIT_WORDS = re.compile(
    r"g|mg|ug|mps|mps2|ms|ms2|m|s|s2|2|lsb|counts|raw|mv|v|c|degc|celsius|k|pulse|pulses|hz"
)
MEAN = frozenset({"mean", "avg", "average", "moyenne", "mittelwert"})

UNITS: dict[str, tuple[Quantity, tuple[str, ...]]] = {
    "m/s^2": (
        "acceleration",
        (
            *(
                "m/s2",
                "m/s/s",
                "ms-2",
                "m*s-2",
                "m.s-2",
                "m/(s2)",
                "m/sec2",
                "mps2",
                "ms2",
                "m/s**2",
                "m/(s2",
                "m_s2",
            ),
            *("meter/s2", "meters/s2", "meterspersecondsquared", "metrespersecondsquared"),
        ),
    ),
    "g": ("acceleration", ("g", "gs", "g0", "gn", "gforce", "g's", "standardgravity")),
    "mg": ("acceleration", ("mg", "milli-g", "millig", "mgs")),
    "counts": ("other", ("lsb", "lsbs", "counts", "count", "raw", "adc", "digits", "ticks", "bits", "cts")),
    "turning": (
        "turning",
        ("rad/s", "rads-1", "deg/s", "degs-1", "dps", "°/s", "mdps", "rad/sec", "deg/sec", "grad/s"),
    ),
    "magnetic": (
        "magnetic",
        ("ut", "mt", "nt", "gauss", "mgauss", "mga", "ga", "uteslas", "microtesla", "localflux"),
    ),
    "s": ("time", ("s", "sec", "secs", "second", "seconds", "sekunden", "secondes")),
    "ms": ("time", ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds", "millisec")),
    "us": ("time", ("us", "usec", "usecs", "micros", "microsecond", "microseconds")),
    "ns": ("time", ("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds")),
    "min": ("time", ("min", "mins", "minute", "minutes", "minuten")),
    "h": ("time", ("h", "hr", "hrs", "hour", "hours")),
    "d": ("time", ("d", "day", "days", "tage", "jours", "datenum", "matlab", "excel")),
    "degC": (
        "temperature",
        ("c", "degc", "°c", "celsius", "k", "kelvin", "degf", "f", "degreescelsius", "degrees"),
    ),
    "-": (
        "other",
        (
            *(
                "-",
                "nounits",
                "none",
                "nounit",
                "unitless",
                "cal",
                "uncal",
                "v",
                "mv",
                "hz",
                "pa",
                "hpa",
                "kpa",
            ),
            *(
                "deg",
                "rad",
                "°",
                "lux",
                "%",
                "kohms",
                "ua",
                "mbar",
                "m",
                "m/s",
                "n/a",
                "a.u.",
                "yyyy/mm/dd",
                "hh:mm:ss",
            ),
        ),
    ),
}
"""Spellings of units by what they stand for; the canonical name comes first."""

_SPELLED = {word: name for name, (_, words) in UNITS.items() for word in words}

FORCE_UNITS = ("g", "mg", "m/s^2")
"""Units of acceleration that say what 1 g is."""

_ACCELERATION = re.compile(
    r"acc|acce?l|accel\w*|accelerat\w*|accelero\w*|beschl\w*|acz|ac|gforce|gf|specificforce"
)
_FREE = frozenset({"free", "user", "gravityfree", "lin", "ohne", "sans", "without", "dynamic", "la"})
_KIND: tuple[tuple[Quantity, re.Pattern[str]], ...] = (
    (
        "turning",
        re.compile(
            r"gyr\w*|gy|omega|angvel|angular\w*|rotation\w*|rotrate|drehrate\w*|winkelg\w*|rate|w|dps"
        ),
    ),
    ("magnetic", re.compile(r"mag|magn\w*|compass|b|h|m")),
    ("gravity", re.compile(r"grav|gravit\w*|schwerkraft")),
    (
        "other",
        re.compile(
            r"q|quat\w*|roll|pitch|yaw|euler\w*|angle|angles|att\w*|ori|orientation\w*|vel|velocity|speed|gps|pos|"
            r"position\w*|lat|lon|alt|setpoint|axis[pidf]|motor|servo|delta\w*|dv|dq|baro\w*|light|lux|pressure|humid\w*"
        ),
    ),
)
_STEMS: dict[str, Quantity] = {
    **dict.fromkeys(("a", "ac", "acc", "accel", "na", "gf"), "acceleration"),
    **dict.fromkeys(("g", "gy", "gyr", "gyro", "w", "omega"), "turning"),
    **dict.fromkeys(("m", "mag", "h", "b"), "magnetic"),
    **dict.fromkeys(("q", "v", "p"), "other"),
}
_TAIL = frozenset(
    {
        "cal",
        "uncal",
        "calibrated",
        "raw",
        "out",
        "value",
        "val",
        "data",
        "axis",
        "d",
        "filt",
        "filtered",
        "run",
        "smooth",
    }
)
_TIME_WORDS = re.compile(
    r"(?:t|time|timestamp|timestamps|stamp|sec|seconds|zeit|zeitstempel|temps|horodatage|utc|date|datetime|datum|millis|"
    r"micros|epoch|epoc|unix|elapsed|uptime|clock|uhrzeit|heure|tow|datenum)+(?:ns|us|usec|ms|msec|s|utc|local|unix|"
    r"cal|fine|sincestart|sincereboot|ofday)*(?:unix|cal|instant)*"
)
_TEMPERATURE = re.compile(
    r"(?:\w*?(?:imu|acc|accel|gyro|sensor|chip|die|board|baro|device|s))?(?:temp|temperature|temperatur|tempc|tmp|degc)"
    r"(?:c|degc|cal|sensor|imu)?|t_?(?:imu|acc|accel|chip|die|sensor)"
)


@dataclass(frozen=True)
class Meaning:
    """What a name says: the quantity, or None; the family, the name without its axis; the axis 0 to 2, or None.

    `number` is the axis as a number where the name has one instead of a letter, as CH3 or acc_0 do.
    """

    quantity: Quantity | None
    family: str
    axis: int | None = None
    number: int | None = None


@lru_cache(maxsize=4096)
def parse_unit(text: str) -> str | None:
    """Return the unit that a text is, by its name in UNITS; None where it is none."""
    bare = text.strip().strip("[]() ").lower().replace("µ", "u").replace("μ", "u").replace("²", "2")
    bare = bare.replace("⁻", "-").replace("·", "*").replace("^", "").replace(" ", "").replace("\ufffd", "2")
    bare = re.sub(r"^[±+/-]*\d+(?=m?g$)", "", bare)  # "40g": the range, in its unit
    return _SPELLED.get(bare) or _SPELLED.get(bare.strip("()"))


def name_unit(name: str) -> str | None:
    """Return the unit in the name of a column, ``g`` for ``ax_g`` and ``gFx``; None where there is none."""
    for text in reversed(_BRACKETS.findall(name)):
        if unit := parse_unit(text):
            return unit
    bare = plain(_INDEX.sub("", name))
    if re.search(r"_?m_s_?2(?:_|$)", bare):
        return "m/s^2"
    words = [
        word for word in re.findall(r"[a-z0-9/^*-]+", _CAMEL.sub("_", bare).lower().replace("_", " ")) if word
    ]
    if len(words) > 1 and words[-1] in (
        "g",
        "mg",
        "mps2",
        "ms2",
        "ms^2",
        "m/s2",
        "m/s^2",
        "lsb",
        "counts",
        "raw",
    ):
        return parse_unit(words[-1])
    return "g" if re.fullmatch(r"g[_ ]?f(?:orce)?[_ ]?[xyz]", bare.lower()) else None


def is_unit_row(cells: Sequence[str]) -> bool:
    """Return whether the cells of a line are units, as they stand between a header and its rows."""
    filled = [cell for cell in cells if cell]
    known = [parse_unit(cell) for cell in filled]
    words = any(
        unit not in (None, "-") or cell.lower() in ("cal", "raw")
        for cell, unit in zip(filled, known, strict=True)
    )
    return bool(filled) and words and known.count(None) <= len(filled) // 3


def plain(text: str) -> str:
    """Return a text without accents."""
    return "".join(c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))


def tokens_of(name: str) -> list[str]:
    """Return the words of a column name in lower case, without units and without "mean"."""
    name = _INDEX.sub(lambda match: "_" + AXES[int(match[1])], re.sub(r"_?m_s_?2", "", plain(name)))
    words = re.findall(r"[a-z0-9]+", _CAMEL.sub("_", _ALL_BRACKETS.sub(" ", name)).lower())
    while (
        len(words) > 1
        and _UNIT_WORDS.fullmatch(words[-1])
        and (words[-1] != "2" or words[-2] in ("s", "ms", "m"))
    ):
        words.pop()
    if len(words) == 1 and (glued := re.fullmatch(r"(?:mean|avg)([xyz])", words[0])):
        return [glued[1]]
    return [word for word in words if word not in MEAN] or words


def is_time(name: str) -> bool:
    """Return whether a column is time by its name: t, Zeit (s), timestamp_ms, S_Timestamp_Unix_CAL."""
    words = tokens_of(name)
    while words and words[0] in (
        "s",
        "sensor",
        "phone",
        "imu",
        "accelerometer",
        "acc",
        "shimmer",
        "latest",
        "gps",
        "device",
    ):
        words = (
            words[2:] if words[1:] and words[1].isalnum() and any(map(str.isdigit, words[1])) else words[1:]
        )
    key = "".join(words)
    return bool(_TIME_WORDS.fullmatch(key))


def is_temperature(name: str) -> bool:
    """Return whether a column is a temperature by its name."""
    return bool(_TEMPERATURE.fullmatch("".join(tokens_of(name))))


def describe(name: str) -> Meaning:
    """Return what a name says behind any prefix: ``imu0.az``, ``Beschl. z``, ``ACCEL_ZOUT``, ``CH3``."""
    words = tokens_of(name)
    while len(words) > 1 and (words[-1] in _TAIL or (words[-1].isdigit() and words[-2] in _TAIL)):
        words.pop()
    at, axis, number = _axis_word(words)
    if at is None:
        return Meaning(_quantity(words), "".join(words))
    stem = (
        re.sub(r"^[xyz](?=acc|gyr|mag)|^[xyz]\w+$|[xyz0-9]+$", "", words[at]) if words[at] not in AXES else ""
    )
    rest = [*words[:at], *([stem] if stem else []), *words[at + 1 :]]
    return Meaning(_quantity(rest) or _STEMS.get(rest[-1] if rest else ""), "".join(rest), axis, number)


def _axis_word(words: Sequence[str]) -> tuple[int | None, int | None, int | None]:
    """Return which word tells the axis, and the axis as 0 to 2 or the number that stands for it."""
    for at in reversed(range(len(words))):
        if words[at] in AXES:
            return at, AXES.index(words[at]), None
    for at in reversed(range(len(words))):
        if match := re.fullmatch(
            r"([xyz])(?:out|axis|ch|acc\w*|gyr\w*|mag\w*|val)|(?:[a-z]*?)([xyz])", words[at]
        ):
            letter = match[1] or match[2]
            if match[1] or len(words[at]) <= 3 or _quantity([words[at][:-1]]):
                return at, AXES.index(letter), None
    if words and (match := re.fullmatch(r"[a-z]*?(\d+)", words[-1])) and int(match[1]) < 1000:
        return len(words) - 1, None, int(match[1])
    return None, None, None


def _quantity(words: Sequence[str]) -> Quantity | None:
    """Return the quantity that some word names."""
    if any(_ACCELERATION.fullmatch(word) for word in words):
        if "angular" in words:
            return "turning"
        return "gravity-free" if _FREE & set(words) else "acceleration"
    for quantity, pattern in _KIND:
        if any(pattern.fullmatch(word) for word in words):
            return quantity
    return None
