"""What every command that runs a study shares: its options, and the running itself.

records = running.run(study, raw=raw, jobs=jobs, cluster=cluster, resume=resume, quiet=quiet)
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import signals
from accelcal_cli.errors import AccelcalError, Interrupted, UsageError

if TYPE_CHECKING:
    from accelcal_cli.studies.engine import Executors, Journal
    from accelcal_cli.studies.engine import Progress as Report
    from accelcal_cli.studies.study import Record, Study

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
    from accelcal_cli.output.raw import write_raw
    from accelcal_cli.studies.engine import Journal, run_study
    from accelcal_cli.studies.study import raw_table

    journal = Journal.open(Path(f"{raw}.journal") if raw else None, study, resume)
    try:
        with _progress(quiet) as progress:
            records = run_study(study, journal, _executors(study, jobs, cluster), progress)
        if raw is not None:
            write_raw(raw_table(study, records), raw)
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
