"""`accelcal capture`: guided poses of a live sensor, into a table that calibrate reads."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options, process
from accelcal_cli.errors import AccelcalError, Interrupted, OutputError, UsageError

if TYPE_CHECKING:
    from accelcal_cli.arrays import Float
    from accelcal_cli.detection.capture import Capture
    from accelcal_cli.output.live import PoseFile, Watch

MOST_READINGS = 1_000_000
INCOMPLETE = 1

in_sensor, in_poses = options.panel("Sensor"), options.panel("Poses")


def command(
    port: Annotated[str, options.in_input(help="Serial port, as /dev/ttyUSB0 or COM3; - is standard input.")],
    baud: Annotated[
        int, options.in_input(help="Speed of the port, bits per second.", min=50, max=100_000_000)
    ] = 115200,
    timeout: Annotated[float, options.in_input(help="Longest silence of the port, seconds.")] = 10.0,
    columns: Annotated[
        str | None,
        options.in_input(
            help="Which numbers of a line are x, y and z, counted from 1, separated by commas.",
            show_default="found by their words, else 1,2,3",
        ),
    ] = None,
    line: Annotated[
        str | None,
        options.in_input(
            help="What the lines of readings begin with, among lines of several kinds.",
            show_default="found by their words",
            metavar="PREFIX",
        ),
    ] = None,
    rate: Annotated[float, options.in_input(help="Readings per second.")] = 100.0,
    unit: Annotated[
        str | None,
        in_sensor(
            help="Output of 1 g: {choices}, or a number.",
            show_default="estimated from the poses",
            autocompletion=options.one_of(options.UNITS),
        ),
    ] = None,
    offset: Annotated[
        str | None,
        in_sensor(
            help="Output at no acceleration: three numbers separated by commas.",
            show_default="estimated from the poses",
        ),
    ] = None,
    poses: Annotated[int, in_poses(help="Poses to plan.", min=1, max=100)] = 12,
    fixture: Annotated[
        str,
        in_poses(
            help="What the sensor can be held against: {choices}.",
            autocompletion=options.one_of(options.FIXTURES[:-1]),
        ),
    ] = "corners",
    window: Annotated[float, in_poses(help="Seconds that stillness is judged by.")] = 0.5,
    hold: Annotated[float, in_poses(help="Seconds of stillness that make a pose.")] = 2.0,
    still: Annotated[
        float | None,
        in_poses(help="Largest standard deviation of a still axis, output units.", show_default="1 % of 1 g"),
    ] = None,
    output: Annotated[str, options.in_output("--output", "-o", help="CSV file; - is standard output.")] = "-",
    overwrite: Annotated[bool, options.in_output("--overwrite", help="Replace a file that exists.")] = False,
    quiet: options.Quiet = False,
) -> None:
    """Take poses from a live sensor, guided.

    Shows which pose is held, whether it is still, and what is missing. Each pose that is held still is averaged into
    one row of the table for accelcal calibrate, written at once. Ctrl-C, a closed terminal, the end of the input and a
    lost port end it early; the poses taken until then are kept. Exit code 1 means that the input
    ended before all poses were taken, or that they show a fault: a dead axis, clipping, no gravity.
    """
    from accelcal_cli.detection.capture import Capture
    from accelcal_cli.io.serial import file_lines, port_lines, readings
    from accelcal_cli.output.files import check_target, is_stream
    from accelcal_cli.planning import candidates, distinct_poses
    from accelcal_cli.sensor.model import OUTPUT_OF_1_G

    options.check_choice("--fixture", fixture, options.FIXTURES[:-1])
    chosen = None if columns is None else _columns(columns)
    for name, seconds in (("window", window), ("hold", hold), ("timeout", timeout), ("rate", rate)):
        options.check_positive(f"--{name}", seconds)
    options.check_positive("--still", still)
    if max(window, hold) * rate > MOST_READINGS or window * rate < 2:
        raise UsageError(
            f"--window {window:g}, --hold {hold:g}, --rate {rate:g}: expected 2 to {MOST_READINGS:,} readings"
        )
    stated = still, _unit(unit), _offset(offset)
    options.check_apart([port], {"-o": output})
    if Path(output).is_file() and not (overwrite or is_stream(output)):
        raise UsageError(f'-o "{output}": exists already; expected a new name, or --overwrite')
    check_target(output)
    options.check_input(port)
    allowed = candidates(fixture)
    if poses > len(allowed):
        raise UsageError(f"--poses {poses}: expected at most {len(allowed)} with --fixture {fixture}")
    capture = Capture(
        allowed[distinct_poses(allowed, poses)],
        round(window * rate),
        round(hold * rate),
        *stated,
        unit if unit in OUTPUT_OF_1_G else None,
    )
    lines = file_lines(sys.stdin.buffer) if port == "-" else port_lines(port, baud, timeout)
    name = "<stdin>" if port == "-" else port
    _run(
        capture,
        readings(lines, chosen, name, line, lambda note: options.tell([note], quiet)),
        output,
        quiet,
    )


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
    from accelcal_cli.sensor.model import OUTPUT_OF_1_G

    try:
        size = OUTPUT_OF_1_G.get(text) or float(text)
    except ValueError:
        size = math.nan
    if not (math.isfinite(size) and size > 0):
        raise UsageError(f'--unit "{text}": expected g, mg, m/s^2 or a positive number, the output of 1 g')
    return size


def _offset(text: str | None) -> Float | None:
    if text is None:
        return None
    import numpy as np

    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise UsageError(f'--offset "{text}": expected three numbers separated by commas')
    return values


def _run(capture: Capture, readings: Iterator[Float], output: str, quiet: bool) -> None:
    """Watch the readings to the end, whatever it is, and keep the poses; then say how it ended."""
    from accelcal_cli.notices import are_serious
    from accelcal_cli.output.live import PoseFile, Watch

    ending: AccelcalError | Interrupted | None = None
    with closing(PoseFile(output)) as file:
        try:
            with Watch(capture, quiet=quiet) as watch:
                _take(capture, readings, file, watch)
        except KeyboardInterrupt as stop:
            ending = process.interrupted(stop)
        except AccelcalError as error:
            ending = error
        try:
            file.save(capture.poses, last=True)
        except OutputError as error:
            ending = error
    summary, notices = _summary(capture, file), capture.notices()
    options.warn(output if file.path != "-" else "<stdout>", notices, quiet)
    if ending is not None:
        ending.args = (f"{ending}; {summary}",)
        raise ending
    options.tell([summary], quiet)
    if capture.missing() or are_serious(notices):
        raise typer.Exit(INCOMPLETE)


def _take(capture: Capture, readings: Iterator[Float], file: PoseFile, watch: Watch) -> None:
    """Keep every pose when it is taken, before it is shown, until all are there or the readings end."""
    for reading in readings:
        status = capture.push(reading)
        if status is None:
            continue
        if status.state == "taken":
            file.save(capture.poses)
        watch.see(status)
        if status.state == "taken" and not capture.missing():
            return


def _summary(capture: Capture, file: PoseFile) -> str:
    """Return what to say of the poses that are written."""
    if not file.kept:
        parts = ["no pose was taken"] * (not capture.poses) + ["nothing is written"] * (not file.flows)
        return ", ".join(parts) or "no pose is written"
    where = "" if file.path == "-" else f" in {file.path}"
    missing = len(capture.missing())
    rest = f", {missing} planned are missing" if missing else ""
    return f"{file.kept} pose{'s' * (file.kept != 1)}{where}{rest}"
