"""Which columns of a table to read: the user's choice, or the names' own word.

What the columns of a table of readings are, told from their names.

Which columns of a raw log are acceleration, rotation and time.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from accelcal_cli.errors import DataError, UsageError, did_you_mean
from accelcal_cli.io.reader import Table
from accelcal_cli.io.text import Selection

Triple = tuple[int, int, int]


@dataclass(frozen=True)
class Columns:
    """Columns of a table of readings, counted from 0."""

    output: Triple
    names: tuple[str, str, str]
    sensor: int | None = None
    label: int | None = None
    count: int | None = None
    scatter: Triple | None = None
    reference: Triple | None = None
    temperature: int | None = None
    time: int | None = None
    notes: tuple[str, ...] = ()

    @property
    def extras(self) -> tuple[int, ...]:
        """Numeric columns beside the output: count, scatter, reference, temperature, as far as present."""
        count = () if self.count is None else (self.count,)
        warmth = () if self.temperature is None else (self.temperature,)
        return (*count, *(self.scatter or ()), *(self.reference or ()), *warmth)

    def selection(self) -> Selection:
        """What to ask of the table; a standard deviation or temperature may be missing in a row."""
        gaps = frozenset((*(self.scatter or ()), *(() if self.temperature is None else (self.temperature,))))
        texts = tuple(column for column in (self.sensor, self.label) if column is not None)
        return Selection((*self.output, *self.extras), gaps, texts)


def choose(table: Table, wanted: Sequence[str] | None = None, sensor: int | None = None) -> Columns:
    """Find the three output columns and the optional ones; DataError or UsageError if in doubt.

    `sensor` is the column that says which sensor a row is of, in a table of many.
    """
    if not table.has_rows:
        raise DataError(f"{table.name}: has a header but no readings below it")
    names = table.names
    roles = recognise(names) if names is not None else Roles()
    note: tuple[str, ...] = ()
    if wanted is not None:
        output = stated(table, [wanted] if isinstance(wanted, str) else wanted)
    elif names is None:
        output = _nameless(table, sensor)
        shown = ", ".join(str(k + 1) for k in output)
        note = (f"no header: columns {shown} taken as x, y, z",)
    elif roles.families:
        output = _only_family(table, roles)
    else:
        output = _only_numeric(table, names, roles, sensor)
        note = (f"columns {_listed(names, output)} taken as x, y, z: the only three that can be",)
    return _with_extras(table, output, roles, note, sensor)


def stated(table: Table, wanted: Sequence[str], option: str = "--columns") -> Triple:
    """Return the three columns that the user names or numbers; UsageError names the `option`."""
    words = [word.strip() for word in (wanted[0].split(",") if len(wanted) == 1 else wanted)]
    if len(words) != 3:
        raise UsageError(f"{option}: three columns were expected (x, y, z), not {len(words)}")
    found = [find_column(table, word, option) for word in words]
    for k, column in enumerate(found):
        if column in found[:k]:
            raise UsageError(f'{option}: column "{words[k]}" is asked for twice')
    return found[0], found[1], found[2]


def find_column(table: Table, word: str, option: str = "--columns") -> int:
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


def sensor_columns(table: Table) -> tuple[list[int], list[int]]:
    """Return the columns whose names say that they label the sensor, and those that may do so."""
    roles = recognise(table.names or ())
    return roles.sensors, roles.perhaps_sensors


def sensor_column(table: Table, wanted: str | None = None) -> int:
    """Find the column that says which sensor a row is of; DataError or UsageError if in doubt."""
    option, names = "--sensor-column", table.names
    if wanted is not None:
        return find_column(table, wanted.strip(), option)
    if names is None:
        raise DataError(
            f"{table.name}: has no header; say which column labels the sensor, as in {option} 1, or give one file "
            "a sensor"
        )
    sure, perhaps = sensor_columns(table)
    found = sure or perhaps
    if len(found) > 1:
        raise DataError(
            f"{table.name}: the sensor could be {_listed(names, found, ' or ')}; say which with {option}"
        )
    if not found:
        raise DataError(
            f"{table.name}: no column that labels the sensor, such as sensor, serial, device or id; say which with "
            f"{option} (there are {_listed(names, range(len(names)))}), or give one file a sensor"
        )
    return found[0]


def _nameless(table: Table, sensor: int | None) -> Triple:
    width = len(table.numeric)
    left = [k for k in range(width) if k != sensor]
    if len(left) == 3:
        return left[0], left[1], left[2]
    if width < 3:
        raise DataError(f"{table.name}: has {_plural(width)} where three (x, y, z) were expected")
    raise DataError(
        f"{table.name}: has {width} columns and no header; say which three are x, y, z, as in --columns 1,2,3"
    )


def _only_family(table: Table, roles: Roles) -> Triple:
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


def _only_numeric(table: Table, names: Sequence[str], roles: Roles, sensor: int | None) -> Triple:
    known = {*(roles.reference or ()), roles.count, roles.temperature, roles.label, sensor}
    known.update(roles.other, roles.sensors)
    known.update(column for triple in roles.scatter.values() for column in triple)
    left = [k for k in range(len(names)) if k not in known]
    if len(left) > 3:
        left = [k for k in left if table.numeric[k]]
    if len(left) == 3:
        _refuse_namesakes(table, [names[k] for k in left if names[k]])
        return left[0], left[1], left[2]
    if len(names) < 3:
        raise DataError(f"{table.name}: has {_plural(len(names))} where three (x, y, z) were expected")
    raise DataError(
        f"{table.name}: no column names such as ax, ay, az; say which columns are x, y, z with --columns "
        f"(there are {_listed(names, range(len(names)))})"
    )


def _refuse_namesakes(table: Table, names: Sequence[str]) -> None:
    for k, name in enumerate(names):
        if name in names[:k]:
            raise DataError(
                f'{table.name}: two columns are called "{name}"; say which are x, y, z with --columns and column '
                "numbers"
            )


def _with_extras(
    table: Table, output: Triple, roles: Roles, note: tuple[str, ...], sensor: int | None
) -> Columns:
    """Add the optional columns that are not themselves the output or the label of the sensor."""
    names = table.names

    def free(column: int | None) -> int | None:
        return None if column in (*output, sensor) else column

    def free_triple(triple: Triple | None) -> Triple | None:
        return None if triple is None or set(triple) & {*output, sensor} else triple

    shown = [str(k + 1) if names is None or not names[k] else names[k] for k in output]
    scatter = _scatter_of(names, output, roles)
    chosen = Columns(
        output,
        (shown[0], shown[1], shown[2]),
        sensor,
        free(roles.label),
        free(roles.count),
        free_triple(scatter),
        free_triple(roles.reference),
        free(roles.temperature),
        None if names is None else free(time_column(names)),
    )
    used = [k for k in (sensor, chosen.label, *chosen.extras) if k is not None]
    if names is not None and used:
        note = (*note, f"column{'s' * (len(used) > 1)} {_listed(names, used)} found")
    return replace(chosen, notes=(*note, *roles.partial))


def _scatter_of(names: Sequence[str] | None, output: Triple, roles: Roles) -> Triple | None:
    """Find the standard deviations that belong to the output: those of its own family, or of none."""
    if names is None:
        return None
    family = "".join(tokens_of(names[output[0]]))[:-1]
    return roles.scatter.get(family, roles.scatter.get(""))


def _listed(names: Sequence[str], columns: Sequence[int], between: str = ", ") -> str:
    listed = between.join(f'"{names[k]}"' for k in columns[:20])
    return listed + (f" and {len(columns) - 20} more" if len(columns) > 20 else "")


def _bare_name(name: str) -> str:
    return "".join(tokens_of(name))


def _plural(columns: int) -> str:
    return f"{columns} column{'s' * (columns != 1)}"


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


NONE = "none"

NAMELESS: dict[int, tuple[Triple, Triple | None, int | None]] = {
    3: ((0, 1, 2), None, None),
    4: ((1, 2, 3), None, 0),
    6: ((0, 1, 2), (3, 4, 5), None),
    7: ((1, 2, 3), (4, 5, 6), 0),
}
"""Acceleration, gyroscope and time of a log without a header, by its number of columns."""


@dataclass(frozen=True)
class RawColumns:
    """Columns of a raw log, counted from 0.

    Attributes:
        output: the accelerometer; names: of its columns, or their numbers from 1.
        gyro, time: None where there are none.
        dated: `time` holds dates, not numbers.
        guessed: `time` is only time when it never decreases.
        doubtful: what to say when a guessed time column is none and so nothing is known of the others.
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
        """What to ask of the table: acceleration, gyroscope, time; dates as text."""
        sensors = (*self.output, *(self.gyro or ()))
        if self.time is None:
            return Selection(sensors)
        return Selection(sensors, texts=(self.time,)) if self.dated else Selection((*sensors, self.time))


