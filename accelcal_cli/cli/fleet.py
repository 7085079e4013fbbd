"""`accelcal fleet`: readings of thousands of sensors in, a row or a result file for each out."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from accelcal_cli.cli import meta as metadata
from accelcal_cli.cli import options, process, running, wear
from accelcal_cli.errors import AccelcalError, Interrupted, UsageError
from accelcal_cli.schema import frozen

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from accelcal_cli.arrays import Bool
    from accelcal_cli.calibration.fleet import Fleet
    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.calibration.settings import Settings
    from accelcal_cli.fleets.blocks import Supply, Work
    from accelcal_cli.fleets.limits import Limit
    from accelcal_cli.fleets.logs import LogForm
    from accelcal_cli.fleets.run import Executors, Finished, Whole
    from accelcal_cli.views.blocks import Block, Table

SUFFIXES = (".csv", ".parquet", ".json")
NAMED = 5
"""Sensors that a line on standard error names."""

MOST_NOTES = 10
"""Notes on the logs of a fleet that are told."""

in_model = options.panel("Model")


@frozen()
class FleetRunOptions:
    """Where the blocks of a fleet are calibrated, and whether an interrupted run is continued."""

    jobs: Annotated[
        int,
        running.in_runs(
            "--jobs", "-j", help="Processes on this machine.", min=1, max=running.MOST_JOBS, metavar="N"
        ),
    ] = 1
    cluster: Annotated[
        str | None,
        running.in_runs("--cluster", help="Run on a Dask cluster: tcp://host:8786.", metavar="ADDRESS"),
    ] = None
    resume: Annotated[
        bool,
        running.in_runs(
            "--resume",
            help="Go on with an interrupted run; its blocks are in OUTPUT.journal, beside the -o OUTPUT.",
        ),
    ] = False

    def check(self, output: str | None) -> None:
        """Refuse options that do not go together, and to begin anew what can be gone on with.

        Raises:
            UsageError: --resume without -o, or --jobs beside --cluster. DataError: an interrupted run left its blocks.
        """
        if self.resume and output is None:
            raise UsageError("--resume needs the -o OUTPUT of the interrupted run")
        if self.cluster is not None and self.jobs != 1:
            raise UsageError("--jobs and --cluster: expected one of them, not both")
        if output is not None and not self.resume and (journal := _journal(output)).exists():
            from accelcal_cli.fleets.run import interrupted_run

            raise interrupted_run(journal)

    @contextmanager
    def whole(
        self, supply: Supply, work: Work, output: str | None, quiet: bool, what: str
    ) -> Iterator[Whole]:
        """Calibrate the blocks of a fleet; they are kept until the output is written.

        Result files of the sensors, where `work` makes them, are in the folder `output` when this has ended.
        """
        from accelcal_cli.fleets.run import Whole, run_blocks
        from accelcal_cli.output.files import publish_folder, whole_folder
        from accelcal_cli.output.machine import remove_results, write_result

        parts = self._parts(supply, work, output)
        try:
            with ExitStack() as stack:
                results = parts.results
                if work.text is not None and results is None and output is not None:
                    results = stack.enter_context(whole_folder(output))
                write = None if results is None or work.text is None else partial(write_result, results)
                with running.progress_bar(quiet, what) as progress:
                    run_blocks(supply, work, parts, self._executors(supply), progress=progress, write=write)
                whole = Whole(parts, work)
                if work.text is not None and results is not None:
                    remove_results(results, whole.other_units())
                yield whole
            if work.text is not None and parts.results is not None and output is not None:
                publish_folder(parts.results, output)
        except KeyboardInterrupt as stop:
            ending = process.interrupted(stop)
            raise Interrupted(f"{ending}{parts.kept()}", ending.code) from None
        except AccelcalError as error:
            raise type(error)(f"{error}{parts.kept()}") from None
        finally:
            parts.leave()
        parts.remove()

    def _parts(self, supply: Supply, work: Work, output: str | None) -> Finished:
        """Return where finished blocks are kept: beside the output, where there is more than one block."""
        from accelcal_cli.fleets.run import Finished, identity_of

        if supply.count < 2:
            return Finished()
        if output is None:
            return Finished.temporary()
        return Finished.open(_journal(output), identity_of(supply, work), self.resume)

    def _executors(self, supply: Supply) -> Executors | None:
        useful = 1 if supply.once else min(self.jobs, supply.count)
        if self.cluster is None and useful < 2:
            return None
        import accelcal_cli.pools as pools

        return (
            partial(pools.local_pool, useful)
            if self.cluster is None
            else partial(pools.cluster, self.cluster)
        )


@dataclass(frozen=True)
class _ResultFile:
    """Makes the text of the result file of a sensor, with what its calibration does not know.

    Attributes:
        meta: what is stated of it; filed_g: where the file of settings states g, or nothing; gravity: as stated.
        date: of the run, so that a file does not depend on when its block was made.
    """

    meta: Mapping[str, str]
    filed_g: str
    gravity: options.GravityOptions
    date: str = field(repr=False)

    def __call__(self, one: Calibration) -> str:
        from accelcal_cli.output.machine import result_line

        source = self.filed_g or self.gravity.source(one.data.get("unit"))
        return result_line(replace(one, meta=dict(self.meta), g_source=source, date=self.date))


def _journal(output: str) -> Path:
    """Return the folder that keeps the finished blocks of a run."""
    return Path(f"{output.rstrip('/')}.journal")


def command(
    *,
    data: Annotated[
        list[str],
        typer.Argument(
            help="Table of static readings with a column that labels the sensor, or one file per sensor; with --raw "
            "logs; text, Parquet, Arrow or native; a folder of Parquet files; - is standard input.",
            rich_help_panel="Input",
        ),
    ],
    sensor_column: Annotated[
        str | None,
        options.in_input(
            help="Column that labels the sensor: name, or number from 1.", show_default="found by name"
        ),
    ] = None,
    columns: options.Columns = None,
    form: options.TextOptions,
    gravity: options.GravityOptions,
    config: Annotated[
        Path | None, options.in_input(help="YAML file: box, nominal, gauge, weights, g.")
    ] = None,
    gauge: Annotated[
        str | None,
        in_model(
            help="Which of the equivalent matrices: {choices}.",
            show_default="lower",
            autocompletion=options.one_of(options.GAUGES[:-1]),
        ),
    ] = None,
    weights: Annotated[
        str | None,
        in_model(
            help="Weight of each pose: {choices}.",
            show_default="none; auto with --raw",
            autocompletion=options.one_of(options.WEIGHTS),
        ),
    ] = None,
    robust: Annotated[
        str | None,
        in_model(help="Loss: {choices}.", show_default="none", autocompletion=options.one_of(options.ROBUST)),
    ] = None,
    misalignment: Annotated[
        bool | None,
        in_model(
            help="Estimate misalignments; without, the axes are taken as perpendicular.",
            show_default="misalignment",
        ),
    ] = None,
    attitudes: Annotated[
        str | None,
        in_model(
            help="Attitudes of the poses: {choices} (from columns fx, fy, fz).",
            show_default="unknown",
            autocompletion=options.one_of(options.ATTITUDES),
        ),
    ] = None,
    temperature: Annotated[
        bool | None,
        in_model(
            help="Estimate temperature slopes, where a column determines them; sensor by sensor, for result files.",
            show_default="temperature with --raw",
        ),
    ] = None,
    raw: Annotated[
        bool,
        options.in_log(
            "--raw", help="The files are raw logs: find the static poses of each first, as detect does."
        ),
    ] = False,
    worn: wear.Worn = False,
    log: options.DetectionOptions,
    runs: FleetRunOptions,
    limits: Annotated[
        Path | None,
        options.in_output(
            help="YAML file of limits per parameter, as bias: 50 mg; exit 1 when a sensor is beyond one.",
            metavar="FILE",
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        options.in_output(
            help="Exit 1 when the rms of |f| - g of a sensor is above this (m/s^2).",
            callback=options.check_tolerance,
        ),
    ] = None,
    output: Annotated[
        str | None,
        options.in_output(
            "--output",
            "-o",
            help="Table of all sensors, .csv, .parquet or .json; or a folder, ending in /, for a result file of each.",
        ),
    ] = None,
    meta: metadata.Meta = None,
    format: options.Format = "table",
    verbose: options.Verbose = False,
    quiet: options.Quiet = False,
) -> None:
    """Calibrate thousands of sensors at once.

    Every sensor as `calibrate --optimizer levenberg-marquardt` would by itself. Prints which sensors are not good,
    which stand out and how the fleet spreads; --format csv or json prints a row for each.
    Exit code 1 means that a sensor is suspect, undetermined or failed, or missed the --tolerance or the --limits.
    """
    from accelcal_cli.calibration.calibrate import moment
    from accelcal_cli.calibration.fleet import check_settings
    from accelcal_cli.calibration.settings import load_settings, weights_of_log
    from accelcal_cli.config import load_mapping
    from accelcal_cli.fleets.blocks import Gravity, Work, supply
    from accelcal_cli.io.fleet import COLD

    for source in data:
        options.check_input(source)
    options.check_apart([*data, config, limits], {"-o": output})
    folder = output is not None and _check_output(output)
    runs.check(output)
    kept = metadata.stated(meta) if meta else {}
    if kept and not folder:
        raise UsageError("--meta is kept in result files: add -o FOLDER/")
    log.check_raw(raw)
    if worn:
        wear.check(raw, log)
    stated_g = gravity.stated()
    stated = options.stated(
        g=stated_g,
        gauge=gauge,
        weights=weights,
        robust=robust,
        misalignment=misalignment,
        attitudes=attitudes,
        temperature=temperature,
    )
    filed = {} if config is None else load_mapping(config)
    if "optimizer" not in filed:
        stated["optimizer"] = "levenberg-marquardt"
    if raw and "weights" not in filed:
        stated.setdefault("weights", weights_of_log({**filed, **stated}))
    if not raw and "temperature" not in filed:
        stated.setdefault("temperature", False)
    settings = load_settings(config, stated)
    check_settings(settings, each=raw)
    bounds = _load_limits(limits, settings)
    filed_g = f"stated in {config.name}" if config and stated_g is None and "g" in filed else ""
    text = _ResultFile(kept, filed_g, gravity, moment()) if folder else None
    work = Work(settings, Gravity(vars(gravity), settings.g, "g" in filed), text)
    if raw:
        from accelcal_cli.fleets.logs import supply_logs

        found = supply_logs(data, _log_form(columns, form, log, sensor_column, worn, settings), work.gravity)
    else:
        read = form.read_options()
        named = options.split_columns(columns)
        found = supply(data, work, named, sensor_column, stdin=sys.stdin.buffer, options=read)
    with runs.whole(found, work, output, quiet, "logs" if raw else "sensors") as whole:
        settings = replace(settings, g=whole.g or settings.g)
        shown = _Shown(whole, settings, bounds)
        if output is not None and not folder:
            shown.write(output)
        with process.even_if_unread():
            shown.show(format, verbose)
        notes = [*found.notes, *_told(whole, raw)]
        if settings.temperature:
            notes = [note for note in notes if not note.startswith(COLD)]
    bad = _bad(shown.fleet, tolerance)
    if shown.check is not None:
        bad["beyond the limits or without a value"] = ~shown.check.passed
    with process.even_if_unread(sys.stderr):
        options.tell(notes, quiet)
        options.tell_assumed_gravity(stated_g, settings.g, quiet)
        options.tell_written([output], quiet)
        _name(bad, shown.labels)
    if any(which.any() for which in bad.values()):
        raise typer.Exit(options.BAD_VERDICT)


def _load_limits(path: Path | None, settings: Settings) -> Mapping[str, Limit] | None:
    if path is None:
        return None
    from accelcal_cli.fleets.limits import load_limits

    return load_limits(path, settings)


def _log_form(
    columns: str | None,
    form: options.TextOptions,
    log: options.DetectionOptions,
    sensor: str | None,
    worn: bool,
    settings: Settings,
) -> LogForm:
    """Return the options of raw logs as the library takes them; they are refused before a file is read."""
    from accelcal_cli.fleets.logs import LogForm

    named, gyro = options.split_columns(columns), options.split_columns(log.gyro)
    return LogForm(
        None if named is None else tuple(named),
        None if gyro is None else tuple(gyro),
        log.time,
        form.read_options(),
        log.settings(1.0),
        wear.settings(log, misalignment=True, slopes=settings.temperature) if worn else None,
        sensor,
    )


def _told(whole: Whole, raw: bool) -> list[str]:
    """Return the notes on files, those on logs each with the number of its logs where there are several."""
    if not raw:
        return list(whole.notes)
    of = len(whole)
    told = [
        f"{note} ({n:,} of {of:,} logs)" if of > 1 else note
        for note, n in whole.notes.most_common(MOST_NOTES)
    ]
    more = len(whole.notes) - len(told)
    return [*told, *([f"and {more:,} more notes (in the result files of -o FOLDER/)"] if more else [])]


def _check_output(output: str) -> bool:
    """Refuse an output that could not be written; return whether it is a folder."""
    from accelcal_cli.output.files import check_folder, check_target

    if output.endswith("/") or Path(output).is_dir():
        check_folder(output)
        return True
    if Path(output).suffix not in SUFFIXES:
        raise UsageError(
            f'-o "{output}": expected a name that ends in {", ".join(SUFFIXES)}, or a folder, ending in /'
        )
    check_target(output)
    return False


class _Shown:
    """A calibrated fleet as it is shown and written.

    Attributes:
        fleet: its summary; check: which sensors keep the limits, None without limits.
    """

    def __init__(self, whole: Whole, settings: Settings, limits: Mapping[str, Limit] | None) -> None:
        """Look which sensors stand out, and which are beyond limits."""
        from accelcal_cli.calibration.fleet import standouts

        self._whole, self._g = whole, settings.g
        self.fleet = whole.summary()
        self.labels: Sequence[str] = cast("Sequence[str]", self.fleet.labels)
        self._outlying = standouts(self.fleet, settings.g)
        self.check = None
        if limits is not None:
            from accelcal_cli.fleets.limits import check_limits

            self.check = check_limits(self.fleet, limits, settings)

    def _rows(self) -> Iterator[Table]:
        """Yield the rows of the sensors, block by block."""
        from accelcal_cli.views import fleet as tables

        for part in self._whole.fleets():
            low, high = int(part.number[0]), int(part.number[-1]) + 1
            own = [replace(one, at=one.at - low) for one in self._outlying if low <= one.at < high]
            table = tables.sensors(part, part.labels.tolist(), own)
            if self.check is not None:
                reasons = [self.check.reason(at) for at in range(low, high)]
                table = tables.with_limits(table, self.check.passed[low:high], reasons)
            yield table

    def write(self, output: str) -> None:
        """Write the rows of all sensors."""
        from accelcal_cli.output.machine import write_tables

        write_tables(self._rows(), output)

    def show(self, format: str, verbose: bool) -> None:
        """Print the fleet in the chosen form."""
        if format == "table":
            from accelcal_cli.output.console import show

            show(self._blocks(verbose))
        else:
            from accelcal_cli.output.machine import write_text

            write_text(self._rows(), sys.stdout, format)
        sys.stdout.flush()

    def _blocks(self, verbose: bool) -> list[Block]:
        from accelcal_cli.views import fleet as tables

        labels, check = self.labels, self.check
        shown = tables.blocks(self.fleet, labels, self._outlying, self._g, verbose)
        if check is None:
            return shown
        return [*tables.limit_blocks(check.passed, check.counts(), check.reason, labels, verbose), *shown]


def _bad(fleet: Fleet, tolerance: float | None) -> dict[str, Bool]:
    """Return which sensors are suspect, not determined or too far off, shape (R,) each, by what they are."""
    kinds = {"undetermined or failed": ~fleet.determined, "suspect": fleet.verdict == "suspect"}
    if tolerance is not None:  # A sensor that failed has no rms; it is named already.
        kinds[f"with an rms above the tolerance {tolerance:.6g}"] = fleet.rms > tolerance
    return kinds


def _name(bad: Mapping[str, Bool], labels: Sequence[str]) -> None:
    """Name the sensors that are bad on standard error."""
    for what, which in bad.items():
        names = [labels[r] for r in which.nonzero()[0].tolist()]
        if names:
            more = f" and {len(names) - NAMED:,} more" if len(names) > NAMED else ""
            count = f"{len(names):,} of {len(labels):,} sensors"
            options.tell([f"{count} {what}: {', '.join(names[:NAMED])}{more}"])
