"""`accelcal capture` from standard input: the table, how it ends, bad input."""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import pytest

from accelcal_cli.errors import OutputError
from accelcal_cli.output import live as capture
from accelcal_cli.planning import candidates, distinct_poses
from accelcal_cli.rng import Streams

FAST = ("--port", "-", "--rate", "20", "--window", "1", "--hold", "2")


def stream(count, still=60):
    """Lines of a sensor that jumps from pose to pose, in units of g."""
    allowed = candidates("corners")
    directions = allowed[distinct_poses(allowed, 12)][:count]
    readings = np.repeat(directions, still, axis=0) + 0.001 * Streams(1, [0]).normal(count * still, 3)[0]
    return "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in readings).encode()


def test_poses_from_standard_input_calibrate(run, tmp_path):
    done = run("capture", *FAST, "-o", "poses.csv", stdin=stream(12))
    assert done.code == 0
    assert done.out == ""
    assert done.err.splitlines()[0] == "12 poses to take, in any order; each held still:"
    assert done.err.splitlines()[-1] == "accelcal: 12 poses in poses.csv"
    calibrated = run("calibrate", "poses.csv", "--g", "1", "--format", "csv")
    assert calibrated.code == 0
    assert "verdict,good" in calibrated.out


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda row: [row[0], row[1], 0.5], 'Column "Nz" is 0.5 in every pose'),
        (lambda row: [min(row[0], 0.4), row[1], row[2]], 'Clipped readings: column "Nx" at 0.4'),
    ],
    ids=["dead axis", "clipped"],
)
def test_poses_that_show_a_fault_are_told_and_kept(run, spoil, said):
    """A fault shows before the sensor is put away."""
    rows = [spoil([float(v) for v in line.split()]) for line in stream(12).decode().splitlines()]
    spoiled = "".join(f"{x} {y} {z}\n" for x, y, z in rows).encode()
    done = run("capture", *FAST, "-o", "poses.csv", stdin=spoiled)
    assert done.code == 1
    assert f"accelcal: poses.csv: warning: {said}" in done.err
    assert "poses in poses.csv" in done.err


def test_the_table_may_go_on_through_a_pipe(run):
    done = run("capture", *FAST, "-q", stdin=stream(12))
    assert (done.code, done.err) == (0, "")
    rows = done.out.splitlines()
    assert rows[0] == "pose,n,Nx,Ny,Nz,sx,sy,sz"
    assert [row.split(",")[:2] for row in rows[1:]] == [[str(k), "40"] for k in range(1, 13)]


def test_an_input_that_ends_early_exits_with_1(run, tmp_path):
    done = run("capture", *FAST, "-o", "poses.csv", stdin=stream(5))
    assert done.code == 1
    assert done.err.splitlines()[-1] == "accelcal: 5 poses in poses.csv, 7 planned are missing"
    assert len((tmp_path / "poses.csv").read_text("utf-8").splitlines()) == 6


def test_an_input_without_a_pose_leaves_no_file(run, tmp_path):
    done = run("capture", *FAST, "-o", "poses.csv", stdin=stream(1, still=10))
    assert done.code == 1
    assert "no pose was taken, nothing is written" in done.err
    assert not (tmp_path / "poses.csv").exists()


def test_an_earlier_session_is_replaced_only_on_request(run, tmp_path):
    (tmp_path / "poses.csv").write_text("an earlier session\n")
    done = run("capture", *FAST, "-o", "poses.csv", stdin=stream(12))
    said = 'accelcal: -o "poses.csv": exists already; expected a new name, or --overwrite\n'
    assert (done.code, done.out, done.err) == (2, "", said)
    assert run("capture", *FAST, "--overwrite", "-o", "poses.csv", stdin=stream(1, still=10)).code == 1
    assert (tmp_path / "poses.csv").read_text() == "an earlier session\n"
    assert run("capture", *FAST, "--overwrite", "-o", "poses.csv", stdin=stream(12)).code == 0
    assert len((tmp_path / "poses.csv").read_text("utf-8").splitlines()) == 13


def test_the_log_itself_is_not_replaced_even_on_request(shell, tmp_path):
    (tmp_path / "log").write_bytes(stream(12))
    done = shell(f"accelcal capture {' '.join(FAST)} --overwrite -o log < log")
    assert (done.code, done.err) == (2, 'accelcal: -o "log": is the input itself; expected another name\n')


