"""Files written whole or not at all, whatever their name stands for."""

from __future__ import annotations

import os

import pytest

from accelcal_cli.errors import OutputError
from accelcal_cli.output.files import check_target, is_stream, whole_file, whole_folder


def write(path, text):
    with whole_file(str(path)) as file:
        file.write(text)


@pytest.mark.parametrize("there", [True, False])
def test_a_symbolic_link_stays_and_its_file_is_replaced(tmp_path, there):
    (tmp_path / "real").mkdir()
    target, link = tmp_path / "real" / "result.yaml", tmp_path / "link.yaml"
    if there:
        target.write_text("old")
    link.symlink_to("real/result.yaml")
    write(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert os.listdir(tmp_path / "real") == ["result.yaml"]


def test_a_link_to_a_folder_stays_when_the_folder_is_filled(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with whole_folder(str(tmp_path / "link")) as made:
        (made / "a.yaml").write_text("a")
    assert (tmp_path / "link").is_symlink()
    assert os.listdir(tmp_path / "real") == ["a.yaml"]


@pytest.mark.parametrize("name", ["link", "x" * 300])
def test_a_ring_of_links_and_a_name_too_long_are_refused_before_any_work(tmp_path, name):
    (tmp_path / "link").symlink_to("link")
    with pytest.raises(OutputError, match=r"cannot be written: (too many levels|file name too long)"):
        check_target(str(tmp_path / name))
    assert os.listdir(tmp_path) == ["link"]


def test_any_name_that_a_file_can_have_will_do(tmp_path):
    name = "x" * 250 + ".yaml"
    write(tmp_path / name, "new")
    assert os.listdir(tmp_path) == [name]


def test_what_is_open_already_is_written_where_it_is(tmp_path):
    log = tmp_path / "log"
    log.write_text("before\n")
    with log.open("a") as file:
        name = f"/dev/fd/{file.fileno()}"
        if not os.path.exists(name):
            pytest.skip("needs /dev/fd")
        (tmp_path / "link").symlink_to(name)
        assert is_stream(name)
        write(name, "one\n")
        write(tmp_path / "link", "two\n")
        file.write("after\n")
    assert log.read_text() == "before\none\ntwo\nafter\n"
    assert sorted(os.listdir(tmp_path)) == ["link", "log"]


def test_a_descriptor_that_is_not_open_is_refused():
    with pytest.raises(OutputError, match="cannot be written: bad file descriptor"):
        check_target("/dev/fd/987")


def test_a_device_is_written_whoever_owns_its_folder(monkeypatch):
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) != "/dev" and allowed(path, mode))
    write("/dev/null", "nothing")
