"""A fleet on the terminal, in a table file, and in a folder of results."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from rich.text import Text

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.output import console as rich_console
from accelcal_cli.output.files import whole_file
from accelcal_cli.output.plain import json_rows, json_text
from accelcal_cli.output.raw import write_raw
from accelcal_cli.table import Table

FORBIDDEN = '/\\:*?"<>|%'
"""Characters that a file name cannot have on some system, and the one that stands for them."""


def show_fleet(counts: str, tables: Iterable[Table]) -> None:
    """Print a fleet to standard output."""
    out = rich_console.console()
    out.print(Text(counts, "bold"))
    out.print()
    rich_console.show(tables, out)


def write_table(table: Table, path: str) -> None:
    """Write one row a sensor as CSV, Parquet or JSON by the ending of the name, whole or not at all."""
    if path.endswith(".json"):
        with whole_file(path) as file:
            file.write(json_text(json_rows([table])))
    else:
        write_raw(table, path)


def write_result(folder: Path, label: str, result: Calibration) -> None:
    """Write the result file of one sensor, named by its label."""
    text = json.dumps(result.record(), allow_nan=False, ensure_ascii=False)
    (folder / f"{file_name(label)}.json").write_text(f"{text}\n", encoding="utf-8", newline="\n")


def file_name(label: str) -> str:
    """Return a label as the name of a file: what a name cannot hold is written as in an address, %2F for a slash."""
    return "".join(f"%{ord(c):02X}" if c in FORBIDDEN or ord(c) < 32 else c for c in label)
