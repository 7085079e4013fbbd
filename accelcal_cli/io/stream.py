"""Streams of bytes and of rows in constant memory.

`ByteSource` reads a file or standard input once, in blocks of whole lines, and hashes it on the way; `unpack` puts the
decoders in front of it that its first bytes ask for (gzip, a zip archive of one file, UTF-16, Latin-1). `RowStore`
keeps rows of numbers and moves them to a temporary file when they outgrow memory. Both leave slow work that releases
the interpreter lock to a `BackgroundThread`.
"""

from __future__ import annotations

import codecs
import hashlib
import io
import os
import sys
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, BinaryIO, Protocol

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError, did_you_mean
from accelcal_cli.schema import frozen

if TYPE_CHECKING:
    from zipfile import ZipFile

    from accelcal_cli.io.formats.base import LogFormat

HEAD = 4 << 20
"""Bytes of the first block: an input up to this size is one block and never needs polars."""

BLOCK = 16 << 20
"""Bytes of a later block."""

LONGEST_LINE = 1 << 20
"""Bytes of a line at most."""

IN_MEMORY = 1_000_000
"""Rows of a store that stay in memory."""

PEEKED = 1 << 16
"""Bytes that show how an input is packed or encoded."""

LAYERS = 3
"""Packings one within another that are undone, as of UTF-16 text in a zip archive."""

MOST_NAMED = 5
"""Members of an archive that a message names at most."""

_FOREIGN = {  # first bytes of files that users pass instead of text
    b"\xd0\xcf\x11\xe0": "an Excel workbook; export the sheet as CSV",
    b"\x89HDF": "an HDF5 file; export the readings as CSV or Parquet",
    b"BZh": "bzip2-compressed; unpack it first",
    b"\xfd7zXZ": "xz-compressed; unpack it first",
    b"7z\xbc\xaf": "a 7-Zip archive; unpack it first",
    b"%PDF": "a PDF document; export the readings as CSV",
    b"SQLite": "an SQLite database; export the readings as CSV",
}

_NATIVE = (  # first bytes of native logs that may have no zero byte soon; all others have one
    b"MD",
    b"PK\x03\x04",
    b"\xa3\x95",
    b"#ROSBAG",
    b"Device Identity",
)

TYPED = (b"PAR1", b"ARROW1", b"\xff\xff\xff\xff")
"""First bytes of Parquet, and of Arrow as a file and as a stream."""

_NOT_NATIVE = (*TYPED, b"\x1f\x8b", b"\xff\xfe", b"\xfe\xff")
"""First bytes of these, of gzip and UTF-16, which have zero bytes and are no native logs."""

_Digest = Callable[[bytes], None]


class Frame(Protocol):
    """A table in memory: a frame of polars or pandas, an Arrow table, or another that gives an Arrow stream."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Return the table as a capsule, by the Arrow PyCapsule interface."""


Source = str | Path | Frame
"""Where a table comes from: a file, ``-`` for standard input, or a frame."""


def is_frame(data: object) -> bool:
    """Return whether something is a table in memory rather than an array of numbers; polars need not be imported."""
    return hasattr(data, "__arrow_c_stream__") or type(data).__name__ in ("LazyFrame", "DataFrame")


class ByteReader(Protocol):
    """What bytes are read from."""

    def read(self, size: int = -1, /) -> bytes:
        """Return up to `size` bytes, none at the end."""

    def close(self) -> None:
        """Release what is held."""


