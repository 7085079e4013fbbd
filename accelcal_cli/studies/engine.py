"""Running a study: in this process, in several, or on a cluster; kept as it goes, and continued after a stop.

The records of a task depend on the study and the run numbers alone, so any number of workers gives the same result
to the last bit. Finished tasks go to a journal at once; an interrupted study reads it and runs the rest.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import Executor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from accelcal_cli import __version__
from accelcal_cli.errors import DataError, OutputError
from accelcal_cli.studies.study import Record, Study, Task

SCHEMA = "accelcal/journal/1"
POOLS = 5
"""Process pools that may break one after the other without a finished task: one that kills its worker must end."""

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

        With `resume` and nothing there, the study starts anew: it may have been stopped that early.

        Raises:
            DataError: a journal is there but not to be resumed, or it belongs to another study or version.
            OutputError: it cannot be read or written.
        """
        journal = cls(path)
        if path is None:
            return journal
        head = {"schema": SCHEMA, "study": study.identity, "version": __version__}
        if path.exists() and not resume:
            raise DataError(
                f"{path}: an interrupted study left this; --resume goes on with it, or delete it to start anew"
            )
        if not (path.exists() and journal._read(head)):
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
            reason = (error.strerror or str(error)).lower()
            raise OutputError(f"{self.path}: cannot be written: {reason}") from None

    def _read(self, head: dict[str, str]) -> bool:
        """Take up what the file holds; False when not even its head was written. Cuts a half-written last line."""
        assert self.path is not None
        try:
            content = self.path.read_bytes()
            whole = content[: content.rfind(b"\n") + 1]
            if whole != content:
                os.truncate(self.path, len(whole))
        except OSError as error:
            raise OutputError(f"{self.path}: {(error.strerror or str(error)).lower()}") from None
        lines = whole.splitlines()
        if lines and _parsed(lines[0]) != head:
            raise DataError(f"{self.path}: the journal of another study or version; delete it to start anew")
        for line in lines[1:]:
            with suppress(KeyError, TypeError, ValueError):  # a damaged line: its task runs again
                entry = json.loads(line)
                self.done[entry["task"]] = [Record.from_json(record) for record in entry["records"]]
        return bool(lines)


def _parsed(line: bytes) -> object:
    try:
        return json.loads(line)
    except ValueError:
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
    report = progress or (lambda _done, _total: None)
    report(finished, total)
    pending = [task for task in tasks if task.key not in journal.done]
    with closing(_results(study, pending, executors)) as results:
        for task, records in results:
            journal.add(task, records)
            finished += len(records)
            report(finished, total)
    return [record for task in tasks for record in journal.done[task.key]]


def _results(
    study: Study, tasks: list[Task], executors: Executors | None
) -> Generator[tuple[Task, list[Record]], None, None]:
    """Yield finished tasks as they come; a pool whose worker died is replaced and its tasks are run again."""
    if executors is None:
        for task in tasks:
            yield task, study.execute(task)
        return
    left = {task.key: task for task in tasks}
    vain = 0
    while left:
        before = len(left)
        try:
            with executors() as executor:
                futures = {executor.submit(study.execute, task): task for task in left.values()}
                for future in as_completed(futures):
                    records = future.result()
                    del left[futures[future].key]
                    yield futures[future], records
        except BrokenProcessPool:
            vain = vain + 1 if len(left) == before else 0
            if vain == POOLS:
                raise DataError(f"workers died {POOLS} times in a row without finishing a run") from None
