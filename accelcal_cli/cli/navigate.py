"""`accelcal navigate`: gravity-aided inertial navigation with particle filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from accelcal_cli.cli import options, running
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.navigation.ins import InsGrade
    from accelcal_cli.navigation.study import FilterEntry, Navigation, NavigationSettings
    from accelcal_cli.studies.study import Record

MODES = ("default", "literal", "both")
PRIORS = ("independent", "tied")
MAPS = ("rough", "moderate", "constant")
ALL = "all"

in_filters, in_voyage = options.panel("Filters"), options.panel("Voyage")


def command(
    *,
    filter: Annotated[
        list[str] | None,
        in_filters(
            "--filter",
            help="Filters, separated by commas or repeated: {choices}.",
            show_default="de-pf, point-mass, or the file's",
            metavar="NAMES",
            autocompletion=options.several_of(lambda: [*options.filters(), ALL]),
        ),
    ] = None,
    mode: Annotated[
        str | None,
        in_filters(
            help="{choices}; literal is as the paper prints it.",
            show_default="default",
            autocompletion=options.one_of(MODES),
        ),
    ] = None,
    particles: Annotated[
        int | None, in_filters(help="Particles.", min=4, max=1_000_000, show_default="100")
    ] = None,
    generations: Annotated[
        int | None, in_filters(help="Generations of the evolution.", min=0, max=1000, show_default="20")
    ] = None,
    map: Annotated[
        str | None,
        in_voyage(
            "--map",
            help="{choices} (generated), or a file: NetCDF, GeoTIFF, ICGEM grid, XYZ text.",
            show_default="rough",
            autocompletion=options.one_of(MAPS),
        ),
    ] = None,
    variable: Annotated[
        str | None, in_voyage(help="Variable of a NetCDF map with several.", metavar="NAME")
    ] = None,
    voyage: Annotated[
        str | None, in_voyage(help="CSV file of a recorded voyage.", show_default="a planned one")
    ] = None,
    period: Annotated[
        float | None, in_voyage(help="Seconds between measurements.", show_default="10")
    ] = None,
    prior: Annotated[
        str | None,
        in_voyage(
            help="Initial errors of the INS: {choices}; tied by alignment and the hours before.",
            show_default="independent",
            autocompletion=options.one_of(PRIORS),
        ),
    ] = None,
    config: Annotated[
        Path | None, in_voyage(help="YAML file: voyage, INS, map, filters and their parameters.")
    ] = None,
    calibration: Annotated[
        str | None,
        in_voyage(
            help="Result of accelcal calibrate: its bias sigma, beside the INS without it; - is standard input."
        ),
    ] = None,
    runs: Annotated[int | None, running.in_runs(help="Runs.", min=1, max=100_000, show_default="20")] = None,
    seed: Annotated[
        int | None, running.in_runs(help="Seed of all random numbers.", min=0, show_default="0")
    ] = None,
    output: Annotated[
        str | None,
        options.in_output("--output", "-o", help="CSV file for RMSE against time; - is standard output."),
    ] = None,
    plot: Annotated[
        str | None,
        options.in_output("--plot", help="Draw map, track and RMSE to a .png or .svg file.", metavar="FILE"),
    ] = None,
    format: options.Format = "table",
    study_options: running.StudyOptions,
) -> None:
    """Navigate by inertia and gravity, simulated or recorded.

    Prints the position error from an hour after the start, the least that any filter can have (the posterior
    Cramer-Rao bound), how many runs lost lock, and whether the claimed spread fits the error (NEES, 2 when it does) and
    the innovations (NIS, 1 when it does). On a recorded voyage innovations that do not fit give a warning and exit
    code 1.
    """
    from accelcal_cli.navigation.study import Navigation, are_suspect, load_study
    from accelcal_cli.studies.study import words
    from accelcal_cli.views.navigation import shown, summary

    options.check_plot(plot)
    if mode is not None:
        options.check_choice("--mode", mode, MODES)
    if prior is not None:
        options.check_choice("--prior", prior, PRIORS)
    if output == "-" and format != "table":
        raise UsageError(f"-o - prints the curves; leave out --format {format}")
    setting = options.stated(map=map, variable=variable, voyage=voyage, period=period, prior=prior)
    limits = {"particles": particles, "generations": generations}
    repeats = options.stated(runs=runs, seed=seed)
    settings = load_study(config, {**setting, **repeats})
    entries = _entries(words(filter or ()), settings.filters, mode, limits)
    grades: tuple[InsGrade, ...] = (settings.ins,)
    if calibration is not None and settings.voyage:
        raise UsageError(
            "--calibration does not apply to --voyage: the record holds the errors that its INS had; leave one of "
            "them out"
        )
    if calibration is not None:
        settings, grades = _calibrated(settings, calibration)
    study = Navigation(settings.with_digests(), tuple(entries), grades)
    inputs = [config, calibration, *study.settings.files()]
    options.check_files(inputs, {"-o": output, "--raw": study_options.raw, "--plot": plot})
    records = study_options.run(study)
    rows = summary(study, records)
    if output != "-":
        options.print_result(format, rows, lambda: [shown(rows)])
    _write(study, records, output, plot)
    options.tell_written([study_options.raw, output, plot], study_options.quiet)
    if are_suspect(study, records):
        raise typer.Exit(options.BAD_VERDICT)


def _entries(
    names: Sequence[str], own: Sequence[FilterEntry], mode: str | None, limits: Mapping[str, Any]
) -> list[FilterEntry]:
    """Return the filters by name or label, in the modes that were asked for."""
    from accelcal_cli.navigation.study import DEFAULT_SET, FilterEntry, filter_names

    stated = {entry.name: entry for entry in own}
    wanted = list(names) or list(stated) or list(DEFAULT_SET)
    if ALL in wanted:
        wanted = list(dict.fromkeys([*stated, *filter_names()]))
    chosen = [stated.get(name) or FilterEntry(name) for name in wanted]
    modes: list[str | None] = ["default", "literal"] if mode == "both" else [mode]
    return [entry.with_settings({**limits, "mode": each}) for each in modes for entry in chosen]


def _calibrated(settings: NavigationSettings, source: str) -> tuple[NavigationSettings, tuple[InsGrade, ...]]:
    """Return the settings and the INS without and with a calibration.

    The accelerometers are strapped down: on a platform an alignment hides their biases.
    """
    from accelcal_cli.navigation.study import grade_of

    result = options.load_result(source)
    ins = replace(settings.ins, mounting="strapdown")
    return settings, (ins, grade_of(result, ins, source))


def _write(study: Navigation, records: Sequence[Record], output: str | None, plot: str | None) -> None:
    """Write the curves as CSV and the picture, as far as they are wanted."""
    if output is None and plot is None:
        return
    from accelcal_cli.output.files import whole_file
    from accelcal_cli.output.machine import write_csv
    from accelcal_cli.views.navigation import chart_of, curves

    table = curves(study, records)
    if output is not None:
        with whole_file(output) as file:
            write_csv(table, file)
    if plot is not None:
        from accelcal_cli.output.plot import plot_voyage

        plot_voyage(chart_of(study, records, table), plot)
