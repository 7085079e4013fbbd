"""`accelcal fleet`: readings of thousands of sensors in, a row or a result file for each out."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import meta as metadata
from accelcal_cli.cli import options, process, wear
from accelcal_cli.errors import AccelcalError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from accelcal_cli.arrays import Bool
    from accelcal_cli.calibration.fleet import Fleet
    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.calibration.settings import Settings
    from accelcal_cli.detection.detect import Detection
    from accelcal_cli.detection.worn import Wear
    from accelcal_cli.io.readings import Readings

SUFFIXES = (".csv", ".parquet", ".json")
NAMED = 5
"""Sensors that a line on standard error names."""

MOST_NOTES = 10
"""Notes on the logs of a fleet that are told."""


in_model = options.panel("Model")


def command(
    *,
    data: Annotated[
        list[str],
        typer.Argument(
            help="Table of static readings with a column that labels the sensor, or one file per sensor; with --raw "
            "logs; text, Parquet, Arrow or native; - is standard input.",
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
    Exit code 1 means that a sensor is suspect, undetermined or failed, or missed the --tolerance.
    """
    from accelcal_cli.calibration.fleet import calibrate_each, calibrate_fleet, check_settings
    from accelcal_cli.calibration.settings import load_settings, weights_of_log
    from accelcal_cli.config import load_mapping
    from accelcal_cli.io.fleet import COLD, read_fleet
    from accelcal_cli.output.files import whole_folder
    from accelcal_cli.output.machine import write_result

    for source in data:
        options.check_input(source)
    options.check_apart([*data, config], {"-o": output})
    folder = output is not None and _check_output(output)
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

    def local_g(unit: str | None) -> float:
        own = gravity.in_unit(unit)
        return settings.g if own is None or (stated_g is None and "g" in filed) else own

    filed_g = f"stated in {config.name}" if config and stated_g is None and "g" in filed else ""
    labels: Sequence[str]
    run: Callable[[Settings, Callable[[int, Calibration], None] | None], Fleet]
    if raw:
        logs = _Logs(columns, form, log, local_g, worn, settings.temperature)
        logs.read(data, sensor_column)
        labels, notes, run = logs.labels, logs.told(), partial(calibrate_each, logs.readings)
        g = logs.g or settings.g
    else:
        readings = read_fleet(
            data,
            options.split_columns(columns),
            sensor_column,
            stdin=sys.stdin.buffer,
            options=form.read_options(),
        )
        notes = list(dict.fromkeys(note for origin in readings.origins for note in origin.notes))
        notes += [COLD] if readings.warm and not settings.temperature else []
        labels, g, run = readings.sensors, local_g(readings.unit), partial(calibrate_fleet, readings)
    settings = replace(settings, g=g)
    if folder and output is not None:
        with whole_folder(output) as results:

            def keep(number: int, one: Calibration) -> None:
                source = filed_g or gravity.source(one.data.get("unit"))
                write_result(results, labels[number], replace(one, meta=kept, g_source=source))

            fleet = run(settings, keep)
    else:
        fleet = run(settings, None)
    with process.even_if_unread():
        _show(fleet, labels, settings, format, None if folder else output, verbose=verbose)
    bad = _bad(fleet, tolerance)
    with process.even_if_unread(sys.stderr):
        options.tell(notes, quiet)
        options.tell_assumed_gravity(stated_g, settings.g, quiet)
        options.tell_written([output], quiet)
        _name(bad, labels)
    if any(which.any() for which in bad.values()):
        raise typer.Exit(options.BAD_VERDICT)


