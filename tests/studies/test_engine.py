"""The same bytes whatever happens: any number of workers, a cluster, dead workers, killed studies, full disks."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import sys
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from threading import Thread

import pytest
from programs import group, program, until

from accelcal_cli import pools
from accelcal_cli.errors import DataError, OutputError
from accelcal_cli.output.machine import write_table
from accelcal_cli.studies import engine
from accelcal_cli.studies.benchmark import Benchmark
from accelcal_cli.studies.engine import Journal, run_study
from accelcal_cli.studies.study import Entry, Task
from accelcal_cli.views.studies import raw_table

ROOT = Path(__file__).parents[2]
SMALL = {"population": 10, "iterations": 20}
STUDY = Benchmark(
    ("sphere", "rosenbrock"),
    (Entry("pso", "pso", SMALL), Entry("de", "de", SMALL)),
    dimensions=(3,),
    runs=12,
    tolerance=1e-2,
)
LINE = (
    *("benchmark", "--func", "sphere,rosenbrock", "--optimizer", "pso,de", "--dim", "8", "--runs", "60"),
    *("--evaluations", "8000", "--quiet", "--format", "csv"),
)
"""A study of two seconds in 48 parts, long enough to be stopped on the way."""


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> bytes:
    return raw(run_study(STUDY, Journal(None)), tmp_path_factory.mktemp("alone"))


def raw(records, folder: Path, name="raw.csv") -> bytes:
    write_table(raw_table(STUDY, records), str(folder / name))
    return (folder / name).read_bytes()


def accelcal(folder: Path, *arguments: str) -> tuple[int, str]:
    process = program(folder, "accelcal_cli", *arguments)
    _, errors = process.communicate(timeout=300)
    return process.returncode, errors


def lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


# Workers


@pytest.mark.parametrize("jobs", [2, 4])
def test_any_number_of_workers_gives_the_same_bytes(jobs, expected, tmp_path):
    records = run_study(STUDY, Journal(None), partial(pools.local_pool, jobs))
    assert raw(records, tmp_path) == expected


def test_a_worker_killed_in_the_middle_changes_nothing(expected, tmp_path):
    killed = []

    def kill(done, total):
        if 0 < done < total and not killed:
            killed.append(active_children()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    records = run_study(STUDY, Journal(None), partial(pools.local_pool, 2), kill)
    assert killed
    assert raw(records, tmp_path) == expected
    assert active_children() == []


class Poison(Benchmark):
    """A study one of whose tasks kills its worker, always."""

    def execute(self, task: Task):
        if task.cell == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().execute(task)


def test_a_task_that_kills_every_worker_ends_the_study(monkeypatch, tmp_path):
    monkeypatch.setattr(engine, "POOLS", 2)
    poison = Poison(STUDY.functions, STUDY.entries, STUDY.dimensions, 2)
    journal = Journal.open(tmp_path / "j", poison, False)
    with pytest.raises(DataError, match="workers died 2 times in a row"):
        run_study(poison, journal, partial(pools.local_pool, 1))
    assert "0:0:2" in journal.done


def test_workers_have_one_thread_and_the_parent_keeps_its_environment(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with pools.local_pool(1) as pool:
        assert [pool.submit(os.getenv, name).result() for name in pools.THREADS] == ["1"] * 3
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


# Clusters


def test_a_cluster_gives_the_same_bytes_also_when_a_worker_dies(cluster, tmp_path):
    address, processes = cluster
    line = [*LINE, "--raw"]
    study = program(tmp_path, "accelcal_cli", *line, "cluster.csv", "--cluster", address)
    until(lambda: lines(tmp_path / "cluster.csv.journal") > 2 or study.poll() is not None)
    processes[1].kill()
    _, errors = study.communicate(timeout=300)
    assert study.returncode == 0, errors
    assert accelcal(tmp_path, *line, "alone.csv") == (0, "")
    assert (tmp_path / "cluster.csv").read_bytes() == (tmp_path / "alone.csv").read_bytes()


def test_a_cluster_that_does_not_answer(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(pools, "ANSWER_TIME", 0.3)
    with (
        pytest.raises(DataError, match="no Dask scheduler answers there"),
        pools.cluster("tcp://127.0.0.1:9"),
    ):
        pass


@pytest.mark.parametrize("greeting", [b"", b"SSH-2.0-OpenSSH_9.6\r\n", b"cut"])
def test_the_port_of_another_server(monkeypatch, greeting):
    pytest.importorskip("distributed")
    monkeypatch.setattr(pools, "ANSWER_TIME", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            client, _ = server.accept()
            with client:
                client.sendall(greeting)
                client.recv(1) if not greeting else None

        thread = Thread(target=answer)
        thread.start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with (
            pytest.raises(DataError, match=r"no Dask scheduler|another server") as refused,
            pools.cluster(address),
        ):
            pass
        thread.join()
    assert "\n" not in str(refused.value)


def test_tls_without_certificates():
    pytest.importorskip("distributed")
    with pytest.raises(DataError, match=r"tls:// needs certificates"), pools.cluster("tls://127.0.0.1:8786"):
        pass


@pytest.mark.parametrize(
    "address", ["", "nowhere", "tcp://host:", "http://host:8786", "host:0", "host:65536"]
)
def test_a_cluster_address_that_is_none(address):
    pytest.importorskip("distributed")
    with pytest.raises(DataError, match="expected tcp://host:port"), pools.cluster(address):
        pass


def test_a_cluster_without_dask(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(DataError, match="python -m pip install distributed"), pools.cluster("tcp://a:1"):
        pass


# Stopping and going on


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_killed_study_goes_on_to_the_same_bytes(jobs, tmp_path):
    line = [*LINE, "--raw", "raw.csv", "--jobs", jobs]
    study = program(tmp_path, "accelcal_cli", *line, start_new_session=True)
    until(lambda: lines(tmp_path / "raw.csv.journal") > 2 or study.poll() is not None)
    study.send_signal(signal.SIGKILL)
    study.communicate()
    assert study.returncode == -signal.SIGKILL
    until(lambda: not group(study.pid))  # no worker outlives its parent
    assert not (tmp_path / "raw.csv").exists()
    assert accelcal(tmp_path, *line)[0] == 2  # not without being told to
    kept = lines(tmp_path / "raw.csv.journal")
    assert kept > 2
    code, errors = accelcal(tmp_path, *line, "--resume")
    assert code == 0, errors
    assert not (tmp_path / "raw.csv.journal").exists()
    assert accelcal(tmp_path, *LINE, "--raw", "whole.csv") == (0, "")
    assert (tmp_path / "raw.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGINT, 130, "interrupted"),
        (signal.SIGHUP, 129, "ended by SIGHUP"),
        (signal.SIGTERM, 143, "ended by SIGTERM"),
    ],
)
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_an_interrupt_keeps_finished_runs(jobs, tmp_path, number, code, said):
    study = program(
        tmp_path, "accelcal_cli", *LINE, "--raw", "raw.csv", "--jobs", jobs, start_new_session=True
    )
    until(lambda: lines(tmp_path / "raw.csv.journal") > 2 or study.poll() is not None)
    os.killpg(study.pid, number)  # the terminal sends it to all of them
    _, errors = study.communicate(timeout=60)
    assert study.returncode == code
    assert len(errors.splitlines()) == 1, errors
    message = errors
    assert message.startswith(f"accelcal: {said}; ")
    assert "--resume" in message
    assert {path.name for path in tmp_path.iterdir()} == {"raw.csv.journal"}
    until(lambda: not group(study.pid))


# The journal


def stopped(tmp_path, after=2) -> Path:
    """A journal of some finished tasks, as a stopped study leaves it."""
    path = tmp_path / "raw.csv.journal"
    journal = Journal.open(path, STUDY, False)
    for task in STUDY.tasks()[:after]:
        journal.add(task, STUDY.execute(task))
    return path


def resumed(path: Path, tmp_path) -> bytes:
    return raw(run_study(STUDY, Journal.open(path, STUDY, True)), tmp_path)


def test_what_is_in_the_journal_is_not_run_again(expected, tmp_path, monkeypatch):
    path = stopped(tmp_path, after=len(STUDY.tasks()))
    monkeypatch.setattr(Benchmark, "execute", None)
    assert resumed(path, tmp_path) == expected


@pytest.mark.parametrize("cut", [1, 30, 400])
def test_a_half_written_last_line_is_run_again(cut, expected, tmp_path):
    path = stopped(tmp_path)
    path.write_bytes(path.read_bytes()[:-cut])
    assert resumed(path, tmp_path) == expected
    assert lines(path) == 1 + len(STUDY.tasks())


def test_a_damaged_line_is_run_again(expected, tmp_path):
    path = stopped(tmp_path)
    head, first, second = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(head + first.replace(b'"cost"', b'"co\xff"') + b"[1]\n" + second)
    assert resumed(path, tmp_path) == expected


@pytest.mark.parametrize("content", [b"", b'{"schema": "accel'])
def test_a_journal_that_was_only_begun_starts_anew(content, expected, tmp_path):
    path = tmp_path / "j"
    path.write_bytes(content)
    assert resumed(path, tmp_path) == expected
    assert json.loads(path.read_text().splitlines()[0])["study"] == STUDY.identity


def test_resuming_without_a_journal_starts(expected, tmp_path):
    assert resumed(tmp_path / "j", tmp_path) == expected


def test_the_journal_of_another_study_is_refused(tmp_path):
    path = stopped(tmp_path)
    other = Benchmark(STUDY.functions, STUDY.entries, (3,), 13, tolerance=1e-2)
    with pytest.raises(DataError, match="another study or version"):
        Journal.open(path, other, True)
    path.write_text("not a journal\n")
    with pytest.raises(DataError, match="another study or version"):
        Journal.open(path, STUDY, True)


def test_a_journal_is_not_overwritten(tmp_path):
    path = stopped(tmp_path)
    with pytest.raises(DataError, match="--resume goes on"):
        Journal.open(path, STUDY, False)
    assert lines(path) == 3


def test_a_journal_that_is_a_folder(tmp_path):
    with pytest.raises(OutputError, match="is a directory"):
        Journal.open(tmp_path, STUDY, True)


def test_a_full_disk_ends_the_study_with_what_it_has(tmp_path, monkeypatch):
    journal = Journal.open(tmp_path / "j", STUDY, False)
    calls = []

    def full(handle):
        calls.append(handle)
        if len(calls) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="no space left on device"):
        run_study(STUDY, journal)


# The raw file


def test_parquet_holds_the_same_rows(tmp_path):
    import polars

    records = run_study(STUDY, Journal(None))
    once, twice = (raw(records, tmp_path, name) for name in ("a.parquet", "b.parquet"))
    assert once == twice
    raw(records, tmp_path)
    frame = polars.read_parquet(tmp_path / "a.parquet")
    table = polars.read_csv(tmp_path / "raw.csv")
    assert frame.columns == table.columns
    assert frame["cost"].to_list() == table["cost"].to_list()
    assert frame["hit"].dtype == polars.Int64


def test_infinite_costs_are_empty_cells(tmp_path):
    from dataclasses import replace

    records = [replace(STUDY.execute(Task(0, 0, 1))[0], cost=float("inf"))]
    assert b"sphere,pso,0,,210," in raw(records, tmp_path)


def test_progress_counts_runs(tmp_path):
    seen = []
    run_study(STUDY, Journal.open(stopped(tmp_path), STUDY, True), None, lambda *now: seen.append(now))
    assert seen[0] == (10, 48)
    assert seen[-1] == (48, 48)
