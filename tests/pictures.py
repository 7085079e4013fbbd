"""Draws the pictures of README and gallery anew: `python tests/pictures.py`, or `make pictures`.

A terminal, a report, a capture, a log with its poses, convergence, a fleet: each made by the command that its caption
names. Report and capture are opened in Chromium; without one their pictures stay as they are.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import chromium
from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.text import Text

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "pictures"

FORMAT = re.sub(r"@font-face \{\{.*?\}\}\s*", "", CONSOLE_SVG_FORMAT, flags=re.DOTALL)
"""rich's picture of a terminal without the fonts that it would fetch."""

TERMINALS = {
    "terminal": "accelcal calibrate data.csv --g 9.80665",
    "plan": "accelcal plan faces.csv --add 6 --noise 0.003",
    "fleet": "accelcal fleet fleet.csv",
}
PLOTS = (
    "accelcal detect log.csv --plot detect.png",
    "accelcal benchmark --func rosenbrock,rastrigin --optimizer de-pso,pso,de --runs 11 --plot convergence.svg",
)
INPUTS = (
    "accelcal simulate --sensor mems --positions 24 --samples 10 --seed 1 -o data.csv",
    "accelcal simulate --sensor mems --positions 6 --scheme faces --samples 10 -o faces.csv",
    "accelcal simulate --sensor mems --sensors 200 --positions 24 --noise 0.005 -o fleet.csv",
    "accelcal simulate --sensor mems --raw --positions 13 --rate 50 --hold 3 --move 1 --noise 0.02 --seed 2 -o log.csv",
    "accelcal calibrate data.csv --g 9.80665 -o result.yaml",
    "accelcal report result.yaml -o report.html",
    "accelcal simulate --raw --sensor mems --positions 12 --scheme edges --rate 200 --hold 1 --move 1 --noise 0.01 "
    "--seed 7 -o session.csv",
)


def run(command: str, folder: Path) -> str:
    """Run a command as on a terminal of 80 columns; return what it prints, with its colours."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "80", "FORCE_COLOR": "1"}
    words = [sys.executable, "-m", "accelcal_cli", *command.split()[1:], "--quiet"]
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode in (0, 1), done.stderr
    return done.stdout


def terminal(command: str, text: str, path: Path) -> None:
    """Write a picture of a terminal with a command and what it prints."""
    console = Console(record=True, width=80, file=open(os.devnull, "w"), force_terminal=True)  # noqa: SIM115
    console.print(Text("$ ", "bold green") + Text(command, "bold"))
    console.print(Text.from_ansi(text.rstrip()))
    path.write_text(
        console.export_svg(title="accelcal", code_format=FORMAT, unique_id=path.stem), encoding="utf-8"
    )


def report(page: Path, path: Path) -> None:
    """Write a picture of the head of a report."""
    browser = chromium.browser()
    if browser is None:
        sys.stderr.write("no chromium and chromedriver: the picture of the report stays\n")
        return
    with chromium.session(browser) as session:
        session.devtools("Emulation.setScrollbarsHidden", hidden=True)
        session.open(page, width=1000, height=800)
        session.screenshot(path, whole=False)


def capture(folder: Path) -> None:
    """Write a picture of a capture as its page shows it, after some of the poses."""
    browser = chromium.browser()
    if browser is None:
        sys.stderr.write("no chromium and chromedriver: the picture of the capture stays\n")
        return
    words = ["--port", "session.csv", "--rate", "200", "--window", "0.25", "--hold", "0.5", "--web", "-q"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "accelcal_cli", "capture", *words, "-o", "poses.csv"]
    with (
        subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True) as program,
        chromium.session(browser) as session,
    ):
        assert program.stderr is not None
        session.open(program.stderr.readline().split()[-1], width=1200, height=760)
        session.devtools("Emulation.setScrollbarsHidden", hidden=True)
        shown = "return document.querySelectorAll('#list .taken').length"
        while program.poll() is None and session.run(shown) < SOME_POSES:
            time.sleep(0.1)
        time.sleep(HELD)
        session.screenshot(PICTURES / "capture.png", whole=False)
        program.kill()


SOME_POSES, HELD = 11, 1.4
"""Poses that the picture of a capture has, and seconds after the last of them."""


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for command in INPUTS:
            run(command, folder)
        for picture, command in TERMINALS.items():
            terminal(command, run(command, folder), PICTURES / f"{picture}.svg")
        for command in PLOTS:
            run(command, folder)
            name = command.rpartition(" ")[2]
            (PICTURES / name).write_bytes((folder / name).read_bytes())
        report(folder / "report.html", PICTURES / "report.png")
        capture(folder)


if __name__ == "__main__":
    main()
