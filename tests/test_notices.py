"""Notices: their sentences, and that every remedy that is a command runs."""

from __future__ import annotations

import ast
import itertools
import re
import shlex
from pathlib import Path

import numpy as np
import typer
from simulated import DPSO, noise, readings

from accelcal_cli import notices
from accelcal_cli.calibration import assess
from accelcal_cli.calibration.apply import ColumnOptions, Correction
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import OLD_RULE
from accelcal_cli.calibration.settings import Nominal, Settings
from accelcal_cli.cli.main import app
from accelcal_cli.detection.intervals import Intervals
from accelcal_cli.detection.log_screening import Liveliness, alternating
from accelcal_cli.io.readings import Readings
from accelcal_cli.io.rows import zero_rows
from accelcal_cli.io.screening import NOTHING, Screened
from accelcal_cli.notices import COMMAND, Notice, are_serious, in_one
from accelcal_cli.sensor import poses

KEYS = {
    *("log", "several-sensors", "duplicate-rows", "zero-rows", "frozen", "clipped", "gravity-removed"),
    *("never-moved", "wrong-gravity", "outliers", "large-misalignment", "residuals", "noise-bias", "tremor"),
    *("correlated", "unequal-noise", "few-attitudes", "box", "thousands", "dead-axis", "unfinished-search"),
    *("perpendicular", "negative-axes", "legacy", "unit", "suspect-result", "quantised", "drift"),
}
"""Those that programs may rely on."""

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
G, TURNS = 9.8, poses.turns()


def _calibrated(output, **settings):
    return calibrate(Readings.from_array(output), Settings(**{"g": G, **settings})).warnings


def _rows(tremor=0.0, poses_=TURNS, count=200):
    """Readings of a hand that trembles, rad, with noise of 10 mm/s^2, shape (J, count, 3)."""
    u = np.repeat(poses_[:, None], count, axis=1)
    u = u + np.cross(tremor * noise(u[..., 0].size, 1.0, 3).reshape(u.shape), u)
    force = G * u / np.linalg.norm(u, axis=2, keepdims=True)
    return DPSO.output(force + noise(u[..., 0].size, 0.01, 4).reshape(u.shape))


def _means(rows):
    """Return the readings of poses with the covariance of their rows."""
    off = rows - rows.mean(axis=1, keepdims=True)
    S = off.swapaxes(1, 2) @ off / (rows.shape[1] - 1)
    return Readings.from_array(
        rows.mean(axis=1),
        count=np.full(len(rows), rows.shape[1]),
        scatter=np.sqrt(np.einsum("jii->ji", S)),
        cross=np.stack([S[:, 0, 1], S[:, 0, 2], S[:, 1, 2]], axis=1),
    )


def _creeping(count, part=0.95):
    """Noise whose rows follow each other, shape (count, 3)."""
    rows = noise(count, np.sqrt(1 - part**2), 5)
    for k in range(1, count):
        rows[k] += part * rows[k - 1]
    return rows


def _screened():
    """What the screening of poses says."""

    def of(rows, source="<array>", **more):
        return Screened(
            rows, ("ax", "ay", "az"), len(rows), lambda k: f"pose {k + 1}", source, **more
        ).notices()

    fine = DPSO.output(G * poses.directions(24, "fibonacci", np.empty((0, 3))) + noise(24, 1e-3, 1))
    dead = np.column_stack([fine[:, 0], fine[:, 0], np.full(24, 7.0)])
    turning = DPSO.output(G * np.vstack([np.linspace(a, b, 30) for a, b in itertools.pairwise(TURNS)]))
    scatter = np.full((24, 3), 5e3)
    scatter[3] = 0.0
    alone = np.full((24, 3), 5e3)
    alone[:8, 1] = 0.0
    coarse = np.round(DPSO.output(G * np.tile(TURNS, (4, 1)) + noise(96, 0.01, 2)) / 2e5) * 2e5
    other = np.where(np.arange(24)[:, None] % 2, fine * [1.02, 0.98, 1.01] + 2e5, fine)
    count = np.full(24, 50.0)
    return [
        *(n for source in ("my log.csv", "<stdin>", "<array>") for n in of(turning, source, timed=True)),
        *of(np.repeat(DPSO.output(G * TURNS), 60, axis=0) + noise(1440, 1e3, 3)),
        *of(dead),
        *of(np.repeat(fine, 2, axis=0)),
        *of(coarse),
        *of(fine[:1] + noise(24, 1e3, 6)),
        *of(noise(24, 1e5, 7)),
        *of(np.clip(DPSO.output(G * TURNS), -5.4e6, 5.4e6)),
        *of(fine, scatter=scatter, count=count),
        *of(fine, scatter=alone, count=count),
        *of(fine, scatter=np.full((24, 3), 5e3) * [1, 1, 4], count=np.geomspace(10, 1000, 24)),
        *of(coarse, scatter=np.zeros((96, 3)), count=np.full(96, 9.0), behind=NOTHING.and_also(coarse, 96)),
        *of(other),
        *zero_rows(2, "line 3", 20),
        *zero_rows(30, "line 3", 20),
    ]


def _screened_log():
    """What the screening of logs says."""
    low, high = np.full(3, -8192.0), np.full(3, 8191.0)
    lively = Liveliness(np.ones(3, dtype=bool), 9, ((1, 90),), low, high)
    n = np.array([100])
    intervals = Intervals(n, n + 99, n, np.array([[8191.0, 0, 0]]), np.full((1, 3), 2.0))
    rows = np.where(np.arange(400)[:, None] % 2, 5.0, -5.0) + noise(400, 0.1, 8)
    return [*lively.notices(10), *lively.clipped(intervals, ("ax", "ay", "az")), *alternating(rows, None)]


