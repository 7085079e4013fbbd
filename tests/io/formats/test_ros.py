"""Bags of ROS 1 and 2, in all storages, alone and in their folders."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from native_logs import write_bag

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.formats import base
from accelcal_cli.io.reader import ReadOptions, Selection, open_table

pytest.importorskip("rosbags")

FORMS = ("rosbag1", "rosbag2", "mcap")
TIMES = np.arange(300) / 100
FORCE = np.random.default_rng(4).normal(size=(300, 3))


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    return {form: write_bag(folder / f"{form}.bag", {"/imu": (TIMES, FORCE)}, form) for form in FORMS}


def read(source: object, **options: object):
    table = (
        open_table("-", source, options=ReadOptions(**options))
        if isinstance(source, io.BytesIO)
        else open_table(source, options=ReadOptions(**options))
    )
    assert table.names == ("time", "ax", "ay", "az", "gx", "gy", "gz")
    rows = np.concatenate([b.numbers for b in table.blocks(Selection(tuple(range(7))))])
    notes, form, sha256 = table.notes, table.source_format, table.sha256
    table.close()
    return rows, notes, form, sha256


@pytest.mark.parametrize("form", FORMS)
def test_a_bag_is_read_from_disk_from_standard_input_and_under_another_name(bags, form, tmp_path):
    data = bags[form].read_bytes()
    other = tmp_path / "other.log"
    other.write_bytes(data)
    for source in (bags[form], io.BytesIO(data), other):
        rows, notes, found, sha256 = read(source)
        np.testing.assert_array_equal(rows[:, 1:4], FORCE)
        np.testing.assert_array_equal(rows[:, 4:], np.tile([0.01, 0.02, 0.03], (300, 1)))
        np.testing.assert_allclose(rows[:, 0], TIMES, atol=1e-9)
        assert (found, notes) == (form, ("/imu taken",))
        import hashlib

        assert sha256 == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("form", FORMS[1:])
def test_the_folder_of_a_bag_is_one_input(bags, form):
    rows, _, found, sha256 = read(bags[form].parent)
    np.testing.assert_array_equal(rows[:, 1:4], FORCE)
    assert found == form
    assert sha256 == read(bags[form])[3]


@pytest.mark.parametrize("form", FORMS)
def test_a_topic_is_chosen(tmp_path, form):
    path = write_bag(tmp_path / "two", {"/imu": (TIMES, FORCE), "/rear/imu": (TIMES, FORCE + 1)}, form)
    path = shutil.copy(path, tmp_path / "two.bag") if form == "rosbag1" else path
    with pytest.raises(
        DataError, match=r"several accelerometers \(/imu, /rear/imu\); .*--accelerometer '/imu'"
    ):
        read(path)
    rows, notes, *_ = read(path, accelerometer="/rear/imu")
    np.testing.assert_array_equal(rows[:, 1:4], FORCE + 1)
    assert notes == ("/rear/imu taken; --accelerometer takes /imu",)


@pytest.mark.parametrize("form", FORMS)
def test_time_is_that_of_the_recording_where_there_are_no_stamps(tmp_path, form):
    path = write_bag(tmp_path / "b", {"/imu": (TIMES, FORCE)}, form, stamped=False, frame="odd")
    rows, notes, *_ = read(path)
    np.testing.assert_allclose(rows[:, 0], TIMES, atol=1e-9)
    np.testing.assert_array_equal(rows[:, 1:4], FORCE)
    assert notes[1] == "its messages have no stamps: time is that of the recording"


def test_the_extra_is_named_where_it_is_missing(bags, monkeypatch):
    monkeypatch.setattr(base, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"is a ROS 1 bag; .* extra ros: python -m pip install rosbags"):
        read(bags["rosbag1"])


def test_a_folder_without_a_bag_is_refused(tmp_path: Path):
    (tmp_path / "metadata.yaml").write_text("x: 1")
    with pytest.raises(DataError, match=r"is a folder of ROS 2 without a .db3 or .mcap file"):
        open_table(tmp_path)
