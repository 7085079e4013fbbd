"""Notices: their sentences, and that every remedy that is a command runs."""

from __future__ import annotations

import re
import shlex

import numpy as np
import typer
from simulated import DPSO, noise, readings

from accelcal_cli.calibration import assess
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.cli.main import app
from accelcal_cli.io.readings import Readings, doubts, log_warnings
from accelcal_cli.notices import COMMAND, Notice, are_serious, in_one
from accelcal_cli.sensor import poses

KEYS = {
    *("log", "several-sensors", "duplicate-rows", "zero-rows", "frozen", "clipped", "gravity-removed"),
    *("never-moved", "wrong-gravity", "outliers", "large-misalignment", "residuals", "noise-bias", "tremor"),
    *("correlated", "unequal-noise", "few-attitudes", "box", "thousands", "dead-axis", "unfinished-search"),
    *("perpendicular", "negative-axes", "legacy"),
}
"""Those that programs may rely on."""

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
G = 9.8


def _all():
    """Every notice that the readers and a calibration have, made by what makes them."""
    dead = DPSO.output(G * poses.turns())
    dead[:, 1] = dead[:, 0]
    dead[:, 2] = 7.0
    creep = np.cumsum(noise(600, 1e-3, 1), axis=0)
    logs = [
        notice
        for source in ("my log.csv", "<stdin>", "<array>")
        for notice in log_warnings(600, creep, 1e3, source, timed=True)
    ]
    u = G * poses.turns() + noise(24, 1e-3, 2)
    known = Readings.from_array(DPSO.output(u), reference=-G * poses.turns())
    stopped = Settings(g=G, polish=False, parameters={"iterations": 1})
    return [
        *logs,
        *doubts(np.repeat(dead, 2, axis=0), ("ax", "ay", "az")),
        *(n for loss in ("plain", "robust", "known") for n in assess.not_fitting(["line 2"], 15, loss)),
        *assess.large_residuals(1.0, G, 100),
        *assess.more_than_noise(9.0, 1e-9),
        *assess.odd_gravity(98.0),
        assess.PERPENDICULAR,
        assess.WALLED,
        *calibrate(known, Settings(g=G, attitudes="known")).warnings,
        *calibrate(readings(poses.turns(), sigma=1e-3), stopped).warnings,
        *calibrate(readings(np.tile(poses.turns(), (500, 1)), sigma=1.0), Settings(g=G)).warnings,
    ]


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
    assert {"log", "dead-axis", "duplicate-rows", "outliers", "residuals"} < {notice.key for notice in seen}
    for notice in seen:
        assert notice.key in KEYS
        assert notice.remedy, notice
        assert set(OPTION.findall(notice.remedy)) <= calibrate_options, notice
        if notice.remedy.startswith(COMMAND):
            name, *words = shlex.split(notice.remedy)[1:]
            command = group.get_command(None, name)
            assert command is not None, notice
            command.make_context(name, words)
        else:
            assert notice.remedy.endswith("."), notice
