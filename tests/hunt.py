"""The hunt for misread tables: one truth written in a thousand ways reads back as its numbers, or is refused in words.

`python tests/hunt.py 10000` prints the counts and every rendering that was misread.
"""

from __future__ import annotations

import io
import random
import sys
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.errors import AccelcalError
from accelcal_cli.io.readings import read_readings

PREAMBLES = (
    (),
    (),
    (),
    ("Device: LOGGER 7", "Serial Number: AB1234", "Range: 8 g"),
    ("Recorded with Logger 2.1", "Start Time 17:41:40", "Start Date 11/12/2024", "", "Sample rate: 100 Hz"),
    ("Gerät: Messgerät 3", "Temperatur 21 °C"),
    ("-------------",),
)
NAMES = (
    ("ax", "ay", "az"),
    ("Acc_X", "Acc_Y", "Acc_Z"),
    ("accel x", "accel y", "accel z"),
    ("Acceleration x (m/s^2)", "Acceleration y (m/s^2)", "Acceleration z (m/s^2)"),
    ("imu0.ax", "imu0.ay", "imu0.az"),
    ("Beschl. x", "Beschl. y", "Beschl. z"),
    ("linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z"),
)
FORMS = ("%.6f", "%.4f", "%.9g", "%.5e", "%+.6f", "%12.6f")


@dataclass
class Rendering:
    """A table in text form, the numbers that it holds, shape (J, 3), and how it was written."""

    data: bytes
    truth: np.ndarray
    how: dict[str, object] = field(default_factory=dict)


def render(seed: int) -> Rendering:
    """Write twelve to forty poses in some way."""
    draw = random.Random(seed)
    numbers = np.random.default_rng(seed)
    poses = draw.randint(12, 40)
    u = numbers.normal(size=(poses, 3))
    size = draw.choice([1.0, 9.80665, 1000.0, 16384.0])
    output = size * (u / np.linalg.norm(u, axis=1, keepdims=True) + numbers.normal(scale=0.02, size=3))
    comma = draw.random() < 0.35
    separator = draw.choice([";", "\t", "; "] if comma else [",", ";", "\t", " ", ", ", "  "])
    form = draw.choice(FORMS)
    quoted = draw.random() < 0.2 and separator.strip() != ""
    header = draw.random() < 0.85
    named = draw.choice(NAMES)
    if separator.strip() == "" and separator != "\t":
        named = NAMES[draw.choice([0, 1, 4])]
    columns: list[tuple[str, list[str], str]] = []
    truth = np.empty_like(output)
    for k in range(3):
        cells = [
            (form % value).strip() if separator.strip() == "" else form % value for value in output[:, k]
        ]
        truth[:, k] = [float(cell) for cell in cells]
        columns.append((named[k], cells, "m/s^2"))
    if header and draw.random() < 0.2:
        draw.shuffle(columns)
    extras: list[tuple[str, list[str], str]] = []
    if header and draw.random() < 0.4:
        extras += [
            (f"gyro_{a}", [f"{v:.5f}" for v in numbers.normal(scale=0.01, size=poses)], "rad/s")
            for a in "xyz"
        ]
    if header and draw.random() < 0.3:
        extras += [
            (f"mag_{a}", [f"{v:.2f}" for v in numbers.normal(scale=40, size=poses)], "uT") for a in "xyz"
        ]
    front: list[tuple[str, list[str], str]] = []
    if header and draw.random() < 0.5:
        front.append(
            (
                draw.choice(["t", "time", "timestamp", "Time (s)" if separator.strip() else "t"]),
                [f"{0.5 * k:.3f}" for k in range(poses)],
                "s",
            )
        )
    if header and draw.random() < 0.2:
        front.insert(0, (draw.choice(["index", "row"]), [str(k) for k in range(poses)], "-"))
    layout = [*front, *columns, *extras] if draw.random() < 0.8 else [*front, *extras, *columns]
    lines = [[cells[k] for _, cells, _ in layout] for k in range(poses)]
    if comma:
        lines = [[cell.replace(".", ",") for cell in line] for line in lines]
    if quoted:
        lines = [[f'"{cell}"' for cell in line] for line in lines]
    texts = [separator.join(line) for line in lines]
    top: list[str] = []
    preamble: tuple[str, ...] = draw.choice(PREAMBLES)
    comments = draw.random() < 0.2
    top += [f"{draw.choice(['# ', '// ', '% '])}written by hand" for _ in range(comments)]
    top += list(preamble)
    if header:
        names = [f'"{name}"' if quoted else name for name, _, _ in layout]
        top.append(("#" if draw.random() < 0.05 else "") + separator.join(names))
        if draw.random() < 0.2 and all(unit != "-" for _, _, unit in layout):
            top.append(separator.join(unit for _, _, unit in layout))
    if draw.random() < 0.15:
        texts.insert(draw.randint(1, len(texts)), "")
    if draw.random() < 0.1 and separator.strip() in (",", ";"):
        texts = [text + separator.strip() for text in texts]
        if header:
            top[-1] += separator.strip()
    end = draw.choice(["\n", "\n", "\r\n", "\r\n", "\r"])
    text = end.join([*top, *texts]) + (end if draw.random() < 0.8 else "")
    encoding = draw.choice(["utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"])
    how = {
        "separator": separator,
        "comma": comma,
        "form": form,
        "header": header,
        "preamble": preamble,
        "end": end,
        "encoding": encoding,
        "quoted": quoted,
        "names": named,
    }
    return Rendering(text.encode(encoding), truth, how)


def outcome(rendering: Rendering) -> str:
    """Return `equal`, `refused: why`, or `misread`."""
    try:
        found = read_readings("-", stdin=io.BytesIO(rendering.data))
    except AccelcalError as refusal:
        return f"refused: {refusal}"
    output = found.output()
    equal = output.shape == rendering.truth.shape and bool((output == rendering.truth).all())
    return "equal" if equal else "misread"


def hunt(count: int) -> tuple[Counter[str], list[tuple[int, str]]]:
    """Return how many renderings came out how, and those that were not equal."""
    counts: Counter[str] = Counter()
    bad = []
    for seed in range(count):
        said = outcome(render(seed))
        counts[said.split(":")[0]] += 1
        if said != "equal":
            bad.append((seed, said))
    return counts, bad


if __name__ == "__main__":
    counts, bad = hunt(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
    for seed, said in bad:
        print(seed, said)  # noqa: T201
    print(dict(counts))  # noqa: T201
    sys.exit(counts["misread"] > 0)
