"""Options that several commands share, groups of options, and the checks on them.

A group is a frozen dataclass whose fields are options: a command that has a parameter of such a type takes them all,
and `main.expand` spells them out for typer. An option's panel is its heading in the help; what `one_of` or `several_of`
offers to the shell stands in the help in place of {choices}.
"""

from __future__ import annotations

import math
import os
import pkgutil
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Annotated, Any

import typer

from accelcal_cli.errors import UsageError, did_you_mean, visible
from accelcal_cli.registry import is_mentioned
from accelcal_cli.schema import frozen

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.detection.detect import Detection, DetectSettings
    from accelcal_cli.io.reader import ReadOptions
    from accelcal_cli.io.readings import Readings
    from accelcal_cli.notices import Notice
    from accelcal_cli.views.blocks import Block, Table

Complete = Callable[[str], list[str]]
"""What the shell asks for values: from what is typed so far to what it may become."""


def one_of(names: Iterable[str] | Callable[[], Iterable[str]]) -> Complete:
    """Return the completion of an option that takes one of some names; a function is asked when they are needed."""

    def complete(incomplete: str) -> list[str]:  # noqa: ARG001  # typer picks what begins so
        return list(names() if callable(names) else names)

    return complete


def several_of(names: Iterable[str] | Callable[[], Iterable[str]]) -> Complete:
    """Return the completion of an option that takes some of the names, separated by commas."""

    def complete(incomplete: str) -> list[str]:
        before, comma, _ = incomplete.rpartition(",")
        return [f"{before}{comma}{name}" for name in one_of(names)("")]

    return complete


def classes_in(package: str, group: str) -> list[str]:
    """Return the names in a registry without importing a class: help and a shell that completes do not wait for numpy.

    Args:
        package, group: of the registry, see `registry.Registry`.
    """
    modules = (module.name for module in pkgutil.iter_modules(import_module(package).__path__))
    names = {name.replace("_", "-") for name in modules if name != "base"}
    if is_mentioned(group):
        from importlib.metadata import entry_points

        names.update(point.name for point in entry_points(group=group))
    return sorted(names)


optimizers = partial(classes_in, "accelcal_cli.optimization.algorithms", "accelcal.optimizers")
filters = partial(classes_in, "accelcal_cli.navigation.filters", "accelcal.filters")
exporters = partial(classes_in, "accelcal_cli.exporters", "accelcal.exporters")


def optimizers_or_all() -> list[str]:
    """Return the names of the optimizers, and "all"."""
    return [*optimizers(), "all"]


def shipped(kind: str) -> list[str]:
    """Return the names of the shipped configurations of a kind: sensors, studies."""
    from accelcal_cli.config import shipped as shipped_files

    return list(shipped_files(kind))


def panel(heading: str) -> Callable[..., Any]:
    """Return typer.Option for options that stand under a heading of the help."""
    return partial(typer.Option, rich_help_panel=heading)


def stated(**values: Any) -> dict[str, Any]:
    """Return the options that were stated, by name; those of a group as `**vars(group)`."""
    return {name: value for name, value in values.items() if value is not None}


# Options of one kind in all commands

BAD_VERDICT = 1
"""Exit code of a command that did its work and found something bad."""

BAD_VERDICTS = ("suspect", "undetermined")
"""Verdicts on a calibration that have that exit code."""

PLOT_SUFFIXES = (".png", ".svg")
FORMATS = ("table", "json", "csv")
SCHEMES = ("faces", "edges", "faces-edges", "icosahedron", "turns", "fibonacci", "random")
GAUGES = ("lower", "upper", "symmetric", "full")
ROBUST = ("none", "huber", "soft-l1")
ATTITUDES = ("unknown", "known")
WEIGHTS = ("none", "n", "sd", "auto")
UNITS = ("m/s^2", "g", "mg")
FIXTURES = ("faces", "edges", "corners", "any")
"""Names of the library, stated again so that help need not import it; tests compare them."""


