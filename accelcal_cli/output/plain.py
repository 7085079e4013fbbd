"""Tables and records for programs: CSV and JSON."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable
from typing import IO, Any

from accelcal_cli.table import Table


def write_csv(table: Table, file: IO[str]) -> None:
    """Write a table as CSV: keys of the columns, then rows; numbers with all their digits, nothing for none."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([column.key or column.name for column in table.columns])
    inf = math.inf
    for row in table.rows:
        # As `_missing` has it; a call for each cell would take longer than writing it.
        writer.writerow(["" if isinstance(v, float) and not -inf < v < inf else v for v in row])


def json_text(record: Any) -> str:
    """Return a record as JSON text with a line end; it must hold no NaN."""
    return json.dumps(record, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def json_rows(tables: Iterable[Table]) -> list[Any]:
    """Return the rows of tables as records; NaN and inf become None."""
    return [
        {key: None if _missing(value) else value for key, value in record.items()}
        for table in tables
        for record in table.records()
    ]


def _missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and not math.isfinite(value))
