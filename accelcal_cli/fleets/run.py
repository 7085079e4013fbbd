"""Running a fleet: its blocks here, in processes or on a cluster; kept as they come, and continued after a stop.

A finished block is a file of arrays and text in a folder beside the output, or in memory where there is but one block.
The fleet is put together block by block from these: what the summary needs as arrays of numbers, the rows as they are
written.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.arrays import Bool, Int
from accelcal_cli.calibration.fleet import FAILED, UNWEIGHTED, Fleet
from accelcal_cli.errors import DataError, OutputError
from accelcal_cli.fleets.blocks import Block, Outcome, Supply, Work, failed
from accelcal_cli.notices import Notice

SCHEMA = "accelcal/fleet-journal/1"
HEAD = "head.json"

POOLS = 5
"""Process pools that may break one after the other without a finished block."""

AHEAD = 32
"""Blocks that are with the workers, or on their way to them, at once."""

NAMED = 10
"""Sensors of each kind whose sentences a summary may show."""

SUMMED = ("parameters", "gain", "s", "rms", "rms_before", "freedom", "poses", "coverage")
"""Numbers of a fleet that its summary is made of, beside the verdict and the worst dilution of precision."""

TOLD = ("reason", "outlying")
"""Texts of a sensor of which a summary shows a few."""

Progress = Callable[[int, int], None]
Executors = Callable[[], AbstractContextManager[Executor]]


@dataclass(frozen=True)
class Digest:
    """What a fleet needs to know of a part before it reads it again.

    Attributes:
        size: its sensors; first: label and reason of the first of them.
        gravities: how many were calibrated with each g.
        notes, misused: see `Outcome`; unweighted: whether no sensor gives the weights asked for.
    """

    size: int
    first: tuple[str, str]
    gravities: dict[str, int]
    notes: dict[str, int]
    misused: str
    unweighted: bool

    @classmethod
    def of(cls, part: Outcome) -> Digest:
        """Return that of a part."""
        fleet, own = part.fleet, part.gravity[~np.isnan(part.gravity)]
        return cls(
            len(fleet.number),
            (str(fleet.labels[0]), str(fleet.reason[0])),
            {repr(g): n for g, n in Counter(own.tolist()).items()},
            dict(part.notes),
            part.misused,
            all(reason.startswith(UNWEIGHTED) for reason in fleet.reason),
        )


@dataclass
class Finished:
    """Finished blocks, by their number.

    Attributes:
        folder: they are kept in; None keeps them in memory alone.
        done: what is known of those that are finished.
        memory: the blocks themselves, without a folder.
        lasting: whether the folder stays when the run is interrupted.
    """

    folder: Path | None = None
    lasting: bool = False
    done: dict[int, Digest] = field(default_factory=dict)
    memory: dict[int, Outcome] = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path, identity: str, resume: bool) -> Finished:
        """Return the finished blocks of a run in a folder, with what an interrupted run left when `resume` is set.

        With `resume` and nothing there, the run starts anew: it may have been stopped that early.

        Raises:
            DataError: something is there but not to be resumed, or it belongs to other data, settings or version.
            OutputError: it cannot be read or written.
        """
        parts, head = cls(folder, lasting=True), {"schema": SCHEMA, "fleet": identity, "version": __version__}
        if folder.exists() and not resume:
            raise interrupted_run(folder)
        try:
            if folder.exists() and (folder / HEAD).exists():
                if json.loads((folder / HEAD).read_text()) != head:
                    raise DataError(
                        f"{folder}: of other data, settings or another version of accelcal; delete it to start anew"
                    )
                parts._find()
            else:
                folder.mkdir(exist_ok=True)
                _write(folder / HEAD, json.dumps(head).encode())
            (folder / "results").mkdir(exist_ok=True)
        except (OSError, ValueError) as error:
            raise _unusable(folder, error) from None
        return parts

    @classmethod
    def temporary(cls) -> Finished:
        """Return no finished blocks, to be kept in a temporary folder."""
        folder = Path(tempfile.mkdtemp(prefix="accelcal-"))
        (folder / "results").mkdir()
        return cls(folder)

    def _find(self) -> None:
        assert self.folder is not None
        for path in self.folder.glob("part-*.npz"):
            with suppress(
                OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile
            ):  # that block is run again
                with np.load(path, allow_pickle=False) as archive:
                    digest = json.loads(archive["digest"].tobytes())
                digest["first"] = tuple(digest["first"])
                self.done[int(path.stem.partition("-")[2])] = Digest(**digest)

    @property
    def results(self) -> Path | None:
        """The folder for result files of the sensors."""
        return None if self.folder is None else self.folder / "results"

    def add(self, number: int, part: Outcome) -> None:
        """Keep a finished block, on the disk before anything else happens."""
        digest = Digest.of(part)
        if self.folder is None:
            self.memory[number] = part
        else:
            try:
                _write(self._path(number), _packed(part, digest))
            except OSError as error:
                raise _unusable(self.folder, error) from None
        self.done[number] = digest

    def load(self, number: int, names: Sequence[str] | None = None) -> Outcome:
        """Return a finished block, of its numbers these alone if stated; without the result files."""
        if number in self.memory:
            return self.memory[number]
        try:
            return _unpacked(self._path(number), names)
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DataError(f"{self._path(number)}: damaged ({error}); delete it and --resume") from None

    def kept(self) -> str:
        """Return what to say of finished blocks after a failure."""
        if not self.lasting or not self.done:
            return ""
        plural = "s are" if len(self.done) > 1 else " is"
        return (
            f"; {len(self.done):,} finished block{plural} kept in {self.folder}, --resume goes on with them"
        )

    def leave(self) -> None:
        """Delete what is of no use when a run ends early: a temporary folder, or one without finished blocks."""
        if not (self.lasting and self.done):
            self.remove()

    def remove(self) -> None:
        """Delete the folder: the run is finished and written."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, number: int) -> Path:
        assert self.folder is not None
        return self.folder / f"part-{number:06d}.npz"