def check_choice(option: str, choice: str, names: Iterable[str]) -> str:
    """Return a choice that is one of the names or raise UsageError."""
    if choice not in names:
        raise UsageError(
            f'{option} "{choice}": unknown{did_you_mean(choice, names)}; expected one of {", ".join(names)}'
        )
    return choice


def _check_format(choice: str) -> str:
    return check_choice("--format", choice, FORMATS)


def check_positive(option: str, value: float | None, unit: str = "") -> float | None:
    """Return the value of an option that was not stated or is a positive number, or raise UsageError."""
    if value is not None and not (math.isfinite(value) and value > 0):
        raise UsageError(f"{option} {value:g}: expected a positive number{unit}")
    return value


def check_tolerance(tolerance: float | None) -> float | None:
    """Return a tolerance that was not stated or is a positive number, or raise UsageError."""
    return check_positive("--tolerance", tolerance, " in m/s^2")


LARGEST_NOISE = 100.0
"""m/s^2, ten times gravity."""


def check_noise(noise: float | None) -> float | None:
    """Return a noise that was not stated or can be the sigma of an accelerometer in m/s^2, or raise UsageError."""
    if noise is not None and not 0 <= noise <= LARGEST_NOISE:
        raise UsageError(f"--noise {noise:g}: expected 0 to {LARGEST_NOISE:g} m/s^2")
    return noise


in_input, in_output = panel("Input"), panel("Output")

ResultFile = Annotated[
    str,
    typer.Argument(help="Result file of accelcal calibrate; - is standard input.", rich_help_panel="Input"),
]
Columns = Annotated[
    str | None,
    in_input("--columns", help="The three output columns: names, or numbers from 1, separated by commas."),
]
Force = Annotated[bool, in_input("--force", help="Use a result although its verdict is undetermined.")]
Format = Annotated[
    str,
    in_output(
        "--format",
        help="What to print: {choices}.",
        metavar="FORMAT",
        autocompletion=one_of(FORMATS),
        callback=_check_format,
    ),
]
Verbose = Annotated[
    bool, in_output("--verbose", "-v", help="Print all there is: more than one screen of a terminal.")
]
Quiet = Annotated[bool, in_output("--quiet", "-q", help="Print nothing on standard error but errors.")]


@frozen()
class GravityOptions:
    """Local gravity, stated in one of two ways or not at all."""

    g: Annotated[
        float | None,
        in_input(
            "--g", help="Local gravity in m/s^2 (1 for readings in units of g).", show_default="9.80665"
        ),
    ] = None
    latitude: Annotated[float | None, in_input(help="Degrees; gravity from WGS84 instead of --g.")] = None
    height: Annotated[float | None, in_input(help="Metres above the ellipsoid, with --latitude.")] = None

    def in_unit(self, unit: str | None) -> float | None:
        """Return the stated local gravity in the unit of the readings, see `local_gravity`."""
        if self._nothing(unit):
            return None
        from accelcal_cli.sensor.model import local_gravity

        return local_gravity(unit, **vars(self))

    def source(self, unit: str | None) -> str:
        """Return where local gravity comes from, in words."""
        from accelcal_cli.sensor.model import ASSUMED, gravity_source

        return ASSUMED if self._nothing(unit) else gravity_source(unit, **vars(self))

    def _nothing(self, unit: str | None) -> bool:
        """Return whether neither the options nor the unit of the readings say what g is."""
        return unit is None and all(value is None for value in vars(self).values())

    def stated(self) -> float | None:
        """Return the stated local gravity in m/s^2, or None when nothing was stated."""
        return self.in_unit(None)