@pytest.mark.parametrize("output", ["/proc/poses.csv", "/dev/full"])
def test_an_output_that_cannot_be_written_is_told_before_the_first_pose(run, output):
    done = run("capture", *FAST, "-o", output, stdin=stream(12))
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith(f"accelcal: {output}: ")
    assert done.err.count("\n") == 1


def test_standard_output_that_is_full_is_told_before_the_first_pose(shell, tmp_path):
    (tmp_path / "log").write_bytes(stream(12))
    done = shell(f"accelcal capture {' '.join(FAST)} < log > /dev/full")
    assert (done.code, done.err) == (2, "accelcal: cannot write: no space left on device\n")


@pytest.mark.parametrize("there", [0, 3])
def test_a_disk_that_fills_up_leaves_the_poses_before(run, tmp_path, monkeypatch, there):
    real, saved = capture.whole_file, []

    def filling(path):
        saved.append(path)
        if len(saved) > there:
            raise OutputError(f"{path}: cannot be written: no space left on device")
        return real(path)

    monkeypatch.setattr(capture, "whole_file", filling)
    done = run("capture", *FAST, "-o", "poses.csv", stdin=stream(12))
    assert done.code == 2
    kept = "3 poses in poses.csv, 8 planned are missing" if there else "nothing is written"
    said = "accelcal: poses.csv: cannot be written: no space left on device; "
    assert done.err.splitlines()[-1] == said + kept
    assert [len(path.read_text("utf-8").splitlines()) for path in tmp_path.iterdir()] == [there + 1] * (
        there > 0
    )


def test_a_pipe_by_name_gets_a_row_a_pose(shell, tmp_path):
    (tmp_path / "log").write_bytes(stream(12))
    done = shell(f"mkfifo pipe; cat pipe & accelcal capture {' '.join(FAST)} -q -o pipe < log; wait")
    assert (done.code, done.err) == (0, "")
    assert done.out == shell(f"accelcal capture {' '.join(FAST)} -q < log").out
    assert done.out.count("\n") == 13


def test_the_unit_and_the_offset_may_be_stated(run):
    options = ("--unit", "g", "--offset", "0,0,0", "--still", "0.02", "--poses", "6", "--fixture", "faces")
    done = run("capture", *FAST, *options, stdin=b"0 0 1\n" * 60 + b"0 0 -1\n" * 60)
    assert done.code == 1
    assert "pose 1: +z up; 40 readings, sd 0; 5 to take" in done.err
    assert "pose 2: -z up; 40 readings, sd 0; 4 to take" in done.err