class ByteSource:
    """One pass over a file or standard input; `sha256` covers the bytes read so far, `forms` how they were packed.

    `native` is the format of a native log, None for text and Parquet.

    Hashing runs in the background of the parser: at 10 million rows it would otherwise take as long as the parsing.
    """

    def __init__(
        self,
        stream: BinaryIO,
        name: str,
        *,
        head: int = HEAD,
        block: int = BLOCK,
        owned: bool = False,
        hashed: bool = True,
    ) -> None:
        """Read the first `head` bytes of `stream`; `block` is the size in bytes of every later read.

        An `owned` stream is closed with the source; one that is not `hashed` has no `sha256`.
        """
        self.name = name
        self._stream: ByteReader = stream
        self._opened = stream
        self._block = block
        self._owned = owned
        self.hashed = hashed
        self._stopped = False
        self._hash = hashlib.sha256()
        self._hashing, self._reading = BackgroundThread(), BackgroundThread()
        self._may_read_ahead = stream.seekable()  # a pipe may block, and with it the end of the program
        self._ahead: bytes | None = None
        raw = self._read(head)
        unpacked = unpack(stream, raw, name, self._hash.update)
        self.forms: tuple[str, ...] = ()
        self._digest_here = unpacked is None
        if unpacked is not None:  # its decoders tell the hash what they read
            self._stream, self.forms = unpacked.stream, unpacked.forms
            raw = self._read(head)
        else:
            self._hash.update(raw)
        self.whole = len(raw) < head  # the head is all there is
        self.native = find_native(raw)
        binary = self.native is not None or raw.startswith(TYPED)
        self._carriage_returns = (
            not binary and b"\n" not in raw and b"\r" in raw[:-1]
        )  # line ends of old Macs
        self.head = self._unify(raw)

    def stop(self) -> None:
        """Let `rest` end early, for a reader in another thread."""
        self._stopped = True

    def close(self) -> None:
        """Close the stream if it is ours."""
        self._reading.wait()
        if self.forms:
            self._stream.close()
        if self._owned:
            self._opened.close()

    @property
    def sha256(self) -> str:
        """Hexadecimal SHA-256 of the bytes read so far, as they are in the file."""
        self._hashing.wait()
        return self._hash.hexdigest()

    def blocks(self) -> Iterator[bytes]:
        """Blocks of whole lines, the head first.

        Only the last block may lack its line end, and one with a line longer than `LONGEST_LINE`: that line
        comes cut, for the parser to refuse by its number.
        """
        rest, fresh = b"", self.head
        while fresh and not self.whole:
            cut = fresh.rfind(b"\n") + 1
            if cut:
                yield b"".join((rest, memoryview(fresh)[:cut]))
                rest = b""
            rest += fresh[cut:]
            if len(rest) > LONGEST_LINE:
                break
            fresh = self._next()
        if rest or self.whole:
            yield rest or self.head

    def rest(self) -> Iterator[bytes]:
        """Every byte after the head, uncut (for binary formats)."""
        while not (self.whole or self._stopped) and (fresh := self._next()):
            yield fresh

    def _next(self) -> bytes:
        """Return the block read ahead; read the next one and hash this one in the background."""
        self._reading.wait()
        raw = self._read(self._block) if self._ahead is None else self._ahead
        if raw and self._may_read_ahead:
            self._reading.start(self._read_ahead)
        if raw and self.hashed and self._digest_here:
            self._hashing.start(lambda: self._hash.update(raw))
        return self._unify(raw)

    def _read_ahead(self) -> None:
        self._ahead = self._read(self._block)

    def _unify(self, raw: bytes) -> bytes:
        return raw.replace(b"\r", b"\n") if self._carriage_returns else raw

    def _read(self, size: int) -> bytes:
        """Read `size` bytes, fewer only at the end: an unbuffered pipe gives what it has."""
        try:
            return _read_up_to(self._stream, size)
        except OSError as problem:
            raise DataError(f"{self.name}: cannot be read ({problem.strerror or problem})") from problem


