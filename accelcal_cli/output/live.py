"""A capture while it runs: what it shows, a table that changes or one line per pose, and the file of its poses."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from types import TracebackType
from typing import IO

from rich.console import Group
from rich.live import Live
from rich.text import Text

from accelcal_cli.detection.capture import NEAR, Capture, CapturedPose, CaptureStatus
from accelcal_cli.output.console import console
from accelcal_cli.output.files import check_target, is_stream, open_stream, unwritten, whole_file
from accelcal_cli.sensor.poses import describe
from accelcal_cli.views.blocks import wrapped

BAR = 20
WORDS = {
    "moving": "moving: hold it still",
    "still": "still",
    "taken": "taken: go on to another pose",
    "again": "taken already: go on to another pose",
}
STYLES = {"moving": "yellow", "still": "cyan", "taken": "bold green", "again": "green"}


class Watch:
    """Shows a capture on standard error; does nothing when it is to be quiet."""

    def __init__(self, capture: Capture, *, quiet: bool) -> None:
        """Watch a capture."""
        self.capture, self.quiet = capture, quiet
        self.out = console(sys.stderr)
        self.status: CaptureStatus | None = None
        live = not quiet and sys.stderr.isatty()
        self.live = Live(get_renderable=self._drawn, console=self.out, refresh_per_second=8) if live else None

    def __enter__(self) -> Watch:
        """Start to show it."""
        if self.live:
            self.live.start()
        elif not self.quiet:
            heading = f"{len(self.capture.planned)} poses to take, in any order; each held still:"
            self.out.print(wrapped(heading, self.out.width), soft_wrap=True)
            for direction in self.capture.planned:
                self.out.print(f"  {describe(direction)}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the last picture as it is."""
        if self.live:
            with suppress(OSError):  # a terminal that is gone shows nothing more
                self.live.stop()

    def see(self, status: CaptureStatus) -> None:
        """Show what the sensor is doing now; a pose that was taken sounds the bell."""
        self.status = status
        if status.state != "taken" or self.quiet:
            return
        if self.live:
            self.out.bell()
        else:
            self.out.print(wrapped(self._taken(), self.out.width, "", "  "), soft_wrap=True)

    def _taken(self) -> str:
        """Return the line of the latest pose."""
        index, pose = self.capture.recognised()[-1], self.capture.poses[-1]
        name = "not in the plan, kept" if index is None else describe(self.capture.planned[index])
        left = len(self.capture.missing())
        return f"pose {len(self.capture.poses)}: {name}; {pose.n} readings, sd {max(pose.spread):.3g}; {left} to take"

    def _drawn(self) -> Group:
        """Return what is held now, which a low terminal must not cut off, and what has become of the poses."""
        numbers = {index: j + 1 for j, index in enumerate(self.capture.recognised()) if index is not None}
        near = None if self.status is None or self.status.angle > NEAR else self.status.nearest
        lines = []
        for index, direction in enumerate(self.capture.planned):
            mark = f"{numbers[index]:>3} " if index in numbers else "  - "
            pointer = "> " if index == near else "  "
            style = "green" if index in numbers else "bold" if index == near else ""
            lines.append(Text(f"{pointer}{mark} {describe(direction)}", style))
        others = self.capture.recognised().count(None)
        if others:
            lines.append(Text(f"       and {others} not in the plan, kept"))
        return Group(*self._now(), Text(f"{len(numbers)} of {len(self.capture.planned)} taken:"), *lines)

    def _now(self) -> list[Text]:
        if self.status is None:
            return [Text("waiting for readings"), Text("")]
        now, filled = self.status, round(BAR * self.status.progress)
        bar = "#" * filled + "." * (BAR - filled)
        state = f"[{bar}] {WORDS[now.state]}"
        held = f"{now.angle:.0f} degrees from {describe(self.capture.planned[now.nearest])}"
        return [
            Text(state, STYLES[now.state]),
            Text(
                f"{held}; sd {now.spread:.2g}, still below {now.limit:.2g}", overflow="ellipsis", no_wrap=True
            ),
        ]


HEADER = "pose,n,Nx,Ny,Nz,sx,sy,sz\n"


class PoseFile:
    """Keeps poses under a name, one row each.

    A file is replaced by a whole one with every pose, so that it holds all poses so far at all times. A pipe or a
    device cannot be replaced: it gets the header at once, which tells whether it can be written, and then a row with
    every pose. A terminal gets all of them at the end, below what is shown there.

    Attributes:
        kept: number of poses that are written.
        flows: whether it is a pipe or a device, which has the header before there is a pose.
    """

    def __init__(self, path: str) -> None:
        """Open the file; raise OutputError when it cannot be written, before there is a pose to lose."""
        self.path, self.kept = path, 0
        check_target(path)
        self._stream = self._opened()
        self.flows = self._stream is not None and not self._stream.isatty()
        if self.flows:
            try:
                self._send([HEADER])
            except BaseException:
                self.close()
                raise

    def save(self, taken: Sequence[CapturedPose], *, last: bool = False) -> None:
        """Keep all poses taken so far; `last` says that no more will come.

        Raises:
            OutputError: they cannot be written; those that were written before still are.
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

    def close(self) -> None:
        """Close what was opened."""
        if self._stream is not None and self.path != "-":
            self._stream.close()

    def _send(self, lines: Iterable[str]) -> None:
        assert self._stream is not None
        try:
            self._stream.writelines(lines)
            self._stream.flush()
        except OSError as error:
            if self.path == "-":  # reported, or ignored, as for any command
                raise
            raise unwritten(self.path, error) from None


def _row(number: int, pose: CapturedPose) -> str:
    """Return the row of a pose, with the shortest digits that read back to the same numbers."""
    cells = [repr(float(v)) for v in (*pose.mean, *pose.spread)]
    return ",".join([str(number), str(pose.n), *cells]) + "\n"
