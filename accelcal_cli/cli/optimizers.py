"""`accelcal optimizers`: the algorithms, their settings, their sources."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from accelcal_cli.cli import options


def command(
    name: Annotated[
        str | None, typer.Argument(help="One optimizer: its settings and what they mean.", show_default="all")
    ] = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """List the optimizers, their settings and their papers."""
    from accelcal_cli.optimization.optimizer import OPTIMIZERS
    from accelcal_cli.output.console import show
    from accelcal_cli.output.machine import json_rows, json_text, write_csv
    from accelcal_cli.views.optimizers import catalogue, catalogue_blocks, flat, settings, settings_blocks

    options.check_format(format)
    table = settings(name) if name else catalogue()
    if format == "json":
        sys.stdout.write(json_text(json_rows([table])))
    elif format == "csv":
        write_csv(flat(table), sys.stdout)
    elif name:
        show(settings_blocks(table))
    else:
        show(catalogue_blocks(table))
    sys.stdout.flush()
    if not quiet:
        for fault in OPTIMIZERS.faults.values():
            typer.echo(f"accelcal: {fault}", err=True)
