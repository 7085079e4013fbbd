"""An output never takes the place of what the command reads."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

READ = "measured.csv"


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (("detect", READ, "-o", READ), "-o"),
        (("detect", READ, "-o", f"./{READ}"), "-o"),
        (("detect", READ, "--plot", "measured.svg"), "--plot"),
        (("calibrate", READ, "-o", "measured.yaml"), "-o"),
        (("calibrate", "other.csv", "--config", "settings.yaml", "-o", "settings.yaml"), "-o"),
        (("calibrate", READ, "--raw", "-o", "measured.yaml"), "-o"),
        (("fleet", READ, "-o", READ), "-o"),
        (("fleet", "other.csv", READ, "-o", READ), "-o"),
        (("export", "settings.yaml", "--to", "px4", "-o", "settings.yaml"), "-o"),
        (("report", "measured.yaml", "-o", "measured.html"), "-o"),
        (("apply", "settings.yaml", READ, "-o", "settings.yaml"), "-o"),
        (("simulate", "--sensor", "settings.yaml", "-o", "settings.yaml"), "-o"),
        (("simulate", "--sensor", "settings.yaml", "--truth", "settings.yaml"), "--truth"),
        (("compare", READ, "--raw", READ), "--raw"),
        (("compare", "--sensor", "settings.yaml", "--plot", "measured.svg"), "--plot"),
        (("benchmark", "--config", "settings.yaml", "--plot", "measured.svg"), "--plot"),
        (("navigate", "--map", READ, "--raw", READ), "--raw"),
        (("navigate", "--voyage", READ, "-o", READ), "-o"),
    ],
)
def test_the_input_is_refused_as_output_before_any_work(run, tmp_path, arguments, option):
    content = b"readings that exist once\n"
    for name in (READ, "settings.yaml", "other.csv"):
        (tmp_path / name).write_bytes(content if name == READ else b"{}\n")
    for link in ("measured.yaml", "measured.html"):
        (tmp_path / link).symlink_to(READ)
    os.link(tmp_path / ("settings.yaml" if "settings.yaml" in arguments else READ), tmp_path / "measured.svg")
    outcome = run(*arguments)
    output = arguments[arguments.index(option) + 1]
    assert outcome.out == ""
    assert outcome.err == f'accelcal: {option} "{output}": is the input itself; expected another name\n'
    assert outcome.code == 2
    assert (tmp_path / READ).read_bytes() == content


def test_standard_input_is_a_file_too(shell, tmp_path):
    (tmp_path / READ).write_text("t,ax,ay,az\n")
    outcome = shell(f"accelcal detect - -o {READ} < {READ}")
    assert outcome.code == 2
    assert outcome.err == f'accelcal: -o "{READ}": is the input itself; expected another name\n'
    assert shell("accelcal simulate -o /dev/null < /dev/null").code == 0


def test_a_shipped_name_is_no_file_and_a_log_may_be_replaced(run, tmp_path):
    for _ in range(2):
        assert run("simulate", "--sensor", "mems", "--positions", "24", "-o", "mems").code == 0
    assert run("calibrate", "mems", "-o", "result.yaml").code == 0
    assert run("apply", "result.yaml", "mems", "-o", "mems").code == 0
    assert Path("mems").read_text("utf-8").startswith("Nx,Ny,Nz,fx,fy,fz\n")
