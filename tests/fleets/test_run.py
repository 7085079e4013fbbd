"""A fleet in blocks: the same bytes whatever the workers, whoever is killed, whatever the order of the rows."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
from pathlib import Path

import numpy as np
import polars
import pytest
from programs import group, program, until

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.fleet import calibrate_fleet, standouts
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import DataError
from accelcal_cli.fleets import blocks
from accelcal_cli.fleets.blocks import Gravity, TableBlock, Work, supply
from accelcal_cli.fleets.run import Finished, Whole, execute, identity_of, run_blocks
from accelcal_cli.io import batches as reading
from accelcal_cli.io.fleet import read_fleet
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.simulation import load_sensor, simulate_fleet
from accelcal_cli.views.fleet import blocks as summary

G = 9.80665
WORK = Work(Settings(optimizer="levenberg-marquardt"), Gravity({"g": G, "latitude": None, "height": None}, G))
SENSORS = 60
PART = 60
"""Poses of a block in these tests: five sensors or six."""

LAUNCH = (
    f"import accelcal_cli.io.batches as f; f.PART = {PART}; from accelcal_cli.__main__ import main; main()"
)
"""The command line with such blocks."""

WHERE = ("outlying_poses", "warnings", "reason")
"""Columns that name rows."""


def table(order: np.ndarray | None = None, sensors: int = SENSORS, ragged: int = 1) -> polars.DataFrame:
    """Readings of sensors of `ragged` numbers of poses; in the order of these rows, each sensor's in its own."""
    device = load_sensor("mems")
    directions = np.concatenate([poses.edges(), poses.faces()])
    drawn = simulate_fleet(device, sensors, directions, G, 1, device.noise, 3)
    output = [readings.output[: 12 + k % ragged] for k, (_, readings) in enumerate(drawn)]
    labels = np.repeat([f"S{k:03}" for k in range(sensors)], [len(rows) for rows in output])
    if order is not None:
        shuffled = labels[order]
        places = np.argsort(np.argsort(shuffled, kind="stable"), kind="stable")
        labels, rows = shuffled, np.concatenate(output)[places]
    else:
        rows = np.concatenate(output)
    return polars.DataFrame({"sensor": labels, **dict(zip(("ax", "ay", "az"), rows.T, strict=True))})


