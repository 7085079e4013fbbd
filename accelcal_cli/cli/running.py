"""Running a study: the options that every command with a study has, and the running itself.

The progress bar, the journal of finished runs beside the raw file, and the message when it ends early.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from accelcal_cli.cli import options, process
from accelcal_cli.errors import AccelcalError, Interrupted, UsageError

if TYPE_CHECKING:
    from accelcal_cli.studies.engine import Executors, Journal, Progress
    from accelcal_cli.studies.study import Curves, Entry, Record, Study

MOST_JOBS = 1024
RAW_SUFFIXES = (".csv", ".parquet")

in_runs = options.panel("Runs")

Seed = Annotated[int, in_runs("--seed", help="Seed of all random numbers.", min=0)]
Plot = Annotated[
    str | None,
    options.in_output("--plot", help="Draw convergence to a .png or .svg file.", metavar="FILE"),
]
PRESETS = ("printed", "tuned")
"""Names of optimization.optimizer, stated again so that help need not import it; a test compares them."""

Preset = Annotated[
    str | None,
    options.panel("Search")(
        "--preset",
        help="Settings of the optimizers beneath those that are stated: {choices}.",
        show_default="each optimizer's defaults",
        autocompletion=options.one_of(PRESETS),
    ),
]


Peers = Annotated[
    list[str] | None,
    options.panel("Search")(
        "--peer",
        help="Optimizers of other libraries beside ours, LIBRARY:NAME as scipy:differential_evolution, pygmo:pso_gen; "
        "all get the same evaluations.",
        metavar="NAMES",
    ),
]


def peer_entries(stated: list[str] | None) -> list[Entry]:
    """Return the entries of the peers that are named, after a look whether there are such."""
    if not stated:
        return []
    from accelcal_cli.studies.peers import peer
    from accelcal_cli.studies.study import Entry, words

    names = words(stated)
    for name in names:
        peer(name)
    return [Entry(name, name, peer=True) for name in names]


def peer_budget(stated: list[str] | None, evaluations: int | None) -> int | None:
    """Return the evaluations of all optimizers: those that are stated, or with peers the usual 50,000."""
    if evaluations is None and stated:
        from accelcal_cli.studies.peers import BUDGET

        return BUDGET
    return evaluations


@dataclass(frozen=True)
class StudyOptions:
    """Where the runs of a study are made, and where they are kept."""

    jobs: Annotated[
        int, in_runs("--jobs", "-j", help="Processes on this machine.", min=1, max=MOST_JOBS, metavar="N")
    ] = 1
    cluster: Annotated[
        str | None, in_runs("--cluster", help="Run on a Dask cluster: tcp://host:8786.", metavar="ADDRESS")
    ] = None
    raw: Annotated[
        str | None,
        in_runs("--raw", help="File for the result of every run: .csv or .parquet.", metavar="FILE"),
    ] = None
    resume: Annotated[
        bool,
        in_runs("--resume", help="Go on with an interrupted study; its runs are in FILE.journal."),
    ] = False
    quiet: options.Quiet = False

    def run(self, study: Study) -> list[Record]:
        """Run a study, write the raw file, and return all records by cell and run.

        With a raw file the finished runs are kept in a journal beside it until it is written.

        Raises:
            UsageError: options that do not go together, or a raw file with another suffix.
            AccelcalError: what the study, the journal or the cluster could not do.
        """
        if self.raw is not None:
            options.check_suffix("--raw", self.raw, RAW_SUFFIXES)
        elif self.resume:
            raise UsageError("--resume needs the --raw FILE of the interrupted study")
        if self.cluster is not None and self.jobs != 1:
            raise UsageError("--jobs and --cluster: expected one of them, not both")
        from accelcal_cli.output.machine import write_table
        from accelcal_cli.studies.engine import Journal, run_study
        from accelcal_cli.views.studies import raw_table

        journal = Journal.open(Path(f"{self.raw}.journal") if self.raw else None, study, self.resume)
        try:
            with progress_bar(self.quiet) as progress:
                records = run_study(study, journal, self._executors(study), progress)
            if self.raw is not None:
                write_table(raw_table(study, records), self.raw)
        except KeyboardInterrupt as stop:
            ending = process.interrupted(stop)
            raise Interrupted(f"{ending}{_kept(journal)}", ending.code) from None
        except AccelcalError as error:
            raise type(error)(f"{error}{_kept(journal)}") from None
        journal.remove()
        return records

    def _executors(self, study: Study) -> Executors | None:
        import accelcal_cli.pools as pools

        if self.cluster is not None:
            return partial(pools.cluster, self.cluster)
        useful = min(self.jobs, len(study.tasks()))
        return partial(pools.local_pool, useful) if useful > 1 else None


def draw_convergence(
    plot: str | None,
    title: str,
    curves: Curves,
    tolerance: float,
    bands: Callable[[], tuple[Curves, Curves]] | None = None,
) -> None:
    """Write the picture of the median convergence where one was asked for; see `output.plot.plot_convergence`."""
    if plot is not None:
        from accelcal_cli.output.plot import plot_convergence

        plot_convergence(title, curves, tolerance, plot, bands() if bands else None)


def _kept(journal: Journal) -> str:
    """Return what to say of finished runs after a failure; a journal without any is removed."""
    if not journal.done:
        journal.remove()
    if journal.path is None or not journal.done:
        return ""
    runs = sum(map(len, journal.done.values()))
    return f"; {runs:,} finished runs are kept in {journal.path}, --resume goes on with them"


@contextmanager
def progress_bar(quiet: bool, what: str = "runs") -> Iterator[Progress | None]:
    """Open a bar with the time left on standard error, when somebody looks at it."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)

        def update(done: int, total: int) -> None:
            if bar.tasks[0].total is None:
                bar.reset(task, total=total, completed=done)
            bar.update(task, completed=done)

        yield update
