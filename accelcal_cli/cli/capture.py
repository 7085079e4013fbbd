"""`accelcal capture`: guided poses of a live sensor, into a table that calibrate reads."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol

import typer

from accelcal_cli.cli import options, process
from accelcal_cli.errors import AccelcalError, Interrupted, OutputError, UsageError

if TYPE_CHECKING:
    from accelcal_cli.arrays import Float
    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.detection.capture import Capture, CaptureStatus
    from accelcal_cli.output.live import PoseFile
    from accelcal_cli.output.page import LivePage

MOST_READINGS = 1_000_000
INCOMPLETE = 1

LARGEST_PORT = 65535

in_sensor, in_poses, in_page = (options.panel(heading) for heading in ("Sensor", "Poses", "Page"))


def command(
    *,
    port: Annotated[
        str,
        options.in_input(
            help="Serial port, as /dev/ttyUSB0 or COM3; or the file of a recording, which is replayed at --rate; "
            "- is standard input."
        ),
    ],
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
    gravity: options.GravityOptions,
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
    web: Annotated[bool, in_page("--web", help="Show the capture in a browser, too.")] = False,
    bind: Annotated[
        str, in_page(help="Address of this machine at which the page is; 0.0.0.0 for all.", metavar="ADDRESS")
    ] = "127.0.0.1",
    web_port: Annotated[
        int, in_page(help="Port of the page; 0 takes any that is free.", min=0, max=LARGEST_PORT)
    ] = 0,
    output: Annotated[str, options.in_output("--output", "-o", help="CSV file; - is standard output.")] = "-",
    result: Annotated[
        str | None, options.in_output(help="Calibrate the poses in the end into this file: .yaml or .json.")
    ] = None,
    record: Annotated[
        str | None,
        options.in_output(help="Keep the lines of the sensor in this file, which replays with --port."),
    ] = None,
    overwrite: Annotated[bool, options.in_output("--overwrite", help="Replace a file that exists.")] = False,
    quiet: options.Quiet = False,
) -> None:
    """Take poses from a live sensor, guided.

    Shows which pose is held, whether it is still, what is missing, and what the poses so far say of the sensor, on the
    terminal and with --web in a browser. Each pose that is held still is averaged into one row of the table for
    accelcal calibrate, written at once. Ctrl-C, a closed terminal, the end of the input and a lost port end it early;
    the poses taken until then are kept. Exit code 1 means that the input ended before all poses were taken, that they
    show a fault (a dead axis, clipping, no gravity), or with --result or --web that the verdict is "suspect" or
    "undetermined".
    """
    from accelcal_cli.detection.capture import Capture
    from accelcal_cli.io import serial
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
    own_unit = unit if unit in OUTPUT_OF_1_G else None
    g = gravity.in_unit(own_unit)
    _check_page(web, bind, web_port)
    _check_outputs(port, {"-o": output, "--result": result, "--record": record}, overwrite)
    options.check_input(port)
    allowed = candidates(fixture)
    if poses > len(allowed):
        raise UsageError(f"--poses {poses}: expected at most {len(allowed)} with --fixture {fixture}")
    capture = Capture(
        allowed[distinct_poses(allowed, poses)], round(window * rate), round(hold * rate), *stated, own_unit
    )
    replayed = port != "-" and Path(port).is_file()
    if port == "-":
        lines = serial.file_lines(sys.stdin.buffer)
    elif replayed:
        lines = serial.recorded_lines(port)
    else:
        lines = serial.port_lines(port, baud, timeout)
    if record is not None:
        lines = serial.copied(lines, record)
    source = "<stdin>" if port == "-" else port
    readings = serial.readings(lines, chosen, source, line, lambda note: options.tell([note], quiet))
    readings = serial.in_time(readings, rate) if replayed else readings
    with closing(_open_page(capture, bind, web_port)) if web else nullcontext() as page:
        _run(capture, readings, output, page, result, g, quiet)


def _check_page(web: bool, bind: str, web_port: int) -> None:
    import ipaddress

    if not web and (bind != "127.0.0.1" or web_port):
        raise UsageError(f"--{'web-port' if web_port else 'bind'} needs --web")
    try:
        ipaddress.ip_address(bind)
    except ValueError:
        raise UsageError(f'--bind "{bind}": expected an address of this machine, as 192.168.1.5') from None


def _check_outputs(port: str, outputs: dict[str, str | None], overwrite: bool) -> None:
    """Check that each file can be written, is none of the others, and replaces one only on request."""
    from accelcal_cli.output.files import check_target, is_stream

    named = {option: path for option, path in outputs.items() if path is not None}
    if "--result" in named:
        from accelcal_cli.calibration.result import RESULTS

        options.check_suffix("--result", named["--result"], RESULTS)
    if named.get("--record") == "-":
        raise UsageError('--record "-": expected the name of a file')
    options.check_apart([port], outputs)
    for option, path in named.items():
        if Path(path).is_file() and not (overwrite or is_stream(path)):
            raise UsageError(f'{option} "{path}": exists already; expected a new name, or --overwrite')
        if [Path(other).resolve() for other in named.values()].count(Path(path).resolve()) > 1:
            raise UsageError(f'{option} "{path}": is stated twice; expected a name of its own')
        check_target(path)


def _open_page(capture: Capture, bind: str, port: int) -> LivePage:
    """Serve the page and say where; its address is told even when the rest is quiet, as nothing else has the token."""
    from accelcal_cli.output.page import LivePage

    page = LivePage(capture, bind, port)
    typer.echo(f"accelcal: open {page.server.address}", err=True)
    if page.is_shared and sys.stderr.isatty() and sys.stderr.encoding.lower().startswith("utf"):
        try:
            typer.echo(page.qr_code(), err=True)
        except UsageError as missing:
            options.tell([str(missing)])
    return page


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


class Viewer(Protocol):
    """What shows a capture."""

    def see(self, status: CaptureStatus) -> None:
        """Show what the sensor is doing now."""


def _run(
    capture: Capture,
    readings: Iterator[Float],
    output: str,
    page: LivePage | None,
    result: str | None,
    g: float | None,
    quiet: bool,
) -> None:
    """Watch the readings to the end, whatever it is, and keep the poses; then say how it ended."""
    from accelcal_cli.notices import are_serious
    from accelcal_cli.output.live import PoseFile, Watch

    ending: AccelcalError | Interrupted | None = None
    with closing(PoseFile(output)) as file:
        try:
            with Watch(capture, quiet=quiet) as watch:
                viewers: list[Viewer] = [watch] if page is None else [watch, page]
                live = page is not None or watch.live is not None
                _take(capture, _until_stopped(readings, page), file, viewers, g, live)
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
    made = _calibrated(capture, file, g) if page is not None or result is not None else None
    if made is not None:
        if result is not None:
            made.save(result)
        where = "" if result is None else f", in {result}"
        summary += f"; their calibration is {made.verdict}{where}"
    elif result is not None and capture.poses:
        summary += f"; they allow no calibration, {result} is not written"
    if page is not None:
        page.finish(summary if ending is None else f"{ending}; {summary}", made)
    if ending is not None:
        ending.args = (f"{ending}; {summary}",)
    options.tell([summary], quiet or ending is not None)
    if page is not None and not isinstance(ending, Interrupted):
        with suppress(KeyboardInterrupt):
            page.linger()
    if ending is not None:
        raise ending
    bad = made is not None and made.verdict in options.BAD_VERDICTS
    if capture.missing() or are_serious(notices) or bad:
        raise typer.Exit(INCOMPLETE)


def _take(
    capture: Capture,
    readings: Iterable[Float],
    file: PoseFile,
    viewers: Sequence[Viewer],
    g: float | None,
    live: bool,
) -> None:
    """Keep every pose when it is taken, before it is shown, until all are there or the readings end."""
    if live:  # what the first pose should not wait for
        import accelcal_cli.calibration.calibrate
        import accelcal_cli.optimization.algorithms.levenberg_marquardt  # noqa: F401
    for reading in readings:
        status = capture.push(reading)
        if status is None:
            continue
        if status.state == "taken":
            file.save(capture.poses)
            if live:
                capture.calibrate(g)
        for viewer in viewers:
            viewer.see(status)
        if status.state == "taken" and not capture.missing():
            return


def _until_stopped(readings: Iterator[Float], page: LivePage | None) -> Iterator[Float]:
    """Yield readings until a page asks for the end."""
    for reading in readings:
        if page is not None and page.stopping.is_set():
            return
        yield reading


def _calibrated(capture: Capture, file: PoseFile, g: float | None) -> Calibration | None:
    """Return the calibration as accelcal calibrate makes it of the file; None of poses that allow none."""
    from dataclasses import replace

    from accelcal_cli.calibration.calibrate import calibrate
    from accelcal_cli.errors import DataError
    from accelcal_cli.io.readings import read_readings

    if not capture.poses:
        return None
    try:
        readings = capture.readings()
        if Path(file.path).is_file() and file.kept:
            filed = read_readings(file.path)
            readings = replace(filed, warnings=readings.warnings, form=replace(filed.form, unit=capture.unit))
        return calibrate(readings) if g is None else calibrate(readings, g=g)
    except DataError:
        return None


def _summary(capture: Capture, file: PoseFile) -> str:
    """Return what to say of the poses that are written."""
    if not file.kept:
        parts = ["no pose was taken"] * (not capture.poses) + ["nothing is written"] * (not file.flows)
        return ", ".join(parts) or "no pose is written"
    where = "" if file.path == "-" else f" in {file.path}"
    missing = len(capture.missing())
    rest = f", {missing} planned are missing" if missing else ""
    return f"{file.kept} pose{'s' * (file.kept != 1)}{where}{rest}"
