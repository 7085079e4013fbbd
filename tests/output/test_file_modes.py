"""Who may read a file that was written: as before where it was replaced, as the umask says where it is new."""

from __future__ import annotations

import os
import stat

import pytest

from accelcal_cli.output.files import whole_file, whole_folder


@pytest.fixture(params=[0o022, 0o027, 0o077])
def mask(request):
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def mode(path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_new_file_and_a_new_folder_follow_the_umask(tmp_path, mask):
    with whole_file(str(tmp_path / "new.txt")) as file:
        file.write("1")
    with whole_folder(str(tmp_path / "folder")) as folder:
        (folder / "inside.txt").write_text("1")
    assert mode(tmp_path / "new.txt") == 0o666 & ~mask
    assert mode(tmp_path / "folder") == 0o777 & ~mask


@pytest.mark.parametrize("kept", [0o600, 0o640, 0o664, 0o755])
def test_a_replaced_file_keeps_its_mode(tmp_path, mask, kept):
    target = tmp_path / "old.txt"
    target.write_text("0")
    target.chmod(kept)
    with whole_file(str(target)) as file:
        file.write("1")
    assert target.read_text() == "1"
    assert mode(target) == kept
