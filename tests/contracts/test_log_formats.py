"""What every native log format keeps: found by content, damage told in a line, a simulated log comes back.

WRITERS write a file of a format: times, s, shape (n,), and acceleration, m/s^2, shape (n, 3). A format without one is
held to what needs no file.
"""

from __future__ import annotations

import inspect
import io
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from native_logs import write_arrow, write_bag, write_flash, write_ulg
from raw_logs import G, simulated

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.detection.detect import DetectSettings, detect
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.errors import AccelcalError
from accelcal_cli.io.formats.base import LOG_FORMATS, LogFormat
from accelcal_cli.io.reader import Selection, open_table
from accelcal_cli.io.stream import find_native

Writer = Callable[[Path, Float, Float], Path]

WRITERS: dict[str, Writer] = {
    "ardupilot": lambda path, times, force: write_flash(path, {0: (times, force)}),
    "arrow": write_arrow,
    "arrow stream": lambda path, times, force: write_arrow(path, times, force, stream=True),
    "mcap": lambda path, times, force: write_bag(path, {"/imu": (times, force)}, "mcap"),
    "rosbag1": lambda path, times, force: write_bag(path, {"/imu": (times, force)}, "rosbag1"),
    "rosbag2": lambda path, times, force: write_bag(path, {"/imu": (times, force)}, "rosbag2"),
    "ulg": lambda path, times, force: write_ulg(path, {("sensor_combined", 0): (times, force)}),
}
NEEDED = dict.fromkeys(("mcap", "rosbag1", "rosbag2"), "rosbags")
"""Packages that a format cannot be written or read without."""

FORCE = np.random.default_rng(8).normal(size=(1200, 3)).astype(np.float32).astype(float)
TIMES = np.arange(1200) / 100
STEP = 1000
PER_UNIT = 1670.0
"""Output units of the simulated sensor for 1 m/s^2."""


def needs(name: str) -> None:
    if name not in WRITERS:
        pytest.skip(f"no writer of {name}")
    if name in NEEDED and find_spec(NEEDED[name]) is None:
        pytest.skip(f"{NEEDED[name]} is not installed")


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Callable[[str], bytes]:
    """A function that returns the bytes of a file of a format."""
    files: dict[str, bytes] = {}

    def write(name: str) -> bytes:
        needs(name)
        if name not in files:
            files[name] = WRITERS[name](tmp_path_factory.mktemp("log") / "log", TIMES, FORCE).read_bytes()
        return files[name]

    return write


def read(data: bytes) -> tuple[Float, tuple[str, ...]]:
    """Return time, if there is one, and acceleration of a log, and what is said of it."""
    table = open_table("-", io.BytesIO(data))
    try:
        at = (table.names or ()).index("ax")
        blocks = [rows.numbers for rows in table.blocks(Selection((at, at + 1, at + 2)))]
        return np.concatenate([np.empty((0, 3)), *blocks]), table.notes
    finally:
        table.close()


@pytest.mark.parametrize("name", LOG_FORMATS.names())
def test_a_format_says_what_it_is(name: str) -> None:
    cls = LOG_FORMATS.get(name)
    assert issubclass(cls, LogFormat)
    assert not inspect.isabstract(cls)
    assert cls.title.startswith(("a ", "an "))
    assert all(
        not cls.recognises(head) for head in (b"", b"\0", b"ax,ay,az\n1,2,3\n", b"\0" * 100_000, b"\xff" * 4)
    )


@pytest.mark.parametrize("name", sorted({*LOG_FORMATS.names(), *WRITERS} - {"arrow", "arrow stream"}))
def test_it_is_found_by_its_content_alone(written, name: str) -> None:
    data = written(name)
    assert find_native(data[: 1 << 20]) is LOG_FORMATS.get(name)
    assert [other for other in LOG_FORMATS.names() if LOG_FORMATS.get(other).recognises(data)] == [name]


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_its_numbers_come_back(written, name: str, tmp_path: Path) -> None:
    rows, notes = read(written(name))
    np.testing.assert_array_equal(rows, FORCE)
    assert not any("damaged" in note or "cut" in note for note in notes)
    path = tmp_path / "log.txt"
    path.write_bytes(written(name))
    log = open_raw_log(path)
    assert sum(map(len, log.blocks())) == len(FORCE)
    assert log.clock.rate == pytest.approx(100, rel=1e-3)
    assert log.form.source_format == name.split()[0]
    log.close()


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_a_file_that_is_cut_is_a_line_or_its_first_rows_with_a_note(written, name: str) -> None:
    data, faults = written(name), []
    for size in range(STEP, len(data), max(STEP, len(data) // 80 // STEP * STEP)):
        try:
            rows, notes = read(data[:size])
        except AccelcalError as error:
            faults.append(str(error))
            continue
        np.testing.assert_array_equal(rows, FORCE[: len(rows)])
        if len(rows) < len(FORCE) and not is_told(notes):  # cut between two messages, which nothing can tell
            assert is_told(read(data[: size + 1])[1])
    assert all(len(fault.splitlines()) == 1 for fault in faults)


def is_told(notes: tuple[str, ...]) -> bool:
    return any("cut" in note or "damaged" in note for note in notes)


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_a_flipped_byte_is_a_line_or_rows(written, name: str) -> None:
    data, faults = written(name), []
    for at in range(STEP // 2, len(data), max(STEP, len(data) // 80 // STEP * STEP)):
        damaged = bytearray(data)
        damaged[at] ^= 0xFF
        try:
            rows, _ = read(bytes(damaged))
        except AccelcalError as error:
            faults.append(str(error))
            continue
        assert len(rows) <= len(FORCE)
    assert all(len(fault.splitlines()) == 1 for fault in faults)


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_a_simulated_calibration_comes_back(name: str, tmp_path: Path) -> None:
    needs(name)
    numbers, _ = simulated(gyro=False)
    force = (numbers[:, :3] / PER_UNIT).astype(np.float32).astype(float)
    text = tmp_path / "log.csv"
    np.savetxt(
        text,
        np.column_stack([numbers[:, 3], force]),
        delimiter=",",
        header="t,ax,ay,az",
        comments="",
        fmt="%.9g",
    )
    native = WRITERS[name](tmp_path / "log", numbers[:, 3], force)
    ours, theirs = (calibrated(path) for path in (native, text))
    assert ours.data["source_format"] == name.split()[0]
    assert ours.verdict == theirs.verdict
    np.testing.assert_allclose(ours.K_a, theirs.K_a, rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours.D_a, theirs.D_a, rtol=0, atol=1e-5)


def calibrated(path: Path):
    log = open_raw_log(path, gyro=["none"])
    try:
        return calibrate(
            detect(log, DetectSettings(g=G)).readings(), Settings(g=G, optimizer="levenberg-marquardt")
        )
    finally:
        log.close()


def test_text_imports_no_format() -> None:
    modules = {name: module for name, module in sys.modules.items() if ".io.formats" in name}
    for name in modules:
        del sys.modules[name]
    try:
        read(b"ax,ay,az\n0,0,1\n0,1,0\n")
        assert [name for name in sys.modules if ".io.formats" in name] == []
    finally:
        sys.modules.update(modules)