@frozen()
class TextOptions:
    """Which rows of a table to read, and what a user knows of its form."""

    where: Annotated[
        list[str] | None,
        in_input(help="Read only rows with this value, as device=0; repeatable.", metavar="COLUMN=VALUE"),
    ] = None
    skip_rows: Annotated[
        int | None, in_input(help="Lines at the beginning that are not looked at.", min=0, metavar="N")
    ] = None
    skip_bad: Annotated[
        bool | None,
        in_input("--skip-bad", help="Leave out rows that cannot be read, up to 5 % of them."),
    ] = None
    line: Annotated[
        str | None,
        in_input(
            help="What the lines of readings begin with, among lines of several kinds.",
            show_default="found by their words",
            metavar="PREFIX",
        ),
    ] = None
    count: Annotated[
        str | None,
        in_input(
            help="The column of counts of raw readings, or none.",
            show_default="found by name",
            metavar="COLUMN",
        ),
    ] = None
    accelerometer: Annotated[
        str | None,
        in_input(
            help="The accelerometer of a log that has several, as sensor_accel[1], IMU[0] or /imu.",
            show_default="the only one",
            metavar="NAME",
        ),
    ] = None

    def read_options(self) -> ReadOptions:
        """Return the options as the library takes them."""
        from accelcal_cli.io.reader import ReadOptions

        skipped, where = self.skip_rows or 0, tuple(self.where or ())
        return ReadOptions(skipped, bool(self.skip_bad), self.line, self.count, where, self.accelerometer)


LARGEST_MULTIPLIER = 1e6
LARGEST_RATE = 1e6
LARGEST_MERGE, LARGEST_THIN = 5.0, 90.0
"""Degrees: the mean of poses that differ more is shorter than gravity by over a thousandth of it."""

FACES = 6
"""Fewest poses of a log without --min-poses when no misalignment is asked for."""

in_log = panel("Raw log")


