"""Every command on a dozen simulated inputs prints what it printed before, and exits with the same code.

The transcripts in `golden/` hold each command line, its exit code, standard output and standard error. Words are
compared exactly, numbers to a part in a million or one unit of the last digit printed: processors round differently.
`make golden` (`ACCELCAL_GOLDEN=renew pytest tests/journeys/test_golden.py`) writes the transcripts anew; the diff
of that commit then says what users will see change.
"""

from __future__ import annotations

import csv
import html
import io
import math
import os
import random
import re
import sys
import time
from collections.abc import Iterable
from difflib import SequenceMatcher
from pathlib import Path

import pytest

from accelcal_cli.cli.main import main

GOLDEN = Path(__file__).parent / "golden"
RENEW = os.environ.get("ACCELCAL_GOLDEN") == "renew"

RELATIVE = 1e-6
"""What two processors may differ by in a number."""

ZERO = {"calibrate-exact": 1e-6}
"""What numbers may differ by that are rounding errors, by transcript; 1e-12 in the others."""

FORGETTABLE = re.compile(
    r"\d{4}-\d\d-\d\d[T ][\d:.+Z-]*"  # dates
    r"|[0-9a-f]{64}"  # hashes of files that hold measured numbers
    r"|(?<=accelcal )\d[\w.]*|(?<=version: )\d[\w.]*|(?<=version\": \")\d[\w.]*"
)
UNDETERMINED = re.compile(r'(?m)^(Verdict: undetermined|verdict: undetermined| *"verdict": "undetermined",)$')
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d[\d,]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w])")

INPUTS = """
simulate --sensor mems --positions 24 --seed 3 -o good.csv
simulate --sensor mems --positions 18 --samples 20 --noise 0.02 --seed 4 -o samples.csv
simulate --sensor mems --positions 9 --scheme random --noise 0.02 --seed 3 -o weak.csv
simulate --sensor mems --positions 6 --scheme faces --noise 0.01 --seed 5 -o faces.csv
simulate --sensor dpso --positions 12 --g 9.8 --seed 6 -o dpso.csv
simulate --sensor mems --positions 18 --attitude --noise 0.01 --seed 7 -o known.csv
simulate --noise 0 --positions 24 --seed 1 --scheme random -o exact.csv
simulate --sensor navigation --positions 24 --g 1 --seed 8 -o units.csv
simulate --sensor mems --sensors 5 --positions 24 --noise 0.01 --seed 9 -o many.csv
simulate --sensor mems --raw --positions 13 --rate 50 --hold 3 --move 1 --noise 0.02 --gyro --seed 2 -o log.csv
simulate --sensor mems --positions 24 --seed 30 -o again.csv
simulate --sensor mems --sensors 3 --positions 12 --samples 5 --noise 0.02 --seed 10 -o counted.csv
"""
"""Commands that make the inputs; `edited` derives more from them."""

