"""What a terminal shows of a capture: all of it fits, in every width and encoding, and it costs little."""

from __future__ import annotations

import io
import os
import time
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from accelcal_cli.detection.capture import Capture
from accelcal_cli.output import live
from accelcal_cli.output.sphere import attitude, draw_box, draw_map, map_cell
from accelcal_cli.planning import candidates, distinct_poses
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses
from accelcal_cli.views.capture import moment, progress

GOLDEN = Path(__file__).parents[1] / "journeys" / "golden" / "capture-live.txt"
PLANNED = candidates("corners")[distinct_poses(candidates("corners"), 12)]


def stream(count):
    """Readings of poses that are held one after the other, 40 each, m/s^2."""
    noise = 0.01 * Streams(1, [0]).normal(40 * count, 3)[0]
    return 9.8 * np.repeat(PLANNED[:count], 40, axis=0) * [1.02, 0.98, 1.01] + [0.2, -0.1, 0.3] + noise


def captured(readings):
    """A capture after some readings, and its latest status."""
    return _captured(readings.tobytes())


@lru_cache
def _captured(data):
    readings = np.frombuffer(data).reshape(-1, 3)
    capture, status = Capture(PLANNED, window=10, hold=30), None
    for reading in readings:
        status = capture.push(reading)
        if status is not None and status.state == "taken":
            capture.calibrate()
    return capture, status


def shown(capture, status, width, *, height=30, encoding="utf-8"):
    """The lines of a terminal."""
    file = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    out = Console(
        file=file, width=width, height=height, highlight=False, force_terminal=True, color_system=None
    )
    now = None if status is None else moment(capture, status)
    out.print(live.picture(now, progress(capture), out))
    file.flush()
    file.buffer.seek(0)
    return [line.rstrip() for line in file.buffer.read().decode(encoding).splitlines()]


SCENES = {"waiting": 0, "holding": 25, "on the way": 5 * 40 + 20, "calibrated": 11 * 40 + 20}


def test_the_picture_is_what_it_was():
    parts = []
    for width, encoding in ((60, "utf-8"), (80, "utf-8"), (120, "utf-8"), (60, "ascii")):
        for scene, count in SCENES.items():
            lines = shown(*captured(stream(12)[:count]), width, encoding=encoding)
            assert max(map(cell_len, lines)) <= width, (scene, width)
            assert len(lines) <= 23
            parts += [f"$ {scene}, {width} columns, {encoding}", *lines, ""]
    text = "\n".join(parts)
    if os.environ.get("ACCELCAL_GOLDEN") == "renew":
        GOLDEN.write_text(text, encoding="utf-8")
    assert text == GOLDEN.read_text(encoding="utf-8")


@pytest.mark.parametrize("width", [20, 40, 59, 99, 100, 300])
def test_it_fits_any_width(width):
    lines = shown(*captured(stream(10)), width)
    assert max(map(cell_len, lines)) <= width


def test_a_high_terminal_lists_the_poses_below():
    capture, status = captured(stream(3))
    assert sum("up, tilted" in line for line in shown(capture, status, 60)) == 2
    assert sum("up, tilted" in line for line in shown(capture, status, 60, height=40)) == 14


def test_a_warning_of_the_poses_is_shown():
    dead = stream(12)
    dead[:, 2] = 0.5
    capture, status = captured(dead)
    assert any('Column "Nz" is 0.5' in line for line in shown(capture, status, 120))


def test_the_length_is_that_of_the_calibrated_force():
    capture, status = captured(stream(12))
    assert moment(capture, status).length == pytest.approx(1.0, abs=0.003)
    rough = Capture(PLANNED, window=10, hold=30, scale=9.8, centre=np.zeros(3))
    for reading in np.tile([0.0, 4.9, 0.0], (10, 1)):
        status = rough.push(reading)
    assert moment(rough, status).length == pytest.approx(0.5)


def test_the_next_pose_is_the_first_missing_one_that_is_not_held():
    capture, status = captured(stream(4)[:-15])
    assert capture.missing()[0] == 3
    assert (moment(capture, status).held, moment(capture, status).next) == (3, 4)
    capture, status = captured(stream(12)[:-15])  # the last one is held
    assert moment(capture, status).next == 11
    capture, status = captured(stream(12))
    assert (moment(capture, status).next, moment(capture, status).words) == (None, "all poses are taken")


def test_a_terminal_is_drawn_ten_times_a_second_at_most(monkeypatch):
    made = []
    monkeypatch.setattr(live, "moment", lambda *_: made.append(time.monotonic()))
    monkeypatch.setattr(live.sys, "stderr", io.TextIOWrapper(io.BytesIO(), "utf-8"))
    monkeypatch.setattr(live.sys.stderr, "isatty", lambda: True)
    capture, status = captured(stream(1)[:20])
    clock = iter(np.arange(1000) / 200)  # a sensor of 200 readings a second
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    watch = live.Watch(capture, quiet=False)
    for _ in range(400):
        watch.see(status)
    assert 18 <= len(made) <= 21


# The pictures


@pytest.mark.parametrize("direction", [*poses.fixture_directions(), *PLANNED])
def test_a_box_is_held_with_its_direction_up(direction):
    turn = attitude(direction)
    np.testing.assert_allclose(turn @ direction, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)


@pytest.mark.parametrize("face", poses.faces())
def test_the_face_that_is_up_is_named_above_the_others(face):
    axis = int(np.argmax(np.abs(face)))
    up = f"{'+' if face[axis] > 0 else '-'}{'xyz'[axis]}"
    for unicode in (True, False):
        lines = draw_box(tuple(face), unicode=unicode)
        assert next(line for line in lines if any(name in line for name in "xyz")).count(up) == 1
        assert all(line.isascii() for line in lines) is not unicode


def test_the_map_has_the_faces_where_its_edges_say():
    cells = {
        name: map_cell(face)
        for name, face in zip(("+x", "-x", "+y", "-y", "+z", "-z"), poses.faces(), strict=True)
    }
    lines = draw_map([], [], [], None, None, unicode=False)
    foot = lines[9].plain
    for name in ("+x", "-x", "+y", "-y"):
        assert abs(foot.index(name) - 3 - cells[name][1]) <= 1
        assert cells[name][0] == 4
    assert (cells["+z"][0], cells["-z"][0]) == (0, 8)
    assert lines[0].plain.startswith("+z")
    assert lines[8].plain.startswith("-z")


def test_the_map_fills():
    every = poses.fibonacci(200)
    covered = []
    for count in (0, 1, 6, 200):
        lines = draw_map([], every[:count].tolist(), [], None, None, unicode=False)[:9]
        covered.append(sum(line.plain[3:].count(mark) for line in lines for mark in ":#"))
    assert covered == sorted(covered)
    assert (covered[0], covered[-1]) == (0, 9 * 36)