@pytest.fixture
def small(monkeypatch):
    """Blocks of a few sensors."""
    monkeypatch.setattr(reading, "PART", PART)


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder with the table of a fleet as Parquet, in short row groups."""
    table().write_parquet(tmp_path / "fleet.parquet", row_group_size=100)
    return tmp_path


def accelcal(folder: Path, *arguments: str) -> tuple[int, str]:
    """Run the command line with small blocks; return its exit code and what it says."""
    done = program(folder, "", *arguments, launch=LAUNCH)
    _, errors = done.communicate(timeout=300)
    return done.returncode, errors


def fleet_line(*more: str) -> tuple[str, ...]:
    return ("fleet", "fleet.parquet", "--g", str(G), "-q", *more)


def whole(files: list[str], work: Work = WORK) -> Whole:
    """Calibrate files in this process."""
    finished = Finished()
    run_blocks(supply(files, work), work, finished)
    return Whole(finished, work)


# The same whatever the workers


def test_any_number_of_processes_gives_the_same_bytes(folder):
    for jobs in ("1", "2", "3"):
        code, errors = accelcal(folder, *fleet_line("-o", f"{jobs}.parquet", "--jobs", jobs))
        assert code in (0, 1), errors
    files = [(folder / f"{jobs}.parquet").read_bytes() for jobs in (1, 2, 3)]
    assert files[0] == files[1] == files[2]
    assert polars.read_parquet(folder / "1.parquet")["sensor"].to_list() == [
        f"S{k:03}" for k in range(SENSORS)
    ]
    assert sorted(os.listdir(folder)) == ["1.parquet", "2.parquet", "3.parquet", "fleet.parquet"]


def test_a_cluster_gives_the_same_bytes_also_when_a_worker_dies(cluster, folder):
    address, processes = cluster
    line = fleet_line("--cluster", address, "-o", "cluster.csv")
    run = program(folder, "", *line, launch=LAUNCH.replace(str(PART), "12", 1))
    until(lambda: parts(folder / "cluster.csv.journal") > 2 or run.poll() is not None)
    processes[1].kill()
    _, errors = run.communicate(timeout=300)
    assert run.returncode in (0, 1), errors
    accelcal(folder, *fleet_line("-o", "alone.csv"))
    assert (folder / "cluster.csv").read_bytes() == (folder / "alone.csv").read_bytes()


def parts(journal: Path) -> int:
    return len(list(journal.glob("part-*.npz")))


def test_a_worker_that_does_not_see_the_files_gets_the_readings(folder, small):
    """A file of another size or time is another file."""
    offered = supply([str(folder / "fleet.parquet")], WORK)
    (number, block), *_ = offered.blocks(frozenset())
    assert number == 0
    own = execute(block, WORK)
    loaded = block.loaded()
    os.utime(folder / "fleet.parquet", (1, 1))
    assert execute(block, WORK) is None
    sent = execute(loaded, WORK)
    for name in ("K_a", "sigma_d", "number"):
        np.testing.assert_array_equal(getattr(sent.fleet, name), getattr(own.fleet, name))
    assert sent.fleet.labels.tolist() == own.fleet.labels.tolist()


# The same whatever the order and the form


@pytest.mark.parametrize("seed", range(4))
def test_rows_in_any_order_are_the_rows_in_order(tmp_path, small, seed, monkeypatch):
    monkeypatch.setattr(reading, "SLAB", 200)
    table().write_parquet(tmp_path / "sorted.parquet")
    order = np.random.default_rng(seed).permutation(len(table()))
    ending = ("csv", "parquet")[seed % 2]
    mixed = table(order)
    mixed.write_csv(tmp_path / "m.csv") if ending == "csv" else mixed.write_parquet(tmp_path / "m.parquet")
    frames = {}
    for name in ("sorted.parquet", f"m.{ending}"):
        one = whole([str(tmp_path / name)])
        assert len(one.numbers) > 5
        frames[name] = polars.concat([part.to_frame() for part in one.fleets()]).sort("sensor").drop(WHERE)
    expected, found = frames.values()
    assert len(expected) == SENSORS
    assert expected.equals(found)


def test_sensors_of_several_numbers_of_poses_come_out_alike_in_any_company(tmp_path, small):
    """Sums of other lengths round otherwise, in the last digit."""
    rows = table(ragged=4)
    rows.write_parquet(tmp_path / "sorted.parquet")
    table(np.random.default_rng(5).permutation(len(rows)), ragged=4).write_parquet(tmp_path / "m.parquet")
    expected, found = (
        polars.concat([part.to_frame() for part in whole([str(tmp_path / name)]).fleets()]).sort("sensor")
        for name in ("sorted.parquet", "m.parquet")
    )
    assert expected["verdict"].equals(found["verdict"])
    assert expected["poses"].equals(found["poses"])
    for name in ("K_11", "K_32", "D_1", "sigma_K_21", "sigma_D_3", "s", "rms"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, atol=1e-9)


def test_blocks_are_the_fleet_at_once(tmp_path, small):
    """Rows, summary and what stands out; lines of text are named as they are in the file."""
    spoilt = table().with_columns(
        polars.when(polars.col("sensor") == "S031")
        .then(polars.col("ay") * 1.1)
        .otherwise(polars.col("ay"))
        .alias("ay")
    )
    spoilt.write_csv(tmp_path / "fleet.csv")
    name = str(tmp_path / "fleet.csv")
    together = calibrate_fleet(read_fleet([name]), WORK.settings)
    labels = [f"S{k:03}" for k in range(SENSORS)]
    one = whole([name])
    found = one.summary()
    for field in ("parameters", "s", "rms", "freedom", "poses"):
        np.testing.assert_array_equal(getattr(found, field), getattr(together, field))
    assert standouts(found, G) == standouts(together, G)
    assert standouts(found, G)
    for verbose in (False, True):
        assert summary(found, labels, standouts(found, G), G, verbose) == summary(
            together, labels, standouts(together, G), G, verbose
        )
    warned = [said for part in one.fleets() for said in part.warnings]
    assert warned == together.warnings.tolist()
    assert [at for part in one.fleets() for at in part.outlying] == together.outlying.tolist()


def test_a_block_of_rows_names_rows_as_the_whole_table_does(tmp_path, small):
    rows = table().with_row_index()
    zero = (polars.col("index") == 503) | (polars.col("index") == 505)
    rows = rows.with_columns(
        *(polars.when(zero).then(0.0).otherwise(polars.col(axis)).alias(axis) for axis in ("ax", "ay", "az"))
    ).drop("index")
    rows.write_parquet(tmp_path / "fleet.parquet")
    name = str(tmp_path / "fleet.parquet")
    together = calibrate_fleet(read_fleet([name]), WORK.settings)
    said = [said for part in whole([name]).fleets() for said in part.warnings]
    assert said == together.warnings.tolist()
    assert "row 504" in " ".join(str(one) for own in said for one in own)


def test_the_partitions_of_a_table_are_one_table(tmp_path, small):
    """A sensor may go on in the next file; one that comes again later is one sensor, too."""
    rows = table()
    os.mkdir(tmp_path / "parts")
    for k, start in enumerate(range(0, len(rows), 100)):
        rows.slice(start, 100).write_parquet(tmp_path / "parts" / f"{k:02}.parquet")
    rows.write_parquet(tmp_path / "whole.parquet")
    one, many = whole([str(tmp_path / "whole.parquet")]), whole([str(tmp_path / "parts")])
    frames = [polars.concat([part.to_frame() for part in w.fleets()]).drop(WHERE) for w in (one, many)]
    assert frames[0].equals(frames[1])
    os.rename(tmp_path / "parts" / "00.parquet", tmp_path / "parts" / "99.parquet")
    turned = polars.concat([part.to_frame() for part in whole([str(tmp_path / "parts")]).fleets()])
    assert sorted(turned["sensor"].to_list()) == frames[0]["sensor"].to_list()


def test_results_of_a_folder_are_those_of_calibrate(folder):
    done = accelcal(folder, *fleet_line("-o", "results/", "--jobs", "2"))
    assert done[0] in (0, 1), done
    assert len(os.listdir(folder / "results")) == SENSORS
    record = json.loads((folder / "results" / "S017.json").read_text())
    own = table().filter(polars.col("sensor") == "S017").drop("sensor")
    one = calibrate(own, WORK.settings)
    np.testing.assert_allclose(record["K_a"], one.K_a, rtol=1e-9, atol=1e-6)
    assert record["data"]["rows"] == len(table())
    assert not (folder / "results.journal").exists()


# A broken file


def files_of(folder: Path, count: int = 12) -> list[str]:
    """One file per sensor."""
    rows = table(sensors=count)
    for label in rows["sensor"].unique():
        rows.filter(polars.col("sensor") == label).drop("sensor").write_csv(folder / f"{label}.csv")
    return sorted(str(path) for path in folder.glob("S*.csv"))


def test_a_broken_file_is_a_row_with_its_message(tmp_path, monkeypatch):
    monkeypatch.setattr(blocks, "TOGETHER", 5)
    files = files_of(tmp_path)
    alone = {
        label: part
        for part in whole(files).fleets()
        for label, part in zip(part.labels, part.K_a, strict=True)
    }
    Path(files[3]).write_text("ax,ay,az\n1,2,3\n1,2\n")
    Path(files[11]).unlink()
    Path(files[7]).write_text(Path(files[7]).read_text().replace("ax,ay,az", "ax [g],ay [g],az [g]"))
    work = Work(WORK.settings, Gravity({"g": None, "latitude": None, "height": None}, G))
    fleet = whole(files, work).summary()
    assert fleet.labels.tolist() == sorted(alone)
    assert np.flatnonzero(fleet.verdict == "failed").tolist() == [3, 7, 11]
    told = [reason for part in whole(files, work).fleets() for reason in part.reason]
    assert told[3].startswith("Line 3: has 2 cells")
    assert told[7].startswith("1 g is 1 in the unit of its readings")
    assert "no such file" in told[11].lower()
    for part in whole(files, work).fleets():
        for label, matrix, word in zip(part.labels, part.K_a, part.verdict, strict=True):
            if word != "failed":
                np.testing.assert_array_equal(matrix, alone[label])


def test_a_broken_table_among_many_is_a_row(tmp_path, small):
    os.mkdir(tmp_path / "parts")
    rows = table()
    for k in range(3):
        own = rows.filter(polars.col("sensor").str.slice(1).cast(int) // 20 == k)
        own.write_parquet(tmp_path / "parts" / f"{k}.parquet")
    (tmp_path / "parts" / "1.parquet").write_bytes(b"PAR1 nothing")
    fleet = whole([str(tmp_path / "parts")]).summary()
    assert fleet.labels.tolist()[-1] == "1"
    assert fleet.verdict[-1] == "failed"
    assert (fleet.verdict == "failed").sum() == 1
    assert len(fleet.labels) == 41


def test_files_of_which_none_can_be_read_end_it(tmp_path):
    files = files_of(tmp_path, 3)
    for file in files:
        Path(file).write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match=r"S000\.csv"):
        whole(files)


# Stopping and going on


def test_runs_killed_at_random_moments_go_on_to_the_same_bytes(folder):
    accelcal(folder, *fleet_line("-o", "whole.parquet"))
    line = fleet_line("-o", "out.parquet", "--jobs", "2")
    random.seed(4)
    journal = folder / "out.parquet.journal"
    for kill in range(3):
        run = program(folder, "", *line, "--resume", launch=LAUNCH, start_new_session=True)
        least = parts(journal) + random.randrange(3)
        until(lambda least=least, run=run: parts(journal) > least or run.poll() is not None)
        run.send_signal(signal.SIGKILL)
        run.communicate()
        until(lambda run=run: not group(run.pid))  # no worker outlives its parent
        if kill == 0:
            code, errors = accelcal(folder, *line)
            assert code == 2
            assert "--resume goes on with it" in errors
    assert not (folder / "out.parquet").exists()
    code, errors = accelcal(folder, *line, "--resume")
    assert code in (0, 1), errors
    assert (folder / "out.parquet").read_bytes() == (folder / "whole.parquet").read_bytes()
    assert not journal.exists()


def test_an_interrupt_keeps_finished_blocks_and_says_so(folder):
    run = program(folder, "", *fleet_line("-o", "out.csv"), launch=LAUNCH, start_new_session=True)
    until(lambda: parts(folder / "out.csv.journal") > 1 or run.poll() is not None)
    os.killpg(run.pid, signal.SIGINT)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 130
    last = errors.splitlines()[-1]
    assert last.startswith("accelcal: interrupted; ")
    assert last.endswith("finished blocks are kept in out.csv.journal, --resume goes on with them")
    assert sorted(os.listdir(folder)) == ["fleet.parquet", "out.csv.journal"]


def stopped(folder: Path, work: Work = WORK) -> Path:
    """The journal of a run of which some blocks are done."""
    journal = folder / "out.csv.journal"
    offered = supply([str(folder / "fleet.parquet")], work)
    finished = Finished.open(journal, identity_of(offered, work), False)
    for number, block in list(offered.blocks(frozenset()))[:4]:
        finished.add(number, block.calibrate(work))
    return journal


def test_finished_blocks_are_not_run_again(folder, small, monkeypatch):
    journal = stopped(folder)
    (journal / "part-000002.npz").write_bytes(b"damaged")
    offered = supply([str(folder / "fleet.parquet")], WORK)
    finished = Finished.open(journal, identity_of(offered, WORK), True)
    assert sorted(finished.done) == [0, 1, 3]
    made, calibrate_block = [], TableBlock.calibrate
    monkeypatch.setattr(
        TableBlock, "calibrate", lambda self, work: made.append(1) or calibrate_block(self, work)
    )
    run_blocks(offered, WORK, finished)
    assert len(made) == offered.count - 3
    fleet = Whole(finished, WORK).summary()
    np.testing.assert_array_equal(
        fleet.parameters, whole([str(folder / "fleet.parquet")]).summary().parameters
    )


@pytest.mark.parametrize("other", ["data", "settings", "version"])
def test_a_run_of_something_else_is_not_gone_on_with(folder, small, other, monkeypatch):
    journal = stopped(folder)
    work = WORK
    if other == "data":
        table().with_columns(polars.col("ax") + 1e-9).write_parquet(folder / "fleet.parquet")
    elif other == "settings":
        work = Work(Settings(optimizer="levenberg-marquardt", gauge="upper"), WORK.gravity)
    else:
        monkeypatch.setattr("accelcal_cli.fleets.run.__version__", "0.0.1")
    offered = supply([str(folder / "fleet.parquet")], work)
    with pytest.raises(DataError, match="of other data, settings or another version"):
        Finished.open(journal, identity_of(offered, work), True)


def test_resume_needs_an_output_and_jobs_no_cluster(folder):
    assert accelcal(folder, *fleet_line("--resume")) == (
        2,
        "accelcal: --resume needs the -o OUTPUT of the interrupted run\n",
    )
    code, errors = accelcal(folder, *fleet_line("--jobs", "2", "--cluster", "tcp://127.0.0.1:9"))
    assert (code, errors) == (2, "accelcal: --jobs and --cluster: expected one of them, not both\n")


def test_a_full_disk_is_told_and_what_is_done_is_kept(folder, small, monkeypatch):
    """The output cannot be written: nothing is lost that had been calibrated."""
    os.mkdir(folder / "locked")
    shutil.copy(folder / "fleet.parquet", folder / "locked" / "fleet.parquet")
    monkeypatch.chdir(folder / "locked")
    finished = Finished.open(Path("out.csv.journal"), "x", False)
    offered = supply(["fleet.parquet"], WORK)
    run_blocks(offered, WORK, finished)
    assert finished.kept().endswith("finished blocks are kept in out.csv.journal, --resume goes on with them")
    finished.leave()
    assert parts(Path("out.csv.journal")) == offered.count
