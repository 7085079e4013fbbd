"""What the words of a table mean: names and units of columns, and what stands above it.

`parse_unit` reads a unit however it is written, `name_unit` the one that a name ends in, `describe` the quantity and
the axis of a name behind any prefix; `recognise` gives every column its role by its name, the names that are known as
they are first. `read_facts` finds rate, start, serial number, range and the order of day and month in a preamble. They
are the words of tables in English, German and French; which columns are taken is decided in `columns.py`.
"""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

from accelcal_cli.schema import frozen

Quantity = Literal[
    "acceleration", "gravity-free", "gravity", "turning", "magnetic", "time", "temperature", "other"
]

AXES = "xyz"

# Patterns that few names need are strings: `re` compiles them where they are first asked for.
_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]")
_ALL_BRACKETS = re.compile(r"[\[(][^\])]*[\])]")
_ZONE = r",?\s*(?:GMT|UTC)\s*[+-]\d\d:?\d\d\s*$"  # Date Time, GMT-05:00
_INDEX = re.compile(r"\[([012])\]\s*$")  # accelerometer_m_s2[0]
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_UNIT_WORDS = r"g|mg|ug|mps|mps2|ms|ms2|m|s|s2|2|lsb|counts|raw|mv|v|c|degc|celsius|k|pulse|pulses|hz"
MEAN = frozenset({"mean", "avg", "average", "moyenne", "mittelwert"})

UNITS: dict[str, tuple[Quantity, str]] = {
    "m/s^2": (
        "acceleration",
        "m/s2 m/s/s ms-2 m*s-2 m.s-2 m/(s2) m/sec2 mps2 ms2 m/s**2 m/(s2 m_s2 meter/s2 "
        "meters/s2 meterspersecondsquared metrespersecondsquared",
    ),
    "g": ("acceleration", "g gs g0 gn gforce g's standardgravity"),
    "mg": ("acceleration", "mg milli-g millig mgs"),
    "counts": ("other", "lsb lsbs counts count raw adc digits ticks bits cts"),
    "turning": ("turning", "rad/s rads-1 deg/s degs-1 dps °/s mdps rad/sec deg/sec grad/s"),
    "magnetic": ("magnetic", "ut mt nt gauss mgauss mga ga uteslas microtesla localflux"),
    "s": ("time", "s sec secs second seconds sekunden secondes"),
    "ms": ("time", "ms msec msecs millis millisecond milliseconds millisec"),
    "us": ("time", "us usec usecs micros microsecond microseconds"),
    "ns": ("time", "ns nsec nsecs nanos nanosecond nanoseconds"),
    "min": ("time", "min mins minute minutes minuten"),
    "h": ("time", "h hr hrs hour hours"),
    "d": ("time", "d day days tage jours datenum matlab excel"),
    "degC": ("temperature", "c degc °c celsius k kelvin degf f degreescelsius degrees"),
    "-": (
        "other",
        "- nounits none nounit unitless cal uncal v mv hz pa hpa kpa deg rad ° lux % "
        "kohms ua mbar m m/s n/a a.u. yyyy/mm/dd hh:mm:ss",
    ),
}
"""Spellings of units by what they stand for; the canonical name comes first."""

TIME_UNITS = frozenset(name for name, (quantity, _) in UNITS.items() if quantity == "time")

_SPELLED = {word: name for name, (_, words) in UNITS.items() for word in words.split()}

FORCE_UNITS = ("g", "mg", "m/s^2")
"""Units of acceleration that say what 1 g is."""

