"""`accelcal navigate`: gravity-aided inertial navigation with particle filters."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import options as running
from accelcal_cli.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from accelcal_cli.navigation.ins import InsGrade
    from accelcal_cli.navigation.study import FilterEntry, Navigation, NavigationSettings
    from accelcal_cli.studies.study import Record

MODES = ("default", "literal", "both")
ALL = "all"

Plot = Annotated[
    str | None,
    typer.Option("--plot", help="Draw map, track and RMSE to a .png or .svg file.", metavar="FILE"),
]


def command(
    filter: Annotated[
        list[str] | None,
        typer.Option(
            "--filter",
            help='pf, de-pf, pso-pf, apo-pf, reference: names with commas, repeated, or "all".',
            show_default="all, or the file's",
        ),
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(help="default, literal (as the paper prints it) or both.", show_default="default"),
    ] = None,
    runs: Annotated[int | None, typer.Option(help="Runs.", min=1, max=100_000, show_default="20")] = None,
    particles: Annotated[
        int | None, typer.Option(help="Particles.", min=4, max=1_000_000, show_default="100")
    ] = None,
    generations: Annotated[
        int | None, typer.Option(help="Generations of the evolution.", min=0, max=1000, show_default="20")
    ] = None,
    period: Annotated[
        float | None, typer.Option(help="Seconds between measurements.", show_default="10")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of all random numbers.", min=0, show_default="0")
    ] = None,
    map: Annotated[
        str | None,
        typer.Option(
            "--map",
            help="rough, moderate or constant (generated), or a file: NetCDF, GeoTIFF, XYZ text.",
            show_default="rough",
        ),
    ] = None,
    voyage: Annotated[
        str | None, typer.Option(help="CSV file of a recorded voyage.", show_default="a planned one")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML file: voyage, INS, map, filters and their parameters.")
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(
            help="Result of accelcal calibrate: its bias sigma, beside the INS without it; - is standard input."
        ),
    ] = None,
    output: Annotated[
        str | None,
        typer.Option("--output", "-o", help="CSV file for RMSE against time; - is standard output."),
    ] = None,
    raw: running.Raw = None,
    jobs: running.Jobs = 1,
    cluster: running.Cluster = None,
    resume: running.Resume = False,
    plot: Plot = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Navigate by inertia and gravity, simulated or recorded.

    Prints the position error over hours 3 to 8, the least that any filter could have (the posterior Cramer-Rao bound),
    how many runs lost lock, and whether the claimed spread fits the error (NEES, 2 when it does).
    """
    options.check_format(format)
    running.check_plot(plot)
    _check(mode, output, format)
    stated = {"map": map, "voyage": voyage, "period": period}
    settings = {"particles": particles, "generations": generations}
    study = _study(config, stated, filter or (), mode, settings, runs, seed, calibration)
    inputs = [config, calibration, *study.settings.files()]
    options.check_apart(inputs, {"-o": output, "--raw": raw, "--plot": plot})
    records = running.run(study, raw=raw, jobs=jobs, cluster=cluster, resume=resume, quiet=quiet)
    show(study, records, format if output != "-" else "")
    written = [path for path in (raw, output, plot) if path not in (None, "-")]
    _write(study, records, output, plot)
    if not quiet:
        for path in written:
            typer.echo(f"accelcal: wrote {path}", err=True)


def _check(mode: str | None, output: str | None, format: str) -> None:
    if mode is not None and mode not in MODES:
        raise UsageError(f'--mode "{mode}"{did_you_mean(mode, MODES)}; expected one of {", ".join(MODES)}')
    if output is None:
        return
    if output == "-" and format != "table":
        raise UsageError(f"-o - prints the curves; leave out --format {format}")
    from accelcal_cli.output.files import check_target

    check_target(output)


def _study(
    config: Path | None,
    stated: dict[str, Any],
    names: Sequence[str],
    mode: str | None,
    settings: dict[str, Any],
    runs: int | None,
    seed: int | None,
    calibration: str | None,
) -> Navigation:
    """Return the study that file and command line state together."""
    from accelcal_cli.navigation.study import Navigation, load_study
    from accelcal_cli.studies.study import words

    filed = load_study(config, {**stated, "runs": runs, "seed": seed})
    entries = _entries(words(names), filed.filters, mode, settings)
    grades: tuple[InsGrade, ...] = (filed.ins,)
    if calibration is not None:
        filed, grades = _calibrated(filed, calibration)
    return Navigation(filed.with_digests(), tuple(entries), grades)


