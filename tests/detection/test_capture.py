"""Guided capture: a stream to poses, and the command over a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hand_held import PLANNED, Device, G, hand, held, text_of
from simulated import MEMS

from accelcal_cli.detection.capture import Capture, fit_rough_sensor
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.readings import read_readings
from accelcal_cli.io.serial import port_lines
from accelcal_cli.sensor import poses

ROOT = Path(__file__).parents[2]


def take(stream, capture):
    """Push a stream; return the states without repetition."""
    states = []
    for reading in stream:
        status = capture.push(reading)
        if status is not None and (not states or states[-1] != status.state):
            states.append(status.state)
    return states


# The rough sensor


def test_the_rough_sensor_of_one_pose_is_centred():
    rough = fit_rough_sensor(np.array([[0.0, 0.0, 5.0]]), None, None)
    np.testing.assert_allclose(rough.centre, 0.0, atol=1e-12)
    assert rough.scale == pytest.approx(5.0)


@pytest.mark.parametrize("bias", [[0, 0, 0], [0.4, -0.8, 0.3], [512, 512, 512]])
def test_the_rough_sensor_finds_the_sphere(bias):
    outputs = 100.0 * PLANNED + np.array(bias)
    rough = fit_rough_sensor(outputs, None, None)
    np.testing.assert_allclose(rough.centre, bias, atol=1.0)
    assert rough.scale == pytest.approx(100.0, rel=0.01)


def test_what_is_stated_is_kept():
    rough = fit_rough_sensor(100.0 * PLANNED + 7.0, 50.0, np.full(3, 7.0))
    assert rough.scale == 50.0
    np.testing.assert_array_equal(rough.centre, [7.0] * 3)
    np.testing.assert_allclose(rough.directions(100.0 * PLANNED + 7.0), PLANNED)


# A stream


def test_every_pose_that_is_held_is_taken_once():
    capture = Capture(PLANNED, window=30, hold=60)
    states = take(hand(held(PLANNED, 4.0)), capture)
    assert states == ["moving", "still", "taken", "again"] * 12
    assert capture.missing() == []
    assert capture.recognised() == list(range(12))


def test_a_pose_is_the_mean_of_its_readings():
    capture = Capture(PLANNED, window=30, hold=80)
    take(hand(PLANNED, sigma=0.02), capture)
    for pose, direction in zip(capture.poses, PLANNED, strict=True):
        assert pose.n == 80
        np.testing.assert_allclose(pose.mean, MEMS.output(G * direction), atol=5 * 0.02 / np.sqrt(80))
        np.testing.assert_allclose(pose.spread, 0.02, rtol=0.4)


def test_any_order_and_any_unit_will_do():
    order = np.array([5, 0, 11, 7, 1, 2, 10, 9, 3, 4, 6, 8])
    capture = Capture(PLANNED, window=30, hold=60)
    take(1634.0 * hand(PLANNED[order]), capture)
    assert capture.recognised() == order.tolist()


@pytest.mark.parametrize(("offset", "stated"), [(512.0, np.full(3, 512.0)), (10.0, None)])
def test_an_offset_is_stated_when_it_is_large(offset, stated):
    """Counts from 0 to 1023 with no acceleration at 512; a tenth of 1 g is found out as the poses come."""
    capture = Capture(PLANNED, window=30, hold=60, centre=stated)
    take(offset + 10.0 * hand(PLANNED), capture)
    assert capture.recognised() == list(range(12))


def test_a_pose_held_again_is_not_taken_again():
    capture = Capture(PLANNED, window=30, hold=60)
    take(hand(PLANNED[[0, 1, 2, 3, 0, 1]]), capture)
    assert capture.recognised() == [0, 1, 2, 3]
    assert capture.missing() == list(range(4, 12))


def test_a_pose_beside_the_plan_is_kept():
    capture = Capture(poses.faces(), window=30, hold=60)
    corner = np.ones(3) / np.sqrt(3)
    take(hand(np.concatenate([poses.faces(), corner[None]])), capture)
    assert capture.recognised() == [0, 1, 2, 3, 4, 5, None]
    assert capture.missing() == []


def test_a_shaking_hand_is_not_still():
    capture = Capture(PLANNED, window=30, hold=60)
    assert take(hand(PLANNED, sigma=0.3), capture) == ["moving"]
    generous = Capture(PLANNED, window=30, hold=60, still=0.5)
    take(hand(PLANNED, sigma=0.3), generous)
    assert generous.missing() == []


def test_a_slow_turn_is_not_a_pose():
    """A degree in 20 readings: each window looks still, the hold does not."""
    angle = np.radians(np.arange(1200) / 20)
    stream = G * np.stack([np.zeros(1200), np.sin(angle), np.cos(angle)], axis=1)
    capture = Capture(PLANNED, window=20, hold=200)
    assert "taken" not in take(stream, capture)


def test_status_says_which_pose_and_how_far():
    capture = Capture(poses.faces(), window=30, hold=60, scale=G, centre=np.zeros(3))
    tilted = np.array([0.0, np.sin(np.radians(8)), np.cos(np.radians(8))])
    status = [capture.push(G * tilted) for _ in range(45)][-1]
    assert status.state == "still"
    assert status.nearest == 4
    assert status.angle == pytest.approx(8.0)
    assert status.progress == pytest.approx(45 / 60)
    assert status.limit == pytest.approx(0.01 * G)


# Over a pseudo-terminal


@pytest.fixture
def device():
    found = Device()
    yield found
    found.unplug()


CONTROL = "import fcntl, os, sys, termios; fcntl.ioctl(2, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
"""Take standard error for the controlling terminal, then become the program of the arguments."""


@pytest.fixture
def start(tmp_path):
    """Start the command as a program; it is ended with the test."""
    pytest.importorskip("serial")
    started = []

    def begin(*arguments, stderr=subprocess.PIPE, terminal=False):
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        environment = {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "error", "TERM": "xterm"}
        command = [sys.executable, "-m", "accelcal_cli", "capture", *arguments]
        streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": stderr}
        if terminal:  # of its own: its standard error, which sends a hangup when it goes
            command = [sys.executable, "-c", CONTROL, *command]
        program = subprocess.Popen(
            command, cwd=tmp_path, env=environment, encoding="utf-8", start_new_session=terminal, **streams
        )
        started.append(program)
        return program

    yield begin
    for program in started:
        if program.poll() is None:
            program.kill()
        program.wait()
        for stream in filter(None, (program.stdout, program.stderr)):
            stream.close()


FAST = ("--columns", "2,3,4", "--rate", "30", "--window", "1", "--hold", "2")


def until(program, word):
    """Read standard error up to a line that begins with a word."""
    for line in program.stderr:
        if line.startswith(word):
            return
    raise AssertionError(f"no line {word!r}")


def test_all_poses_over_a_serial_line(device, start, tmp_path):
    program = start("--port", device.name, *FAST, "-o", "poses.csv")
    until(program, "12 poses to take")
    device.send(text_of(hand(held(PLANNED, 3.0))))
    out, err = program.communicate()
    assert (program.returncode, out) == (0, "")
    assert err.splitlines()[-1] == "accelcal: 12 poses in poses.csv"
    taken = read_readings(tmp_path / "poses.csv")
    assert taken.poses == 12
    assert taken.columns == ("Nx", "Ny", "Nz")
    np.testing.assert_array_equal(taken.count, 60)
    np.testing.assert_allclose(taken.scatter, 0.01, rtol=0.5)
    np.testing.assert_allclose(taken.output(), MEMS.output(G * held(PLANNED, 3.0)), atol=0.02)


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGINT, 130, "interrupted"),
        (signal.SIGHUP, 129, "ended by SIGHUP"),
        (signal.SIGTERM, 143, "ended by SIGTERM"),
    ],
)
def test_poses_are_kept_when_it_is_interrupted(device, start, tmp_path, number, code, said):
    program = start("--port", device.name, *FAST, "-o", "poses.csv")
    until(program, "12 poses to take")
    device.send(text_of(hand(PLANNED[:3])))
    until(program, "pose 3")
    program.send_signal(number)
    _, err = program.communicate()
    assert program.returncode == code
    assert err == f"accelcal: {said}; 3 poses in poses.csv, 9 planned are missing\n"
    assert read_readings(tmp_path / "poses.csv").poses == 3
    assert os.listdir(tmp_path) == ["poses.csv"]


def test_every_pose_is_in_the_file_when_it_is_said_to_be_taken(device, start, tmp_path):
    program = start("--port", device.name, *FAST, "-o", "poses.csv")
    until(program, "12 poses to take")
    device.send(text_of(hand(PLANNED[:3])))
    for number in (1, 2, 3):
        until(program, f"pose {number}")
        assert len((tmp_path / "poses.csv").read_text("utf-8").splitlines()) >= number + 1
    program.kill()
    program.communicate()
    assert len((tmp_path / "poses.csv").read_text("utf-8").splitlines()) == 4
    assert os.listdir(tmp_path) == ["poses.csv"]


def test_a_hangup_that_is_ignored_stays_ignored(device, start, tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        program = start("--port", device.name, *FAST, "-o", "poses.csv")
    finally:
        signal.signal(signal.SIGHUP, before)
    until(program, "12 poses to take")
    program.send_signal(signal.SIGHUP)
    device.send(text_of(hand(PLANNED)))
    program.communicate()
    assert program.returncode == 0


def test_poses_are_kept_when_the_terminal_goes(device, start, tmp_path):
    screen, slave = pty.openpty()
    program = start("--port", device.name, *FAST, "-o", "poses.csv", stderr=slave, terminal=True)
    os.close(slave)
    shown = b""
    while b"waiting for readings" not in shown:
        shown += os.read(screen, 65536)
    device.send(text_of(hand(PLANNED[:3])))
    while shown.count(b"\a") < 3:
        shown += os.read(screen, 65536)
    os.close(screen)
    assert program.wait() == 129
    assert read_readings(tmp_path / "poses.csv").poses == 3


def test_poses_are_kept_when_the_port_is_lost(device, start, tmp_path):
    program = start("--port", device.name, *FAST, "-o", "poses.csv")
    until(program, "12 poses to take")
    device.send(text_of(hand(PLANNED[:4])))
    until(program, "pose 4")
    device.unplug()
    _, err = program.communicate()
    assert program.returncode == 2
    assert err == f"accelcal: {device.name}: the port is gone; 4 poses in poses.csv, 8 planned are missing\n"
    assert read_readings(tmp_path / "poses.csv").poses == 4


def test_a_silent_port_leaves_no_file(device, start, tmp_path):
    program = start("--port", device.name, "--timeout", "0.2", "-o", "poses.csv", "-q")
    _, err = program.communicate()
    assert program.returncode == 2
    assert err == f"accelcal: {device.name}: no data for 0.2 s; no pose was taken, nothing is written\n"
    assert list(tmp_path.iterdir()) == []


def test_a_terminal_shows_it_live_and_rings(device, start):
    screen, slave = pty.openpty()
    program = start("--port", device.name, *FAST, stderr=slave)
    os.close(slave)
    shown = b""
    while b"waiting for readings" not in shown:  # opening a port drops what came before
        shown += os.read(screen, 65536)
    device.send(text_of(hand(PLANNED)))
    with contextlib.suppress(OSError):  # that is how the end of a pseudo-terminal reads
        while chunk := os.read(screen, 65536):
            shown += chunk
    os.close(screen)
    out, _ = program.communicate()
    assert program.returncode == 0
    assert out.startswith("pose,n,Nx,Ny,Nz,sx,sy,sz\n1,60,")
    assert shown.count(b"\a") == 12
    assert b"+x up, tilted 45 degrees towards" in shown
    assert b"go on to another pose" in shown


def test_a_line_without_an_end_is_refused(device):
    pytest.importorskip("serial")
    found = port_lines(device.name, 9600, 5.0)
    device.send(b"\x80" * 10000)
    with pytest.raises(DataError, match=r"bytes without a line end; is --baud 9600 right\?"):
        list(found)


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(UsageError, match="python -m pip install pyserial"):
        port_lines("/dev/ttyUSB0", 9600, 1.0)


def test_a_port_that_is_not_there(tmp_path):
    pytest.importorskip("serial")
    with pytest.raises(DataError, match=r"tty0: cannot be opened: .*no such file"):
        port_lines(str(tmp_path / "tty0"), 9600, 1.0)
