"""The columns of a table: which they are is stated by the user, or recognised by their names.

`choose` finds the columns of a table of static readings, `choose_raw` those of a raw log, `sensor_column` the one that
labels the sensor in a table of many sensors. All of them use `recognise`, which gives every column its role by its
name. An ambiguous table is an error that says what to state; columns are never guessed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.errors import DataError, UsageError, did_you_mean
from accelcal_cli.io.reader import InputTable, Selection
from accelcal_cli.io.rows import Condition, RowBlock, RowFilter
from accelcal_cli.io.vocabulary import (
    FORCE_UNITS,
    Roles,
    Triple,
    bare_name,
    describe,
    listed,
    name_unit,
    parse_unit,
    recognise,
)
from accelcal_cli.schema import frozen

COUNTED = 16
"""Digits from which on a time is read as an integer: a 64-bit float would round it."""

GUESSED = ("s", "ms", "us", "ns")
"""Units of time that a step alone may tell."""

NONE = "none"
"""Option value for no gyroscope, or no time."""

NAMELESS: dict[int, tuple[Triple, Triple | None, int | None]] = {
    3: ((0, 1, 2), None, None),
    4: ((1, 2, 3), None, 0),
    6: ((0, 1, 2), (3, 4, 5), None),
    7: ((1, 2, 3), (4, 5, 6), 0),
}
"""Acceleration, gyroscope and time of a log without a header, by its number of columns."""

RUNNING = 3
"""Rows from which on a number that grows by one counts the rows."""

FEWEST_ROWS, RAW_ENOUGH = 6, 500
"""Rows from which on columns can be told by their length, and on which only the calmer half is looked at."""

CONSTANT = 0.15
"""Part of its length by which acceleration at rest differs from gravity: errors of scale and bias."""


@frozen()
class Columns:
    """Columns of a table of readings, counted from 0; None where there are none.

    Attributes:
        output: x, y, z; names: of these, or their numbers from 1.
        sensor, label: which sensor and which pose a row is of.
        identity: columns whose values tell sensors apart, where no `sensor` is stated.
        count, scatter: raw readings behind a row, and the standard deviation of one of them.
        reference: known specific force; temperature, time, gyro: as their names say.
        unit: of the output as the file states it: g, mg, m/s^2 or counts.
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
    unit: str | None = None
    identity: tuple[int, ...] = ()
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
        texts = (*_present(self.sensor, self.label), *self.identity)
        return Selection((*self.output, *self.extras), gaps, texts, self.output)

    def split(self, extras: Float) -> tuple[Float | None, Float | None, Float]:
        """Split the values of `extras`, shape (B, k), into count (B,), scatter (B, 3) and the others (B, m)."""
        at = 0 if self.count is None else 1
        then = at + (0 if self.scatter is None else 3)
        return extras[:, 0] if at else None, extras[:, at:then] if then > at else None, extras[:, then:]

    def check(self, table: InputTable, rows: RowBlock) -> None:
        """Refuse counts that are not whole numbers of 1 or more, and standard deviations below zero."""
        for at, column in enumerate(self.extras, 3):
            counts, values = column == self.count, rows.numbers[:, at]
            bad = are_no_counts(values) if counts else values < 0
            if (counts or column in (self.scatter or ())) and bad.any():
                expected = "count of 1 or more" if counts else "standard deviation of 0 or more"
                where = table.where(rows.start + int(np.argmax(bad)))
                raise DataError(
                    f'{table.name}, {where}, column "{(table.names or ())[column]}": a {expected} was expected'
                )


def are_no_counts(count: Float) -> Bool:
    """Return which numbers are not whole ones of 1 or more, same shape."""
    return np.asarray((count < 1) | (count != np.round(count)))