def open_source(source: str | Path, stdin: BinaryIO | None = None, *, hashed: bool = True) -> ByteSource:
    """Open a path, or standard input for ``-``; DataError says why a path cannot be opened."""
    if str(source) == "-":
        return ByteSource(stdin or sys.stdin.buffer, "<stdin>", hashed=hashed)
    path = Path(source)
    try:
        stream = path.open("rb")
    except FileNotFoundError as problem:
        raise DataError(f"{source}: no such file{_neighbour(path)}") from problem
    except IsADirectoryError as problem:
        if (path / "metadata.yaml").is_file():
            from accelcal_cli.io.formats.ros import BagFolder

            return ByteSource(io.BufferedReader(BagFolder(path)), str(source), owned=True, hashed=hashed)
        raise DataError(f"{source}: is a directory; a file of readings was expected") from problem
    except PermissionError as problem:
        raise DataError(f"{source}: no permission to read it") from problem
    except (OSError, ValueError) as problem:  # ValueError: a NUL in the name
        raise DataError(f"{source}: cannot be opened ({problem})") from problem
    try:
        return ByteSource(stream, str(source), owned=True, hashed=hashed)
    except BaseException:
        stream.close()
        raise


def _neighbour(path: Path) -> str:
    """Name the file in the same folder that was probably meant."""
    try:
        names = [entry.name for entry in path.parent.iterdir() if entry.is_file()]
    except OSError:
        return f'; the folder "{path.parent}" does not exist either'
    return did_you_mean(path.name, names)


@frozen()
class Unpacked:
    """A stream of plain text, of Parquet or of a native log.

    Attributes:
        stream: to read on from, its first bytes included.
        forms: what was undone, as ``gzip`` or ``UTF-16``, outermost first.
    """

    stream: ByteReader
    forms: tuple[str, ...] = ()


def unpack(stream: ByteReader, head: bytes, name: str, digest: _Digest) -> Unpacked | None:
    """Return the stream decoded, None where it is plain already.

    Args:
        stream: after its first bytes, `head`; name: of the input, for messages.
        digest: gets every byte of the input as it is read.

    Raises:
        DataError: a format that is no text, or an archive of several members.
    """
    layer = _layer(head, name)
    if layer is None:
        return None
    forms: list[str] = []
    source: ByteReader = _Replayed(head, stream, digest)
    while layer is not None and len(forms) < LAYERS:
        form, decode = layer
        decoded = decode(source, name)
        forms.append(form)
        head = _read_up_to(decoded, PEEKED)
        source = _Replayed(head, decoded)
        layer = _layer(head, name)
    return Unpacked(source, tuple(forms))


def find_native(head: bytes) -> type[LogFormat] | None:
    """Return the format of a native log by its first bytes, None for anything else; no format is loaded for text."""
    if head.startswith(_NOT_NATIVE) or not (b"\0" in head[:PEEKED] or head.startswith(_NATIVE)):
        return None
    from accelcal_cli.io.formats.base import recognise

    return recognise(head)


def _layer(head: bytes, name: str) -> tuple[str, Callable[[ByteReader, str], ByteReader]] | None:
    """Return the outermost packing of some bytes and how to undo it."""
    if find_native(head) is not None:
        return None
    for magic, what in _FOREIGN.items():
        if head.startswith(magic):
            raise DataError(f"{name}: is {what}")
    if head.startswith(b"\x1f\x8b"):
        return "gzip", _Gunzipped
    if head.startswith(b"PK\x03\x04"):
        return "zip", _Member
    if head.startswith(TYPED):
        return None
    encoding = _encoding(head)
    return None if encoding is None else (encoding[0], lambda stream, _: _Transcoded(stream, encoding[1]))


