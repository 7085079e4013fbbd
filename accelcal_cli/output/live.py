"""A capture while it runs: what it shows, a table that changes or one line per pose, and the file of its poses."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import zip_longest
from types import TracebackType
from typing import IO

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from accelcal_cli.detection.capture import Capture, CapturedPose, CaptureStatus
from accelcal_cli.output.console import VERDICT_STYLE, console
from accelcal_cli.output.files import check_target, is_stream, open_stream, unwritten, whole_file
from accelcal_cli.output.sphere import BOX_WIDTH, MAP_WIDTH, draw_box, draw_map
from accelcal_cli.sensor.poses import AXES, describe
from accelcal_cli.views.blocks import wrapped
from accelcal_cli.views.capture import Moment, Progress, moment, progress

BAR = 20
PER_SECOND = 10
"""How often a terminal is drawn at most."""

STYLES = {"moving": "yellow", "still": "cyan", "taken": "bold green", "again": "green"}

LISTED = 100
"""Columns of a terminal that has the list of poses beside the map."""

HEIGHT = 36
"""Lines of a narrower terminal that has it below."""

SENTENCES = 2
"""Sentences on the poses that are shown, a line each; the command says all of them at its end."""

NARROWEST = 3 + MAP_WIDTH + 2 + BOX_WIDTH
"""Columns that map and box need side by side."""


class Watch:
    """Shows a capture on standard error; does nothing when it is to be quiet."""

    def __init__(self, capture: Capture, *, quiet: bool) -> None:
        """Watch a capture."""
        self.capture, self.quiet = capture, quiet
        self.out = console(sys.stderr)
        self.scene: tuple[Moment | None, Progress] = (None, progress(capture))
        self.drawn = -1.0
        live = not quiet and sys.stderr.isatty()
        self.live = (
            Live(get_renderable=self._drawn, console=self.out, refresh_per_second=PER_SECOND)
            if live
            else None
        )

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
        taken, now = status.state == "taken", time.monotonic()
        if self.live and (taken or now - self.drawn >= 1.0 / PER_SECOND):
            _, before = self.scene
            self.scene = moment(self.capture, status), progress(self.capture) if taken else before
            self.drawn = now
        if not taken or self.quiet:
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
        return picture(*self.scene, self.out)


def picture(now: Moment | None, so_far: Progress, out: Console) -> Group:
    """Return what a terminal shows: what is held now first, which a low terminal must not cut off.

    Args:
        now: None while the sensor has sent too little.
        so_far: what has become of the poses; out: the terminal, whose size and encoding decide.
    """
    unicode = out.encoding.lower().startswith("utf")
    listed = _list(now, so_far)
    lines = [*_now(now, so_far, unicode), *_pictures(now, so_far, out, listed, unicode=unicode)]
    lines += [Text(so_far.count, "bold"), *_calibration(so_far)]
    if out.width < LISTED and out.height >= HEIGHT:
        lines += listed
    for line in lines:
        line.no_wrap, line.overflow = True, "ellipsis" if unicode else "crop"
    return Group(*lines)


def _now(now: Moment | None, so_far: Progress, unicode: bool) -> list[Text]:
    if now is None:
        return [Text("waiting for readings")]
    filled = round(BAR * now.progress)
    full, empty = ("█", "░") if unicode else ("#", ".")
    axes = "  ".join(f"{axis} {value:+9.4g}" for axis, value in zip(AXES, now.reading, strict=True))
    following = "-" if now.next is None else so_far.words[now.next]
    return [
        Text(f"{axes}  |f| {now.length:.4f} g"),
        Text(f"[{full * filled}{empty * (BAR - filled)}] {now.words}", STYLES[now.state]),
        Text(f"sd    {now.spread:.2g}, still below {now.limit:.2g}"),
        Text(f"held  {now.hold}"),
        Text.assemble("next  ", (following, "bold cyan")),
    ]


def _pictures(
    now: Moment | None, so_far: Progress, out: Console, listed: list[Text], *, unicode: bool
) -> list[Text]:
    """Return the map, and beside it as much as the terminal has columns for: the box of the next pose, the list."""
    missing = [index for index, number in enumerate(so_far.numbers) if number is None]
    following = now.next if now is not None else missing[0] if missing else None
    direction = None if now is None else now.direction
    lines = draw_map(so_far.planned, so_far.taken, missing, following, direction, unicode=unicode)
    if following is not None and out.width >= NARROWEST:
        box = [Text(line, "cyan") for line in draw_box(so_far.planned[following], unicode=unicode)]
        lines = _beside(lines, [*box, Text(f"{'next, up is up':^{BOX_WIDTH}}")], 3 + MAP_WIDTH + 2)
    return _beside(lines, listed, NARROWEST + 2) if out.width >= LISTED else lines


def _beside(left: list[Text], right: list[Text], column: int) -> list[Text]:
    """Return lines of two pictures beside each other, the right one from a column on."""
    lines = []
    for one, other in zip_longest(left, right):
        line = Text() if one is None else one.copy()
        if other is not None:
            line.append(" " * max(column - line.cell_len, 1)).append_text(other)
        lines.append(line)
    return lines


def _list(now: Moment | None, so_far: Progress) -> list[Text]:
    """Return the planned poses, a line each: the number of the captured pose, or none, and how to hold it."""
    lines = []
    for index, (words, number) in enumerate(zip(so_far.words, so_far.numbers, strict=True)):
        held = now is not None and now.held == index
        style = "green" if number is not None else "bold" if held else ""
        mark = "-" if number is None else f"{number}"
        lines.append(Text(f"{'>' if held else ' '} {mark:>3}  {words}", style))
    return lines


def _calibration(so_far: Progress) -> list[Text]:
    """Return the calibration of the poses so far, or what it waits for."""
    found, said = so_far.summary, [Text(sentence) for sentence in so_far.sentences[:SENTENCES]]
    if found is None:
        return [Text(f"calibration: {so_far.outlook}"), *said]
    bias = "  ".join(f"{axis} {value}" for axis, (value, _) in zip(AXES, found.bias, strict=True))
    dop = "  ".join(f"{kind} {size}" for kind, size in found.dop)
    return [
        Text.assemble("calibration: ", (found.verdict, VERDICT_STYLE.get(found.verdict, "bold"))),
        Text(f"bias  {bias}   s {found.noise}"),
        Text(f"DOP   {dop}"),
        *said,
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
        rows = pose_rows(taken)
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


def pose_rows(taken: Sequence[CapturedPose]) -> list[str]:
    """Return the rows of poses, with the shortest digits that read back to the same numbers."""
    cells = [[repr(float(v)) for v in (*pose.mean, *pose.spread)] for pose in taken]
    return [
        ",".join([str(number), str(pose.n), *row]) + "\n"
        for number, (pose, row) in enumerate(zip(taken, cells, strict=True), 1)
    ]