@frozen()
class RawColumns:
    """Columns of a raw log, counted from 0.

    Attributes:
        output: the accelerometer; names: of its columns, or their numbers from 1.
        gyro, time, temperature: None where there are none.
        unit: of the output as the file states it: g, mg, m/s^2 or counts.
        identity: columns whose values tell sensors apart.
        dated: `time` holds dates, not numbers.
        guessed: `time` is only time when it never decreases.
        doubtful: the error when a guessed time column is not time, so that the others are unknown, too.
        notes: what a user should know.
    """

    output: Triple
    names: tuple[str, str, str]
    gyro: Triple | None = None
    time: int | None = None
    temperature: int | None = None
    unit: str | None = None
    dated: bool = False
    guessed: bool = False
    doubtful: str = ""
    identity: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    def selection(self) -> Selection:
        """Return what to ask of the table: acceleration, gyroscope, temperature, time; dates and identity as text."""
        warm = _present(self.temperature)
        sensors, time = (*self.output, *(self.gyro or ()), *warm), _present(self.time)
        texts, numbers = (time, sensors) if self.dated else ((), (*sensors, *time))
        return Selection(numbers, frozenset(warm), (*texts, *self.identity), self.output, frozenset(warm))


def choose(
    table: InputTable,
    wanted: Sequence[str] | None = None,
    sensor: int | None = None,
    count: str | None = None,
) -> Columns:
    """Find the three output columns and the optional ones.

    Args:
        table: of static readings, open.
        wanted: the three output columns, by name or number from 1; None to go by the names.
        sensor: the column that labels the sensor, in a table of many sensors.
        count: the column of counts, or "none"; None to go by the names.

    Raises:
        DataError: the table has no rows, or its columns are ambiguous. UsageError: `wanted` does not fit the table.
    """
    if not table.has_rows:
        raise DataError(f"{table.name}: has a header but no readings below it")
    roles = recognise(table.names or ())
    notes: list[str] = []
    if wanted is not None:
        output = parse_triple(table, [wanted] if isinstance(wanted, str) else wanted)
    else:
        output, notes = _find_output(table, roles, sensor)
    timed = roles.alone["time"] or [k for k in _with_unit(table, GUESSED) if k not in output]
    roles.alone["time"] = [k for k in timed if _is_filled(table, k)] or timed
    if count is not None:
        roles.alone["count"] = [] if count.lower() == NONE else [find_column(table, count, "--count")]
    else:
        if not roles.scatter:  # rows that state their scatter are means, whatever their count
            roles.alone["count"], more = _true_counts(table, roles.alone["count"])
            notes += more
    return _with_extras(table, output, roles, tuple(notes), sensor)


def _find_output(table: InputTable, roles: Roles, sensor: int | None) -> tuple[Triple, list[str]]:
    """Return the output columns, and what to say of how they were found: by name, by unit, by what is left."""
    names = table.names
    for families in (roles.families, roles.described):
        if families:
            stated = {
                name: one for name, one in families.items() if unit_of_output(table, one) in FORCE_UNITS
            }
            return _only_family(table, roles, stated if len(stated) == 1 else families), []
    by_unit = [k for k in _left(table, roles, sensor) if unit_of_output(table, (k, k, k)) in FORCE_UNITS]
    if len(by_unit) == 3 and names is not None and table.facts.unit is None:
        output = _in_order(names, by_unit)
        return output, [
            f"columns {listed(names, output)} taken as x, y, z: their unit is that of acceleration"
        ]
    left = _left(table, roles, sensor)
    if len(left) == 3 or names is None or len(left) < 3:
        output = _only_three(table, left)
        if names is None:
            return output, [f"no header: columns {_numbered(output)} taken as x, y, z"]
        return output, [f"columns {listed(names, output)} taken as x, y, z: the only three that can be"]
    runs = [(left[k], left[k + 1], left[k + 2]) for k in range(len(left) - 2)]
    for triples in (list(roles.unknown.values()), runs):
        constant = [triple for triple in triples if _is_gravity(table, triple)]
        if len(constant) == 1:
            output = constant[0]
            return output, [
                f"columns {listed(names, output)} taken as x, y, z: the only three whose length is constant at rest"
            ]
    return _only_three(table, left), []


