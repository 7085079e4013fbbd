"""The poses of a capture, kept as they are taken."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import IO

from accelcal_cli.output.files import check_target, is_stream, open_stream, unwritten, whole_file
from accelcal_cli.sensor.capture import Held

HEADER = "pose,n,Nx,Ny,Nz,sx,sy,sz\n"


class PoseFile:
    """Keeps poses under a name, one row each.

    A file is replaced by a whole one with every pose, so that it holds all poses so far at any moment. A pipe or a
    device cannot be replaced: it gets the names of the columns at once, which tells whether it takes anything, and
    then a row with every pose. A terminal gets all of them in the end, below what is shown there.

    Attributes:
        kept: poses that are written.
        flows: it is a pipe or a device, which has the names of the columns before there is a pose.
    """

    def __init__(self, path: str) -> None:
        """Open the name; OutputError when it cannot be written, before there is a pose to lose."""
        self.path, self.kept = path, 0
        check_target(path)
        self._stream = self._opened()
        self.flows = self._stream is not None and not self._stream.isatty()
        if self.flows:
            try:
                self._send([HEADER])
            except BaseException:
                self._close()
                raise

    def __enter__(self) -> PoseFile:
        """Keep poses."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close what was opened."""
        self._close()

    def save(self, taken: Sequence[Held], *, last: bool = False) -> None:
        """Keep all poses taken so far; `last` says that no more will come.

        Raises:
            OutputError: they cannot be written; those that were kept before still are.
        """
        if len(taken) == self.kept:
            return
        rows = [_row(number, pose) for number, pose in enumerate(taken, 1)]
        if self._stream is None:
            with whole_file(self.path) as file:
                file.writelines([HEADER, *rows])
        elif self.flows:
            self._send(rows[self.kept :])
        elif last:
            self._send([HEADER, *rows])
        else:
            return
        self.kept = len(taken)

    def _opened(self) -> IO[str] | None:
        """Return standard output, a pipe or a device; None for a file."""
        if self.path == "-":
            return sys.stdout  # as it is now: a picture on the terminal puts another in its place
        if not is_stream(self.path):
            return None
        try:  # without a buffer, which would try to get rid of what a full device refused, again and again
            return io.TextIOWrapper(
                open_stream(self.path), encoding="utf-8", newline="\n", write_through=True
            )
        except OSError as error:
            raise unwritten(self.path, error) from None

    def _close(self) -> None:
        if self._stream is not None and self.path != "-":
            self._stream.close()

    def _send(self, lines: Iterable[str]) -> None:
        assert self._stream is not None
        try:
            self._stream.writelines(lines)
            self._stream.flush()
        except OSError as error:
            if self.path == "-":  # told, or left quietly, as for any command
                raise
            raise unwritten(self.path, error) from None


def _row(number: int, pose: Held) -> str:
    """Return the row of a pose, with the shortest digits that read back to the same numbers."""
    cells = [repr(float(v)) for v in (*pose.mean, *pose.spread)]
    return ",".join([str(number), str(pose.n), *cells]) + "\n"
