"""The raw results of a study in a file, one row a run: CSV or Parquet by its suffix."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from accelcal_cli.output.files import whole_file
from accelcal_cli.output.plain import write_csv
from accelcal_cli.table import Table

if TYPE_CHECKING:
    import polars


def write_raw(table: Table, path: str) -> None:
    """Write a table whole or not at all; a missing number is an empty cell or a null.

    Raises:
        OutputError: it cannot be written.
    """
    if path.endswith(".parquet"):
        with whole_file(path, binary=True) as file:
            _frame(table).write_parquet(file)
        return
    with whole_file(path) as file:
        write_csv(table, file)


def _frame(table: Table) -> polars.DataFrame:
    """Return a table as polars columns: text, 64-bit integers or 64-bit floats by their format."""
    import polars

    types = {"": polars.String, "d": polars.Int64}
    columns = [
        polars.Series(
            column.key or column.name,
            [_finite(row[i]) for row in table.rows],
            dtype=types.get(column.format, polars.Float64),
        )
        for i, column in enumerate(table.columns)
    ]
    return polars.DataFrame(columns)


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value