def _in_order(names: Sequence[str], columns: Sequence[int]) -> Triple:
    """Return three columns by the letter or the number of their axis, as they come where they have none."""
    meanings = [describe(names[k]) for k in columns]
    places = [m.number if m.axis is None else m.axis for m in meanings]
    known = [place for place in places if place is not None]
    if len(set(known)) == 3:
        columns = [column for _, column in sorted(zip(known, columns, strict=True))]
    return columns[0], columns[1], columns[2]


def unit_of_output(table: InputTable, output: Triple) -> str | None:
    """Return the unit of three columns where the file states one and the same: g, mg, m/s^2 or counts."""
    names, units = table.names, table.units
    found = set()
    for column in output:
        unit = parse_unit(units[column]) if units is not None and column < len(units) else None
        found.add(unit or (name_unit(names[column]) if names is not None else None))
    if found == {None} and table.facts.unit:
        return table.facts.unit
    unit = found.pop() if len(found) == 1 else None
    return unit if unit in (*FORCE_UNITS, "counts") else None


def _with_unit(table: InputTable, units: Sequence[str]) -> list[int]:
    """Return the columns whose names state one of some units."""
    return [k for k, name in enumerate(table.names or ()) if name_unit(name) in units]


def _is_filled(table: InputTable, column: int) -> bool:
    """Return whether most cells of a column hold something."""
    cells = [cells[column] for cells in table.preview()]
    return 2 * sum(map(bool, cells)) >= len(cells)


def _true_counts(table: InputTable, columns: list[int]) -> tuple[list[int], list[str]]:
    """Return the columns of counts without those that number the rows from 0 or 1, and what to say of these."""
    kept: list[int] = []
    notes: list[str] = []
    for column in columns:
        values = [_value(cells[column]) for cells in table.preview()]
        steps = np.diff(values) if len(values) >= RUNNING else np.zeros(1)
        if values and values[0] in (0, 1) and (steps == steps[0]).all() and steps[0] > 0:
            notes.append(f'column "{(table.names or ())[column]}" numbers the rows, so it is no count')
        else:
            kept.append(column)
    return kept, notes


def _value(cell: str) -> float:
    try:
        return float(cell.replace(",", "."))
    except ValueError:
        return math.nan


def _is_gravity(table: InputTable, triple: Triple) -> bool:
    """Return whether three columns are of constant length wherever they are still, in several directions."""
    if not all(table.numeric[k] for k in triple):
        return False
    rows = np.array([[_value(cells[k]) for k in triple] for cells in table.preview()]).reshape(-1, 3)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < FEWEST_ROWS:
        return False
    calm = np.abs(np.diff(rows, axis=0)).max(axis=1)
    still = rows[1:][calm <= np.quantile(calm, 0.5)] if len(rows) > RAW_ENOUGH else rows
    length = np.linalg.norm(still, axis=1)
    middle = float(np.median(length))
    off = np.quantile(np.abs(length - middle), 0.9)
    turned = np.ptp(still, axis=0).max() > middle
    return bool(middle > 0 and off < CONSTANT * middle and turned)


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
    warm = None if raw.temperature in (*(turning or ()), clock) else raw.temperature
    used = (*raw.output, *(turning or ()), *_present(clock))
    if len(set(used)) < len(used):
        raise UsageError("--columns, --gyro, --time: a column is asked for twice")
    return replace(
        raw, gyro=turning, time=clock, temperature=warm, dated=clock is not None and _is_text(table, clock)
    )


def _is_text(table: InputTable, clock: int) -> bool:
    """Return whether a time column has to be read as text: dates, clocks, and counts too long for a float."""
    if not table.numeric[clock]:
        return True
    first = next((cells[clock] for cells in table.preview() if cells[clock]), "")
    return first.isascii() and first.isdigit() and len(first) >= COUNTED