CASES = {
    "simulate": """
        simulate --positions 3 --seed 1
        simulate --positions 2 --samples 2 --attitude --seed 2 --format csv
        simulate --positions 2 --sensors 2 --seed 3 --truth truth.yaml
        simulate --raw --positions 2 --rate 2 --hold 2 --move 1 --gyro --seed 4
        simulate --scheme icosahedron --positions 3 --quiet
    """,
    "calibrate-good": """
        calibrate good.csv
        calibrate good.csv --optimizer levenberg-marquardt --gauge full --seed 5
        calibrate good.csv --optimizer ellipsoid --quiet --no-polish --gauge symmetric
    """,
    "calibrate-verdicts": """
        calibrate weak.csv --g 9.81
        calibrate faces.csv --g 9.81
        calibrate faces.csv --no-misalignment --latitude 48 --height 500 --format csv
        calibrate good.csv --tolerance 1e-4 --quiet --format csv
    """,
    "calibrate-robust": """
        calibrate outlier.csv --g 9.81
        calibrate outlier.csv --g 9.81 --robust huber --format csv
        calibrate outlier.csv --g 9.81 --robust soft-l1 --format csv --runs 3
    """,
    "calibrate-weights": """
        calibrate samples.csv --g 9.81
        calibrate samples.csv --g 9.81 --weights n --format csv
        calibrate samples.csv --g 9.81 --weights sd --format csv
        calibrate samples.csv --g 9.81 --weights auto --format csv
    """,
    "calibrate-temperature": """
        calibrate warm.csv --g 9.80665
        calibrate warm.csv --no-temperature --format csv
        calibrate cool.csv --format csv
    """,
    "calibrate-attitudes": """
        calibrate known.csv --attitudes known
        calibrate known.csv --format csv
        calibrate turned.csv --attitudes known --format csv
    """,
    "calibrate-records": """
        calibrate weak.csv --g 9.81 --format json --quiet --no-misalignment --optimizer levenberg-marquardt
        calibrate weak.csv --g 9.81 --seed 1 -o - --quiet
    """,
    "calibrate-exact": """
        calibrate exact.csv --g 9.80665 --format csv
        calibrate exact.csv --g 9.80665 --format csv --optimizer levenberg-marquardt
    """,
    "calibrate-units": """
        calibrate units.csv --g 1 --format csv
        calibrate units.csv --g 1 --columns 1,2,3 --optimizer pso --population 30 --iterations 100 --format csv
    """,
    "calibrate-raw": """
        calibrate log.csv --raw --g 9.80665
        calibrate log.csv --raw --gyro none --merge 10 --format csv
        calibrate log.csv --format csv
    """,
    "detect": """
        detect log.csv
        detect log.csv --gyro none --window 20rows --multiplier 5,20 --thin 20 --format csv -o -
        detect good.csv
    """,
    "fleet": """
        fleet fleet.csv
        fleet fleet.csv --format csv --g 9.81
        fleet fleet.csv --gauge symmetric --tolerance 0.01 --quiet -o fleet.json
        fleet counted.csv --weights sd --g 9.81 --format csv
        fleet many.csv --quiet -o results/ --format csv
        fleet good.csv again.csv faces.csv --g 9.81 --format csv
    """,
    "plan": """
        plan
        plan weak.csv --add 3 --fixture any
        plan good.yaml --add 2 --format csv
        plan --poses 6 --fixture faces --noise 0.01 --format json
    """,
    "verify": """
        verify good.yaml again.csv
        verify good.yaml changed.csv --format json
        verify good.yaml weak.csv --level 0.01 --tolerance 1e-3 --format csv
        verify faces.yaml again.csv
    """,
    "export": """
        export metric.yaml --to px4
        export metric.yaml --to ardupilot --instance 1 --driver-scale 1
        export good.yaml --to px4
        export good.yaml --to kalibr
        export good.yaml --to imucal
        export good.yaml --to ros
        export good.yaml --to c-header
        export good.yaml --to numpy -o good.npz
        export faces.yaml --to ros
        export warm.yaml --to ros
        export warm.yaml --to px4 --driver-scale 1670 --device-id 1310988
        export warm.yaml --to ardupilot --driver-scale 1670
        export warm.yaml --to c-header
        export good.yaml --to nonsense
    """,
    "apply": """
        apply good.yaml three.csv
        apply good.yaml three.csv --unit g --replace --tilt --noise 0.01
        apply warm.yaml three.csv
        apply faces.yaml three.csv
        apply good.yaml three.csv --prefix a_ --columns 3,4,5
    """,
    "report": """
        report good.yaml -o good.html --title Golden
        report faces.yaml -o faces.html
    """,
    "benchmark": """
        benchmark --func sphere,rosenbrock --optimizer pso,de --runs 3 --iterations 20 --dim 4 --format csv --quiet
        benchmark --func sphere,rosenbrock --optimizer pso,de-pso --runs 3 --iterations 20 --dim 4 --shift
        benchmark --func ackley --optimizer all --runs 2 --evaluations 300 --dim 3 --format json
    """,
    "compare": """
        compare --runs 2 --optimizer de-pso,levenberg-marquardt,ellipsoid --iterations 30
        compare good.csv --runs 2 --optimizer levenberg-marquardt,pso --iterations 30 --polish --format csv
    """,
    "studies": """
        optimizers
        optimizers de-pso
        optimizers --format csv
        reproduce
        reproduce dpso-figure2 --runs 2 --format csv
        navigate --filter pf,reference --runs 2 --particles 20 --period 600 --generations 2
        navigate --filter de-pf --mode literal --runs 1 --particles 20 --period 1200 --generations 2 --format csv
    """,
    "refusals": """
        calibrate missing.csv
        calibrate text.csv
        calibrate short.csv
        calibrate equal.csv
        calibrate good.csv --columns 1,2,9
        calibrate good.csv --optimizer de-pos
        calibrate good.csv --gauge lowr
        calibrate good.csv --config wrong.yaml
        calibrate good.csv --weights sd
        calibrate good.csv --attitudes known
        calibrate good.csv --nonsense
        calibrate good.csv -o good.txt
        calibrat good.csv
        detect good.csv --window 5x
        fleet good.csv --sensor-column sensor
        fleet fleet.csv --weights sd
        apply good.csv three.csv
        verify good.yaml good.csv --g 9.7
        benchmark --func spere
        benchmark --func sphere --optimizer foa --dim 1
        compare --sensor mem
        reproduce dpso-figure3
        navigate --filter kalman
        simulate --positions 7 --scheme icosahedron
        simulate --sensor mems --positions 5 --rate 3
        plan --fixture tetrahedron
        export good.csv --to ros
        report good.yaml -o missing/good.html
    """,
}
"""Command lines by transcript; a dozen of lines each, so that a difference is found soon."""


