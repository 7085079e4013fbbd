"""`accelcal optimizers`: the algorithms, their settings, their sources."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from accelcal_cli.cli import options


def command(
    name: Annotated[
        str | None,
        typer.Argument(
            help="One optimizer: its settings and what they mean.",
            show_default="all",
            rich_help_panel="Input",
            autocompletion=options.one_of(options.optimizers),
        ),
    ] = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """List the optimizers, their settings and their papers."""
    from accelcal_cli.optimization.optimizer import OPTIMIZERS
    from accelcal_cli.output.console import show
    from accelcal_cli.output.machine import json_rows
    from accelcal_cli.views.optimizers import catalogue, catalogue_blocks, flat, settings, settings_blocks

    table = settings(name) if name else catalogue()
    if not options.print_data(format, lambda: json_rows([table]), lambda: flat(table)):
        show(settings_blocks(table) if name else catalogue_blocks(table))
    sys.stdout.flush()
    if not quiet:
        for fault in OPTIMIZERS.faults.values():
            typer.echo(f"accelcal: {fault}", err=True)