def restrict(table: InputTable, where: Sequence[str]) -> None:
    """Let only those rows of a table be read that meet conditions, each as COLUMN=VALUE.

    Raises:
        UsageError: no condition, or no such column.
    """
    if not where:
        return
    conditions = []
    for text in where:
        word, equals, value = text.partition("=")
        if not (equals and word.strip() and value.strip()):
            raise UsageError(f'--where "{text}": expected COLUMN=VALUE, as in device=0')
        column = find_column(table, word.strip(), "--where")
        name = str(column + 1) if table.names is None else table.names[column]
        conditions.append(Condition(column, name, value.strip()))
    table.keep_only(RowFilter(table.name, conditions))


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
            f"{table.name}: the sensor could be {listed(names, candidates, ' or ')}; say which with {option}"
        )
    if not candidates:
        raise DataError(
            f"{table.name}: no column that labels the sensor, such as sensor, serial, device or id; say which with "
            f"{option} (there are {listed(names, range(len(names)))}), or give one file per sensor"
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
    for fold in (str, str.lower, bare_name):
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
    hint = did_you_mean(word, names) or f"; there are {listed(names, range(width))}"
    raise UsageError(f'{option}: no column "{word}" in {table.name}{hint}')


def _only_family(table: InputTable, roles: Roles, families: dict[str, Triple]) -> Triple:
    if len(families) > 1:
        raise DataError(
            f"{table.name}: the readings could be {' or '.join(families)}; say which with --columns"
        )
    if roles.doubtful:
        raise DataError(
            f'{table.name}: more than one column could be "{roles.doubtful[0]}"; '
            "say which to use with --columns and column numbers"
        )
    return next(iter(families.values()))


def _left(table: InputTable, roles: Roles, sensor: int | None) -> list[int]:
    """Return the columns whose names do not say that they are something else than readings."""
    names, width = table.names, len(table.numeric)
    known = {
        *(roles.reference or ()),
        *(roles.gyro or ()),
        *roles.alone["other"],
        *roles.alone["sensor"],
        *roles.alone["instance"],
        *roles.alone["kind"],
        sensor,
        *(roles.first(role) for role in ("count", "temperature", "label")),
        *(column for triple in roles.scatter.values() for column in triple),
    }
    left = [k for k in range(width) if k not in known]
    return left if names is None or len(left) <= 3 else [k for k in left if table.numeric[k]]


def _only_three(table: InputTable, left: list[int]) -> Triple:
    """Return the columns that are left, if they are just three."""
    names, width = table.names, len(table.numeric)
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
        f"(there are {listed(names, range(width))})"
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
    family = "" if names is None else bare_name(names[output[0]])[:-1]
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
        unit_of_output(table, output),
        () if sensor is not None else _identity(roles, taken),
    )
    if columns.unit is not None:
        notes = (*notes, f"the readings are in {columns.unit} by the file")
    used = (*_present(sensor, columns.label), *columns.extras)
    if names is not None and used:
        notes = (*notes, f"column{'s' * (len(used) > 1)} {listed(names, used)} found")
    return replace(columns, notes=(*notes, *roles.partial))


def _identity(roles: Roles, taken: set[int | None]) -> tuple[int, ...]:
    """Return the columns whose values tell sensors apart, as far as they are not otherwise used."""
    columns = (column for role in ("sensor", "instance", "kind") for column in roles.alone[role])
    return tuple(column for column in columns if column not in taken)


def _by_name(table: InputTable, wanted: Sequence[str] | None) -> RawColumns:
    """Go by the names of the columns, or, for a stated accelerometer, by what the names leave."""
    columns = choose(table, wanted)
    if table.names is not None:
        kept = [note for note in columns.notes if "taken as x, y, z" in note or "by the file" in note]
        return RawColumns(
            columns.output,
            columns.names,
            columns.gyro,
            columns.time,
            columns.temperature,
            columns.unit,
            identity=columns.identity,
            notes=tuple(kept),
        )
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


def _numbered(columns: Triple) -> str:
    return ", ".join(str(k + 1) for k in columns)


def _present(*columns: int | None) -> tuple[int, ...]:
    return tuple(column for column in columns if column is not None)
