"""Tables and records for programs: CSV, JSON and Parquet, result files of a fleet, and simulated logs."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterable
from itertools import repeat
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from accelcal_cli.errors import visible
from accelcal_cli.output.files import whole_file
from accelcal_cli.schema import to_mapping
from accelcal_cli.views.blocks import Table

if TYPE_CHECKING:
    import polars

    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.sensor.simulation import LogSegment


_STEERING = re.compile("[\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Control characters that JSON may hold as they are, and that a terminal would obey."""


SPECIAL = str.maketrans({
    "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}",
})  # fmt: skip
"""What LaTeX takes for more than a character."""


def latex_text(table: Table) -> str:
    """Return a table as LaTeX with the rules of the package booktabs; its notes stand under it."""

    left = [any(isinstance(row[i], str) for row in table.rows) for i in range(len(table.columns))]
    heads = [(f"{c.name} [{c.unit}]" if c.unit else c.name).translate(SPECIAL) for c in table.columns]
    rows = [
        [c.text(v).translate(SPECIAL) for c, v in zip(table.columns, row, strict=True)] for row in table.rows
    ]
    lines = [
        f"\\begin{{tabular}}{{{''.join('l' if word else 'r' for word in left)}}}",
        "\\toprule",
        " & ".join(heads) + r" \\",
        "\\midrule",
        *(" & ".join(row) + r" \\" for row in rows),
        "\\bottomrule",
        "\\end{tabular}",
        *(f"% {note}" for note in table.notes),
    ]
    return "\n".join(lines) + "\n"


def write_csv(table: Table, file: IO[str], *, head: bool = True) -> None:
    """Write a table as CSV: keys of the columns, then rows; numbers with all their digits, nothing for none."""
    writer = csv.writer(file, lineterminator="\n")
    if head:
        writer.writerow([column.label for column in table.columns])
    inf = math.inf
    rows = table.rows
    if file.isatty():
        rows = tuple(tuple(visible(v) if isinstance(v, str) else v for v in row) for row in rows)
    for row in rows:
        # As `_finite` has it; a call for each cell would take longer than writing it.
        writer.writerow(["" if isinstance(v, float) and not -inf < v < inf else v for v in row])


def json_text(record: Any) -> str:
    """Return a record as JSON text with a line end; it must hold no NaN."""
    text = json.dumps(record, indent=2, allow_nan=False, ensure_ascii=False)
    return _STEERING.sub(lambda match: f"\\u{ord(match[0]):04x}", text) + "\n"


def json_rows(tables: Iterable[Table]) -> list[Any]:
    """Return the rows of tables as records; NaN and inf become None."""
    return [to_mapping(record) for table in tables for record in table.records()]


def write_table(table: Table, path: str) -> None:
    """Write a table as CSV, Parquet or JSON by the ending of the name, whole or not at all; a missing number is empty.

    Raises:
        OutputError: it cannot be written.
    """
    write_tables([table], path)


def write_tables(tables: Iterable[Table], path: str) -> None:
    """Write tables of the same columns as one, of which only one is in memory at a time; see `write_table`.

    Raises:
        OutputError: it cannot be written.
    """
    with whole_file(path, binary=path.endswith(".parquet")) as file:
        if path.endswith(".parquet"):
            from accelcal_cli.io.parquet import sink

            sink(map(frame, tables), file.name if isinstance(file.name, str) else file)
        else:
            write_text(tables, file, "json" if path.endswith(".json") else "csv")


def write_text(tables: Iterable[Table], file: IO[str], format: str) -> None:
    """Write tables of the same columns as one, as CSV or JSON."""
    if format == "csv":
        for k, table in enumerate(tables):
            write_csv(table, file, head=k == 0)
        return
    behind = "["
    for table in tables:
        rows = json_text(json_rows([table])).rstrip()
        if len(rows) > len("[]"):
            file.write(behind + rows[1:-2])
            behind = ","
    file.write("[]\n" if behind == "[" else "\n]\n")


def frame(table: Table) -> polars.DataFrame:
    """Return a table as polars columns: text, 64-bit integers or 64-bit floats by their format."""
    import polars

    types = {"": polars.String, "d": polars.Int64}
    series = []
    cells = zip(*table.rows, strict=True) if table.rows else repeat((), len(table.columns))
    for column, values in zip(table.columns, cells, strict=True):
        if column.format in types:
            own = [str(value) if isinstance(value, tuple) else _finite(value) for value in values]
            series.append(polars.Series(column.label, own, dtype=types[column.format]))
        else:  # all cells at once: a table of a fleet has millions
            numbers = np.array(values, dtype=float)
            numbers[~np.isfinite(numbers)] = np.nan
            series.append(polars.Series(column.label, numbers, nan_to_null=True))
    return polars.DataFrame(series)


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def result_text(result: Calibration, *, json: bool) -> str:
    """Return what the result file of a calibration holds, as JSON or YAML."""
    from accelcal_cli.config import dump

    return json_text(result.record()) if json else dump(result.record())


FORBIDDEN = '/\\:*?"<>|%'
"""Characters that a file name cannot have on some system, and the one that stands for them."""


def result_line(result: Calibration) -> str:
    """Return what the result file of one sensor of a fleet holds."""
    return json.dumps(result.record(), allow_nan=False, ensure_ascii=False) + "\n"


def write_result(folder: Path, label: str, text: str) -> None:
    """Write the result file of one sensor, named by its label."""
    (folder / f"{file_name(label)}.json").write_text(text, encoding="utf-8", newline="\n")


def remove_results(folder: Path, labels: Iterable[str]) -> None:
    """Remove the result files of sensors."""
    for label in labels:
        (folder / f"{file_name(label)}.json").unlink(missing_ok=True)


def file_name(label: str) -> str:
    """Return a label as the name of a file: what a name cannot hold is written as in an address, %2F for a slash."""
    return "".join(f"%{ord(c):02X}" if c in FORBIDDEN or ord(c) < 32 else c for c in label)


DIGITS = "%.9g"


def write_log(stretches: Iterable[LogSegment], gyro: bool, file: IO[str]) -> list[tuple[int, int]]:
    """Write the rows as they come; return first and last row of each hold, counted from 1."""
    file.write("t,ax,ay,az" + ",wx,wy,wz" * gyro + "\n")
    holds, row = [], 0
    for stretch in stretches:
        columns = [stretch.time[:, None], stretch.output] + [stretch.gyro] * gyro
        line = ",".join([DIGITS] * (7 if gyro else 4)) + "\n"
        file.writelines(line % tuple(cells) for cells in np.hstack(columns).tolist())
        if stretch.pose:
            holds.append((row + 1, row + len(stretch.time)))
        row += len(stretch.time)
    return holds
