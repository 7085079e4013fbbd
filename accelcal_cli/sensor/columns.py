"""Which columns of a table to read: the user's choice, or the names' own word."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from accelcal_cli.errors import DataError, UsageError, did_you_mean
from accelcal_cli.sensor.cells import Selection
from accelcal_cli.sensor.colnames import Roles, recognise, time_column, tokens_of
from accelcal_cli.sensor.tabular import Table

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
