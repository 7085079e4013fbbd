"""Input bytes: opened, hashed and cut into blocks of whole lines."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from accelcal_cli.errors import DataError, did_you_mean
from accelcal_cli.sensor.beside import Beside

HEAD = 4 << 20  # bytes: an input up to this size is one block and never needs polars
BLOCK = 16 << 20  # bytes of a later block
LONGEST_LINE = 1 << 20  # bytes

_FOREIGN = {  # first bytes of what people hand over instead of text
    b"\x1f\x8b": "gzip-compressed; unpack it first",
    b"PK\x03\x04": "a zip archive or an Excel workbook; export the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "an Excel workbook; export the sheet as CSV",
    b"\x89HDF": "an HDF5 file; export the readings as CSV or Parquet",
    b"\xff\xfe": "UTF-16 text; save it as UTF-8",
    b"\xfe\xff": "UTF-16 text; save it as UTF-8",
}


class ByteSource:
    """One pass over a file or standard input; `sha256` covers the bytes read so far.

    Hashing runs in a thread beside the parser: hashlib releases the interpreter lock, and at 10 million
    rows the hash would otherwise cost as much as the parsing.
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
        self._stream = stream
        self._block = block
        self._owned = owned
        self.hashed = hashed
        self._stopped = False
        self._hash = hashlib.sha256()
        self._hashing, self._reading = Beside(), Beside()
        self._may_read_ahead = stream.seekable()  # a pipe may block, and with it the end of the program
        self._ahead: bytes | None = None
        raw = self._read(head)
        self.whole = len(raw) < head  # the head is all there is
        self._hash.update(raw)
        self._carriage_returns = b"\n" not in raw and b"\r" in raw[:-1]  # line ends of old Macs
        self.head = self._unify(raw)
        for magic, what in _FOREIGN.items():
            if raw.startswith(magic):
                raise DataError(f"{name}: is {what}")

    def stop(self) -> None:
        """Let `rest` end early, for a reader in another thread."""
        self._stopped = True

    def close(self) -> None:
        """Close the stream if it is ours."""
        self._reading.wait()
        if self._owned:
            self._stream.close()

    @property
    def sha256(self) -> str:
        """Hexadecimal SHA-256 of the bytes read so far."""
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
        """Take the block read ahead, have the next one read, and hash this one, beside the parser."""
        self._reading.wait()
        raw = self._ahead if self._ahead is not None else self._read(self._block)
        if raw and self._may_read_ahead:
            self._reading.start(self._read_ahead)
        if raw and self.hashed:
            self._hashing.start(lambda: self._hash.update(raw))
        return self._unify(raw)

    def _read_ahead(self) -> None:
        self._ahead = self._read(self._block)

    def _unify(self, raw: bytes) -> bytes:
        return raw.replace(b"\r", b"\n") if self._carriage_returns else raw

    def _read(self, size: int) -> bytes:
        """Read `size` bytes, fewer only at the end: an unbuffered pipe gives what it has."""
        try:
            data = self._stream.read(size)
            while data and len(data) < size and (more := self._stream.read(size - len(data))):
                data += more
        except OSError as problem:
            raise DataError(f"{self.name}: cannot be read ({problem.strerror or problem})") from problem
        return data


def open_source(source: str | Path, stdin: BinaryIO | None = None, *, hashed: bool = True) -> ByteSource:
    """Open a path, or standard input for ``-``."""
    if str(source) == "-":
        return ByteSource(stdin or sys.stdin.buffer, "<stdin>", hashed=hashed)
    path = Path(source)
    try:
        stream = path.open("rb")
    except FileNotFoundError as problem:
        raise DataError(f"{source}: no such file{_neighbour(path)}") from problem
    except IsADirectoryError as problem:
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
