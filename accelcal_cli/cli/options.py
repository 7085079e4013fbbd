"""Options that several commands share, and the checks on them.

Options that `detect` and `calibrate --raw` share, and what they come to.

What every command that runs a study shares: its options, and the running itself.

records = running.run(study, raw=raw, jobs=jobs, cluster=cluster, resume=resume, quiet=quiet)
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from accelcal_cli.cli import process as signals
from accelcal_cli.errors import AccelcalError, Interrupted, UsageError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.detection.detect import Detection, DetectSettings
    from accelcal_cli.studies.engine import Executors, Journal
    from accelcal_cli.studies.engine import Progress as Report
    from accelcal_cli.studies.study import Record, Study


FORMATS = ("table", "json", "csv")

Format = Annotated[str, typer.Option("--format", help="What to print: table, json or csv.", metavar="FORMAT")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of all random numbers.", min=0)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing on standard error but errors.")]
Gravity = Annotated[
    float | None,
    typer.Option(
        "--g", help="Local gravity in m/s^2 (1 for readings in units of g).", show_default="9.80665"
    ),
]
Latitude = Annotated[
    float | None, typer.Option("--latitude", help="Degrees; gravity from WGS84 instead of --g.")
]
Height = Annotated[
    float | None, typer.Option("--height", help="Metres above the ellipsoid, with --latitude.")
]
Columns = Annotated[
    str | None,
    typer.Option("--columns", help="The three output columns: names, or numbers from 1, with commas."),
]


def check_format(choice: str) -> str:
    """Return a known output format or raise UsageError."""
    if choice not in FORMATS:
        raise UsageError(
            f'--format "{choice}": unknown{did_you_mean(choice, FORMATS)}; expected one of {", ".join(FORMATS)}'
        )
    return choice


def check_input(source: str) -> None:
    """Raise UsageError when readings are to come from a terminal, where nobody types them."""
    if source == "-" and sys.stdin.isatty():
        raise UsageError("-: standard input is a terminal; expected the name of a file, or a pipe")


def check_apart(inputs: Iterable[str | Path | None], outputs: Mapping[str, str | None]) -> None:
    """Raise UsageError when an output would take the place of a file that is read.

    Args:
        inputs: files that are read, - for standard input, None for one that was not stated.
        outputs: files to write by the option that names them.
    """
    read = [_identity(source) for source in inputs if source is not None]
    for option, output in outputs.items():
        if output in (None, "-") or not os.path.isfile(output):  # a pipe or a device holds nothing to lose
            continue
        written = os.stat(output)
        if any(source is not None and os.path.samestat(source, written) for source in read):
            raise UsageError(f'{option} "{output}": is the input itself; expected another name')


def _identity(source: str | Path) -> os.stat_result | None:
    """Return what tells one file from another, whatever it is called; None where there is no file."""
    try:
        return os.fstat(sys.stdin.fileno()) if source == "-" else os.stat(source)
    except (OSError, ValueError):  # it does not exist, or standard input is no file
        return None


def load_result(source: str, data: str | None = None) -> Calibration:
    """Return the calibration of a result file, or of standard input for `-`.

    Raises:
        UsageError: standard input is a terminal, or `data` is to come from it, too.
        ConfigError, DataError: no result file.
    """
    from accelcal_cli.calibration import result

    if source != "-":
        return result.load_result(source)
    if data == "-":
        raise UsageError(
            "- -: standard input is one file; expected the name of the result file or of the readings"
        )
    check_input(source)
    return result.load_result("<stdin>", sys.stdin.buffer)


def gravity(g: float | None, latitude: float | None, height: float | None) -> float | None:
    """Return the stated local gravity in m/s^2, or None when nothing was stated.

    Raises:
        UsageError: out of range, stated twice, or a height without a latitude.
    """
    from accelcal_cli.sensor.gravity import check_gravity, normal_gravity

    if g is not None and latitude is not None:
        raise UsageError("--g and --latitude: expected one of them, not both")
    if height is not None and latitude is None:
        raise UsageError("--height: needs --latitude")
    if g is not None:
        return check_gravity(g)
    return None if latitude is None else normal_gravity(latitude, height or 0.0)


def caution(source: str, cautions: Iterable[str], quiet: bool) -> None:
    """Say on standard error, unless quiet, what speaks against trusting a file."""
    for text in () if quiet else cautions:
        typer.echo(f"accelcal: {source}: caution: {text}", err=True)


def check_tolerance(tolerance: float | None) -> None:
    """Raise UsageError when a stated tolerance is not a positive number."""
    if tolerance is not None and not (math.isfinite(tolerance) and tolerance > 0):
        raise UsageError(f"--tolerance {tolerance:g}: expected a positive number in m/s^2")


def split_columns(text: str | None) -> list[str] | None:
    """Return the columns named with commas, or None when none were named."""
    return None if text is None else [part.strip() for part in text.split(",")]


def check_positive(option: str, value: float) -> None:
    """Raise UsageError when the value of an option is not a positive number."""
    if not (math.isfinite(value) and value > 0):
        raise UsageError(f"{option} {value:g}: expected a positive number")


LARGEST_MULTIPLIER = 1e6
LARGEST_RATE = 1e6
LARGEST_MERGE, LARGEST_THIN = 5.0, 90.0
"""Degrees: the mean of poses that differ more is shorter than gravity by over a thousandth of it."""

Gyro = Annotated[
    str | None,
    typer.Option(
        help="The three gyroscope columns, or none.", show_default="found by name", metavar="COLUMNS"
    ),
]
Time = Annotated[
    str | None,
    typer.Option(help="The time column, or none.", show_default="found by name", metavar="COLUMN"),
]
Rate = Annotated[
    float | None, typer.Option(help="Rows a second.", show_default="from the time column", metavar="HZ")
]
Window = Annotated[
    str | None,
    typer.Option(
        help="Window of the variance: seconds, or rows as in 101rows.",
        show_default="1 s; 101 rows without time",
        metavar="SPAN",
    ),
]
Still = Annotated[
    str | None,
    typer.Option(
        help="Still period at the beginning that sets the threshold: seconds, or rows.",
        show_default="the quietest windows set it",
        metavar="SPAN",
    ),
]
Multiplier = Annotated[
    str | None,
    typer.Option(
        help="Threshold as a multiple of the still variance; of several, with commas, the best is kept.",
        show_default="2 to 100",
        metavar="NUMBERS",
    ),
]
MinLength = Annotated[
    str | None,
    typer.Option(
        help="Least length of an interval after trimming: seconds, or rows.",
        show_default="1 s; 100 rows without time",
        metavar="SPAN",
    ),
]
Trim = Annotated[
    str | None,
    typer.Option(
        help="Cut off both ends of an interval: seconds, or rows.",
        show_default="half a window",
        metavar="SPAN",
    ),
]
Merge = Annotated[float | None, typer.Option(help="Join poses within this many degrees.", metavar="DEGREES")]
Thin = Annotated[
    float | None,
    typer.Option(help="Of poses within this many degrees keep only the longest.", metavar="DEGREES"),
]
MinPoses = Annotated[
    int | None,
    typer.Option(help="Attitudes, 5 degrees apart, that must be found.", show_default="12", min=2),
]


def stated(**values: Any) -> dict[str, Any]:
    """Return the options that were stated."""
    return {name: value for name, value in values.items() if value is not None}


def find_poses(
    data: str, columns: str | None, chosen: Mapping[str, Any], g: float, picture: bool = False
) -> Detection:
    """Find the static poses of a raw log as the stated options say.

    Args:
        data: file, or - for standard input.
        columns: option --columns.
        chosen: the other options of this module that were stated, by name.
        g: local gravity, m/s^2.
        picture: keep what a picture of the log needs.
    """
    from accelcal_cli.detection.detect import detect
    from accelcal_cli.detection.rawlog import open_raw_log

    check_input(data)
    settings = _settings(chosen, g)
    log = open_raw_log(
        data, _split(columns), _split(chosen.get("gyro")), chosen.get("time"), stdin=sys.stdin.buffer
    )
    try:
        return detect(log, settings, picture)
    finally:
        log.close()


def _settings(chosen: Mapping[str, Any], g: float) -> DetectSettings:
    from accelcal_cli.detection.detect import MULTIPLIERS, DetectSettings
    from accelcal_cli.detection.windows import Spans, parse_span

    if "merge" in chosen and "thin" in chosen:
        raise UsageError("--merge and --thin: expected one of them, not both")
    names = ("window", "still", "min_length", "trim")
    spans = [parse_span(chosen.get(name), f"--{name.replace('_', '-')}") for name in names]
    multipliers = chosen.get("multiplier")
    return DetectSettings(
        spans=Spans(*spans),
        rate=_between("--rate", chosen.get("rate"), LARGEST_RATE, "rows a second"),
        multipliers=MULTIPLIERS if multipliers is None else _multipliers(multipliers),
        merge=_between("--merge", chosen.get("merge"), LARGEST_MERGE, "degrees"),
        thin=_between("--thin", chosen.get("thin"), LARGEST_THIN, "degrees"),
        least_poses=chosen.get("min_poses", DetectSettings.least_poses),
        g=g,
    )


def _split(text: str | None) -> Sequence[str] | None:
    return None if text is None else [part.strip() for part in text.split(",")]


def _between(option: str, value: float | None, most: float, unit: str) -> float | None:
    if value is not None and not 0 < value <= most:
        raise UsageError(f"{option} {value:g}: expected more than 0 and at most {most:g} {unit}")
    return value


def _multipliers(text: str) -> tuple[float, ...]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(1 < value <= LARGEST_MULTIPLIER for value in values):
        raise UsageError(
            f'--multiplier "{text}": expected numbers above 1, at most {LARGEST_MULTIPLIER:g}, with commas'
        )
    return tuple(sorted(set(values)))


MOST_JOBS = 1024
RAW_SUFFIXES = (".csv", ".parquet")
PLOT_SUFFIXES = (".png", ".svg")

Jobs = Annotated[
    int, typer.Option("--jobs", "-j", help="Processes on this machine.", min=1, max=MOST_JOBS, metavar="N")
]
Cluster = Annotated[
    str | None,
    typer.Option("--cluster", help="Run on a Dask cluster: tcp://host:8786.", metavar="ADDRESS"),
]
Raw = Annotated[
    str | None,
    typer.Option("--raw", help="File for every run's result: .csv or .parquet.", metavar="FILE"),
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Go on with an interrupted study; its runs are in FILE.journal.")
]
Plot = Annotated[
    str | None, typer.Option("--plot", help="Draw convergence to a .png or .svg file.", metavar="FILE")
]


def check_plot(plot: str | None) -> None:
    """Refuse a plot that could not be written, before any run is made for it.

    Raises:
        UsageError: another suffix, or matplotlib is missing.
        OutputError: the file cannot be written.
    """
    if plot is None:
        return
    from importlib.util import find_spec

    _check_target("--plot", plot, PLOT_SUFFIXES)
    if find_spec("matplotlib") is None:
        raise UsageError("--plot needs matplotlib: pip install 'accelcal[plot]'")


def run(
    study: Study, *, raw: str | None, jobs: int, cluster: str | None, resume: bool, quiet: bool
) -> list[Record]:
    """Run a study as the options say, write the raw file, and return all records by cell and run.

    With a raw file the finished runs are kept in a journal beside it until it is written.

    Args:
        study: what to run.
        raw, jobs, cluster, resume, quiet: the shared options of the command.

    Raises:
        UsageError: options that do not go together, or a raw file with another suffix.
        AccelcalError: what the study, the journal or the cluster could not do.
    """
    _check(raw, jobs, cluster, resume)
    from accelcal_cli.output.machine import write_table
    from accelcal_cli.studies.engine import Journal, run_study
    from accelcal_cli.views.studies import raw_table

    journal = Journal.open(Path(f"{raw}.journal") if raw else None, study, resume)
    try:
        with _progress(quiet) as progress:
            records = run_study(study, journal, _executors(study, jobs, cluster), progress)
        if raw is not None:
            write_table(raw_table(study, records), raw)
    except KeyboardInterrupt as stop:
        ending = signals.interrupted(stop)
        raise Interrupted(f"{ending}{_kept(journal)}", ending.code) from None
    except AccelcalError as error:
        raise type(error)(f"{error}{_kept(journal)}") from None
    journal.remove()
    return records


def _kept(journal: Journal) -> str:
    """Return what to say of finished runs after a failure; a journal without any goes."""
    if not journal.done:
        journal.remove()
    if journal.path is None or not journal.done:
        return ""
    runs = sum(map(len, journal.done.values()))
    return f"; {runs:,} finished runs are kept in {journal.path}, --resume goes on with them"


def _check(raw: str | None, jobs: int, cluster: str | None, resume: bool) -> None:
    if raw is not None:
        _check_target("--raw", raw, RAW_SUFFIXES)
    elif resume:
        raise UsageError("--resume: needs the --raw FILE of the interrupted study")
    if cluster is not None and jobs != 1:
        raise UsageError("--jobs and --cluster: expected one of them, not both")


def _check_target(option: str, path: str, suffixes: tuple[str, ...]) -> None:
    from accelcal_cli.output.files import check_target

    if Path(path).suffix not in suffixes:
        raise UsageError(f'{option} "{path}": expected a name that ends in {" or ".join(suffixes)}')
    check_target(path)


def _executors(study: Study, jobs: int, address: str | None) -> Executors | None:
    from accelcal_cli.studies import pools

    if address is not None:
        return partial(pools.cluster, address)
    useful = min(jobs, len(study.tasks()))
    return partial(pools.local_pool, useful) if useful > 1 else None


@contextmanager
def _progress(quiet: bool) -> Iterator[Report | None]:
    """Open a bar with the time left on standard error, when somebody looks at it."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("runs", total=None)

        def update(done: int, total: int) -> None:
            if bar.tasks[0].total is None:
                bar.reset(task, total=total, completed=done)
            bar.update(task, completed=done)

        yield update