@frozen()
class DetectionOptions:
    """How static poses are found in a raw log, as `detect` and `calibrate --raw` take it."""

    gyro: Annotated[
        str | None,
        in_log(help="The three gyroscope columns, or none.", show_default="found by name", metavar="COLUMNS"),
    ] = None
    time: Annotated[
        str | None, in_log(help="The time column, or none.", show_default="found by name", metavar="COLUMN")
    ] = None
    rate: Annotated[
        float | None, in_log(help="Rows per second.", show_default="from the time column", metavar="HZ")
    ] = None
    window: Annotated[
        str | None,
        in_log(
            help="Window of the variance: seconds, or rows as in 101rows.",
            show_default="1 s; 101 rows without time",
            metavar="SPAN",
        ),
    ] = None
    still: Annotated[
        str | None,
        in_log(
            help="Still period at the beginning that sets the threshold: seconds, or rows.",
            show_default="the quietest windows set it",
            metavar="SPAN",
        ),
    ] = None
    multiplier: Annotated[
        str | None,
        in_log(
            help="Threshold as a multiple of the still variance; of several, separated by commas, the best is kept.",
            show_default="2 to 100",
            metavar="NUMBERS",
        ),
    ] = None
    min_length: Annotated[
        str | None,
        in_log(
            help="Shortest interval after trimming: seconds, or rows.",
            show_default="1 s; 100 rows without time",
            metavar="SPAN",
        ),
    ] = None
    trim: Annotated[
        str | None,
        in_log(
            help="Cut this off both ends of an interval: seconds, or rows.",
            show_default="half a window",
            metavar="SPAN",
        ),
    ] = None
    merge: Annotated[float | None, in_log(help="Join poses within this many degrees.", metavar="DEGREES")] = (
        None
    )
    thin: Annotated[
        float | None,
        in_log(help="Of poses within this many degrees keep only the longest.", metavar="DEGREES"),
    ] = None
    min_poses: Annotated[
        int | None,
        in_log(help="Attitudes, 5 degrees apart, that must be found.", show_default="12", min=2),
    ] = None

    def check_raw(self, raw: bool) -> None:
        """Refuse options of a log where the file is none: raise UsageError."""
        detection = stated(**vars(self))
        if detection and not raw:
            raise UsageError(f"--{next(iter(detection)).replace('_', '-')} needs --raw")

    def poses(
        self,
        data: str,
        columns: str | None,
        gravity: Callable[[str | None], float],
        form: TextOptions,
        *,
        misalignment: bool,
    ) -> Readings:
        """Return the static poses of a raw log; faces are enough of them where no misalignment is asked for.

        Args:
            data, columns, gravity, form: see `detect`.
            misalignment: whether misalignments are to be estimated.
        """
        few = self.min_poses is None and not misalignment
        own = replace(self, min_poses=FACES) if few else self
        return own.detect(data, columns, gravity, form).readings()

    def detect(
        self,
        data: str,
        columns: str | None,
        gravity: Callable[[str | None], float],
        form: TextOptions,
        picture: bool = False,
    ) -> Detection:
        """Find the static poses of a raw log.

        Args:
            data: file, or - for standard input.
            columns: option --columns.
            gravity: returns local gravity in the unit that the file states.
            form: which rows to read, and what is known of their form.
            picture: keep what a picture of the log needs.
        """
        from accelcal_cli.detection.detect import detect
        from accelcal_cli.detection.rawlog import open_raw_log

        check_input(data)
        self.settings(1.0)  # refuses what is wrong before the file is read
        log = open_raw_log(
            data,
            split_columns(columns),
            split_columns(self.gyro),
            self.time,
            stdin=sys.stdin.buffer,
            options=form.read_options(),
        )
        try:
            return detect(log, self.settings(gravity(log.columns.unit)), picture)
        finally:
            log.close()

    def settings(self, g: float) -> DetectSettings:
        """Return the options as the library takes them; refuse what is wrong with them."""
        from accelcal_cli.detection.detect import MULTIPLIERS, DetectSettings
        from accelcal_cli.detection.windows import Spans, parse_span

        if self.merge is not None and self.thin is not None:
            raise UsageError("--merge and --thin: expected one of them, not both")
        names = ("window", "still", "min_length", "trim")
        spans = [parse_span(getattr(self, name), f"--{name.replace('_', '-')}") for name in names]
        return DetectSettings(
            spans=Spans(*spans),
            rate=_between("--rate", self.rate, LARGEST_RATE, "rows per second"),
            multipliers=MULTIPLIERS if self.multiplier is None else _multipliers(self.multiplier),
            merge=_between("--merge", self.merge, LARGEST_MERGE, "degrees"),
            thin=_between("--thin", self.thin, LARGEST_THIN, "degrees"),
            least_poses=DetectSettings.least_poses if self.min_poses is None else self.min_poses,
            g=g,
        )


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
            f'--multiplier "{text}": expected numbers above 1, at most {LARGEST_MULTIPLIER:g}, separated by commas'
        )
    return tuple(sorted(set(values)))


# What commands check, read and tell


def check_input(source: str) -> None:
    """Raise UsageError when readings are to come from a terminal, where nobody types them."""
    if source == "-" and sys.stdin.isatty():
        raise UsageError("-: standard input is a terminal; expected the name of a file, or a pipe")


def check_apart(inputs: Iterable[str | Path | None], outputs: Mapping[str, str | None]) -> None:
    """Raise UsageError when an output would replace a file that is read.

    Args:
        inputs: files that are read, - for standard input, None for one that was not stated.
        outputs: files to write by the option that names them, None for one that was not stated.
    """
    read = [_identity(source) for source in inputs if source is not None]
    for option, output in outputs.items():
        if output in (None, "-") or not os.path.isfile(output):  # a pipe or a device holds nothing to lose
            continue
        written = os.stat(output)
        if any(source is not None and os.path.samestat(source, written) for source in read):
            raise UsageError(f'{option} "{output}": is the input itself; expected another name')


