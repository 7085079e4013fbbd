"""Files written whole or not at all."""

from __future__ import annotations

import io
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from accelcal_cli.errors import OutputError

PROBE = 4096
"""Bytes that a file system must have room for before any work is done: the size of a block."""

MARK, UNFINISHED = ".accelcal-", ".part"
"""Start and end of the name of a temporary file: short, so that the final name may be as long as the system allows."""

MOST_LINKS = 40
"""Symbolic links in a row that Linux follows."""


def check_target(path: str) -> None:
    """Raise OutputError when `path` cannot be written, before any work is done for it.

    Permissions do not tell everything (a full disk, a folder like /proc): a temporary file is created next to it and
    removed. A pipe or a device is left alone.
    """
    if path == "-":
        return
    target = _target(path)
    try:
        if target.is_dir():
            raise OutputError(f"{path}: is a directory; expected the name of a file")
        if is_stream(path):
            _check_stream(path)
            return
        _check_name(path, target)
        handle, temporary = _part(target)
        try:
            with open(handle, "wb", buffering=0) as file:
                file.write(bytes(PROBE))
        finally:
            os.unlink(temporary)
    except OSError as error:
        raise unwritten(path, error) from None


def _check_name(path: str, target: Path) -> None:
    folder = target.parent
    if not folder.is_dir():
        raise OutputError(f"{path}: no such folder: {folder}")
    if not os.access(folder, os.W_OK) or (target.exists() and not os.access(target, os.W_OK)):
        raise OutputError(f"{path}: permission denied")
    with suppress(FileNotFoundError):
        target.stat()  # a name that is too long, or links in a ring


def _check_stream(path: str) -> None:
    descriptor = _descriptor(path)
    if descriptor is not None:
        os.fstat(descriptor)  # open
    elif not os.access(path, os.W_OK):
        raise OutputError(f"{path}: permission denied")


def is_stream(path: str) -> bool:
    """Whether a name is a pipe, a device, or what this process has open (/dev/stdout): nothing can take its place."""
    target = Path(path)
    return _descriptor(path) is not None or (target.exists() and not (target.is_file() or target.is_dir()))


def open_stream(path: str) -> io.FileIO:
    """Open a stream, without a buffer; one that is open already continues at its position.

    Raises:
        OSError: it cannot be written.
    """
    descriptor = _descriptor(path)
    return io.FileIO(path if descriptor is None else os.dup(descriptor), "w")


def _descriptor(path: str) -> int | None:
    """Return the descriptor that a name has in this process, as 1 for /dev/stdout and 3 for /dev/fd/3."""
    for _ in range(MOST_LINKS):
        folder, name = os.path.realpath(os.path.dirname(path)), os.path.basename(path)
        if folder in ("/dev/fd", f"/proc/{os.getpid()}/fd") and name.isdecimal():
            return int(name)
        if not os.path.islink(path):
            break
        path = os.path.join(folder, os.readlink(path))
    return None


def _target(path: str) -> Path:
    """Return the file that a name stands for: the target of a symbolic link."""
    return Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)


def _part(target: Path) -> tuple[int, str]:
    """Create a temporary file next to the final one; return its open handle and its name."""
    return tempfile.mkstemp(prefix=MARK, suffix=UNFINISHED, dir=target.parent)


@contextmanager
def whole_file(path: str, *, binary: bool = False) -> Iterator[IO[Any]]:
    """Open a file that appears under its name only when all of it was written; "-" is standard output.

    A symbolic link stays: the file that it leads to is replaced. A stream is written as it comes.

    Args:
        path: its name, or "-".
        binary: for bytes; text is UTF-8 with plain line feeds.

    Raises:
        OutputError: it cannot be written (folder, permission, full disk); nothing is left behind.
    """
    if path == "-":
        yield sys.stdout.buffer if binary else sys.stdout
        return
    check_target(path)
    target, temporary = _target(path), ""
    try:
        if is_stream(path):
            with _opened(open_stream(path), binary) as file:
                yield file
            return
        handle, temporary = _part(target)
        os.close(handle)
        with _opened(io.FileIO(temporary, "w"), binary) as file:  # by its name, which polars asks for
            yield file
        os.chmod(temporary, _mode(target))
        os.replace(temporary, target)
        temporary = ""
    except OSError as error:
        raise unwritten(path, error) from None
    finally:
        if temporary:
            Path(temporary).unlink(missing_ok=True)


def _opened(raw: io.FileIO, binary: bool) -> IO[Any]:
    """Return an unbuffered file with a buffer, for bytes or for text."""
    file = io.BufferedWriter(raw)
    return file if binary else io.TextIOWrapper(file, encoding="utf-8", newline="\n")


def check_folder(path: str) -> None:
    """Raise OutputError when `path` cannot become a folder of ours, before any work is done for it."""
    target = Path(path)
    if target.is_dir():
        if any(target.iterdir()):
            raise OutputError(f"{path}: holds files already; expected a new or an empty folder")
    elif target.exists():
        raise OutputError(f"{path}: is a file; expected a new or an empty folder")
    if not target.parent.is_dir():
        raise OutputError(f"{path}: no such folder: {target.parent}")
    if not os.access(target.parent, os.W_OK):
        raise OutputError(f"{path}: permission denied")


@contextmanager
def whole_folder(path: str) -> Iterator[Path]:
    """Give a folder to write to that appears under its name only when all of it was written.

    Raises:
        OutputError: it cannot be written, or holds something already; nothing is left behind.
    """
    check_folder(path)
    target, temporary = _target(path), ""
    try:
        temporary = tempfile.mkdtemp(prefix=MARK, suffix=UNFINISHED, dir=target.parent)
        yield Path(temporary)
        publish_folder(Path(temporary), path)
        temporary = ""
    except OSError as error:
        raise unwritten(path, error) from None
    finally:
        if temporary:
            shutil.rmtree(temporary, ignore_errors=True)


def publish_folder(folder: Path, path: str) -> None:
    """Let a finished folder, on the same file system, appear under its name.

    Raises:
        OutputError: it cannot, or there is something already.
    """
    check_folder(path)
    target = _target(path)
    try:
        os.chmod(folder, _mode(target, 0o777))
        if target.is_dir():
            target.rmdir()
        os.replace(folder, target)
    except OSError as error:
        raise unwritten(path, error) from None


def unwritten(path: str, error: OSError) -> OutputError:
    """Return what to raise for a file or folder that the system refuses to write."""
    return OutputError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}")


def _mode(target: Path, new: int = 0o666) -> int:
    """Return the mode of the file that is replaced, or what the umask gives a new one."""
    if target.exists():
        return target.stat().st_mode & 0o7777
    mask = os.umask(0)
    os.umask(mask)
    return new & ~mask
