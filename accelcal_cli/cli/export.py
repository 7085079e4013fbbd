"""`accelcal export`: a result in the formats that other tools read."""

from __future__ import annotations

import math
import sys
from typing import Annotated

import typer

from accelcal_cli.cli import options
from accelcal_cli.errors import UsageError

NAMES = "px4, ardupilot, kalibr, imucal, ros, c-header or numpy"


def command(
    result: Annotated[str, typer.Argument(help="Result file of accelcal calibrate; - is standard input.")],
    to: Annotated[str, typer.Option(help=f"Format: {NAMES}.", metavar="FORMAT")],
    output: Annotated[str, typer.Option("--output", "-o", help="File to write; - is standard output.")] = "-",
    instance: Annotated[
        int | None,
        typer.Option(
            help="Number of the accelerometer in the target (px4, ardupilot, kalibr).",
            min=0,
            show_default="0",
        ),
    ] = None,
    driver_scale: Annotated[
        float | None,
        typer.Option(
            help="Output units that the target's driver takes for 1 m/s^2 (px4, ardupilot, kalibr)."
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Use a result although its verdict is undetermined.")
    ] = False,
    quiet: options.Quiet = False,
) -> None:
    """Write a result in the format of another tool.

    Warns of what the format cannot hold. PX4 and ArduPilot have no misalignments.
    """
    from accelcal_cli.exporters.base import Target
    from accelcal_cli.exporters.formats import check_name, check_options, export
    from accelcal_cli.output.files import check_target, whole_file

    check_name(to)
    stated = {"--instance": instance, "--driver-scale": driver_scale}
    check_options(to, [option for option, value in stated.items() if value is not None])
    if driver_scale is not None and not (math.isfinite(driver_scale) and driver_scale > 0):
        raise UsageError(f"--driver-scale {driver_scale:g}: expected a positive number")
    options.check_apart([result], {"-o": output})
    check_target(output)
    if to == "numpy" and output == "-" and sys.stdout.isatty():
        raise UsageError("--to numpy is no text for a terminal; name a file with -o")
    calibration = options.load_result(result)
    calibration.check_determined(result, force=force)
    options.caution(result, calibration.cautions, quiet)
    made = export(calibration, to, Target(instance or 0, driver_scale))
    with whole_file(output, binary=True) as file:
        file.write(made.content)
    sys.stdout.flush()
    if not quiet:
        notes = (
            *(f"warning: {text}" for text in made.warnings),
            *([] if output == "-" else [f"wrote {output}"]),
        )
        for note in notes:
            typer.echo(f"accelcal: {note}", err=True)