def check_files(inputs: Iterable[str | Path | None], outputs: Mapping[str, str | None]) -> None:
    """Check, before any work is done, that every output can be written and replaces no input.

    Args:
        inputs, outputs: see `check_apart`.

    Raises:
        UsageError: an output is an input.
        OutputError: an output cannot be written.
    """
    check_apart(inputs, outputs)
    stated = [output for output in outputs.values() if output]
    if stated:  # most runs write no file: they need not wait for the import
        from accelcal_cli.output.files import check_target

        for output in stated:
            check_target(output)


def _identity(source: str | Path) -> os.stat_result | None:
    """Return what tells one file from another, whatever it is called; None where there is no file."""
    try:
        return os.fstat(sys.stdin.fileno()) if source == "-" else os.stat(source)
    except (OSError, ValueError):  # it does not exist, or standard input is no file
        return None


def check_suffix(option: str, path: str, suffixes: tuple[str, ...]) -> None:
    """Raise UsageError when the name of a file to write does not end as it should."""
    if Path(path).suffix not in suffixes:
        raise UsageError(f'{option} "{path}": expected a name that ends in {" or ".join(suffixes)}')


def check_plot(plot: str | None) -> None:
    """Refuse a plot that could not be written, before any run is made for it.

    Raises:
        UsageError: another suffix, or matplotlib is missing.
    """
    if plot is None:
        return
    from importlib.util import find_spec

    check_suffix("--plot", plot, PLOT_SUFFIXES)
    if find_spec("matplotlib") is None:
        raise UsageError("--plot needs matplotlib: python -m pip install matplotlib")


def split_columns(text: str | None) -> list[str] | None:
    """Return the columns named with commas, or None when none were named."""
    return None if text is None else [part.strip() for part in text.split(",")]


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


def print_result(
    format: str,
    table: Table | Callable[[], Table],
    blocks: Callable[[], Iterable[Block]],
    record: Callable[[], object] | None = None,
) -> None:
    """Print a result on standard output.

    Args:
        format: of FORMATS.
        table: what csv prints, or what makes it.
        blocks: makes what people see.
        record: makes what json prints; the rows of the table when None.
    """
    if format == "table":
        from accelcal_cli.output.console import show

        show(blocks())
    else:
        from accelcal_cli.output.machine import json_rows, json_text, write_csv

        if format == "json" and record:
            sys.stdout.write(json_text(record()))
        else:
            rows = table() if callable(table) else table
            if format == "json":
                sys.stdout.write(json_text(json_rows([rows])))
            else:
                write_csv(rows, sys.stdout)
    sys.stdout.flush()


def tell(notes: Iterable[str], quiet: bool = False) -> None:
    """Say something on standard error, a line each, unless quiet; on a terminal in lines that fit."""
    for note in () if quiet else notes:
        text = visible(f"accelcal: {note}")
        if sys.stderr.isatty():
            from accelcal_cli.views.blocks import wrapped

            text = wrapped(text, get_terminal_size().columns, "", "  ")
        typer.echo(text, err=True)


def tell_written(paths: Iterable[str | None], quiet: bool) -> None:
    """Name the files that were written on standard error, unless quiet."""
    tell((f"wrote {path}" for path in paths if path not in (None, "-")), quiet)


def warn(source: str, notices: Iterable[Notice], quiet: bool) -> None:
    """Say on standard error, unless quiet, what speaks against trusting a file."""
    tell((f"{source}: {notice.severity}: {notice}" for notice in notices), quiet)


def tell_assumed_gravity(stated: float | None, g: float, quiet: bool, further: str = "") -> None:
    """Say on standard error, unless quiet, that standard gravity was assumed, where `g` is that and was not stated."""
    from accelcal_cli.sensor.model import STANDARD_GRAVITY

    if stated is None and g == STANDARD_GRAVITY:
        advice = "state yours with --g or --latitude and --height (scale factors are proportional to it)"
        tell([f"g = {g} assumed; {advice}{further}"], quiet)