def choose_raw(
    table: Table,
    columns: Sequence[str] | None = None,
    gyro: Sequence[str] | None = None,
    time: str | None = None,
) -> RawColumns:
    """Find the columns of a raw log; what is stated wins over names, names over the number of columns.

    Raises:
        DataError: the table does not say which columns to take.
        UsageError: a stated column does not exist or is stated twice.
    """
    if not table.has_rows:
        raise DataError(f"{table.name}: has a header but no rows below it")
    found = _nameless_rawcolumns(table) if columns is None and table.names is None else _named(table, columns)
    turning = found.gyro if gyro is None else _stated_gyro(table, gyro)
    clock, guessed = found.time, found.guessed
    if time is not None:
        clock, guessed = None if time.lower() == NONE else find_column(table, time, "--time"), False
    elif clock is not None and clock in (turning or ()):
        clock = None
    used = [*found.output, *(turning or ()), *(() if clock is None else (clock,))]
    if len(set(used)) < len(used):
        raise UsageError("--columns, --gyro, --time: a column is asked for twice")
    return replace(
        found,
        gyro=turning,
        time=clock,
        dated=clock is not None and not table.numeric[clock],
        guessed=guessed,
        doubtful=found.doubtful if time is None else "",
    )


def _named(table: Table, columns: Sequence[str] | None) -> RawColumns:
    """Go by the names of the columns, or, for a stated accelerometer, by what the names leave."""
    chosen = choose(table, columns)
    names = table.names
    if names is None:
        guess = 0 if 0 not in chosen.output and table.numeric[0] else None
        return RawColumns(chosen.output, chosen.names, time=guess, guessed=True)
    gyro, time = gyro_columns(names), time_column(names)
    if gyro is not None and set(gyro) & set(chosen.output):
        gyro = None
    if time in (*chosen.output, *(gyro or ())):
        time = None
    return RawColumns(chosen.output, chosen.names, gyro, time)


