"""A Parquet log written anew, as Parquet or as text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO, Any

import numpy as np
import polars as pl

from accelcal_cli.sensor.parquet import ParquetTable
from accelcal_cli.sensor.rewrite import Change, system_errors
from accelcal_cli.sensor.tabular import Table


def frames(table: ParquetTable, change: Change) -> Iterator[pl.DataFrame]:
    """Yield the changed log, block after block."""
    for frame, rows in table.pairs(change.selection):
        values = np.ascontiguousarray(change.compute(rows.numbers).T)
        new = [pl.Series(name, column) for name, column in zip(change.names, values, strict=True)]
        for place, column in zip(change.places, new, strict=False):
            frame.replace_column(place, column)
        yield frame.hstack(new[len(change.places) :])


def to_text(table: Table, change: Change, file: IO[bytes]) -> None:
    """Write the changed log as CSV."""
    assert isinstance(table, ParquetTable)
    for k, frame in enumerate(frames(table, change)):
        with system_errors():
            frame.write_csv(file, include_header=k == 0)


def to_parquet(table: Table, change: Change, file: IO[bytes]) -> None:
    """Write the changed log as Parquet, by the name of the file if it has one.

    Raises:
        OSError: it cannot be written.
    """
    from polars.io.plugins import register_io_source

    assert isinstance(table, ParquetTable)
    fault: list[BaseException] = []
    blocks = frames(table, change)
    first = next(blocks)

    def source(*_: Any) -> Iterator[pl.DataFrame]:
        yield first
        try:
            yield from blocks
        except BaseException as problem:  # polars would wrap it beyond recognition
            fault.append(problem)

    target = (
        file.name if isinstance(file.name, str) else file
    )  # what was open already has no name, but a number
    with system_errors():
        register_io_source(source, schema=first.schema).sink_parquet(target)
    if fault:
        raise fault[0]
