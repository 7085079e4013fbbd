"""`accelcal capture`: poses from a sensor that is being held, guided, into a table that calibrate reads."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options, pipes
from accelcal_cli.errors import DataError, Interrupted, UsageError

if TYPE_CHECKING:
    from accelcal_cli.sensor.capture import Capture
    from accelcal_cli.streams import Float

MOST_READINGS = 1_000_000
UNITS = {"g": 1.0, "m/s2": 9.80665}
INCOMPLETE = 1


def command(
    port: Annotated[str, typer.Option(help="Serial port, as /dev/ttyUSB0 or COM3; - is standard input.")],
    baud: Annotated[
        int, typer.Option(help="Speed of the port, bits per second.", min=50, max=100_000_000)
    ] = 115200,
    columns: Annotated[
        str, typer.Option(help="Which numbers of a line are x, y and z, counted from 1, with commas.")
    ] = "1,2,3",
    poses: Annotated[int, typer.Option(help="Poses to plan.", min=1, max=100)] = 12,
    fixture: Annotated[
        str, typer.Option(help="What the sensor can be held against: faces, edges or corners.")
    ] = "corners",
    rate: Annotated[float, typer.Option(help="Readings a second.")] = 100.0,
    window: Annotated[float, typer.Option(help="Seconds that stillness is judged by.")] = 0.5,
    hold: Annotated[float, typer.Option(help="Seconds of stillness that make a pose.")] = 2.0,
    still: Annotated[
        float | None,
        typer.Option(
            help="Largest standard deviation of a still axis, output units.", show_default="1 % of 1 g"
        ),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(help="Output of 1 g: g, m/s2, or a number.", show_default="estimated from the poses"),
    ] = None,
    offset: Annotated[
        str | None,
        typer.Option(
            help="Output at no acceleration: three numbers with commas.",
            show_default="estimated from the poses",
        ),
    ] = None,
    timeout: Annotated[float, typer.Option(help="Longest silence of the port, seconds.")] = 10.0,
    output: Annotated[str, typer.Option("--output", "-o", help="CSV file; - is standard output.")] = "-",
    quiet: options.Quiet = False,
) -> None:
    """Take poses from a live sensor, guided.

    Shows which pose is held, whether it is still, and what is missing. Each pose that is held still is averaged;
    when all are there, one row a pose is written, for accelcal calibrate. Ctrl-C, the end of the input and a lost
    port end it early; the poses taken until then are written. Exit code 1 means that the input ended before all
    poses were taken.
    """
    from accelcal_cli.calibration.planner import FIXTURES
    from accelcal_cli.output.files import check_target

    if fixture not in FIXTURES[:-1]:
        raise UsageError(f'--fixture "{fixture}": expected one of {", ".join(FIXTURES[:-1])}')
    chosen = _columns(columns)
    for name, seconds in (("window", window), ("hold", hold), ("timeout", timeout), ("rate", rate)):
        options.check_positive(f"--{name}", seconds)
    if still is not None:
        options.check_positive("--still", still)
    if max(window, hold) * rate > MOST_READINGS or window * rate < 2:
        raise UsageError(
            f"--window {window:g}, --hold {hold:g}, --rate {rate:g}: expected 2 to {MOST_READINGS:,} readings"
        )
    scale, centre = _unit(unit), _offset(offset)
    check_target(output)
    options.check_input(port)
    capture = _capture(poses, fixture, round(window * rate), round(hold * rate), (still, scale, centre))
    _run(capture, _readings(port, baud, timeout, chosen), output, quiet)


def _columns(text: str) -> list[int]:
    words = [word.strip() for word in text.split(",")]
    if (
        len(words) != 3
        or len(set(words)) != 3
        or not all(w.isascii() and w.isdigit() and 0 < int(w) < 1000 for w in words)
    ):
        raise UsageError(f'--columns "{text}": expected three different numbers from 1, as 1,2,3')
    return [int(word) - 1 for word in words]


def _unit(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        size = UNITS.get(text) or float(text)
    except ValueError:
        size = math.nan
    if not (math.isfinite(size) and size > 0):
        raise UsageError(f'--unit "{text}": expected g, m/s2 or a positive number, the output of 1 g')
    return size


def _offset(text: str | None) -> Float | None:
    if text is None:
        return None
    import numpy as np

    try:
        found = np.array([float(word) for word in text.split(",")])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise UsageError(f'--offset "{text}": expected three numbers with commas')
    return found


def _capture(
    poses: int, fixture: str, window: int, hold: int, stated: tuple[float | None, float | None, Float | None]
) -> Capture:
    from accelcal_cli.calibration.planner import candidates, distinct_poses
    from accelcal_cli.sensor.capture import Capture

    allowed = candidates(fixture)
    if poses > len(allowed):
        raise UsageError(f"--poses {poses}: expected at most {len(allowed)} with --fixture {fixture}")
    return Capture(allowed[distinct_poses(allowed, poses)], window, hold, *stated)


def _readings(port: str, baud: int, timeout: float, columns: list[int]) -> Iterator[Float]:
    from accelcal_cli.sensor.lines import file_lines, port_lines, readings

    lines = file_lines(sys.stdin.buffer) if port == "-" else port_lines(port, baud, timeout)
    return readings(lines, columns, "<stdin>" if port == "-" else port)


def _run(capture: Capture, readings: Iterator[Float], output: str, quiet: bool) -> None:
    """Watch the readings to the end, whatever it is; write what was taken; then say how it ended."""
    from accelcal_cli.output.live import Watch

    ending: Exception | None = None
    try:
        with Watch(capture, quiet=quiet) as watch:
            for reading in readings:
                status = capture.push(reading)
                if status is not None:
                    watch.see(status)
                if status is not None and status.state == "taken" and not capture.missing():
                    break
    except KeyboardInterrupt:
        ending = Interrupted("interrupted")
    except DataError as error:
        ending = error
    kept = _write(capture, output)
    if ending is not None:
        raise type(ending)(f"{ending}; {kept}")
    if not quiet:
        typer.echo(f"accelcal: {kept}", err=True)
    if capture.missing():
        raise typer.Exit(INCOMPLETE)


def _write(capture: Capture, output: str) -> str:
    """Write one row a pose, whole or not at all; return what to say of it."""
    from accelcal_cli.output.files import whole_file

    if not capture.taken:
        return "no pose was taken, nothing is written"
    with pipes.even_if_unread(), whole_file(output) as file:
        file.write("pose,n,Nx,Ny,Nz,sx,sy,sz\n")
        for number, pose in enumerate(capture.taken, 1):
            cells = [repr(float(v)) for v in (*pose.mean, *pose.spread)]
            file.write(",".join([str(number), str(pose.n), *cells]) + "\n")
    where = "" if output == "-" else f" in {output}"
    missing = len(capture.missing())
    rest = f", {missing} planned are missing" if missing else ""
    return f"{len(capture.taken)} pose{'s' * (len(capture.taken) != 1)}{where}{rest}"
