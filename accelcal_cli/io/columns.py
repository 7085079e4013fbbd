"""The columns of a table: which they are is stated by the user, or recognised by their names.

`choose` finds the columns of a table of static readings, `choose_raw` those of a raw log, `sensor_column` the one that
labels the sensor in a table of many sensors. All of them use `recognise`, which gives every column its role by its
name. An ambiguous table is an error that says what to state; columns are never guessed.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError, UsageError, did_you_mean
from accelcal_cli.io.reader import InputTable, Selection

Triple = tuple[int, int, int]
Group = dict[str, tuple[list[int], list[int], list[int]]]
"""Columns of each axis, by family of names; a second column of one name opens a second triple."""

AXES = "xyz"

COUNTED = 16
"""Digits from which on a time is read as an integer: a 64-bit float would round it."""

NONE = "none"
"""Option value for no gyroscope, or no time."""

NAMELESS: dict[int, tuple[Triple, Triple | None, int | None]] = {
    3: ((0, 1, 2), None, None),
    4: ((1, 2, 3), None, 0),
    6: ((0, 1, 2), (3, 4, 5), None),
    7: ((1, 2, 3), (4, 5, 6), 0),
}
"""Acceleration, gyroscope and time of a log without a header, by its number of columns."""

SHOWN = 20
"""Column names that a message lists at most."""

_BRACKETS = re.compile(r"[\[(][^\])]*[\])]")
_INDEX = re.compile(r"\[([012])\]\s*$")  # accelerometer_m_s2[0]
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_UNITS = re.compile(r"g|mg|ug|mps|mps2|ms|ms2|m|s|s2|2|lsb|counts|raw|mv|v|c|degc|celsius|k|pulse|pulses|hz")
_MEAN = frozenset({"mean", "avg", "average"})
_SPREAD = frozenset({"std", "sd", "sigma", "stdev", "stddev"})
_SPREAD_GLUED = re.compile(r"(?:std|sd|sigma|s)([xyz])")

_ACCELERATION = ("acc", "accel", "acceleration", "accelerometer", "linearacceleration")
_OUTPUT = ("a", *_ACCELERATION, "fieldlinearacceleration", "accsmooth", "n", "out", "output", "")
_REFERENCE = ("f", "ref", "reference", "fref", "reff", "specificforce")
_GYRO = (
    *("w", "g", "gyr", "gyro", "gyroscope", "gyrorad"),
    *("omega", "angvel", "angularvelocity", "rotationrate"),
)
_CAPITAL_T = re.compile(r"T(?:_?(?:deg)?[cCkK]|\s*[\[(]\s*(?!m?s\b).*)?")  # t would be time
_ALONE = {
    "temperature": re.compile(r"temperature|temp"),
    "label": re.compile(
        r"pose|poses|poseid|poselabel|posename|position|positionid|pos|label|orientation|face"
    ),
    "count": re.compile(r"n|count|counts|samples|nsamples|numsamples|npoints"),
    "sensor": re.compile(
        r"(?:sensor|device|serial|imu|accelerometer|dut|node|board|chip|module|unit|part)"
        r"(?:id|no|nr|num|number|name|label|serial|serialno|serialnr|serialnumber|sn)|sensors?|device|serial|sn|imu|dut"
    ),
    "other": re.compile(
        r"|t|time|timestamp|stamp|start|end|stop|tstart|tend|starttime|endtime|index|row|sec|seconds|id"
    ),
}
"""Roles of single columns, by their names without separators; those of `other` are not readings."""

_TIME = re.compile(r"(?:t|time|timestamp|stamp|sec|seconds)(?:ns|us|usec|ms|msec)?")
_SENSOR_PERHAPS = re.compile(r"id|uid|uuid|name|unit|part|chip|module|node|board|accelerometer")


@dataclass(frozen=True)
class Columns:
    """Columns of a table of readings, counted from 0; None where there are none.

    Attributes:
        output: x, y, z; names: of these, or their numbers from 1.
        sensor, label: which sensor and which pose a row is of.
        count, scatter: raw readings behind a row, and the standard deviation of one of them.
        reference: known specific force; temperature, time, gyro: as their names say.
        notes: what a user should know.
    """

    output: Triple
    names: tuple[str, str, str]
    sensor: int | None = None
    label: int | None = None
    count: int | None = None
    scatter: Triple | None = None
    reference: Triple | None = None
    temperature: int | None = None
    time: int | None = None
    gyro: Triple | None = None
    notes: tuple[str, ...] = ()

    @property
    def extras(self) -> tuple[int, ...]:
        """Numeric columns other than the output: count, scatter, reference, temperature, as far as present."""
        return (
            *_present(self.count),
            *(self.scatter or ()),
            *(self.reference or ()),
            *_present(self.temperature),
        )

    def selection(self) -> Selection:
        """Return what to ask of the table; a standard deviation or temperature may be missing in a row."""
        gaps = frozenset((*(self.scatter or ()), *_present(self.temperature)))
        return Selection((*self.output, *self.extras), gaps, _present(self.sensor, self.label), self.output)

    def split(self, extras: Float) -> tuple[Float | None, Float | None, Float]:
        """Split the values of `extras`, shape (B, k), into count (B,), scatter (B, 3) and the others (B, m)."""
        at = 0 if self.count is None else 1
        then = at + (0 if self.scatter is None else 3)
        return extras[:, 0] if at else None, extras[:, at:then] if then > at else None, extras[:, then:]


@dataclass(frozen=True)
class RawColumns:
    """Columns of a raw log, counted from 0.

    Attributes:
        output: the accelerometer; names: of its columns, or their numbers from 1.
        gyro, time: None where there are none.
        dated: `time` holds dates, not numbers.
        guessed: `time` is only time when it never decreases.
        doubtful: the error when a guessed time column is not time, so that the others are unknown, too.
        notes: what a user should know.
    """

    output: Triple
    names: tuple[str, str, str]
    gyro: Triple | None = None
    time: int | None = None
    dated: bool = False
    guessed: bool = False
    doubtful: str = ""
    notes: tuple[str, ...] = ()

    def selection(self) -> Selection:
        """Return what to ask of the table: acceleration, gyroscope, time; dates as text."""
        sensors, time = (*self.output, *(self.gyro or ())), _present(self.time)
        needed = self.output
        if self.dated:
            return Selection(sensors, texts=time, needed=needed)
        return Selection((*sensors, *time), needed=needed)


def choose(table: InputTable, wanted: Sequence[str] | None = None, sensor: int | None = None) -> Columns:
    """Find the three output columns and the optional ones.

    Args:
        table: of static readings, open.
        wanted: the three output columns, by name or number from 1; None to go by the names.
        sensor: the column that labels the sensor, in a table of many sensors.

    Raises:
        DataError: the table has no rows, or its columns are ambiguous. UsageError: `wanted` does not fit the table.
    """
    if not table.has_rows:
        raise DataError(f"{table.name}: has a header but no readings below it")
    names = table.names
    roles = recognise(names or ())
    notes: tuple[str, ...] = ()
    if wanted is not None:
        output = parse_triple(table, [wanted] if isinstance(wanted, str) else wanted)
    elif roles.families:
        output = _only_family(table, roles)
    else:
        output = _only_three(table, roles, sensor)
        notes = (
            f"no header: columns {_numbered(output)} taken as x, y, z"
            if names is None
            else f"columns {_listed(names, output)} taken as x, y, z: the only three that can be",
        )
    return _with_extras(table, output, roles, notes, sensor)


def choose_raw(
    table: InputTable,
    columns: Sequence[str] | None = None,
    gyro: Sequence[str] | None = None,
    time: str | None = None,
) -> RawColumns:
    """Find the columns of a raw log; what is stated wins over names, names over the number of columns.

    Raises:
        DataError: the table is ambiguous.
        UsageError: a stated column does not exist or is stated twice.
    """
    if not table.has_rows:
        raise DataError(f"{table.name}: has a header but no rows below it")
    raw = _by_width(table) if columns is None and table.names is None else _by_name(table, columns)
    turning = raw.gyro
    if gyro is not None:
        words = [gyro] if isinstance(gyro, str) else list(gyro)
        turning = None if [word.lower() for word in words] == [NONE] else parse_triple(table, words, "--gyro")
    clock = None if raw.time in (turning or ()) else raw.time
    if time is not None:
        clock = None if time.lower() == NONE else find_column(table, time, "--time")
        raw = replace(raw, guessed=False, doubtful="")
    used = (*raw.output, *(turning or ()), *_present(clock))
    if len(set(used)) < len(used):
        raise UsageError("--columns, --gyro, --time: a column is asked for twice")
    return replace(raw, gyro=turning, time=clock, dated=clock is not None and _is_text(table, clock))


def _is_text(table: InputTable, clock: int) -> bool:
    """Return whether a time column has to be read as text: dates, clocks, and counts too long for a float."""
    if not table.numeric[clock]:
        return True
    first = next((cells[clock] for cells in table.preview() if cells[clock]), "")
    return first.isascii() and first.isdigit() and len(first) >= COUNTED


def sensor_column(table: InputTable, wanted: str | None = None) -> int:
    """Find the column that labels the sensor; DataError or UsageError if in doubt."""
    option, names = "--sensor-column", table.names
    if wanted is not None:
        return find_column(table, wanted.strip(), option)
    if names is None:
        raise DataError(
            f"{table.name}: has no header; say which column labels the sensor, as in {option} 1, or give one file "
            "per sensor"
        )
    roles = recognise(names)
    candidates = roles.alone["sensor"] or roles.alone["perhaps sensor"]
    if len(candidates) > 1:
        raise DataError(
            f"{table.name}: the sensor could be {_listed(names, candidates, ' or ')}; say which with {option}"
        )
    if not candidates:
        raise DataError(
            f"{table.name}: no column that labels the sensor, such as sensor, serial, device or id; say which with "
            f"{option} (there are {_listed(names, range(len(names)))}), or give one file per sensor"
        )
    return candidates[0]


def own_sensor_column(table: InputTable) -> int | None:
    """Return the column that labels the sensor in a table of one sensor, None where there are none or several."""
    sensors = recognise(table.names or ()).alone["sensor"]
    return sensors[0] if len(sensors) == 1 else None


def parse_triple(table: InputTable, wanted: Sequence[str], option: str = "--columns") -> Triple:
    """Return the three columns that the user names or numbers; UsageError names the `option`."""
    words = [word.strip() for word in (wanted[0].split(",") if len(wanted) == 1 else wanted)]
    if len(words) != 3:
        raise UsageError(f"{option}: three columns were expected (x, y, z), not {len(words)}")
    columns = [find_column(table, word, option) for word in words]
    for k, column in enumerate(columns):
        if column in columns[:k]:
            raise UsageError(f'{option}: column "{words[k]}" is asked for twice')
    return columns[0], columns[1], columns[2]


def find_column(table: InputTable, word: str, option: str = "--columns") -> int:
    """Find a column by exact name, by name in any case or without its unit, or by number."""
    names, width = table.names, len(table.numeric)
    for fold in (str, str.lower, _bare_name):
        matches = [k for k, name in enumerate(names or ()) if fold(name) == fold(word)]
        if len(matches) > 1:
            numbers = " or ".join(str(k + 1) for k in matches)
            raise UsageError(f'{option}: "{word}" could be column {numbers} of {table.name}; give the number')
        if matches:
            return matches[0]
    if word.isascii() and word.isdigit():
        if 1 <= int(word) <= width:
            return int(word) - 1
        raise UsageError(f"{option}: no column {word}; {table.name} has columns 1 to {width}")
    if names is None:
        raise UsageError(
            f'{option}: no column "{word}": {table.name} has no header; give numbers from 1 to {width}'
        )
    hint = did_you_mean(word, names) or f"; there are {_listed(names, range(width))}"
    raise UsageError(f'{option}: no column "{word}" in {table.name}{hint}')


@dataclass
class Roles:
    """Columns by role, counted from 0; a triple is (x, y, z)."""

    alone: defaultdict[str, list[int]] = field(
        default_factory=lambda: defaultdict(list)
    )  # by name of the role
    families: dict[str, Triple] = field(default_factory=dict)  # candidates for the output, by their names
    scatter: dict[str, Triple] = field(default_factory=dict)  # by family, "" for any
    reference: Triple | None = None
    gyro: Triple | None = None
    doubtful: list[str] = field(default_factory=list)  # names that occur twice where one is needed
    partial: list[str] = field(default_factory=list)  # triples that lack an axis, in words

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
        if _TIME.fullmatch(key):
            roles.alone["time"].append(column)
        if _SENSOR_PERHAPS.fullmatch(key):
            roles.alone["perhaps sensor"].append(column)
        if role := _role(name, key):
            roles.alone[role].append(column)
            continue
        if axis := _spread(words, key):
            _put(spread, axis, column)
        for group, prefixes in ((reference, _REFERENCE), (output, _OUTPUT), (gyro, _GYRO)):
            if not axis and (axis := _axis(key, prefixes)):
                _put(group, axis, column)
    roles.families = {_listed(names, triple): triple for _, triple in _triples(output)}
    roles.doubtful = [names[column] for column in _left_over(output, 1)]
    roles.scatter = dict(reversed(_triples(spread)))  # of two triples of one family the first stays
    roles.reference = next((triple for _, triple in _triples(reference)), None)
    roles.gyro = next((triple for _, triple in _triples(gyro)), None)
    roles.partial = [
        f'column "{names[k]}" not used: no {what} for all three axes'
        for group, what in ((spread, "standard deviation"), (reference, "reference"))
        for k in _left_over(group)
    ]
    return roles


def tokens_of(name: str) -> list[str]:
    """Return the words of a column name in lower case, without units and without "mean"."""
    name = _INDEX.sub(lambda match: "_" + AXES[int(match[1])], re.sub(r"_?m_s_?2", "", name))
    words = re.findall(r"[a-z0-9]+", _CAMEL.sub("_", _BRACKETS.sub(" ", name)).lower())
    while len(words) > 1 and _UNITS.fullmatch(words[-1]):
        words.pop()
    return [word for word in words if word not in _MEAN] or words


def _only_family(table: InputTable, roles: Roles) -> Triple:
    if len(roles.families) > 1:
        raise DataError(
            f"{table.name}: the readings could be {' or '.join(roles.families)}; say which with --columns"
        )
    if roles.doubtful:
        raise DataError(
            f'{table.name}: more than one column could be "{roles.doubtful[0]}"; '
            "say which to use with --columns and column numbers"
        )
    return next(iter(roles.families.values()))


def _only_three(table: InputTable, roles: Roles, sensor: int | None) -> Triple:
    """Return the three columns whose names do not say that they are something else, if there are just three."""
    names, width = table.names, len(table.numeric)
    known = {
        *(roles.reference or ()),
        *roles.alone["other"],
        *roles.alone["sensor"],
        sensor,
        *(roles.first(role) for role in ("count", "temperature", "label")),
        *(column for triple in roles.scatter.values() for column in triple),
    }
    left = [k for k in range(width) if k not in known]
    if names is not None and len(left) > 3:
        left = [k for k in left if table.numeric[k]]
    if len(left) == 3:
        twice = [names[k] for k in left if names[k]] if names is not None else []
        if len(set(twice)) < len(twice):
            again = next(name for k, name in enumerate(twice) if name in twice[:k])
            raise DataError(
                f'{table.name}: two columns are called "{again}"; say which are x, y, z with --columns and column '
                "numbers"
            )
        return left[0], left[1], left[2]
    if width < 3:
        plural = "s" * (width != 1)
        raise DataError(f"{table.name}: has {width} column{plural} where three (x, y, z) were expected")
    if names is None:
        raise DataError(
            f"{table.name}: has {width} columns and no header; say which three are x, y, z, as in --columns 1,2,3"
        )
    raise DataError(
        f"{table.name}: no column names such as ax, ay, az; say which columns are x, y, z with --columns "
        f"(there are {_listed(names, range(width))})"
    )


def _with_extras(
    table: InputTable, output: Triple, roles: Roles, notes: tuple[str, ...], sensor: int | None
) -> Columns:
    """Add the optional columns that are not themselves the output or the label of the sensor."""
    names, taken = table.names, {*output, sensor}

    def free(role: str) -> int | None:
        column = roles.first(role)
        return None if column in taken else column

    def free_triple(triple: Triple | None) -> Triple | None:
        return None if triple is None or taken & set(triple) else triple

    shown = [names[k] if names is not None and names[k] else str(k + 1) for k in output]
    # The standard deviations of the output are those of its own family, or of none.
    family = "" if names is None else _bare_name(names[output[0]])[:-1]
    columns = Columns(
        output,
        (shown[0], shown[1], shown[2]),
        sensor,
        free("label"),
        free("count"),
        free_triple(roles.scatter.get(family, roles.scatter.get(""))),
        free_triple(roles.reference),
        free("temperature"),
        free("time"),
        free_triple(roles.gyro),
    )
    used = (*_present(sensor, columns.label), *columns.extras)
    if names is not None and used:
        notes = (*notes, f"column{'s' * (len(used) > 1)} {_listed(names, used)} found")
    return replace(columns, notes=(*notes, *roles.partial))


def _by_name(table: InputTable, wanted: Sequence[str] | None) -> RawColumns:
    """Go by the names of the columns, or, for a stated accelerometer, by what the names leave."""
    columns = choose(table, wanted)
    if table.names is not None:
        return RawColumns(columns.output, columns.names, columns.gyro, columns.time)
    guess = 0 if 0 not in columns.output and table.numeric[0] else None
    return RawColumns(columns.output, columns.names, time=guess, guessed=True)


def _by_width(table: InputTable) -> RawColumns:
    """Go by the number of columns of a log without a header."""
    width = len(table.numeric)
    if width not in NAMELESS:
        raise DataError(
            f"{table.name}: has {width} columns and no header; expected 3 (acceleration), 4 (time, acceleration), "
            "6 (acceleration, gyroscope) or 7 (time, acceleration, gyroscope); say which are x, y, z with "
            "--columns, as in --columns 2,3,4"
        )
    output, gyro, time = NAMELESS[width]
    names = (str(output[0] + 1), str(output[1] + 1), str(output[2] + 1))
    turning = "" if gyro is None else f", columns {_numbered(gyro)} as gyroscope"
    note = f"no header: columns {_numbered(output)} taken as acceleration x, y, z{turning}"
    doubtful = (
        f"{table.name}: has {width} columns and no header, and the first is not time; say which are x, y, z "
        "with --columns, as in --columns 1,2,3"
    )
    return RawColumns(output, names, gyro, time, guessed=time is not None, doubtful=doubtful, notes=(note,))


def _role(name: str, key: str) -> str | None:
    """Return the role of a single column, None for an axis and for an unknown name."""
    if _CAPITAL_T.fullmatch(name.strip()):
        return "temperature"
    return next((role for role, pattern in _ALONE.items() if pattern.fullmatch(key)), None)


def _axis(key: str, prefixes: Sequence[str]) -> tuple[str, str] | None:
    """Return family and axis of a key such as accx, xacc or xaxis."""
    if key[-1] in AXES and key[:-1] in prefixes:
        return key[:-1], key[-1]
    leading = key[0] in AXES and key[1:] in (*_ACCELERATION, "axis") and "a" in prefixes
    return (key[1:], key[0]) if leading else None


def _spread(words: Sequence[str], key: str) -> tuple[str, str] | None:
    """Return family and axis of a standard deviation; family "" where the name has none."""
    rest = "".join(word for word in words if word not in _SPREAD)
    if rest and len(rest) < len(key):
        return _axis(rest, _OUTPUT)
    glued = _SPREAD_GLUED.fullmatch(key)
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


def _listed(names: Sequence[str], columns: Sequence[int], between: str = ", ") -> str:
    listed = between.join(f'"{names[k]}"' for k in columns[:SHOWN])
    return listed + (f" and {len(columns) - SHOWN} more" if len(columns) > SHOWN else "")


def _numbered(columns: Triple) -> str:
    return ", ".join(str(k + 1) for k in columns)


def _present(*columns: int | None) -> tuple[int, ...]:
    return tuple(column for column in columns if column is not None)


def _bare_name(name: str) -> str:
    return "".join(tokens_of(name))
