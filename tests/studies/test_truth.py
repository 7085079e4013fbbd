"""The study of traps: its own yardsticks, and a small version of its table."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated import DPSO, noise

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import truth, truth_checks, truth_coverage  # noqa: E402
from benchmarks.truth_scenes import Scene, deviations, fault_of, holds, inside, observe, plain_fit, stream  # noqa: E402
from benchmarks.truth_traps import TRAPS  # noqa: E402

G, DRAWS, NOISE = 9.8, 3, 2.0

SURE = ("cap of 20 degrees", "corners only", "turned about one axis", "turned about two axes", "mixed units")
"""Traps that are judged right in every draw."""


def scene(trap, index=0):
    count = trap.counts[0]
    key = stream(1, trap.name, int(1000 * NOISE), count, index)
    return Scene.of(key, NOISE, count, trap.rows or (1, truth.REPEATED)[index % 2])


def honest_result(seed=1):
    output = DPSO.output(G * poses.turns() + noise(24, 2e-3, seed))
    return calibrate(Readings.from_array(output), Settings("levenberg-marquardt", g=G))


def test_the_plain_fit_is_that_of_the_library():
    output = DPSO.output(G * poses.turns() + noise(24, 2e-3, 5))
    result = calibrate(Readings.from_array(output), Settings("levenberg-marquardt", g=G))
    fit = plain_fit(output, G, DPSO)
    # |f| - g and (g^2 - |f|^2) / 2 g differ by the square of the noise
    assert np.abs(fit.K - result.K_a).max() < 0.01 * result.sigma.K_a[0, 0]
    assert np.abs(fit.D - result.D_a).max() < 0.01 * result.sigma.D_a[0]


def test_a_plain_fit_of_nothing_is_far_off():
    trap = next(trap for trap in TRAPS if trap.name == "gravity removed")
    assert fault_of(*trap.make(scene(trap))).shift > 100


def test_wider_intervals_hold_an_honest_truth_and_none_that_is_far():
    result = honest_result()
    assert holds(result, DPSO)
    off = ErrorModel(DPSO.K, DPSO.D + 8 * result.sigma.D_a)
    assert not holds(result, off)
    assert np.nansum(inside(result, off)) <= np.nansum(inside(result, DPSO)) - 3


def test_without_a_fault_nothing_shifts():
    trap = next(trap for trap in TRAPS if trap.name == "clipped in one axis")
    faulty, honest = trap.make(scene(trap))
    assert fault_of(honest, honest).shift == 0
    assert not fault_of(honest, honest).seen
    assert fault_of(faulty, honest).shift > truth.SHIFT


def test_a_draw_does_not_depend_on_its_company():
    trap = next(trap for trap in TRAPS if trap.name == "mixed units")
    assert truth.draws((trap.name, NOISE, 12, range(3), 7))[2] == truth.draw(trap, NOISE, 12, 2, 7)


def test_names_are_those_of_one_row():
    assert len({(trap.name, count) for trap in TRAPS for count in trap.counts}) == sum(
        len(trap.counts) for trap in TRAPS
    )
    assert len({kind.name for kind in truth_coverage.KINDS}) == len(truth_coverage.KINDS)
    for checks in truth_checks.CHECKS.values():
        assert len({check.name for check in checks}) == len(checks)


@pytest.mark.parametrize("trap", TRAPS, ids=lambda trap: f"{trap.name}, {trap.counts[0]}")
def test_an_honest_counterpart_can_be_calibrated_and_is_no_trap(trap):
    faulty, honest = trap.make(scene(trap))
    stated = replace(faulty.settings, robust="none")
    differs = faulty.text != honest.text or stated != honest.settings or faulty.raw != honest.raw
    assert differs or faulty.columns != honest.columns
    outcome = observe(honest)
    assert outcome.result is not None, outcome.said
    error, half, _ = deviations(outcome.result, honest.truth)
    assert np.nanmax(np.abs(error) / half) < 8


@pytest.mark.parametrize("name", SURE)
def test_traps_are_judged_right_and_named(name):
    trap = next(trap for trap in TRAPS if trap.name == name)
    drawn = truth.draws((name, NOISE, trap.counts[0], range(DRAWS), 1))
    mattering = [one for one in drawn if one.matters]
    assert mattering
    assert all(one.right and one.named for one in mattering), mattering
    assert all(one.sound for one in drawn), drawn


def test_the_table_says_what_it_counts(capsys):
    truth.main(["--draws", "1", "--only", "corners", "--jobs", "1"])
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| corners")]
    assert len(rows) == 4
    assert all(row[4].strip() == "1" and row[5].strip() == "100%" for row in rows)


def test_a_table_is_written_into_the_page(tmp_path, capsys):
    page = tmp_path / "trust.md"
    before = (ROOT / "docs/explanation/trust.md").read_text(encoding="utf-8")
    page.write_text(before, encoding="utf-8")
    truth.main(["--draws", "1", "--only", "corners", "--jobs", "1", "--write", str(page)])
    text = page.read_text(encoding="utf-8")
    assert text.count("| corners only |") == 4
    assert "Remarks" not in text
    start, end = before.index("<!-- truth: traps -->"), before.index("<!-- end -->")
    assert text.startswith(before[:start]), "what stands before the table is not the table's"
    assert text.endswith(before[end:]), "nor what stands behind it"
    assert capsys.readouterr().out.count("| corners only |") == 4


def test_the_page_lists_the_invisible_faults():
    assert truth.invisible() in (ROOT / "docs/explanation/trust.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["equal noise, 24 poses", "known attitudes", "temperature, n of 100"])
def test_coverage_of_honest_readings_is_near_its_level(name):
    counts = truth_coverage.count((name, range(40), 1))
    assert counts.withheld <= 0.05
    assert 0.85 < counts.each.mean() <= 1


def test_spoiled_poses_and_unchanged_sensors_are_counted(capsys):
    truth.main(["--robust", "--draws", "2", "--only", "huber, one of 24 times 0", "--jobs", "1"])
    truth.main(["--verify", "--draws", "2", "--only", "equal, 24 then 24", "--jobs", "1"])
    truth.main(["--weights", "--draws", "5", "--only", "sd, n 20", "--jobs", "1"])
    out = capsys.readouterr().out
    assert "| huber, one of 24 times 0 | 2 | 100% | 100% |" in out
    assert "| equal, 24 then 24 | 2 | " in out
    assert "| sd, n 20 | 5 | " in out
