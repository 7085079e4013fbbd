"""`accelcal optimizers`: the algorithms, their settings, their sources."""

from __future__ import annotations

from functools import partial
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
    from accelcal_cli.output.machine import json_rows
    from accelcal_cli.views import studies as views

    if name and ":" in name:
        OPTIMIZERS.imported(name)
    table = views.optimizer_settings(name) if name else views.optimizer_catalogue()
    blocks = views.optimizer_settings_blocks if name else views.optimizer_catalogue_blocks
    options.print_result(
        format, partial(views.flat_text, table), partial(blocks, table), partial(json_rows, [table])
    )
    options.tell(OPTIMIZERS.faults.values(), quiet)
