"""Running a study: in this process, in several, or on a cluster; kept as it goes, and continued after a stop.

The records of a task depend on the study and the run numbers alone, so any number of workers gives the same result
to the last bit. Finished tasks go to a journal at once; an interrupted study reads it and runs the rest.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path

from accelcal_cli import __version__
from accelcal_cli.errors import DataError, OutputError
from accelcal_cli.studies.study import Record, Study, Task

SCHEMA = "accelcal/journal/1"
POOLS = 5
"""Process pools started at most after workers that died: a task that kills its worker must not go on for ever."""

Progress = Callable[[int, int], None]
Executors = Callable[[], AbstractContextManager[Executor]]


@dataclass
class Journal:
    """The records of finished tasks, one line of JSON each, in a file that only grows.

    Attributes:
        path: the file; None keeps the records in memory alone.
        done: records by task key.
    """

    path: Path | None
    done: dict[str, list[Record]] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path | None, study: Study, resume: bool) -> Journal:
        """Return the journal of a study, with what an interrupted one left when `resume` is set.

        Raises:
            DataError: a journal is there but not to be resumed, or it belongs to another study or version.
        """
        journal = cls(path)
        if path is None:
            return journal
        head = {"schema": SCHEMA, "study": study.identity, "version": __version__}
        if path.exists():
            if not resume:
                raise DataError(
                    f"{path}: an interrupted study left this; --resume goes on with it, or delete it"
                )
            journal._read(head)
            return journal
        if resume:
            raise DataError(f"{path}: nothing to resume; leave out --resume")
        journal._append(head)
        return journal

    def add(self, task: Task, records: list[Record]) -> None:
        """Keep the records of a finished task, on the disk before anything else happens."""
        self.done[task.key] = records
        self._append({"task": task.key, "records": [asdict(record) for record in records]})

    def remove(self) -> None:
        """Delete the file: the study is finished and written."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _append(self, line: Mapping[str, object]) -> None:
        if self.path is None:
            return
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise OutputError(
                f"{self.path}: cannot be written: {(error.strerror or str(error)).lower()}; --resume goes on later"
            ) from None

    def _read(self, head: dict[str, str]) -> None:
        assert self.path is not None
        text = self.path.read_text(encoding="utf-8", errors="replace")
        whole = text[: text.rfind("\n") + 1]  # the last line may be half written
        lines = whole.splitlines()
        if not lines or _parsed(lines[0]) != head:
            raise DataError(f"{self.path}: the journal of another study or version; delete it to start anew")
        for line in lines[1:]:
            entry = _parsed(line)
            if isinstance(entry, dict) and "task" in entry:
                self.done[entry["task"]] = [Record.from_json(record) for record in entry["records"]]
        if whole != text:
            os.truncate(self.path, len(whole.encode("utf-8", errors="replace")))


def _parsed(line: str) -> object:
    try:
        return json.loads(line)
    except json.JSONDecodeError:
        return None


def run_study(
    study: Study, journal: Journal, executors: Executors | None = None, progress: Progress | None = None
) -> list[Record]:
    """Run what the journal does not hold yet, and return all records, by cell and run.

    Args:
        study: what to run.
        journal: finished tasks; new ones are added as they come.
        executors: opens an Executor of the concurrent.futures kind; None runs in this process.
        progress: called with (runs done, runs in all).
    """
    tasks = study.tasks()
    total = sum(task.last - task.first for task in tasks)
    finished = sum(len(journal.done.get(task.key, ())) for task in tasks)
    if progress:
        progress(finished, total)
    pending = [task for task in tasks if task.key not in journal.done]
    for task, records in _results(study, pending, executors):
        journal.add(task, records)
        finished += len(records)
        if progress:
            progress(finished, total)
    return [record for task in tasks for record in journal.done[task.key]]


def _results(
    study: Study, tasks: list[Task], executors: Executors | None
) -> Iterator[tuple[Task, list[Record]]]:
    """Yield finished tasks as they come; a pool whose worker died is replaced and its tasks are run again."""
    if executors is None:
        for task in tasks:
            yield task, study.execute(task)
        return
    left = {task.key: task for task in tasks}
    for attempt in range(POOLS):
        try:
            with executors() as executor:
                futures = {executor.submit(study.execute, task): task for task in left.values()}
                for future in as_completed(futures):
                    task = futures[future]
                    records = future.result()
                    del left[task.key]
                    yield task, records
            return
        except BrokenProcessPool:
            if attempt == POOLS - 1:
                raise DataError(f"workers died {POOLS} times; finished runs are kept") from None


@contextmanager
def local_pool(jobs: int) -> Iterator[Executor]:
    """Open a pool of processes on this machine; what is queued is dropped when the study stops."""
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """Open a Dask cluster as an executor of the concurrent.futures kind.

    Raises:
        DataError: dask is not installed, or nothing answers at the address.
    """
    try:
        from dask.distributed import Client
    except ImportError:
        raise DataError("--cluster needs dask: pip install 'accelcal[cluster]'") from None
    try:
        client = Client(address, timeout="10s")  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise DataError(f"--cluster {address}: no Dask scheduler answers there ({error})") from None
    with client:
        yield client.get_executor(pure=False)  # type: ignore[no-untyped-call]
