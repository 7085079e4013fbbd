"""What the live views of a capture cost, over a pseudo-terminal at 200 Hz: `python -m benchmarks.live_view`.

Processor time of the whole command as a share of one core: without a view, with the terminal's, with the page's and
one or four pages that listen; how many moments a second reach a page; and how long the calibration of a pose takes,
for which no reading waits longer than the line's buffer holds.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import pty
import re
import subprocess
import sys
import threading
import time
import tty

import numpy as np

from accelcal_cli.detection.capture import Capture
from accelcal_cli.planning import candidates, distinct_poses

RATE, STILL, MOVING, TOGETHER = 200, 300, 60, 4
SECONDS, SETTLING = 15.0, 2.0
LIMIT = 0.15
"""Share of a core that a live view may take."""

PLANNED = candidates("corners")[distinct_poses(candidates("corners"), 12)]
OPTIONS = [
    "--rate",
    str(RATE),
    "--window",
    "0.25",
    "--hold",
    "1",
    "--columns",
    "1,2,3",
    "--output",
    os.devnull,
]


def lines() -> list[bytes]:
    """The readings of twelve poses, m/s^2, a line each."""
    rng = np.random.default_rng(1)
    rows = []
    for direction in PLANNED:
        rows += [9.8 * direction + 2.0 * rng.normal(size=3) for _ in range(MOVING)]
        rows += [9.8 * direction + 0.01 * rng.normal(size=3) for _ in range(STILL)]
    return [b"%.5f %.5f %.5f\n" % tuple(row) for row in rows]


def send(master: int, sent: list[bytes]) -> None:
    """Write lines at RATE until nobody reads any more."""
    begun = time.monotonic()
    with contextlib.suppress(OSError):
        for start in range(0, len(sent), TOGETHER):
            time.sleep(max(0.0, begun + start / RATE - time.monotonic()))
            os.write(master, b"".join(sent[start : start + TOGETHER]))


def used(pid: int) -> float:
    """Processor time of a process, s."""
    with open(f"/proc/{pid}/stat") as file:
        cells = file.read().rpartition(") ")[2].split()
    return (int(cells[11]) + int(cells[12])) / os.sysconf("SC_CLK_TCK")


class Listener(threading.Thread):
    """A page that listens and counts."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        host, token = address.removeprefix("http://").split("/#")
        self.connection = http.client.HTTPConnection(host, timeout=60)
        self.connection.request("GET", "/events", headers={"Authorization": f"Bearer {token}"})
        self.answer, self.moments = self.connection.getresponse(), 0
        self.start()

    def run(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            while line := self.answer.readline():
                self.moments += line == b"event: moment\n"


def measure(name: str, arguments: list[str], *, terminal: bool = False, pages: int = 0) -> None:
    """Run a capture, print its share of a core and the moments a second that pages get."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    screen, error = pty.openpty() if terminal else (0, subprocess.PIPE)
    command = [
        sys.executable,
        "-m",
        "accelcal_cli",
        "capture",
        "--port",
        os.ttyname(slave),
        *OPTIONS,
        *arguments,
    ]
    with subprocess.Popen(command, stderr=error, stdout=subprocess.DEVNULL) as program:
        address = None
        if terminal:
            os.close(error)
            threading.Thread(target=drain, args=(screen,), daemon=True).start()
        else:
            assert program.stderr is not None
            address = re.search(rb"http\S+", program.stderr.readline())
            threading.Thread(target=program.stderr.read, daemon=True).start()
        listeners = [Listener(address[0].decode()) for _ in range(pages)] if address else []
        time.sleep(SETTLING)
        threading.Thread(target=send, args=(master, [b"\n", *lines()]), daemon=True).start()
        time.sleep(SETTLING)
        before, begun, seen = used(program.pid), time.monotonic(), [one.moments for one in listeners]
        time.sleep(SECONDS)
        seconds = time.monotonic() - begun
        share = (used(program.pid) - before) / seconds
        rates = [(one.moments - count) / seconds for one, count in zip(listeners, seen, strict=True)]
        told = f", {min(rates):.1f} moments/s" if rates else ""
        print(
            f"{name:<24} {100 * share:5.1f} % of a core{told}{'' if share < LIMIT else '  TOO MUCH'}",
            flush=True,
        )
        program.kill()
    for descriptor in (master, slave, *([screen] if terminal else [])):
        os.close(descriptor)


def drain(screen: int) -> None:
    with contextlib.suppress(OSError):
        while os.read(screen, 65536):
            pass


def calibration() -> None:
    """Print how long the calibration after each pose takes."""
    capture, times = Capture(PLANNED, RATE // 4, RATE), []
    for line in lines():
        status = capture.push(np.array([float(word) for word in line.split()]))
        if status is not None and status.state == "taken":
            begun = time.perf_counter()
            capture.calibrate()
            times.append(1e3 * (time.perf_counter() - begun))
    rest = f"then {np.median(times[1:]):.0f} ms, at most {max(times[1:]):.0f} ms"
    print(f"calibration of a pose    {times[0]:.0f} ms the first, {rest}")


def main() -> None:
    measure("lines", [])
    measure("terminal", [], terminal=True)
    measure("web, no page", ["--web"])
    measure("web, one page", ["--web"], pages=1)
    measure("web, four pages", ["--web"], pages=4)
    calibration()


if __name__ == "__main__":
    main()