def _nameless_rawcolumns(table: Table) -> RawColumns:
    width = len(table.numeric)
    if width not in NAMELESS:
        raise DataError(
            f"{table.name}: has {width} columns and no header; expected 3 (acceleration), 4 (time, acceleration), "
            "6 (acceleration, gyroscope) or 7 (time, acceleration, gyroscope); say which are x, y, z with "
            "--columns, as in --columns 2,3,4"
        )
    output, gyro, time = NAMELESS[width]
    names = (str(output[0] + 1), str(output[1] + 1), str(output[2] + 1))
    note = f"no header: columns {_listed_rawcolumns(output)} taken as acceleration x, y, z"
    if gyro is not None:
        note += f", columns {_listed_rawcolumns(gyro)} as gyroscope"
    doubtful = (
        f"{table.name}: has {width} columns and no header, and the first is not time; say which are x, y, z "
    )
    doubtful += "with --columns, as in --columns 1,2,3"
    return RawColumns(output, names, gyro, time, guessed=time is not None, doubtful=doubtful, notes=(note,))


def _stated_gyro(table: Table, gyro: Sequence[str]) -> Triple | None:
    words = [gyro] if isinstance(gyro, str) else list(gyro)
    return None if [word.lower() for word in words] == [NONE] else stated(table, words, "--gyro")


def _listed_rawcolumns(columns: Triple) -> str:
    return ", ".join(str(k + 1) for k in columns)
