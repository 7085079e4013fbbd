"""Files written whole or not at all."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from accelcal_cli.errors import OutputError

PROBE = 4096
"""Bytes that a file system must have room for before any work is done: it gives room by blocks of this size."""


def check_target(path: str) -> None:
    """Raise OutputError when `path` cannot be written, before any work is done for it.

    Permissions do not tell everything (a full disk, a folder like /proc): a temporary file is made beside it and
    removed. A pipe or a device is left alone.
    """
    if path == "-":
        return
    target = Path(path)
    if target.is_dir():
        raise OutputError(f"{path}: is a directory; expected the name of a file")
    folder = target.parent
    if not folder.is_dir():
        raise OutputError(f"{path}: no such folder: {folder}")
    if not os.access(folder, os.W_OK) or (target.exists() and not os.access(target, os.W_OK)):
        raise OutputError(f"{path}: permission denied")
    if target.exists() and not target.is_file():
        return
    try:
        handle, temporary = _part(target)
        try:
            with open(handle, "wb", buffering=0) as file:
                file.write(bytes(PROBE))
        finally:
            os.unlink(temporary)
    except OSError as error:
        raise unwritten(path, error) from None


def _part(target: Path) -> tuple[int, str]:
    """Make a temporary file beside the one that is to be; return its open handle and its name."""
    return tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)


@contextmanager
def whole_file(path: str, *, binary: bool = False) -> Iterator[IO[Any]]:
    """Open a file that appears under its name only when all of it was written; "-" is standard output.

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
    target = Path(path)
    text = {} if binary else {"encoding": "utf-8", "newline": "\n"}
    device = target.exists() and not target.is_file()  # a pipe or a device, which must not be replaced
    temporary = ""
    try:
        if not device:
            handle, temporary = _part(target)
            os.close(handle)
        with open(temporary or target, "wb" if binary else "w", **text) as file:  # type: ignore[call-overload]
            yield file
        if not device:
            os.chmod(temporary, _mode(target))
            os.replace(temporary, target)
            temporary = ""
    except OSError as error:
        raise unwritten(path, error) from None
    finally:
        if temporary:
            Path(temporary).unlink(missing_ok=True)


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
    target = Path(path)
    temporary = ""
    try:
        temporary = tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
        yield Path(temporary)
        os.chmod(temporary, _mode(target, 0o777))
        if target.is_dir():
            target.rmdir()
        os.replace(temporary, target)
        temporary = ""
    except OSError as error:
        raise unwritten(path, error) from None
    finally:
        if temporary:
            shutil.rmtree(temporary, ignore_errors=True)


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