@dataclass
class _Logs:
    """The raw logs of a fleet, detected one after the other.

    Attributes:
        columns, form, log, local_g: see `options.DetectionOptions.detect`.
        worn: they are of days of wear; slopes: with temperature are fitted.
        labels: of the sensors; readings: the static poses of each, or why there are none.
        gravities: local gravity in the unit of each that has poses, by its number; g: in that of most of them.
        notes: what there is to say of logs, and of how many.
    """

    columns: str | None
    form: options.TextOptions
    log: options.DetectionOptions
    local_g: Callable[[str | None], float]
    worn: bool = False
    slopes: bool = True
    labels: list[str] = field(default_factory=list)
    readings: list[Readings | str] = field(default_factory=list)
    gravities: dict[int, float] = field(default_factory=dict)
    g: float | None = None
    notes: Counter[str] = field(default_factory=Counter)

    def read(self, sources: Sequence[str], sensor: str | None) -> None:
        """Find the static poses of all sensors; a log that is broken or too poor does not stop the others.

        Raises:
            UsageError: a file twice, or options that fit no log.
        """
        from accelcal_cli.io.fleet import check_once, file_names

        check_once(sources)
        faults: list[AccelcalError] = []
        for source, name in zip(sources, file_names(sources), strict=True):
            try:
                parts = self._parts(source, name, sensor, alone=len(sources) == 1)
            except AccelcalError as error:
                self._add(name, source, error)
                faults.append(error)
                continue
            for label, form in parts:
                try:
                    self._add(label, source, self._found(source, form))
                except AccelcalError as error:
                    self._add(label, source, error)
                    faults.append(error)
        if len(faults) == len(self.labels) and all(isinstance(error, UsageError) for error in faults):
            raise faults[0]
        self._leave_out_other_units()

    def _found(self, source: str, form: options.TextOptions) -> Detection | Wear:
        """Find the static poses of a log."""
        if not self.worn:
            return self.log.detect(source, self.columns, self.local_g, form)
        return wear.find(
            source, self.columns, self.log, self.local_g, form, misalignment=True, slopes=self.slopes
        )

    def told(self) -> list[str]:
        """Return the notes, each once with the number of its logs where there are several."""
        of = len(self.labels)
        told = [
            f"{note} ({n:,} of {of:,} logs)" if of > 1 else note
            for note, n in self.notes.most_common(MOST_NOTES)
        ]
        more = len(self.notes) - len(told)
        return [*told, *([f"and {more:,} more notes (in the result files of -o FOLDER/)"] if more else [])]

    def _parts(
        self, source: str, name: str, sensor: str | None, *, alone: bool
    ) -> list[tuple[str, options.TextOptions]]:
        """Return the sensors of a log, and the rows to read of each: of several files each is one, unless told."""
        from accelcal_cli.detection.rawlog import sensors_of

        if sensor is None and (source == "-" or not alone):
            return [(name, self.form)]
        if source == "-":
            raise UsageError(
                "-: standard input is read once; --sensor-column with --raw needs the name of a file"
            )
        found = sensors_of(source, sensor, options=self.form.read_options())
        if sensor is None and len(found) < 2:
            return [(name, self.form)]
        stated = self.form.where or []
        return [
            (label if alone else f"{name}/{label}", replace(self.form, where=[*stated, condition]))
            for label, condition in found
        ]

    def _add(self, label: str, source: str, found: Detection | Wear | AccelcalError) -> None:
        """Add a sensor: its poses, or why there are none."""
        self.labels.append(label)
        if isinstance(found, AccelcalError):
            self.readings.append(str(found).removeprefix(source).lstrip(":, ").rstrip("."))
            return
        self.readings.append(found.readings())
        self.gravities[len(self.readings) - 1] = found.settings.g
        self.notes.update(found.notes)

    def _leave_out_other_units(self) -> None:
        """Leave out sensors whose readings are in another unit than those of most: they cannot be compared."""
        if not self.gravities:
            return
        ((self.g, _),) = Counter(self.gravities.values()).most_common(1)
        for at, own in self.gravities.items():
            if own != self.g:
                self.readings[at] = (
                    f"1 g is {own:g} in the unit of its readings, and {self.g:g} in that of most logs"
                )


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


def _show(
    fleet: Fleet, labels: Sequence[str], settings: Settings, format: str, output: str | None, *, verbose: bool
) -> None:
    """Write the table of all sensors, then print the fleet in the chosen form."""
    from accelcal_cli.calibration.fleet import standouts
    from accelcal_cli.output.machine import write_table
    from accelcal_cli.views import fleet as fleet_tables

    outlying = standouts(fleet, settings.g)
    rows = cache(partial(fleet_tables.sensors, fleet, labels, outlying))  # made when asked for
    if output is not None:
        write_table(rows(), output)
    options.print_result(
        format, rows, partial(fleet_tables.blocks, fleet, labels, outlying, settings.g, verbose)
    )


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