def _all():
    """Every notice that the readers and a calibration have, made by what makes them."""
    u = G * TURNS
    known = Readings.from_array(DPSO.output(u + noise(24, 1e-3, 2)), reference=-u)
    stopped = Settings(g=G, runs=3, polish=False, parameters={"iterations": 1})
    faces = np.repeat(np.vstack([np.eye(3), -np.eye(3)]), 2, axis=0)
    wrong = DPSO.output(u + noise(24, 1e-3, 1))
    wrong[[3, 9]] *= [[1.6], [1.5]]
    two = _rows()
    two[:, ::2] += 2e5
    lying = Readings.from_array(DPSO.output(u), labels=[_label(v, k) for k, v in enumerate(TURNS)])
    return [
        *_screened(),
        *_screened_log(),
        *(n for loss in ("plain", "robust", "known") for n in assess.not_fitting(["line 2"], 15, loss)),
        *assess.large_residuals(1.0, G, 100),
        *(n for freedom in (3, 15) for n in assess.more_than_noise(9.0, 1e-9, freedom)),
        *assess.odd_gravity(98.0),
        assess.PERPENDICULAR,
        assess.WALLED,
        OLD_RULE,
        *_of_another_unit(),
        *calibrate(known, Settings(g=G, attitudes="known")).warnings,
        *calibrate(readings(TURNS, sigma=1e-3), stopped).warnings,
        *calibrate(lying, Settings(g=G)).warnings,
        *calibrate(_means(_rows(0.02)), Settings(g=G, weights="auto")).warnings,
        *calibrate(_means(_rows(0.1)), Settings(g=G, weights="auto")).warnings,
        *calibrate(_means(two), Settings(g=G, weights="auto")).warnings,
        *calibrate(_warming(), Settings(g=G)).warnings,
        *_calibrated(DPSO.output(G * faces + noise(12, 1e-3, 1))),
        *_calibrated(wrong),
        *_calibrated(DPSO.output(1.01 * u + noise(24, 1e-3, 1)), nominal=Nominal(scale=(5.67e5,) * 3)),
        *_calibrated(DPSO.output(np.tile(u, (500, 1)) + noise(12_000, 0.3, 1))),
        *_calibrated(DPSO.output(np.repeat(u, 100, axis=0) + 0.05 * _creeping(2400))),
    ]


def _warming():
    """Return readings whose temperature goes with their attitudes."""
    u = poses.directions(14, "fibonacci", np.empty((0, 3)))
    return Readings.from_array(DPSO.output(G * u + noise(14, 1e-4, 2)), temperature=np.linspace(15, 45, 14))


def _of_another_unit():
    """What is said of readings that come out as 10 g."""
    correction = Correction(calibrate(readings(TURNS, sigma=1e-3), Settings(g=G)), ColumnOptions())
    correction(10 * DPSO.output(G * TURNS))
    return correction.warnings()


def _label(direction, number):
    """Say the opposite of the axis that points up."""
    axis = int(np.abs(direction).argmax())
    return f"{'xyz'[axis]} {'down' if direction[axis] > 0 else 'up'} {number}"


def _made():
    """Return key and severity of every notice that the code makes, where both are stated."""
    for path in (Path(notices.__file__).parent).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Notice":
                stated = [getattr(argument, "value", None) for argument in node.args[:2]]
                if stated and all(isinstance(word, str) for word in stated):
                    yield tuple(stated)


ELSEWHERE = {
    *(("correlated", "warning"), ("suspect-result", "note")),
    *(("nis", "warning"), ("fix", "warning"), ("disturbed", "note"), ("gap", "note")),
}
"""Made by groups of rows that are fewer than few attitudes, and by verify, whose own test has it; and of recorded
voyages, which are no calibrations: tests/navigation has them."""


def test_a_notice_is_its_sentence_and_what_to_do():
    notice = Notice("log", "warning", "A log.", f"{COMMAND}calibrate data.csv --raw")
    assert str(notice) == "A log. Run: accelcal calibrate data.csv --raw"
    assert in_one([notice, Notice("box", "note", "A box.")]) == f"{notice} A box."
    assert are_serious([notice])
    assert not are_serious([Notice("box", "note", "A box.")])


def test_every_remedy_is_an_action_or_a_command_that_runs():
    """Its command and its options exist; the file it names is the one that was read."""
    group = typer.main.get_command(app)
    calibrate_options = {
        o for p in group.get_command(None, "calibrate").params for o in (*p.opts, *p.secondary_opts)
    }
    seen = _all()
    assert set(_made()) - ELSEWHERE <= {(notice.key, notice.severity) for notice in seen}
    for notice in seen:
        assert notice.key in KEYS
        assert notice.remedy or notice.severity == "note", notice
        assert set(OPTION.findall(notice.remedy)) <= calibrate_options, notice
        if notice.remedy.startswith(COMMAND):
            name, *words = shlex.split(notice.remedy)[1:]
            command = group.get_command(None, name)
            assert command is not None, notice
            command.make_context(name, words)
        elif notice.remedy:
            assert notice.remedy.endswith("."), notice


def test_every_key_is_documented():
    page = (Path(__file__).parent.parent / "docs/reference/result-file.md").read_text(encoding="utf-8")
    table = page.split("Keys of warnings")[1].split("\n\n")[1]
    assert set(re.findall(r"^\| `([a-z-]+)`", table, re.M)) == KEYS
