"""What the columns of a table of readings are, told from their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

AXES = "xyz"
_BRACKETS = re.compile(r"[\[(][^\])]*[\])]")
_INDEX = re.compile(r"\[([012])\]\s*$")  # accelerometer_m_s2[0]
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_UNITS = re.compile(r"g|mg|ug|mps|mps2|ms|ms2|m|s|s2|2|lsb|counts|raw|mv|v|c|degc|celsius|k|pulse|pulses|hz")
_CAPITAL_T = re.compile(r"T(?:_?(?:deg)?[cCkK]|\s*[\[(]\s*(?!m?s\b).*)?")  # t would be time
_MEAN = frozenset({"mean", "avg", "average"})
_SPREAD = frozenset({"std", "sd", "sigma", "stdev", "stddev"})
_SPREAD_GLUED = re.compile(r"(?:std|sd|sigma|s)([xyz])")

_ACCELERATION = ("acc", "accel", "acceleration", "accelerometer", "linearacceleration")
_OUTPUT = ("a", *_ACCELERATION, "fieldlinearacceleration", "accsmooth", "n", "out", "output", "")
_REFERENCE = ("f", "ref", "reference", "fref", "reff", "specificforce")
_GYRO = (
    "w",
    "g",
    "gyr",
    "gyro",
    "gyroscope",
    "gyrorad",
    "omega",
    "angvel",
    "angularvelocity",
    "rotationrate",
)
_TIME = re.compile(r"(?:t|time|timestamp|stamp|sec|seconds)(?:ns|us|usec|ms|msec)?")
_LABEL = re.compile(r"pose|poses|poseid|poselabel|posename|position|positionid|pos|label|orientation|face")
_SENSOR = re.compile(
    r"(?:sensor|device|serial|imu|accelerometer|dut|node|board|chip|module|unit|part)"
    r"(?:id|no|nr|num|number|name|label|serial|serialno|serialnr|serialnumber|sn)|sensors?|device|serial|sn|imu|dut"
)
_SENSOR_PERHAPS = re.compile(r"id|uid|uuid|name|unit|part|chip|module|node|board|accelerometer")
_COUNT = frozenset({"n", "count", "counts", "samples", "nsamples", "numsamples", "npoints"})
_TEMPERATURE = frozenset({"temperature", "temp"})
_OTHER = re.compile(
    r"t|time|timestamp|stamp|start|end|stop|tstart|tend|starttime|endtime|index|row|sec|"
    r"seconds|id"
)


@dataclass
class Roles:
    """Columns by role, counted from 0; a triple is (x, y, z)."""

    families: dict[str, tuple[int, int, int]] = field(default_factory=dict)  # candidates for the output
    scatter: dict[str, tuple[int, int, int]] = field(default_factory=dict)  # by family, "" for any
    reference: tuple[int, int, int] | None = None
    label: int | None = None
    count: int | None = None
    temperature: int | None = None
    sensors: list[int] = field(default_factory=list)  # which sensor a row is of
    perhaps_sensors: list[int] = field(default_factory=list)  # the same, where no other column says so
    doubtful: list[str] = field(default_factory=list)  # names that come twice where one is needed
    other: set[int] = field(default_factory=set)  # known to be no readings: time, row number
    partial: list[str] = field(default_factory=list)  # triples that lack an axis, in words


def tokens_of(name: str) -> list[str]:
    """Words of a column name in lower case, without units and without "mean"."""
    name = re.sub(r"_?m_s_?2", "", name)
    name = _INDEX.sub(lambda found: "_" + AXES[int(found[1])], name)
    words = re.split(r"[^a-z0-9]+", _CAMEL.sub("_", _BRACKETS.sub(" ", name)).lower())
    words = [word for word in words if word]
    while len(words) > 1 and _UNITS.fullmatch(words[-1]):
        words.pop()
    return [word for word in words if word not in _MEAN] or words


def recognise(names: Sequence[str]) -> Roles:
    """Give every column its role."""
    roles = Roles()
    output: dict[tuple[str, int], dict[str, int]] = {}
    spread: dict[tuple[str, int], dict[str, int]] = {}
    reference: dict[tuple[str, int], dict[str, int]] = {}
    for column, name in enumerate(names):
        words = tokens_of(name)
        key = "".join(words)
        if _single(roles, column, name, key):
            continue
        if found := _spread(words, key):
            _put(spread, found, column)
        elif found := _axis(key, _REFERENCE):
            _put(reference, found, column)
        elif found := _axis(key, _OUTPUT):
            _put(output, found, column)
    roles.families = {_title(names, triple): triple for triple in _triples(output).values()}
    again = [by for (_, turn), by in output.items() if turn and len(by) < len(AXES)]
    roles.doubtful = [names[column] for by in again for column in by.values()]
    for (family, _), triple in _triples(spread).items():
        roles.scatter.setdefault(family, triple)
    roles.reference = next(iter(_triples(reference).values()), None)
    for group, what in ((spread, "standard deviation"), (reference, "reference")):
        roles.partial += _lacking(group, names, what)
    return roles


def gyro_columns(names: Sequence[str]) -> tuple[int, int, int] | None:
    """Return the columns of a gyroscope, such as wx, wy, wz or gyro_x, gyro_y, gyro_z; None where there are none."""
    found: dict[tuple[str, int], dict[str, int]] = {}
    for column, name in enumerate(names):
        if axis := _axis("".join(tokens_of(name)) or " ", _GYRO):
            _put(found, axis, column)
    return next(iter(_triples(found).values()), None)


def time_column(names: Sequence[str]) -> int | None:
    """Return the first column that is called time, None where there is none."""
    return next((k for k, name in enumerate(names) if _TIME.fullmatch("".join(tokens_of(name)))), None)


def _single(roles: Roles, column: int, name: str, key: str) -> bool:
    """Settle a column that stands alone; of two of a kind the first counts."""
    if _SENSOR_PERHAPS.fullmatch(key):
        roles.perhaps_sensors.append(column)
    if key in _TEMPERATURE or _CAPITAL_T.fullmatch(name.strip()):
        roles.temperature = column if roles.temperature is None else roles.temperature
    elif _LABEL.fullmatch(key):
        roles.label = column if roles.label is None else roles.label
    elif key in _COUNT:
        roles.count = column if roles.count is None else roles.count
    elif _SENSOR.fullmatch(key):
        roles.sensors.append(column)
    elif _OTHER.fullmatch(key) or not key:
        roles.other.add(column)
    else:
        return False
    return True


def _axis(key: str, prefixes: Sequence[str]) -> tuple[str, str] | None:
    """Family and axis of a key such as accx, xacc or xaxis."""
    if key[-1] in AXES and key[:-1] in prefixes:
        return key[:-1], key[-1]
    if key[0] in AXES and key[1:] in (*_ACCELERATION, "axis") and "a" in prefixes:
        return key[1:], key[0]
    return None


def _spread(words: Sequence[str], key: str) -> tuple[str, str] | None:
    """Family and axis of a standard deviation; family "" where the name has none."""
    rest = "".join(word for word in words if word not in _SPREAD)
    if rest and len(rest) < len(key):
        return _axis(rest, _OUTPUT)
    glued = _SPREAD_GLUED.fullmatch(key)
    return ("", glued[1]) if glued else None


def _put(group: dict[tuple[str, int], dict[str, int]], found: tuple[str, str], column: int) -> None:
    """File a column under its family; a second column of one name opens a second triple."""
    family, axis = found
    turn = 0
    while axis in group.setdefault((family, turn), {}):
        turn += 1
    group[family, turn][axis] = column


def _triples(group: dict[tuple[str, int], dict[str, int]]) -> dict[tuple[str, int], tuple[int, int, int]]:
    return {key: (by["x"], by["y"], by["z"]) for key, by in group.items() if len(by) == len(AXES)}


def _title(names: Sequence[str], triple: tuple[int, int, int]) -> str:
    return ", ".join(f'"{names[column]}"' for column in triple)


def _lacking(group: dict[tuple[str, int], dict[str, int]], names: Sequence[str], what: str) -> list[str]:
    short = [column for by in group.values() if len(by) < len(AXES) for column in by.values()]
    return [f'column "{names[column]}" not used: no {what} for all three axes' for column in short]
