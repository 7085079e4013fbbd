"""Bytes as they come: gzip, zip archives with one member, UTF-16 and Latin-1, turned into UTF-8 text on the way.

`unpack` looks at the first bytes of a stream and puts the decoders in front of it that they ask for; the hash of a file
stays that of its bytes as they are on disk.
"""

from __future__ import annotations

import codecs
import gzip
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from accelcal_cli.errors import DataError

HEAD = 1 << 16
"""Bytes that are looked at."""

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
    b"\xa3\x95\x80\x80": "a binary ArduPilot log; convert it with mavlogdump.py --format csv --types IMU",
    b"ULog": "a binary PX4 log; convert it with ulog2csv",
    b"%PDF": "a PDF document; export the readings as CSV",
    b"SQLite": "an SQLite database; export the readings as CSV",
}

_Digest = Callable[[bytes], None]


class ByteReader(Protocol):
    """What bytes are read from."""

    def read(self, size: int = -1, /) -> bytes:
        """Return up to `size` bytes, none at the end."""

    def close(self) -> None:
        """Release what is held."""


@dataclass(frozen=True)
class Unpacked:
    """A stream of plain text or Parquet.

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
        head = _read(decoded, HEAD)
        source = _Replayed(head, decoded)
        layer = _layer(head, name)
    return Unpacked(source, tuple(forms))


def _layer(head: bytes, name: str) -> tuple[str, Callable[[ByteReader, str], ByteReader]] | None:
    """Return the outermost packing of some bytes and how to undo it."""
    for magic, what in _FOREIGN.items():
        if head.startswith(magic):
            raise DataError(f"{name}: is {what}")
    if head.startswith(b"\x1f\x8b"):
        return "gzip", _Gunzipped
    if head.startswith(b"PK\x03\x04"):
        return "zip", _Member
    if head.startswith(b"PAR1"):
        return None
    encoding = _encoding(head)
    return None if encoding is None else (encoding[0], lambda stream, _: _Transcoded(stream, encoding[1]))


def _encoding(head: bytes) -> tuple[str, str] | None:
    """Return name and codec of an encoding other than UTF-8, None for UTF-8 and for what is no text."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "UTF-16", "utf-16"
    pairs = head[: len(head) // 2 * 2]
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


def _read(stream: ByteReader, size: int) -> bytes:
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
        self.name = name
        self.file = gzip.GzipFile(fileobj=stream)  # type: ignore[call-overload]

    def read(self, size: int = -1, /) -> bytes:
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
        try:
            return self.file.read(size)
        except (zipfile.BadZipFile, EOFError, zlib.error) as problem:
            raise DataError(f"{self.name}: its zip archive is damaged; copy the file anew") from problem

    def close(self) -> None:
        self.file.close()
        self.copy.close()


def _only_file(archive: zipfile.ZipFile, name: str) -> str:
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