def _entries(
    names: Sequence[str], own: Sequence[FilterEntry], mode: str | None, settings: dict[str, Any]
) -> list[FilterEntry]:
    """Return the filters by name or label, in the modes that were asked for."""
    from accelcal_cli.navigation.study import FilterEntry, filter_names

    stated = {entry.name: entry for entry in own}
    wanted = list(names) or list(stated) or [ALL]
    if ALL in wanted:
        wanted = list(dict.fromkeys([*stated, *filter_names()]))
    chosen = [stated.get(name) or FilterEntry(name) for name in wanted]
    modes: list[str | None] = ["default", "literal"] if mode == "both" else [mode]
    return [entry.with_settings({**settings, "mode": each}) for each in modes for entry in chosen]


def _calibrated(settings: NavigationSettings, source: str) -> tuple[NavigationSettings, tuple[InsGrade, ...]]:
    """Return the settings and the INS without and with a calibration.

    The accelerometers are strapped down: on a platform an alignment hides their biases. Any drift is taken that the
    filters can start with.
    """
    from accelcal_cli.navigation.study import grade_of

    result = options.load_result(source)
    free = replace(settings, plan=replace(settings.plan, drift=(0.0, settings.initial)))
    ins = replace(settings.ins, mounting="strapdown")
    return free, (ins, grade_of(result, ins, source))


def show(study: Navigation, records: Sequence[Record], format: str) -> None:
    """Print the summary in a format; "" prints nothing."""
    from accelcal_cli.output.machine import json_rows, json_text, write_csv
    from accelcal_cli.views.navigation import summary

    rows = summary(study, records)
    if format == "json":
        sys.stdout.write(json_text(json_rows([rows])))
    elif format == "csv":
        write_csv(rows, sys.stdout)
    elif format:
        from accelcal_cli.output.console import show

        show([rows])
    sys.stdout.flush()


def reproduce(
    name: str,
    runs: int | None,
    seed: int | None,
    raw: str | None,
    jobs: int,
    cluster: str | None,
    resume: bool,
    plot: str | None,
    format: str,
    quiet: bool,
) -> None:
    """Run a shipped experiment on navigation filters and print it beside the paper's numbers."""
    from accelcal_cli.navigation.study import Navigation, load_study
    from accelcal_cli.output.machine import json_rows, json_text, write_csv
    from accelcal_cli.views.navigation import summary, with_paper

    settings = load_study(name, {"runs": runs, "seed": seed})
    study = Navigation(settings, settings.filters, (settings.ins,))
    records = running.run(study, raw=raw, jobs=jobs, cluster=cluster, resume=resume, quiet=quiet)
    table = with_paper(summary(study, records), settings)
    if format == "json":
        parts = [{"title": table.title, "rows": json_rows([table])}]
        sys.stdout.write(json_text({"name": name, "title": settings.title, "tables": parts}))
    elif format == "csv":
        write_csv(table, sys.stdout)
    else:
        from accelcal_cli.output.console import show

        show([table])
    sys.stdout.flush()
    _write(study, records, None, plot)
    if not quiet:
        for path in filter(None, (raw, plot)):
            typer.echo(f"accelcal: wrote {path}", err=True)


def _write(study: Navigation, records: Sequence[Record], output: str | None, plot: str | None) -> None:
    """Write the curves as CSV and the picture, as far as they are wanted."""
    if output is None and plot is None:
        return
    from accelcal_cli.output.files import whole_file
    from accelcal_cli.output.machine import write_csv
    from accelcal_cli.views.navigation import curves

    found = curves(study, records)
    if output is not None:
        with whole_file(output) as file:
            write_csv(found, file)
    if plot is not None:
        from accelcal_cli.output.plot import plot_voyage
        from accelcal_cli.views.navigation import chart_of

        plot_voyage(chart_of(study, records, found), plot)