def interrupted_run(folder: Path) -> DataError:
    """Return what to raise where finished blocks of an earlier run lie, and nobody said what to do with them."""
    return DataError(
        f"{folder}: an interrupted run left this; --resume goes on with it, or delete it to start anew"
    )


def _unusable(folder: Path, error: Exception) -> OutputError:
    reason = str(getattr(error, "strerror", None) or error).lower()
    return OutputError(f"{folder}: cannot be used: {reason}")


def _write(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, on the disk when this returns."""
    with path.with_suffix(".part").open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(path.with_suffix(".part"), path)


def _packed(part: Outcome, digest: Digest) -> bytes:
    """Return a part as a NumPy archive: arrays of numbers, and the texts as JSON; nothing in it is code."""
    import io

    arrays: dict[str, Any] = {"gravity": part.gravity}
    arrays["digest"] = np.frombuffer(json.dumps(asdict(digest)).encode(), np.uint8)
    texts: dict[str, Any] = {}
    for f in fields(Fleet):
        values = getattr(part.fleet, f.name)
        if values.dtype != object:
            arrays[f.name] = values
        elif f.name == "warnings":
            texts[f.name] = [[asdict(one) for one in said] for said in values]
        else:
            texts[f.name] = values.tolist()
    arrays["texts"] = np.frombuffer(json.dumps(texts).encode(), np.uint8)
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _unpacked(path: Path, names: Sequence[str] | None) -> Outcome:
    with np.load(path, allow_pickle=False) as archive:
        texts = json.loads(archive["texts"].tobytes())
        numbers = {
            f.name: archive[f.name]
            for f in fields(Fleet)
            if f.name in archive.files and (names is None or f.name in names)
        }
        gravity = archive["gravity"]
    said = [tuple(Notice(**one) for one in own) for own in texts["warnings"]]
    values = {**{f.name: np.zeros(0) for f in fields(Fleet)}, **numbers, "warnings": _objects(said)}
    for f in fields(Fleet):
        if f.name in texts and f.name != "warnings":
            values[f.name] = _objects(texts[f.name])
    return Outcome(Fleet(**values), gravity)


def _objects(values: Sequence[object]) -> np.ndarray:
    array = np.empty(len(values), dtype=object)
    array[:] = values if not values or not isinstance(values[0], tuple) else [*values, ()][:-1]
    return array


def identity_of(supply: Supply, work: Work) -> str:
    """Return the hash of all that the blocks depend on: data, settings, and what result files say beside."""
    text = json.dumps(
        [
            supply.identity,
            asdict(work.settings),
            asdict(work.gravity),
            getattr(work.text, "__qualname__", repr(work.text)),
        ],
        sort_keys=True,
        default=str,
    )
    return hashlib.sha256(text.encode()).hexdigest()


def execute(block: Block, work: Work) -> Outcome | None:
    """Return what became of a block; None where its files are not here."""
    return block.calibrate(work) if block.visible() else None


def run_blocks(
    supply: Supply,
    work: Work,
    parts: Finished,
    executors: Executors | None = None,
    *,
    progress: Progress | None = None,
    write: Callable[[str, str], None] | None = None,
) -> None:
    """Run the blocks that are not done yet.

    Args:
        supply: the blocks; work: what to do with them.
        parts: finished ones; new ones are added as they come.
        executors: opens an Executor of the concurrent.futures kind; None runs in this process.
        progress: called with (sensors or files done, in all).
        write: takes label and text of each result file.
    """
    report = progress or (lambda _done, _size: None)
    sizes: dict[int, int] = {}

    def pending() -> Iterator[tuple[int, Block]]:
        for number, block in supply.blocks(frozenset(parts.done)):
            sizes[number] = block.size
            yield number, block

    finished = supply.size * len(parts.done) // max(supply.count, 1)
    report(finished, supply.size)
    with closing(_results(pending(), work, executors)) as results:
        for number, part in results:
            if write is not None:
                for label, text in part.texts:
                    write(label, text)
            parts.add(number, replace(part, texts=[]))
            finished = min(finished + sizes.pop(number), supply.size)
            report(finished, supply.size)
    _check(parts, supply.name)


def _results(
    blocks: Iterator[tuple[int, Block]], work: Work, executors: Executors | None
) -> Generator[tuple[int, Outcome], None, None]:
    """Yield finished blocks as they come; a pool whose worker died is replaced and its blocks are run again."""
    if executors is None:
        for number, block in blocks:
            yield number, block.calibrate(work)
        return
    sent: dict[int, Block] = {}
    vain = 0
    while True:
        before = len(sent)
        try:
            with executors() as executor:
                for number, part in _running(executor, blocks, sent, work):
                    vain = 0
                    yield number, part
            return
        except BrokenProcessPool:
            vain += 1
            if vain == POOLS and before:
                raise DataError(f"workers died {POOLS} times in a row without finishing a block") from None


def _running(
    executor: Executor, blocks: Iterator[tuple[int, Block]], sent: dict[int, Block], work: Work
) -> Iterator[tuple[int, Outcome]]:
    """Yield blocks as an executor finishes them; `sent` holds those that it has."""
    futures: dict[Future[Outcome | None], int] = {
        executor.submit(execute, block, work): number for number, block in sent.items()
    }
    while True:
        while len(futures) < AHEAD and (item := next(blocks, None)) is not None:
            sent[item[0]] = item[1]
            futures[executor.submit(execute, item[1], work)] = item[0]
        if not futures:
            return
        for future in wait(futures, return_when=FIRST_COMPLETED).done:
            number = futures.pop(future)
            part = future.result()
            if part is None:  # the worker does not see the files
                sent[number] = sent[number].loaded()
                futures[executor.submit(execute, sent[number], work)] = number
                continue
            del sent[number]
            yield number, part


def _check(parts: Finished, name: str) -> None:
    """Raise DataError where no sensor came of it for the same reason: options that fit no file, or no weights."""
    digests = [digest for _, digest in sorted(parts.done.items())]
    if all(digest.misused for digest in digests):
        raise DataError(digests[0].misused)
    if all(digest.unweighted for digest in digests):
        label, reason = digests[0].first
        raise DataError(f'{name}: sensor "{label}", as all others: {reason.rstrip(".")}')


class Whole:
    """A fleet whose blocks are done: its summary as one `Fleet`, its rows block by block.

    Attributes:
        g: local gravity in the unit of most sensors; None where none was calibrated; mixed: whether there are others.
        starts: number of the first sensor of each block, and of all sensors, shape (B + 1,).
        notes: what there is to say of the files, and of how many.
    """

    def __init__(self, parts: Finished, work: Work) -> None:
        """Take over finished blocks."""
        self._parts, self._work = parts, work
        self.numbers = sorted(parts.done)
        gravities, self.notes, sizes = Counter[str](), Counter[str](), [0]
        for number in self.numbers:
            digest = parts.done[number]
            gravities.update(digest.gravities)
            self.notes.update(digest.notes)
            sizes.append(digest.size)
        self.starts: Int = np.cumsum(sizes)
        self.mixed = len(gravities) > 1
        self.g = float(gravities.most_common(1)[0][0]) if gravities else None

    def __len__(self) -> int:
        """R, the number of sensors."""
        return int(self.starts[-1])

    def fleets(self, names: Sequence[str] | None = None) -> Iterator[Fleet]:
        """Yield the sensors of each block, all of their numbers or some; those in another unit have failed."""
        for start, number in zip(self.starts, self.numbers, strict=False):
            part = self._parts.load(number, names)
            yield replace(self._in_one_unit(part), number=start + np.arange(len(part.gravity)))

    def _in_one_unit(self, part: Outcome) -> Fleet:
        other: Bool = ~np.isnan(part.gravity) & (part.gravity != self.g)
        if not other.any():
            return part.fleet
        at = np.flatnonzero(other)
        labels = part.fleet.labels[at].tolist()
        words = [
            f"1 g is {part.gravity[k]:g} in the unit of its readings, and {self.g:g} in that of most sensors"
            for k in at.tolist()
        ]
        lost = failed(labels, words, np.arange(len(at)), self._work)
        values = {f.name: getattr(part.fleet, f.name).copy() for f in fields(Fleet)}
        for name, own in values.items():
            if len(own):
                own[at] = getattr(lost, name) if name != "number" else own[at]
        return Fleet(**values)

    def other_units(self) -> list[str]:
        """Return the labels of the sensors that are in another unit than most."""
        if not self.mixed:
            return []
        parts = (self._parts.load(number, ()) for number in self.numbers)
        return [
            label
            for part in parts
            for label in part.fleet.labels[~np.isnan(part.gravity) & (part.gravity != self.g)].tolist()
        ]

    def summary(self) -> Fleet:
        """Return all sensors; of more than one block without what only rows show."""
        if len(self.numbers) == 1:
            return next(self.fleets())
        size, filled = len(self), dict[str, np.ndarray]()
        for start, fleet in zip(self.starts.tolist(), self.fleets((*SUMMED, "dop")), strict=False):
            own = trimmed(fleet)
            for name, values in own.items():
                if name not in filled:
                    filled[name] = np.empty((size, *values.shape[1:]), dtype=values.dtype)
                filled[name][start : start + len(fleet.number)] = values
        nothing = {f.name: np.broadcast_to(np.nan, (size,)) for f in fields(Fleet) if f.name not in filled}
        return Fleet(**{**nothing, **filled})


def trimmed(fleet: Fleet) -> Mapping[str, np.ndarray]:
    """Return what a summary needs of a part of a fleet: numbers of all sensors, and sentences of those it may name.

    The sentences of all others are replaced by one that stands for them.
    """
    told = np.zeros(len(fleet.number), dtype=bool)
    for word in ("weak", "suspect", "undetermined", FAILED):
        told[np.flatnonzero(fleet.verdict == word)[:NAMED]] = True
    warned = np.flatnonzero(fleet.warned)
    told[warned[np.argsort(-np.nan_to_num(fleet.s[warned]), kind="stable")][:NAMED]] = True
    told[np.argsort(-np.nan_to_num(np.where(fleet.determined, fleet.rms, -1.0)), kind="stable")[:NAMED]] = (
        True
    )
    values: dict[str, np.ndarray] = {name: getattr(fleet, name) for name in SUMMED}
    for name in TOLD:
        texts = getattr(fleet, name)
        values[name] = np.where(told | (texts == ""), texts, STANDS_FOR)
    values["warnings"] = fleet.warnings.copy()
    for at in np.flatnonzero(fleet.warned & ~told).tolist():
        values["warnings"][at] = SOME
    names = {word: word for word in set(fleet.verdict)}  # one object for each word
    values["verdict"] = np.array([names[word] for word in fleet.verdict], dtype=object)
    values["dop"] = fleet.dop.max(axis=1, keepdims=True)  # the worst, by which it is shown
    values["number"] = fleet.number
    values["labels"] = fleet.labels.astype(np.dtypes.StringDType())
    return values


STANDS_FOR = "..."
SOME = (Notice(STANDS_FOR, "note", STANDS_FOR),)
"""What stands for the sentences of the sensors that a summary does not name."""