@pytest.mark.parametrize(
    ("reading", "options", "said"),
    [
        (
            "0 0 0",
            ("m/s2",),
            "reads 0, 0, 0, length 0; expected 4.903 to 19.61, about 1 g with --unit m/s2; are --unit",
        ),
        ("1000 0 0", ("g",), "length 1000; expected 0.5 to 2, about 1 g with --unit g; state --unit mg;"),
        (
            "0 0.6 0.8",
            ("m/s^2",),
            "length 1; expected 4.903 to 19.61, about 1 g with --unit m/s^2; state --unit g;",
        ),
        (
            "0 0 -9.8",
            ("mg",),
            "length 9.8; expected 500 to 2000, about 1 g with --unit mg; state --unit m/s^2;",
        ),
        ("5 0 1", ("g", "--offset", "-5,0,0"), "reads 10, 0, 1, length 10.05;"),
    ],
)
def test_a_first_pose_that_is_not_1_g_in_the_stated_unit_is_refused(run, tmp_path, reading, options, said):
    stdin = f"{reading}\n".encode() * 60
    done = run("capture", *FAST, "-q", "-o", "poses.csv", "--unit", *options, stdin=stdin)
    assert (done.code, done.out) == (2, "")
    assert said in done.err
    assert done.err.endswith("no pose was taken, nothing is written\n")
    assert done.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("reading", "options"),
    [
        ("0 0 -0.6", ("g",)),
        ("0 0 1900", ("mg",)),
        ("5 0 1", ("g", "--offset", "5,0,0")),
        ("0 0 30000", ("16384",)),  # counts may have any bias
        ("0 0 60000", ("16384",)),
    ],
)
def test_a_first_pose_may_miss_1_g_by_much_and_counts_by_anything(run, reading, options):
    done = run("capture", *FAST, "-q", "--unit", *options, stdin=f"{reading}\n".encode() * 60)
    assert (done.code, done.err) == (1, "")
    assert done.out.count("\n") == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "--port"),
        (("--port", "nowhere"), "nowhere: cannot be opened"),
        (("--port", "-", "--columns", "1,2"), '--columns "1,2": expected three different numbers'),
        (("--port", "-", "--columns", "1,2,2"), "--columns"),
        (("--port", "-", "--columns", "0,1,2"), "--columns"),
        (("--port", "-", "--columns", "x,y,z"), "--columns"),
        (("--port", "-", "--poses", "0"), "--poses"),
        (("--port", "-", "--poses", "27"), "--poses 27: expected at most 26 with --fixture corners"),
        (("--port", "-", "--poses", "7", "--fixture", "faces"), "at most 6 with --fixture faces"),
        (
            ("--port", "-", "--fixture", "any"),
            '--fixture "any": unknown; expected one of faces, edges, corners',
        ),
        (("--port", "-", "--rate", "0"), "--rate 0: expected a positive number"),
        (("--port", "-", "--window", "nan"), "--window nan: expected a positive number"),
        (("--port", "-", "--window", "0.001"), "expected 2 to 1,000,000 readings"),
        (("--port", "-", "--hold", "1e9"), "expected 2 to 1,000,000 readings"),
        (("--port", "-", "--still", "-1"), "--still -1: expected a positive number"),
        (("--port", "-", "--timeout", "0"), "--timeout 0: expected a positive number"),
        (("--port", "-", "--baud", "3"), "--baud"),
        (("--port", "-", "--unit", "ft"), '--unit "ft": expected g, mg, m/s^2 or a positive number'),
        (("--port", "-", "--unit", "0"), '--unit "0"'),
        (("--port", "-", "--offset", "1,2"), '--offset "1,2": expected three numbers'),
        (("--port", "-", "-o", "no/poses.csv"), "no such folder"),
    ],
)
def test_bad_input_is_one_message_and_no_file(run, tmp_path, arguments, message):
    done = run("capture", *arguments, *(() if "-o" in arguments else ("-o", "poses.csv")), stdin=stream(12))
    assert (done.code, done.out) == (2, "")
    assert message in done.err
    assert "Traceback" not in done.err
    assert done.err.splitlines()[-1].startswith("accelcal: ")
    assert list(tmp_path.iterdir()) == []


def test_lines_without_numbers_are_refused(run, tmp_path):
    done = run("capture", *FAST, "-q", "-o", "poses.csv", stdin=b"hello world\n" * 200)
    assert done.code == 2
    assert 'lines in a row without 3 numbers, as "hello world"' in done.err
    assert list(tmp_path.iterdir()) == []


# Recordings


def test_a_recording_replays_in_its_time(run, tmp_path):
    """The poses are those that standard input gives, and each reading takes its time."""
    (tmp_path / "session.txt").write_bytes(b"# a comment takes none\n" * 50 + stream(3))
    quick = ("--rate", "200", "--window", "0.1", "--hold", "0.2")
    assert run("capture", "--port", "-", *quick, "-o", "piped.csv", stdin=stream(3)).code == 1
    before = time.monotonic()
    done = run("capture", "--port", "session.txt", *quick, "-o", "replayed.csv")
    assert done.code == 1
    assert time.monotonic() - before >= (3 * 60 - 1) / 200
    assert "accelcal: 3 poses in replayed.csv" in done.err
    assert (tmp_path / "replayed.csv").read_bytes() == (tmp_path / "piped.csv").read_bytes()


def test_what_is_recorded_replays(run, tmp_path):
    options = ("--rate", "2000", "--window", "0.01", "--hold", "0.02")
    first = run(
        "capture", "--port", "-", *options, "--record", "session.txt", "-o", "1.csv", stdin=stream(12)
    )
    assert first.code == 0
    assert stream(12).startswith((tmp_path / "session.txt").read_bytes())
    again = run("capture", "--port", "session.txt", *options, "-o", "2.csv")
    assert again.code == 0
    assert again.err.replace("2.csv", "1.csv") == first.err
    assert (tmp_path / "2.csv").read_bytes() == (tmp_path / "1.csv").read_bytes()


def test_a_recording_is_kept_when_the_input_ends_early(run, tmp_path):
    assert run("capture", *FAST, "--record", "session.txt", "-o", "1.csv", stdin=stream(5)).code == 1
    assert (tmp_path / "session.txt").read_bytes() == stream(5)


def test_a_full_disk_ends_a_recording_and_keeps_the_poses(run, tmp_path):
    done = run("capture", *FAST, "--record", "/dev/full", "-o", "poses.csv", stdin=stream(12))
    assert done.code == 2
    assert done.err.startswith("12 poses to take")
    assert "accelcal: /dev/full: cannot be written: no space left on device; " in done.err
    assert "Traceback" not in done.err