def lines(text: str) -> list[str]:
    """The lines of a block that hold something."""
    return [line.strip() for line in text.splitlines() if line.strip()]


def edited(folder: Path) -> None:
    """Write the inputs that `simulate` does not make: an outlier, a temperature, a degenerate fleet, wrong files."""
    heading, *rows = table(folder / "good.csv")
    write(
        folder / "outlier.csv", [heading, *rows[:7], [f"{1.02 * float(x):.4f}" for x in rows[7]], *rows[8:]]
    )
    write(
        folder / "metric.csv", [["x", "y", "z"], *([f"{float(x) / 1660:.7f}" for x in row] for row in rows)]
    )
    write(folder / "cool.csv", [[*heading, "temperature"], *([*row, "21.5"] for row in rows)])
    write(
        folder / "three.csv", [["time", "temperature", *heading], *(["0.5", "30", *row] for row in rows[:3])]
    )
    heading, *later = table(folder / "again.csv")
    write(folder / "changed.csv", [heading, *([f"{float(x) * 1.004 + 40:.4f}", y, z] for x, y, z in later)])
    noise = random.Random(1)
    warm = [[*heading, "temperature"]]
    for row in 3 * rows:
        degrees = noise.uniform(5.0, 45.0)
        drift = [(1 + 1e-4 * (degrees - 25)) * float(x) + 3.0 * (degrees - 25) for x in row]
        warm.append([*(f"{x + noise.gauss(0, 10):.4f}" for x in drift), f"{degrees:.2f}"])
    write(folder / "warm.csv", warm)
    heading, *rows = table(folder / "known.csv")
    write(folder / "turned.csv", [heading, *([*row[:3], row[4], row[3], row[5]] for row in rows)])
    heading, *rows = table(folder / "many.csv")
    first = [row for row in rows if row[0] == rows[0][0]]
    flat = [["flat", *row[1:3], first[0][3]] for row in first]
    few = [["few", *row[1:]] for row in first[:6]]
    bad = [["bad", *row[1:]] for row in first]
    bad[4][1] = f"{1.03 * float(bad[4][1]):.4f}"
    write(folder / "fleet.csv", [heading, *rows, *flat, *few, *bad])
    write(folder / "text.csv", [["x", "y", "z"], ["1", "2", "3"], ["1", "two", "3"]])
    write(folder / "short.csv", [["x", "y", "z"], ["1", "2", "3"]])
    write(folder / "equal.csv", [["x", "y", "z"], *(["1", "2", "3"] for _ in range(12))])
    (folder / "wrong.yaml").write_text("optimizer: de-pso\nparameters: {populatoin: 3}\nguage: lower\n")