_ACCELERATION = r"acc|acce?l|accel\w*|accelerat\w*|accelero\w*|beschl\w*|acz|ac|gforce|gf|specificforce"
_FREE = frozenset({"free", "user", "gravityfree", "lin", "ohne", "sans", "without", "dynamic", "la"})
_KIND: tuple[tuple[Quantity, str], ...] = (
    (
        "turning",
        (r"gyr\w*|gy|omega|angvel|angular\w*|rotation\w*|rotrate|drehrate\w*|winkelg\w*|rate|w|dps"),
    ),
    ("magnetic", (r"mag|magn\w*|compass|b|h|m")),
    ("gravity", (r"grav|gravit\w*|schwerkraft")),
    (
        "other",
        (
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
_TIME_WORDS = (
    r"(?:t|time|timestamp|timestamps|stamp|sec|seconds|zeit|zeitstempel|temps|horodatage|utc|date|datetime|datum|millis|"
    r"micros|epoch|epoc|unix|elapsed|uptime|clock|uhrzeit|heure|tow|datenum)+(?:ns|us|usec|ms|msec|s|utc|local|unix|"
    r"cal|fine|sincestart|sincereboot|ofday)*(?:unix|cal|instant)*"
)
_TEMPERATURE = (
    r"(?:\w*?(?:imu|acc|accel|gyro|sensor|chip|die|board|baro|device|s))?(?:temp|temperature|temperatur|tempc|tmp|degc)"
    r"(?:c|degc|cal|sensor|imu)?|t_?(?:imu|acc|accel|chip|die|sensor)"
)

Triple = tuple[int, int, int]
Group = dict[str, tuple[list[int], list[int], list[int]]]
"""Columns of each axis, by family of names; a second column of one name opens a second triple."""

SHOWN = 20
"""Column names that a message lists at most."""

_SPREAD = frozenset({"std", "sd", "sigma", "stdev", "stddev"})
_SPREAD_GLUED = r"(?:std|sd|sigma|s)([xyz])"

_ACCELERATION_NAMES = ("acc", "accel", "acceleration", "accelerometer", "linearacceleration")
_OUTPUT = (
    "a",
    "ac",
    "gf",
    *_ACCELERATION_NAMES,
    "fieldlinearacceleration",
    "accsmooth",
    "n",
    "out",
    "output",
    "",
)
_REFERENCE = ("f", "ref", "reference", "fref", "reff", "specificforce")
_TRUE = frozenset({"true", "truth", "known", "nominal", "reference"})
_GYRO = (
    *("w", "g", "gy", "gyr", "gyro", "gyroscope", "gyrorad"),
    *("omega", "angvel", "angularvelocity", "rotationrate"),
)
_CAPITAL_T = r"T(?:_?(?:deg)?[cCkK]|\s*[\[(]\s*(?!m?s\b).*)?"  # t would be time
_ALONE = {
    "temperature": (r"temperature|temp"),
    "label": (r"pose|poses|poseid|poselabel|posename|position|positionid|pos|label|orientation|face"),
    "count": (r"n|count|counts|samples|nsamples|numsamples|npoints"),
    "sensor": (
        r"(?:sensor|device|serial|imu|accelerometer|dut|node|board|chip|module|unit|part)"
        r"(?:id|no|nr|num|number|name|label|serial|serialno|serialnr|serialnumber|sn)|sensors?|device|serial|sn|imu|dut"
    ),
    "instance": (r"(?:imu|sensor|acc|accel)?instance(?:id|no|nr|num|number)?"),
    "kind": (r"(?:sensor|data|msg|message)?(?:type|kind)|topic|channel|measurement"),
    "other": (
        r"|t|time|timestamp|stamp|start|end|stop|tstart|tend|starttime|endtime|index|row|sec|seconds|id"
    ),
}
"""Roles of single columns, by their names without separators; those of `other` are not readings."""

_STAMPS = frozenset({"TimeUS", "TimeMS"})
_TIME = r"(?:t|time|timestamp|stamp|sec|seconds)(?:ns|us|usec|ms|msec)?"
_SENSOR_PERHAPS = r"id|uid|uuid|name|unit|part|chip|module|node|board|accelerometer"

_RATE = r"(\d+(?:\.\d+)?)\s*hz\b"  # compiled where there is something above a table
_RATE_NAMED = (
    r"(?:sampl\w*[ _-]?(?:rate|freq\w*)|update rate|data rate|measurement frequency|abtastrate|frequency)"
    r"\W+(\d+(?:\.\d+)?)"
)
_SERIAL = r"(?:serial(?:[ _-]?(?:number|code|no|nr))?|device[ _]?id|seriennummer)\W+(\w[\w-]*)"
_START = r"start(?:[ _-]?(?:time|date))?\W+(\d[\d/.:T -]*\d)"
_RANGE = r"range\W+([^,;\t]*?\d+\s*g)\b"
_ORDER = r"\b(d{1,2}[/.-]m{1,2}|m{1,2}[/.-]d{1,2})[/.-]y{2,4}"

LAYOUTS: dict[tuple[str, int], tuple[str, ...]] = {
    ("GENEActiv", 7): ("time", "x [g]", "y [g]", "z [g]", "light [lux]", "button", "temperature [degC]"),
}
"""Names of the columns of devices that write none: by a word of the preamble and the width of the table."""

DEVICE_UNITS = {"ActiGraph": "g", "GENEActiv": "g", "Axivity": "g", "AX3": "g"}
"""Units of acceleration of devices that do not write it, by a word of the preamble."""


@frozen()
class Meaning:
    """What a name says: the quantity, or None; the family, the name without its axis; the axis 0 to 2, or None.

    `number` is the axis as a number where the name has one instead of a letter, as CH3 or acc_0 do.
    """

    quantity: Quantity | None
    family: str
    axis: int | None = None
    number: int | None = None

    @property
    def is_axis(self) -> bool:
        """Whether it is an axis, be it by a number of an acceleration."""
        return self.axis is not None or (self.number is not None and self.quantity == "acceleration")


@lru_cache(maxsize=4096)
def parse_unit(text: str) -> str | None:
    """Return the unit that a text is, by its name in UNITS; None where it is none."""
    bare = text.strip().strip("[]() ").lower().replace("µ", "u").replace("μ", "u").replace("²", "2")
    bare = bare.replace("⁻", "-").replace("·", "*").replace("^", "").replace(" ", "").replace("\ufffd", "2")
    bare = re.sub(r"^[±+/-]*\d+(?=m?g$)", "", bare)  # "40g": the range, in its unit
    return _SPELLED.get(bare) or _SPELLED.get(bare.strip("()"))


def name_unit(name: str) -> str | None:
    """Return the unit in the name of a column, ``g`` for ``ax_g`` and ``gFx``; None where there is none."""
    behind_comma = re.findall(r",\s*([^,(\[]+?)\s*(?:[(\[]|$)", name)  # X Accel, g (LGR S/N: 10271234)
    for text in reversed(behind_comma + _BRACKETS.findall(name)):
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
        and re.fullmatch(_UNIT_WORDS, words[-1])
        and (words[-1] != "2" or words[-2] in ("s", "ms", "m"))
    ):
        words.pop()
    if len(words) == 1 and (glued := re.fullmatch(r"(?:mean|avg)([xyz])", words[0])):
        return [glued[1]]
    return [word for word in words if word not in MEAN] or words


def is_time(name: str) -> bool:
    """Return whether a column is time by its name: t, Zeit (s), timestamp_ms, S_Timestamp_Unix_CAL."""
    words = tokens_of(re.sub(_ZONE, "", name))
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
    return bool(re.fullmatch(_TIME_WORDS, key))


def is_temperature(name: str) -> bool:
    """Return whether a column is a temperature by its name."""
    return bool(re.fullmatch(_TEMPERATURE, "".join(tokens_of(name))))


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


def count_known(names: Sequence[str]) -> int:
    """Return how many cells of a line are names that are known."""
    return sum(bool(name) and (is_time(name) or describe(name).is_axis) for name in names)


def is_known(names: Sequence[str]) -> bool:
    """Return whether cells are names of columns, of which some say what they are."""
    return len(names) > 1 and count_known(names) > 1


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
    if any(re.fullmatch(_ACCELERATION, word) for word in words):
        if "angular" in words:
            return "turning"
        return "gravity-free" if _FREE & set(words) else "acceleration"
    for quantity, pattern in _KIND:
        if any(re.fullmatch(pattern, word) for word in words):
            return quantity
    return None


@dataclass
class Roles:
    """Columns by role, counted from 0; a triple is (x, y, z)."""

    alone: defaultdict[str, list[int]] = field(
        default_factory=lambda: defaultdict(list)
    )  # by name of the role
    families: dict[str, Triple] = field(default_factory=dict)  # candidates for the output, by their names
    described: dict[str, Triple] = field(default_factory=dict)  # acceleration behind any prefix
    unknown: dict[str, Triple] = field(default_factory=dict)  # three axes of something
    scatter: dict[str, Triple] = field(default_factory=dict)  # by family, "" for any
    reference: Triple | None = None
    gyro: Triple | None = None
    doubtful: list[str] = field(default_factory=list)  # names that occur twice where one is needed
    partial: list[str] = field(default_factory=list)  # triples that lack an axis, in words

    def single(self) -> set[int]:
        """Return the columns that have a role by themselves."""
        return {k for role, columns in self.alone.items() if role != "perhaps sensor" for k in columns}

    def first(self, role: str) -> int | None:
        """Return the first single column of a role."""
        return next(iter(self.alone[role]), None)


def recognise(names: Sequence[str]) -> Roles:
    """Give every column its role by its name."""
    roles = Roles()
    groups: tuple[Group, Group, Group, Group] = ({}, {}, {}, {})
    output, spread, reference, gyro = groups
    for column, name in enumerate(names):
        words = tokens_of(name)
        key = "".join(words)
        timed = parse_unit(next(reversed(_BRACKETS.findall(name)), "")) in TIME_UNITS
        if key and not timed and key[-1] in AXES and key[:-1] in _OUTPUT and key[:-1] not in _REFERENCE:
            _put(output, (key[:-1], key[-1]), column)  # the commonest names, without a look at any other
            continue
        if timed or re.fullmatch(_TIME, key) or is_time(name):
            roles.alone["time"].append(column)
        if re.fullmatch(_SENSOR_PERHAPS, key):
            roles.alone["perhaps sensor"].append(column)
        if role := _role(name, key) or ("other" if timed else None):
            roles.alone[role].append(column)
            continue
        if axis := _spread(words, key):
            _put(spread, axis, column)
        if (
            not axis
            and (truth := _TRUE & set(words))
            and (axis := _axis("".join(w for w in words if w not in truth), _OUTPUT))
        ):
            _put(reference, axis, column)
        for group, prefixes in ((reference, _REFERENCE), (output, _OUTPUT), (gyro, _GYRO)):
            if not axis and (axis := _axis(key, prefixes)):
                _put(group, axis, column)
    roles.families = {listed(names, triple): triple for _, triple in _triples(output)}
    roles.doubtful = [names[column] for column in _left_over(output, 1)]
    roles.scatter = dict(reversed(_triples(spread)))  # of two triples of one family the first stays
    roles.reference = next((triple for _, triple in _triples(reference)), None)
    roles.gyro = next((triple for _, triple in _triples(gyro)), None)
    roles.partial = [
        f'column "{names[k]}" not used: no {what} for all three axes'
        for group, what in ((spread, "standard deviation"), (reference, "reference"))
        for k in _left_over(group)
    ]
    assigned = {k for group in groups for axes in group.values() for axis in axes for k in axis}
    _describe_rest(names, [k for k in range(len(names)) if k not in assigned | roles.single()], roles)
    return roles


def _describe_rest(names: Sequence[str], columns: Sequence[int], roles: Roles) -> None:
    """Find triples among the columns whose names are not known as they are."""
    groups: dict[tuple[Quantity | None, str], dict[int, int]] = {}
    for column in columns:
        meaning = describe(names[column])
        place = meaning.axis if meaning.axis is not None else meaning.number
        told = place is not None or len(bare_name(names[column])) > 3
        if told and meaning.quantity not in (None, "acceleration"):
            roles.alone["other"].append(column)
        if place is not None:
            group = groups.setdefault((meaning.quantity, meaning.family + "#" * (meaning.axis is None)), {})
            group.setdefault(place, column)
    for (quantity, _), places in groups.items():
        order = sorted(places)
        if len(order) != 3 or order[2] - order[0] != 2:
            continue
        triple = (places[order[0]], places[order[1]], places[order[2]])
        if quantity == "turning":
            roles.gyro = roles.gyro or triple
        elif quantity in (None, "acceleration"):
            (roles.described if quantity else roles.unknown)[listed(names, triple)] = triple


def _role(name: str, key: str) -> str | None:
    """Return the role of a single column, None for an axis and for an unknown name."""
    if re.fullmatch(_CAPITAL_T, name.strip()):
        return "temperature"
    if name.strip() == "I":  # the instance, in the logs of ArduPilot
        return "instance"
    role = next((role for role, pattern in _ALONE.items() if re.fullmatch(pattern, key)), None)
    if role is None and is_temperature(name):
        return "temperature"
    return "other" if role is None and is_time(name) else role


def _axis(key: str, prefixes: Sequence[str]) -> tuple[str, str] | None:
    """Return family and axis of a key such as accx, xacc or xaxis."""
    if key[-1] in AXES and key[:-1] in prefixes:
        return key[:-1], key[-1]
    leading = key[0] in AXES and key[1:] in (*_ACCELERATION_NAMES, "axis") and "a" in prefixes
    return (key[1:], key[0]) if leading else None


def _spread(words: Sequence[str], key: str) -> tuple[str, str] | None:
    """Return family and axis of a standard deviation; family "" where the name has none."""
    rest = "".join(word for word in words if word not in _SPREAD)
    if rest and len(rest) < len(key):
        return _axis(rest, _OUTPUT)
    glued = re.fullmatch(_SPREAD_GLUED, key)
    return ("", glued[1]) if glued else None


def _put(group: Group, place: tuple[str, str], column: int) -> None:
    family, axis = place
    group.setdefault(family, ([], [], []))[AXES.index(axis)].append(column)


def _triples(group: Group) -> list[tuple[str, Triple]]:
    """Return family and columns of every triple that has all axes."""
    return [(family, triple) for family, axes in group.items() for triple in zip(*axes, strict=False)]


def _left_over(group: Group, least: int = 0) -> list[int]:
    """Return the columns of incomplete triples; with `least` 1 those of a second triple and later ones alone."""
    ends = (axis[max(least, min(map(len, axes))) :] for axes in group.values() for axis in axes)
    return sorted(column for end in ends for column in end)


def listed(names: Sequence[str], columns: Sequence[int], between: str = ", ") -> str:
    """Return names of columns in quotes."""
    listed = between.join(f'"{names[k]}"' for k in columns[:SHOWN])
    return listed + (f" and {len(columns) - SHOWN} more" if len(columns) > SHOWN else "")


def bare_name(name: str) -> str:
    """Return a name without unit, in lower case."""
    return "".join(tokens_of(name))


def note_of_vehicle(names: Sequence[str]) -> str:
    """Return what to say of a table whose columns a vehicle has corrected; "" of any other."""
    if "accelerometer_m_s2[0]" in names:
        vehicle, own = "PX4", "CAL_ACC"
    elif {"AccX", "AccY", "AccZ"} <= set(names) and not _STAMPS.isdisjoint(names):
        vehicle, own = "ArduPilot", "INS_ACC"
    else:
        return ""
    return (
        f"{vehicle} corrected the readings by its {own} parameters, which a table does not hold: an export corrects "
        "what the vehicle has corrected; calibrate the log itself"
    )


def is_kind(name: str) -> bool:
    """Return whether a column, by its name, holds kinds: of sensors perhaps, or of poses."""
    return bool(recognise((name,)).alone["kind"])


@frozen()
class Facts:
    """What stands above a table, as far as it was understood.

    Attributes:
        rate: rows per second, Hz; start, serial, range: as written.
        day_first: whether dates begin with the day, None where nothing says.
        device: key of LAYOUTS, "" where there is none; unit: of the acceleration that it writes, None if unknown.
    """

    rate: float | None = None
    start: str = ""
    serial: str = ""
    range: str = ""
    day_first: bool | None = None
    device: str = ""
    unit: str | None = None

    def __str__(self) -> str:
        """What was understood, in words."""
        rate = "" if self.rate is None else f"{self.rate:g} Hz"
        parts = (("rate", rate), ("start", self.start), ("serial number", self.serial), ("range", self.range))
        return ", ".join(f"{name} {value}" for name, value in parts if value)


def read_facts(lines: Sequence[str]) -> Facts:
    """Return what the lines above a table say."""
    if not lines:
        return Facts()
    text = "\n".join(lines)
    named, rate, start, serial, span, order = (
        re.search(pattern, text, re.IGNORECASE)
        for pattern in (_RATE_NAMED, _RATE, _START, _SERIAL, _RANGE, _ORDER)
    )
    rate = named or rate
    return Facts(
        float(rate[1]) if rate and float(rate[1]) > 0 else None,
        start[1].strip() if start else "",
        serial[1] if serial else "",
        span[1].strip() if span else "",
        None if order is None else order[1].lower().startswith("d"),
        next((device for device, _ in LAYOUTS if device.lower() in text.lower()), ""),
        next((unit for device, unit in DEVICE_UNITS.items() if device.lower() in text.lower()), None),
    )
