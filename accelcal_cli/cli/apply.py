"""`accelcal apply`: a raw log in, calibrated specific force out."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from accelcal_cli.cli import options

PARQUET = (".parquet", ".pq")

in_force = options.panel("Specific force")


def command(
    *,
    result: options.ResultFile,
    data: Annotated[
        str,
        typer.Argument(
            help="Raw log: text, Parquet, Arrow or native; - is standard input.", rich_help_panel="Input"
        ),
    ],
    columns: options.Columns = None,
    form: options.TextOptions,
    force: options.Force = False,
    unit: Annotated[
        str | None,
        in_force(
            help="Unit of the specific force: {choices}.",
            show_default="the result's",
            autocompletion=options.one_of(options.UNITS),
        ),
    ] = None,
    replace: Annotated[
        bool,
        in_force("--replace", help="Write the force in place of the readings, not after the last column."),
    ] = False,
    prefix: Annotated[str, in_force(help="Name of the new columns, before x, y and z.")] = "f",
    tilt: Annotated[
        bool,
        in_force("--tilt", help="Add roll, pitch and their sigma, in degrees: for a sensor at rest."),
    ] = False,
    noise: Annotated[
        float, in_force(help="Noise of one row and axis, one sigma, m/s^2, for the sigma of --tilt.")
    ] = 0.0,
    output: Annotated[
        str,
        options.in_output("--output", "-o", help="Log to write, .parquet for Parquet; - is standard output."),
    ] = "-",
    quiet: options.Quiet = False,
) -> None:
    """Apply a calibration to a log of any length.

    Adds the calibrated specific force as columns fx, fy, fz. All other columns stay as they are, byte for byte from
    text to text. The log streams through: memory does not grow with it.
    """
    from accelcal_cli.calibration.apply import ColumnOptions, prepare
    from accelcal_cli.io.columns import restrict
    from accelcal_cli.io.reader import open_table
    from accelcal_cli.output.files import whole_file

    options.check_input(data)
    options.check_files([result], {"-o": output})  # the log itself may be the output
    wanted = ColumnOptions(unit, replace, prefix, tilt, noise)
    calibration = options.load_result(result, data)
    calibration.check_determined(result, force=force)
    options.warn(result, calibration.warnings, quiet)
    read = form.read_options()
    table = open_table(data, sys.stdin.buffer, hashed=False, options=read)
    try:
        restrict(table, read.where)
        log = prepare(calibration, table, options.split_columns(columns), wanted, read.count)
        parquet = Path(output).suffix.lower() in PARQUET
        with whole_file(output, binary=True) as file:
            log.write(file, parquet=parquet)
        rewritten = parquet or table.rows_skipped or table.source_format != "csv"
        skipped = table.notes if rewritten else ()
    finally:
        table.close()
    sys.stdout.flush()
    options.warn(data, log.formula.warnings(), quiet)
    options.tell((*log.notes, *skipped), quiet)
    options.tell_written([output], quiet)
