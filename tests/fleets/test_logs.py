"""Raw logs of many sensors: blocks of logs are what each log is by itself, however it is read and by whom."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from accelcal_cli.calibration.settings import Settings
from accelcal_cli.fleets import logs
from accelcal_cli.fleets.blocks import Gravity, Work
from accelcal_cli.fleets.logs import LogForm, supply_logs
from accelcal_cli.fleets.run import Finished, Whole, execute, run_blocks
from accelcal_cli.output.machine import write_log
from accelcal_cli.sensor.poses import fibonacci
from accelcal_cli.sensor.simulation import Handling, load_sensor, simulate_log

GRAVITY = Gravity({"g": 9.80665, "latitude": None, "height": None}, 9.80665)
WORK = Work(Settings(optimizer="levenberg-marquardt", weights="auto"), GRAVITY)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> list[str]:
    """Three logs of 14 poses, and one that is broken."""
    folder: Path = tmp_path_factory.mktemp("logs")
    handling = Handling(rate=50.0, hold=3.0, move=1.0)
    for k in range(3):
        with (folder / f"log{k}.csv").open("w") as file:
            write_log(
                simulate_log(load_sensor("mems"), fibonacci(14), 9.80665, handling, 0.02, k), False, file
            )
    text = (folder / "log1.csv").read_text()
    (folder / "log1b.csv").write_text(text[:3000] + "\nnothing,at,all\n" + text[3000:])
    return sorted(str(path) for path in folder.iterdir())


def calibrated(files: list[str]) -> Whole:
    finished = Finished()
    run_blocks(supply_logs(files, LogForm(), GRAVITY), WORK, finished)
    return Whole(finished, WORK)


def test_logs_in_one_block_and_read_by_polars_are_the_same(files, monkeypatch):
    apart = calibrated(files)
    monkeypatch.setattr(logs, "BLOCKS", 1)
    monkeypatch.setattr(logs, "MANY", 1)
    together = calibrated(files)
    assert (len(apart.numbers), len(together.numbers)) == (4, 1)
    (whole,) = together.fleets()
    assert whole.verdict.tolist()[2] == "failed"
    assert whole.labels.tolist() == ["log0", "log1", "log1b", "log2"]
    for at, part in enumerate(apart.fleets()):
        for name in ("K_a", "D_a", "sigma_k", "s"):
            np.testing.assert_array_equal(getattr(part, name)[0], getattr(whole, name)[at])
        assert part.reason[0] == whole.reason[at]
    assert together.notes == apart.notes


def test_a_worker_without_the_logs_gets_their_poses(files):
    (_, block), *_ = supply_logs(files, LogForm(), GRAVITY).blocks(frozenset())
    own, sent = execute(block, WORK), block.loaded().calibrate(WORK)
    np.testing.assert_array_equal(own.fleet.K_a, sent.fleet.K_a)
    assert own.notes == sent.notes