def _encoding(head: bytes) -> tuple[str, str] | None:
    """Return name and codec of an encoding other than UTF-8, None for UTF-8 and for what is no text."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "UTF-16", "utf-16"
    pairs = head[: min(len(head), PEEKED) // 2 * 2]
    even, odd = pairs[::2], pairs[1::2]
    if len(even) > 2 and odd.count(0) > 0.9 * len(odd) and not even.count(0):
        return "UTF-16", "utf-16-le"
    if len(even) > 2 and even.count(0) > 0.9 * len(even) and not odd.count(0):
        return "UTF-16", "utf-16-be"
    if head.isascii() or b"\0" in head:
        return None
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "Latin-1", "cp1252"
    return None


def _read_up_to(stream: ByteReader, size: int) -> bytes:
    """Read `size` bytes, fewer only at the end."""
    parts: list[bytes] = []
    while size and (part := stream.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


class _Replayed:
    """The bytes that were read already, then the rest of a stream, each told to a digest."""

    def __init__(self, head: bytes, stream: ByteReader, digest: _Digest | None = None) -> None:
        self.head, self.stream, self.digest = head, stream, digest
        if digest is not None:
            digest(head)

    def read(self, size: int = -1, /) -> bytes:
        if self.head:
            size = len(self.head) if size < 0 else size
            data, self.head = self.head[:size], self.head[size:]
            return data
        data = self.stream.read(size)
        if self.digest is not None:
            self.digest(data)
        return data

    def close(self) -> None:
        if self.digest is None:  # else it is the input itself, which is not ours
            self.stream.close()


class _Gunzipped:
    """The bytes of a gzip file."""

    def __init__(self, stream: ByteReader, name: str) -> None:
        import gzip  # like zipfile it takes longer to import than a small table to read

        self.name = name
        self.file = gzip.GzipFile(fileobj=stream)  # type: ignore[call-overload]

    def read(self, size: int = -1, /) -> bytes:
        import zlib

        try:
            data: bytes = self.file.read(size)
        except (EOFError, OSError, zlib.error) as problem:
            raise DataError(
                f"{self.name}: its gzip data are damaged or end early; copy the file anew"
            ) from problem
        return data

    def close(self) -> None:
        self.file.close()


class _Transcoded:
    """Text of another encoding as UTF-8."""

    def __init__(self, stream: ByteReader, codec: str) -> None:
        self.stream = stream
        self.decoder = codecs.getincrementaldecoder(codec)(errors="replace")
        self.ready = b""
        self.ended = False

    def read(self, size: int = -1, /) -> bytes:
        while not self.ended and not self.ready:
            raw = self.stream.read(max(size, 1))
            self.ended = not raw
            self.ready = self.decoder.decode(raw, final=self.ended).encode()
        size = len(self.ready) if size < 0 else size
        data, self.ready = self.ready[:size], self.ready[size:]
        return data

    def close(self) -> None:
        self.stream.close()


class _Member:
    """The one file in a zip archive, which is copied to where it can be read from its end."""

    def __init__(self, stream: ByteReader, name: str) -> None:
        import shutil
        import tempfile
        import zipfile

        self.name = name
        self.copy = tempfile.TemporaryFile(prefix="accelcal-")  # noqa: SIM115
        try:
            shutil.copyfileobj(stream, self.copy)
            archive = zipfile.ZipFile(self.copy)
            self.file = archive.open(_only_file(archive, name))
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as problem:
            self.copy.close()
            raise DataError(
                f"{name}: is a zip archive, or an Excel workbook, that cannot be read ({str(problem).lower()}); "
                "unpack it, or export the sheet as CSV"
            ) from problem
        except BaseException:
            self.copy.close()
            raise

    def read(self, size: int = -1, /) -> bytes:
        import zipfile
        import zlib

        try:
            return self.file.read(size)
        except (zipfile.BadZipFile, EOFError, zlib.error) as problem:
            raise DataError(f"{self.name}: its zip archive is damaged; copy the file anew") from problem

    def close(self) -> None:
        self.file.close()
        self.copy.close()


def _only_file(archive: ZipFile, name: str) -> str:
    """Return the name of the one file in an archive."""
    names = [entry.filename for entry in archive.infolist() if not entry.is_dir()]
    files = [member for member in names if not member.startswith("__MACOSX/") and "/." not in f"/{member}"]
    if "[Content_Types].xml" in files:
        raise DataError(f"{name}: is an Excel workbook; export the sheet as CSV")
    if len(files) == 1:
        return files[0]
    shown = ", ".join(f'"{member}"' for member in files[:MOST_NAMED])
    more = f" and {len(files) - MOST_NAMED} more" if len(files) > MOST_NAMED else ""
    held = f"{len(files)} files ({shown}{more})" if files else "no file"
    raise DataError(f"{name}: is a zip archive of {held}; unpack it and name the one with the readings")


@dataclass(eq=False)
class BackgroundThread:
    """Runs calls in order, one at a time, while the caller goes on."""

    _thread: Thread | None = None  # None while idle
    _fault: BaseException | None = None

    def start(self, call: Callable[[], object]) -> None:
        """Wait for the running call, then start the next one."""
        self.wait()
        self._thread = Thread(target=self._run, args=(call,), daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait for the running call; raise what it raised."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._fault is not None:
            fault, self._fault = self._fault, None
            raise fault

    def _run(self, call: Callable[[], object]) -> None:
        try:
            call()
        except BaseException as fault:
            self._fault = fault


@dataclass(eq=False, repr=False)
class RowStore:
    """Rows of `width` numbers, appended once and read back in blocks as often as needed.

    Beyond `limit` rows they live as float64 in an unlinked temporary file, so that memory stays constant;
    it is read with ordinary reads, because mapped pages would count as the process's own.
    """

    width: int = 3
    limit: int = IN_MEMORY  # rows that stay in memory
    rows: int = field(default=0, init=False)
    _parts: list[Float] = field(default_factory=list, init=False)
    _file: BinaryIO | None = field(default=None, init=False)
    _writing: BackgroundThread = field(default_factory=BackgroundThread, init=False)

    def append(self, rows: Float) -> None:
        """Add rows (B, width)."""
        if not len(rows):
            return
        self._parts.append(np.array(rows, dtype=np.float64, order="C"))
        self.rows += len(rows)
        if self.rows > self.limit:
            parts, self._parts = self._parts, []
            with _named_disk_errors():
                self._writing.start(lambda: self._spill(parts))

    def blocks(self, rows: int = 65536) -> Iterator[tuple[int, Float]]:
        """Yield (first row, block) with blocks of up to `rows` rows; blocks are read-only or private."""
        self._settle()
        if self._file is None:
            whole = self._in_memory()
            for start in range(0, self.rows, rows):
                yield start, whole[start : start + rows]
            return
        for start in range(0, self.rows, rows):
            self._settle()  # a writer that came between two blocks moves the file's position
            count = min(rows, self.rows - start)
            with _named_disk_errors():
                self._file.seek(start * self.width * 8)
                block = np.fromfile(self._file, count=count * self.width)
            yield start, block.reshape(count, self.width)

    def part(self, start: int, stop: int) -> Float:
        """Return the rows from `start` to `stop` - 1, (B, width); they are read-only or private."""
        self._settle()
        if self._file is None:
            return self._in_memory()[start:stop]
        with _named_disk_errors():
            self._file.seek(start * self.width * 8)
            return np.fromfile(self._file, count=(stop - start) * self.width).reshape(-1, self.width)

    def all(self) -> Float:
        """Every row, (rows, width)."""
        self._settle()
        return self._in_memory() if self._file is None else np.concatenate([b for _, b in self.blocks()])

    def _in_memory(self) -> Float:
        if len(self._parts) != 1:
            self._parts = [np.concatenate([np.empty((0, self.width)), *self._parts])]
        self._parts[0].flags.writeable = False
        return self._parts[0]

    def _settle(self) -> None:
        with _named_disk_errors():
            self._writing.wait()

    def _spill(self, parts: list[Float]) -> None:
        if self._file is None:
            import tempfile  # costs as much as reading a small table

            self._file = tempfile.TemporaryFile(prefix="accelcal-", buffering=0)  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        self._file.seek(0, os.SEEK_END)
        for part in parts:
            view = part.data.cast("B")
            while view:  # an unbuffered write may take less than all
                view = view[self._file.write(view) :]


@contextmanager
def _named_disk_errors() -> Iterator[None]:
    try:
        yield
    except OSError as problem:
        from tempfile import gettempdir

        raise DataError(
            f"{gettempdir()}: the temporary file for more than {IN_MEMORY:,} readings failed "
            f"({problem.strerror or problem}); free some space, or set TMPDIR to a larger folder"
        ) from problem