def table(path: Path) -> list[list[str]]:
    """The cells of a CSV file."""
    with path.open() as file:
        return list(csv.reader(file))


def write(path: Path, rows: Iterable[Iterable[str]]) -> None:
    """Write cells as a CSV file."""
    path.write_text("".join(",".join(row) + "\n" for row in rows))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with all inputs, and results of some of them."""
    place = tmp_path_factory.mktemp("golden")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        for line in lines(INPUTS):
            transcript(line, patch)
        edited(place)
        for name in ("good", "faces", "warm", "metric"):
            transcript(f"calibrate {name}.csv --seed 1 -o {name}.yaml", patch)
    return place


def transcript(line: str, patch: pytest.MonkeyPatch, columns: int | None = None, stdin: bytes = b"") -> str:
    """Run a command line in this process; return it with its exit code and all that it printed.

    Args:
        line: without the name of the program; columns: width of the terminal, None for a pipe; stdin: what it reads.
    """
    out, err = io.TextIOWrapper(io.BytesIO(), "utf-8"), io.TextIOWrapper(io.BytesIO(), "utf-8")
    patch.setattr(sys, "argv", ["accelcal", *line.split()])
    patch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(stdin)))
    patch.setattr(sys, "stdout", out)
    patch.setattr(sys, "stderr", err)
    patch.setattr(time, "thread_time", lambda: 0.0)
    patch.setattr(time, "perf_counter", lambda: 0.0)
    patch.delenv("COLUMNS", raising=False)
    if columns:
        patch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit) as stop:
        main()
    texts = []
    for stream in (out, err):
        stream.flush()
        stream.buffer.seek(0)
        texts.append(stream.buffer.read().decode())
    parts = [f"$ accelcal {line}", f"exit {stop.value.code or 0}"]
    parts += [
        f"--- {name}\n{text.rstrip()}" for name, text in zip(("out", "err"), texts, strict=True) if text
    ]
    return "\n".join(parts) + "\n" + written(line)


def written(line: str) -> str:
    """What a report says without its pictures, and the names in a folder of results."""
    words = line.split()
    if "-o" not in words or words[words.index("-o") + 1] == "-":
        return ""
    path = Path(words[words.index("-o") + 1])
    if path.suffix == ".html" and path.exists():
        page = re.sub(r"<(style|script|svg)\b.*?</\1>", " ", path.read_text(), flags=re.DOTALL)
        page = re.sub(r"</?(code|span)\b[^>]*>", "", page)
        text = re.sub(r"[ \t]*\n\s*", "\n", html.unescape(re.sub(r"<[^>]+>", "\n", page))).strip()
        return f"--- {path}\n{text}\n"
    if path.is_dir():
        return f"--- {path}\n{' '.join(sorted(file.name for file in path.iterdir()))}\n"
    return ""


def normal(text: str) -> str:
    """A transcript without what differs from day to day: dates, versions, hashes; with short rules and gaps."""
    text = FORGETTABLE.sub("...", text)
    text = re.sub(r"─+", "─", text)
    text = re.sub(r"(?<=\S) {3,}", "  ", text)
    text = re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", lambda found: f"[{' '.join(found[1].split())}]", text)
    return "\n".join(line.rstrip() for line in text.splitlines()) + "\n"


def sections(text: str) -> list[list[str]]:
    """The lines of a transcript, command by command."""
    return [part.splitlines() for part in re.split(r"(?m)^(?=\$ )", text) if part]


def compared(was: list[str], now: list[str], zero: float) -> tuple[list[str], list[str]]:
    """What the lines of a command differ in, and its lines anew: of two that are the same, that of before.

    Lines that are new or gone do not make those after them differ.
    """
    words = [[" ".join(NUMBER.sub("#", line).split()) for line in part] for part in (was, now)]
    differences, lines = [], []
    for tag, i, k, j, m in SequenceMatcher(None, *words, autojunk=False).get_opcodes():
        if tag != "equal":
            differences.append(
                "\n".join([was[0], *(f"- {a}" for a in was[i:k]), *(f"+ {b}" for b in now[j:m])])
            )
            lines += now[j:m]
            continue
        for a, b in zip(was[i:k], now[j:m], strict=True):
            alike = same(a, b, math.inf if ",undetermined," in a else zero)
            lines.append(a if alike else b)
            if not alike:
                differences.append(f"{was[0]}\n- {a}\n+ {b}")
    return differences, lines


def same(expected: str, actual: str, zero: float = 1e-12) -> bool:
    """Whether two lines have the same words, and numbers that differ by rounding, or by `zero`, only."""
    if NUMBER.sub("#", expected).split() != NUMBER.sub("#", actual).split():
        return False
    pairs = zip(NUMBER.findall(expected), NUMBER.findall(actual), strict=True)
    return all(a == b or _near(a, b, zero) for a, b in pairs)


def _near(a: str, b: str, zero: float) -> bool:
    x, y = (float(text.replace(",", "")) for text in (a, b))
    unit = min(_unit(a), _unit(b))
    return math.isclose(x, y, rel_tol=RELATIVE, abs_tol=max(zero, 1.01 * unit))


def _unit(text: str) -> float:
    """One unit of the last digit of a number with a decimal point; integers are exact."""
    digits, _, power = text.lower().replace(",", "").partition("e")
    decimals = len(digits.partition(".")[2])
    return 10.0 ** (int(power or 0) - decimals) if "." in digits or power else 0.0


@pytest.mark.parametrize("name", CASES)
def test_commands_print_what_they_printed(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    text = normal("\n".join(transcript(line, monkeypatch) for line in lines(CASES[name])))
    check(name, text)
    assert RENEW or len(sections((GOLDEN / f"{name}.txt").read_text())) == len(lines(CASES[name]))


def check(name: str, text: str) -> None:
    """Compare transcripts with the golden ones, or write them anew."""
    path = GOLDEN / f"{name}.txt"
    before = {part[0]: part for part in sections(path.read_text())} if path.exists() else {}
    differences, lines_anew = [], []
    for now in sections(text):
        was = before.get(now[0], [now[0]])
        # Numbers that the poses do not determine are no contract.
        zero = math.inf if UNDETERMINED.search("\n".join(was)) else ZERO.get(name, 1e-12)
        differ, anew = compared(was, now, zero)
        differences += differ
        lines_anew += anew
    if RENEW:
        path.write_text("\n".join(lines_anew) + "\n")
        return
    assert not differences, f"{path.name}: {len(differences)} differences\n" + "\n".join(differences[:20])


def test_the_comparison_sees_a_word_and_a_number():
    assert same("rms 0.0123 of 24 poses", "rms   0.0124 of 24 poses")
    assert not same("rms 0.0123 of 24 poses", "rms 0.0125 of 24 poses")
    assert not same("rms 0.0123 of 24 poses", "rms 0.0123 of 25 poses")
    assert not same("rms 0.0123 of 24 poses", "rms 0.0123 of 24 attitudes")
    assert same("1.234567890123e-05", "1.234567890124e-05")
    assert not same("1.234567890123e-05", "1.2346e-05")
    assert same("cost 3.1e-25", "cost 1.7e-27")
