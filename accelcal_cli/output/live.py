"""What a capture shows while it runs: a table that changes on a terminal, a line for each pose elsewhere."""

from __future__ import annotations

import sys
from contextlib import suppress
from types import TracebackType

from rich.console import Group
from rich.live import Live
from rich.text import Text

from accelcal_cli.output.console import console
from accelcal_cli.sensor.capture import NEAR, Capture, Status
from accelcal_cli.sensor.poses import describe

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
        self.status: Status | None = None
        live = not quiet and sys.stderr.isatty()
        self.live = Live(get_renderable=self._drawn, console=self.out, refresh_per_second=8) if live else None

    def __enter__(self) -> Watch:
        """Begin to show."""
        if self.live:
            self.live.start()
        elif not self.quiet:
            self.out.print(f"{len(self.capture.planned)} poses to take, in any order; each held still:")
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

    def see(self, status: Status) -> None:
        """Show what the sensor is doing now; a pose that was taken sounds the bell."""
        self.status = status
        if status.state != "taken" or self.quiet:
            return
        if self.live:
            self.out.bell()
        else:
            self.out.print(self._taken())

    def _taken(self) -> str:
        """Return the line of the latest pose."""
        index, pose = self.capture.recognised()[-1], self.capture.taken[-1]
        name = "beside the plan, kept" if index is None else describe(self.capture.planned[index])
        spread = max(pose.spread)
        left = len(self.capture.missing())
        return f"pose {len(self.capture.taken)}: {name}; {pose.n} readings, sd {spread:.3g}; {left} to take"

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
        beside = self.capture.recognised().count(None)
        if beside:
            lines.append(Text(f"       and {beside} beside the plan, kept"))
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