# The calibration in the end


def test_the_result_is_what_calibrate_makes_of_the_poses(run, tmp_path):
    done = run("capture", *FAST, "-o", "poses.csv", "--result", "result.yaml", "--g", "1", stdin=stream(12))
    assert done.code == 0
    assert done.err.splitlines()[-1] == (
        "accelcal: 12 poses in poses.csv; their calibration is good, in result.yaml"
    )
    assert run("calibrate", "poses.csv", "--g", "1", "-o", "other.yaml").code == 0
    assert (tmp_path / "result.yaml").read_text() == (tmp_path / "other.yaml").read_text()


@pytest.mark.parametrize("unit", ["g", "mg"])
def test_the_unit_of_the_sensor_decides_what_gravity_is(run, tmp_path, unit):
    lines = stream(12).decode().splitlines()
    size = 1.0 if unit == "g" else 1000.0
    data = "".join(" ".join(f"{size * float(v):.6f}" for v in line.split()) + "\n" for line in lines).encode()
    done = run("capture", *FAST, "-o", "poses.csv", "--unit", unit, "--result", "result.json", stdin=data)
    assert done.code == 0
    record = json.loads((tmp_path / "result.json").read_text())
    assert (record["g"], record["data"]["unit"]) == (size, unit)


def test_too_few_poses_are_calibrated_as_undetermined(run, tmp_path):
    done = run("capture", *FAST, "-o", "poses.csv", "--result", "result.yaml", stdin=stream(5))
    assert done.code == 1
    assert "their calibration is undetermined, in result.yaml" in done.err


def test_one_pose_is_not_calibrated(run, tmp_path):
    done = run("capture", *FAST, "-o", "poses.csv", "--result", "result.yaml", stdin=stream(1))
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        "accelcal: 1 pose in poses.csv, 11 planned are missing; they allow no calibration, result.yaml is not written"
    )
    assert not (tmp_path / "result.yaml").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--bind", "0.0.0.0"), "--bind needs --web"),
        (("--web-port", "8000"), "--web-port needs --web"),
        (("--web", "--bind", "example.org"), '--bind "example.org": expected an address of this machine'),
        (("--web", "--bind", "192.0.2.1"), "--bind 192.0.2.1 --web-port 0: cannot be used: "),
        (
            ("--result", "result.csv"),
            '--result "result.csv": expected a name that ends in .yaml or .yml or .json',
        ),
        (("--record", "-"), '--record "-": expected the name of a file'),
        (
            ("--record", "there.txt"),
            '--record "there.txt": exists already; expected a new name, or --overwrite',
        ),
        (("--record", "./new.txt", "-o", "new.txt"), 'new.txt": is stated twice; expected a name of its own'),
        (("--record", "no/new.txt"), "no/new.txt: no such folder: no"),
        (("--g", "9.8", "--latitude", "48"), "--g and --latitude: expected one of them, not both"),
    ],
)
def test_what_is_stated_wrongly_is_told_before_the_first_reading(run, tmp_path, options, said):
    (tmp_path / "there.txt").write_text("an earlier session\n")
    done = run("capture", *FAST, *options, stdin=stream(1))
    assert (done.code, done.out) == (2, "")
    assert said in done.err
    assert done.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["there.txt"]


def test_the_recording_that_is_replayed_is_not_replaced(run, tmp_path):
    (tmp_path / "session.txt").write_bytes(stream(1))
    done = run("capture", "--port", "session.txt", "--record", "session.txt", "--overwrite")
    assert (done.code, done.err) == (
        2,
        'accelcal: --record "session.txt": is the input itself; expected another name\n',
    )


def test_without_a_page_nothing_of_its_server_is_imported(shell, tmp_path):
    (tmp_path / "log").write_bytes(stream(12))
    told = shell(
        f"{sys.executable} -X importtime -m accelcal_cli capture {' '.join(FAST)} -o p.csv < log"
    ).err
    loaded = {
        line.rpartition("|")[2].strip() for line in told.splitlines() if line.startswith("import time:")
    }
    assert "accelcal_cli.output.live" in loaded
    assert not loaded & {
        "asyncio",
        "http.client",
        "segno",
        "accelcal_cli.output.server",
        "accelcal_cli.output.page",
        "accelcal_cli.calibration.calibrate",
        "serial",
    }
