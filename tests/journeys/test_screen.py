"""What commands show fits the terminal: no table is wider, no unit is torn from its number, one screen is enough."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
import test_golden
from rich.cells import cell_len
from test_golden import folder as folder  # the inputs of the golden transcripts

from accelcal_cli.cli.examples import EXAMPLES, GUIDE
from accelcal_cli.cli.main import NAMES, main
from accelcal_cli.sensor.poses import faces
from accelcal_cli.views.blocks import wrapped

WIDTHS = (60, 80, 120)
COMMANDS = (
    "calibrate good.csv --g 9.81",
    "calibrate warm.csv --g 9.81",
    "calibrate faces.csv --g 9.81",
    "calibrate outlier.csv --g 9.81",
    "calibrate log.csv --raw --g 9.81",
    "detect log.csv",
    "verify good.yaml again.csv",
    "verify good.yaml changed.csv",
    "plan weak.csv --add 3 --g 9.81",
    "plan",
    "fleet fleet.csv --g 9.81",
    "capture - --rate 50 --hold 1 --poses 6 --fixture faces --quiet",
    "capture - --rate 50 --hold 1 --poses 6 --fixture faces -o poses.csv --overwrite",
)
VERBOSE = (
    "calibrate warm.csv --g 9.81 --verbose",
    "calibrate log.csv --raw --g 9.81 --verbose",
    "detect log.csv --verbose",
    "plan weak.csv --add 3 --g 9.81 --verbose",
    "fleet fleet.csv --g 9.81 --verbose",
)
SCREEN = 50
"""Lines of a screen."""

UNIT = re.compile(
    r"(?:%|ppm|mrad|micro-g|micro-rad|m/s\^2|arcsec|mg|Hz|degrees?|rows?|poses?|output units)\b"
)


def live() -> bytes:
    """What a serial port would send: six faces, each held for a second and a half at 50 Hz, with moves between."""
    rng = np.random.default_rng(1)
    rows = []
    for direction in faces():
        rows += [9.81 * direction + 0.01 * rng.normal(size=3) for _ in range(75)]
        rows += [9.81 * direction + 3.0 * rng.normal(size=3) for _ in range(25)]
    return "".join(f"{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in rows).encode()


def shown(line: str, width: int, patch: pytest.MonkeyPatch) -> str:
    return test_golden.transcript(line, patch, width, live() if line.startswith("capture") else b"")


def printed(text: str) -> list[str]:
    """The lines on standard output; those on standard error are a terminal's to break."""
    return text.partition("--- out\n")[2].partition("--- err\n")[0].splitlines()


@pytest.mark.parametrize("width", WIDTHS)
def test_commands_print_what_they_printed(width, folder, monkeypatch):
    monkeypatch.chdir(folder)
    texts = [shown(line, width, monkeypatch) for line in COMMANDS]
    for text in texts:
        fits(text, width)
    test_golden.check(f"screen-{width}", test_golden.normal("\n".join(texts)))


@pytest.mark.parametrize("line", VERBOSE)
@pytest.mark.parametrize("width", WIDTHS)
def test_all_there_is_to_show_fits_too(line, width, folder, monkeypatch):
    monkeypatch.chdir(folder)
    fits(shown(line, width, monkeypatch), width)


def fits(text: str, width: int) -> None:
    """Check that no line is wider than the terminal, and none begins with the unit of the number before it."""
    lines = printed(text)
    if text.startswith("$ accelcal capture"):
        return
    assert lines, text
    for line in lines:
        assert cell_len(line) <= width, line
    for line, following in pairwise(lines):
        words = not re.match(r"  (\S+( \S+)*  |value )", line)  # no row of a table
        torn = words and re.search(r"\d$", line) and UNIT.match(following.strip())
        assert not torn, f"{line}\n{following}"


@pytest.mark.parametrize("line", [line for line in COMMANDS if not line.startswith("capture")])
def test_the_default_is_one_screen(line, folder, monkeypatch):
    monkeypatch.chdir(folder)
    text = shown(line, 80, monkeypatch)
    lines = printed(text)
    assert len(lines) <= SCREEN, f"{len(lines)} lines\n{text}"


def test_a_table_at_80_columns_is_in_one_part(folder, monkeypatch):
    monkeypatch.chdir(folder)
    for line in (*COMMANDS, *VERBOSE):
        heads = [row.split()[0] for row in printed(shown(line, 80, monkeypatch)) if "value" in row.split()]
        assert len(heads) == len(set(heads)) or line.startswith("verify"), line


def test_a_number_and_its_unit_stay_on_one_line():
    text = (
        "The residuals are 0.0123 m/s^2 in 24 poses at 50 Hz, within 5 % of 9.81 m/s^2 (p < 0.01), 3 ± 1 ppm."
    )
    for width in range(20, 100):
        lines = wrapped(text, width).splitlines()
        assert " ".join(lines) == text
        for whole in ("0.0123 m/s^2", "24 poses", "50 Hz", "5 %", "9.81 m/s^2", "p < 0.01", "3 ± 1 ppm"):
            assert any(whole in line for line in lines), (width, whole)


def test_a_console_without_the_sign_prints_two(folder, monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), "ascii", "backslashreplace")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["accelcal", "calibrate", "good.csv", "--quiet"])
    monkeypatch.setattr(sys, "stdout", out)
    with pytest.raises(SystemExit):
        main()
    out.flush()
    text = out.buffer.getvalue().decode()
    assert "value +- 95 %" in text
    assert "\\x" not in text


def test_accelcal_alone_and_help_guide():
    for words in ([], ["help"]):
        done = run(words)
        assert (done.returncode, done.stdout, done.stderr) == (0, GUIDE, "")
    assert run(["help", "plan"]).stdout == run(["plan", "--help"]).stdout
    assert "calibrate" in run(["--help"]).stdout
    assert run(["help", "plann"]).returncode == 2


def run(words: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "accelcal_cli", *words], capture_output=True, text=True, check=False
    )


def test_help_has_examples():
    assert set(EXAMPLES) == set(NAMES)
    assert all(line.startswith(f"accelcal {name}") for name, lines in EXAMPLES.items() for line in lines)
    assert "Examples:\n  accelcal verify result.yaml new.csv" in run(["verify", "--help"]).stdout


def test_the_examples_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^  accelcal (\S.*?)(?:  .*)?$", GUIDE, re.MULTILINE)
    for first in ("simulate --raw --positions 13 -o log.csv", "simulate --sensor mems --seed 2 -o new.csv"):
        assert call(first, monkeypatch) == 0
    assert call("simulate --sensors 5 --positions 24 -o fleet.csv", monkeypatch) == 0
    lines += [line.removeprefix("accelcal ") for name in NAMES for line in EXAMPLES[name]]
    for line in lines:
        if not line.startswith(("capture", "navigate", "compare", "benchmark", "reproduce dpso")):
            assert call(line, monkeypatch) in (0, 1), line


def call(line: str, patch: pytest.MonkeyPatch) -> int:
    text = test_golden.transcript(line, patch)
    return int(re.search(r"^exit (\d+)$", text, re.MULTILINE)[1])  # type: ignore[index]
