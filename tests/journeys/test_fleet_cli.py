"""`accelcal fleet`: a table or files of many sensors in, a summary, a table or a folder of results out."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pytest
import yaml

from accelcal_cli.calibration.result import load_result
from accelcal_cli.notices import Notice, in_one


@pytest.fixture
def table(run) -> str:
    """The name of a table of twenty sensors in twelve poses."""
    made = run("simulate", "--sensor", "mems", "--sensors", "20", "--seed", "2", "-o", "fleet.csv")
    assert made.code == 0
    return "fleet.csv"


def rows_of(text):
    return {row["sensor"]: row for row in csv.DictReader(io.StringIO(text))}


def test_the_true_sensors_are_found(run):
    made = ("--sensor", "mems", "--sensors", "20", "--positions", "24", "-o", "many.csv", "--truth", "t.yaml")
    run("simulate", *made)
    done = run("fleet", "many.csv", "--format", "csv", "-q")
    assert (done.code, done.err) == (0, "")
    rows = rows_of(done.out)
    truth = yaml.safe_load(Path("t.yaml").read_text())["sensors"]
    assert list(rows) == list(truth) == [f"S{k:02}" for k in range(1, 21)]
    for label, sensor in truth.items():
        lower = np.linalg.cholesky(np.array(sensor["K_a"]) @ np.array(sensor["K_a"]).T)
        row = rows[label]
        for i in range(3):
            sigma = float(row[f"sigma_D_{i + 1}"])
            assert abs(float(row[f"D_{i + 1}"]) - sensor["D_a"][i]) < 6 * sigma
            for j in range(i + 1):
                assert abs(float(row[f"K_{i + 1}{j + 1}"]) - lower[i, j]) < 6 * float(
                    row[f"sigma_K_{i + 1}{j + 1}"]
                )
        assert row["verdict"] == "good"
        assert float(row["rms"]) < 0.03 < float(row["rms_before"])


def test_sensors_differ_and_the_first_of_many_is_the_first_of_few(run):
    few = run("simulate", "--sensor", "mems", "--sensors", "2").out.splitlines()
    many = run("simulate", "--sensor", "mems", "--sensors", "9").out.splitlines()
    assert many[:25] == few
    assert few[0] == "sensor,Nx,Ny,Nz"
    assert few[1].split(",")[1:] != few[13].split(",")[1:]


def test_standard_input_and_several_samples_a_pose(run):
    text = run("simulate", "--sensor", "mems", "--sensors", "3", "--samples", "5").out
    assert text.startswith("sensor,pose,Nx,Ny,Nz\nS1,1,")
    done = run("fleet", "-", stdin=text.encode())
    assert done.code == 0
    assert done.out.startswith("3 sensors: 3 good\n")
    assert 'accelcal: columns "sensor", "pose" found\n' in done.err
    assert "g = 9.80665 assumed" in done.err
    rows = run("fleet", "-", "--format", "json", "--g", "9.80665", "-q", stdin=text.encode())
    assert [row["poses"] for row in json.loads(rows.out)] == [12, 12, 12]


@pytest.mark.parametrize("name", ["all.csv", "all.json", "all.parquet"])
def test_the_table_goes_to_a_file(run, table, name):
    shown = json.loads(run("fleet", table, "--format", "json", "-q").out)
    done = run("fleet", table, "-o", name)
    assert done.code == 0
    assert done.err.endswith(f"accelcal: wrote {name}\n")
    assert "20 sensors: 20 good" in done.out
    if name.endswith("json"):
        assert json.loads(Path(name).read_text()) == shown
        return
    import polars

    frame = polars.read_csv(name) if name.endswith("csv") else polars.read_parquet(name)
    assert frame.columns == list(shown[0])
    for key in ("sensor", "poses", "K_21", "sigma_D_2", "dop_bias_x", "s"):
        assert frame[key].to_list() == [row[key] for row in shown]


def test_a_folder_takes_a_result_file_of_each(run, table):
    done = run("fleet", table, "-o", "results/")
    assert done.code == 0
    assert sorted(os.listdir("results")) == [f"S{k:02}.json" for k in range(1, 21)]
    rows = rows_of(run("fleet", table, "--format", "csv", "-q").out)
    result = load_result("results/S07.json")
    assert result.K_a[1, 0] == float(rows["S07"]["K_21"])
    one = [
        line.split(",", 1)[1] for line in Path(table).read_text().splitlines() if line[:3] in ("S07", "sen")
    ]
    Path("one.csv").write_text("\n".join(one) + "\n")
    assert run("verify", "results/S07.json", "one.csv", "-q").code == 0
    assert run("apply", "results/S07.json", "one.csv", "-q").code == 0
    assert run("export", "results/S07.json", "--to", "ros", "-q").code == 0
    again = run("fleet", table, "-o", "results")
    assert (again.code, again.out) == (2, "")
    assert "holds files already" in again.err


def test_an_empty_folder_will_do_and_labels_become_file_names(run, table):
    os.mkdir("results")
    text = Path(table).read_text().replace("S07", "rack 1/a%").replace("S08", "Größe")
    Path("named.csv").write_text(text)
    assert run("fleet", "named.csv", "-o", "results", "-q").code == 0
    assert {"rack 1%2Fa%25.json", "Größe.json"} < set(os.listdir("results"))


def test_one_file_a_sensor(run, table):
    lines = Path(table).read_text().splitlines()
    os.mkdir("rack")
    for name in ("S01", "S02", "S03"):
        own = [line.split(",", 1)[1] for line in lines if line.startswith(name)]
        Path(f"rack/{name}.csv").write_text("\n".join(["Nx,Ny,Nz", *own]) + "\n")
    done = run("fleet", "rack/S01.csv", "rack/S02.csv", "rack/S03.csv", "--format", "csv", "-q")
    assert done.code == 0
    whole = rows_of(run("fleet", table, "--format", "csv", "-q").out)
    for label, row in rows_of(done.out).items():
        assert float(row["K_31"]) == pytest.approx(float(whole[label]["K_31"]), rel=1e-9)
    os.mkdir("tray")
    Path("tray/S01.csv").write_bytes(Path("rack/S02.csv").read_bytes())
    twins = run("fleet", "rack/S01.csv", "tray/S01.csv", "--format", "csv", "-q")
    assert list(rows_of(twins.out)) == ["rack/S01", "tray/S01"]


def test_tables_are_joined_by_the_stated_column(run, table):
    lines = Path(table).read_text().splitlines()
    Path("a.csv").write_text("\n".join(lines[:121]) + "\n")
    Path("b.csv").write_text("\n".join([lines[0], *lines[121:]]) + "\n")
    joined = run("fleet", "a.csv", "b.csv", "--sensor-column", "sensor", "--format", "csv", "-q")
    assert joined.out == run("fleet", table, "--format", "csv", "-q").out
    apart = run("fleet", "a.csv", "b.csv")
    assert apart.code == 2
    assert 'a.csv: column "sensor" labels several sensors' in apart.err


@pytest.mark.parametrize(
    "name", ["Serial No.", "device_id", "sensor", "SN", "serialNumber", "id", "Unit", "IMU", "chip-id"]
)
def test_the_column_is_found_by_many_names(run, table, name):
    text = Path(table).read_text().replace("sensor,", f"{name},", 1)
    Path("named.csv").write_text(text)
    assert run("fleet", "named.csv", "-q").code == 0


def test_numbers_serve_for_a_table_without_a_header(run, table):
    Path("bare.csv").write_text("\n".join(Path(table).read_text().splitlines()[1:]))
    assert run("fleet", "bare.csv", "--sensor-column", "1", "-q").out == run("fleet", table, "-q").out


def test_parquet(run, table):
    import polars

    polars.read_csv(table).write_parquet("fleet.parquet")
    whole = run("fleet", table, "--format", "csv", "-q").out
    assert run("fleet", "fleet.parquet", "--format", "csv", "-q").out == whole
    assert run("fleet", "-", "--format", "csv", "-q", stdin=Path("fleet.parquet").read_bytes()).out == whole


def test_lost_sensors_are_named_and_the_others_calibrated(run, table):
    lines = Path(table).read_text().splitlines()
    lost = [line for line in lines if not line.startswith("S04")] + [lines[37]] * 3
    lost = [line for k, line in enumerate(lost) if not line.startswith("S09") or k % 12 < 7]
    Path("lost.csv").write_text("\n".join(lost))
    done = run("fleet", "lost.csv", "-q")
    assert done.code == 1
    assert done.err == "accelcal: 2 of 20 sensors undetermined or failed: S09, S04\n"
    assert done.out.startswith(
        "20 sensors: 18 good, 1 undetermined, 1 failed, 1 of them with a note or a warning\n"
    )
    assert "all 3 poses are equal" in done.out
    rows = rows_of(run("fleet", "lost.csv", "--format", "csv", "-q").out)
    whole = rows_of(run("fleet", table, "--format", "csv", "-q").out)
    assert rows["S04"]["K_11"] == ""
    assert float(rows["S05"]["K_11"]) == float(whole["S05"]["K_11"])
    kept = run("fleet", "lost.csv", "-q", "-o", "results/")
    assert kept.code == 1
    assert sorted(set(rows) - {name[:-5] for name in os.listdir("results")}) == ["S04"]


def test_a_missed_tolerance_is_named(run, table):
    rms = {
        label: float(row["rms"])
        for label, row in rows_of(run("fleet", table, "--format", "csv", "-q").out).items()
    }
    limit = sorted(rms.values())[-3]
    done = run("fleet", table, "-q", "--tolerance", repr(limit))
    above = [label for label, value in rms.items() if value > limit]
    assert done.code == 1
    assert done.err == (
        f"accelcal: 2 of 20 sensors with an rms above the tolerance {limit:.6g}: {', '.join(above)}\n"
    )
    assert run("fleet", table, "-q", "--tolerance", "1").code == 0
    many = run("fleet", table, "-q", "--tolerance", "1e-9")
    assert many.err.endswith("S01, S02, S03, S04, S05 and 15 more\n")


def test_a_broken_sensor_is_told_in_every_form(run):
    """The x axis of one stops at half of g; it is suspect."""
    text = run("simulate", "--sensor", "mems", "--sensors", "20", "--positions", "24").out
    lines = [line.split(",") for line in text.splitlines()]
    rows = [[a, repr(min(float(x), 9000.0)) if a == "S07" else x, y, z] for a, x, y, z in lines[1:]]
    Path("cut.csv").write_text("\n".join(map(",".join, [lines[0], *rows])))
    shown = run("fleet", "cut.csv", "-q")
    assert (shown.code, shown.err) == (1, "accelcal: 1 of 20 sensors suspect: S07\n")
    assert shown.out.startswith("20 sensors: 19 good, 1 suspect, 1 of them with a note or a warning\n")
    assert "\nNot good\n" in shown.out
    assert "\nWarnings\n" not in shown.out
    assert "\nWarnings\n" in run("fleet", "cut.csv", "-q", "--verbose").out
    by_csv = rows_of(run("fleet", "cut.csv", "-q", "--format", "csv").out)
    by_json = json.loads(run("fleet", "cut.csv", "-q", "--format", "json", "-o", "results/").out)
    said = {row["sensor"]: " ".join(str(Notice(**one)) for one in row["warnings"]) for row in by_json}
    assert said == {label: row["warnings"] for label, row in by_csv.items()}
    assert [label for label, row in by_csv.items() if row["warnings"]] == ["S07"]
    assert by_csv["S07"]["warnings"] == in_one(load_result("results/S07.json").warnings)


def test_gravity_gauge_and_configuration(run, table):
    def first(*options):
        return rows_of(run("fleet", table, "--format", "csv", "-q", *options).out)["S01"]

    plain, stronger = first(), first("--g", "9.83")
    assert float(plain["K_11"]) / float(stronger["K_11"]) == pytest.approx(9.83 / 9.80665, rel=1e-9)
    assert float(first("--latitude", "48")["K_11"]) != float(plain["K_11"])
    assert float(first("--gauge", "symmetric")["K_12"]) == pytest.approx(
        float(first("--gauge", "symmetric")["K_21"])
    )
    Path("c.yaml").write_text("gauge: upper\ng: 9.83\n")
    assert float(first("--config", "c.yaml")["K_12"]) != 0
    assert float(first("--config", "c.yaml")["K_21"]) == 0


def test_an_interrupt_leaves_nothing_behind(run, table, monkeypatch):
    before = sorted(os.listdir("."))

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("accelcal_cli.output.machine.write_result", stop)
    done = run("fleet", table, "-o", "results/")
    assert (done.code, done.out, done.err) == (130, "", "accelcal: interrupted\n")
    assert sorted(os.listdir(".")) == before


def test_a_temperature_column_is_not_used_and_that_is_said(run, table):
    rows = Path(table).read_text().splitlines()
    warm = [f"{row},{'temperature' if k == 0 else 20 + k % 12}" for k, row in enumerate(rows)]
    Path("warm.csv").write_text("\n".join(warm))
    plain, told = (run("fleet", name, "--format", "csv") for name in (table, "warm.csv"))
    assert told.out == plain.out
    note = "Temperature column not used; --temperature fits slopes with it, sensor by sensor."
    assert note not in plain.err
    assert f"accelcal: {note}\n" in told.err


def test_slopes_with_temperature_are_fitted_when_asked_for(run, table):
    rows = Path(table).read_text().splitlines()
    warm = [f"{row},{'temperature' if k == 0 else 20 + k % 12}" for k, row in enumerate(rows)]
    Path("warm.csv").write_text("\n".join(warm))
    Path("warm.yaml").write_text("temperature: true\n")
    for asked in (("--temperature",), ("--config", "warm.yaml")):
        done = run("fleet", "warm.csv", *asked, "-o", "results/")
        assert "Temperature column not used" not in done.err
        notes = [note for path in Path("results").iterdir() for note in json.loads(path.read_text())["notes"]]
        assert notes
        assert all("emperature" in note for note in notes)
        shutil.rmtree("results")


# Raw logs


@pytest.fixture
def logs(run) -> list[str]:
    """The names of three raw logs of 14 poses, one sensor each."""
    names = [f"s{k}.csv" for k in (1, 2, 3)]
    for seed, name in enumerate(names, start=1):
        raw = ("--raw", "--sensor", "mems", "--positions", "14", "--rate", "50", "--hold", "3", "--move", "1")
        made = run("simulate", *raw, "--noise", "0.02", "--seed", str(seed), "-o", name)
        assert made.code == 0
    return names


def test_each_raw_log_is_a_sensor(run, logs):
    """Its numbers are those of `calibrate --raw` by itself."""
    done = run("fleet", "--raw", *logs, "--g", "9.80665", "--format", "json", "-o", "results/")
    assert (done.code, done.err) == (0, "accelcal: wrote results/\n")
    rows = json.loads(done.out)
    assert [(row["sensor"], row["poses"]) for row in rows] == [("s1", 14), ("s2", 14), ("s3", 14)]
    for name, row in zip(logs, rows, strict=True):
        alone = ("calibrate", name, "--raw", "--optimizer", "levenberg-marquardt", "--g", "9.80665", "-q")
        assert run(*alone, "-o", "one.json").code == 0
        one, kept = (
            json.loads(Path(file).read_text()) for file in ("one.json", f"results/{row['sensor']}.json")
        )
        assert kept == one
        assert row["K_21"] == one["K_a"][1][0]
        assert (row["verdict"], one["settings"]["weights"]) == (one["verdict"], "auto")


def test_a_broken_or_poor_log_is_a_row_and_not_the_end(run, logs):
    lines = Path(logs[0]).read_text().splitlines(keepends=True)
    Path("broken.csv").write_text("".join([*lines[:300], "1,2,x\n", *lines[300:]]))
    Path("poor.csv").write_text("".join(lines[:700]))
    in_g = [line.split(",") for line in lines[1:]]
    cells = [[row[0], *(f"{float(cell) / 16350:.6f}" for cell in row[1:])] for row in in_g]
    Path("in_g.csv").write_text("t,ax [g],ay [g],az [g]\n" + "".join(",".join(row) + "\n" for row in cells))
    files = ("in_g.csv", "broken.csv", logs[0], "poor.csv", "gone.csv", logs[1])
    done = run("fleet", "--raw", *files, "--format", "json")
    assert done.code == 1
    rows = {row["sensor"]: row for row in json.loads(done.out)}
    assert [(name, row["verdict"]) for name, row in rows.items()] == [
        ("in_g", "failed"), ("broken", "failed"), ("s1", "good"), ("poor", "failed"), ("gone", "failed"),
        ("s2", "good"),
    ]  # fmt: skip
    assert rows["broken"]["reason"].startswith("Line 301: has 3 cells")
    assert "fewer than 12" in rows["poor"]["reason"]
    assert rows["gone"]["reason"].startswith("No such file")
    assert rows["in_g"]["reason"].startswith("1 g is 1 in the unit of its readings, and 9.80665 in that")
    assert "4 of 6 sensors undetermined or failed: in_g, broken, poor, gone" in done.err
    mended = run("fleet", "--raw", "broken.csv", logs[1], "--skip-bad", "--format", "json")
    assert [row["verdict"] for row in json.loads(mended.out)] == ["good", "good"]
    assert "1 broken row left out (--skip-bad): line 301 (1 of 2 logs)" in mended.err


def test_the_values_of_a_column_are_the_sensors_of_a_log(run, logs):
    """Rows of two sensors in turn; the column is found by its name, or stated."""
    rows = [Path(name).read_text().splitlines() for name in logs[:2]]
    in_turn = zip_longest(
        *([f"{row},{label}\n" for row in table[1:]] for table, label in zip(rows, "AB", strict=True))
    )
    both = [row for pair in in_turn for row in pair if row]
    alone = json.loads(run("fleet", "--raw", *logs[:2], "--format", "json", "-q").out)
    for name, column in (("device", ()), ("unit_of_test", ("--sensor-column", "unit_of_test"))):
        Path("both.csv").write_text(f"{rows[0][0]},{name}\n" + "".join(both))
        done = run("fleet", "--raw", "both.csv", *column, "--format", "json", "-q")
        found = json.loads(done.out)
        assert [row["sensor"] for row in found] == ["A", "B"]
        assert [row["poses"] for row in found] == [14, 14]
        for one, other in zip(found, alone, strict=True):
            assert {**one, "sensor": ""} == {**other, "sensor": ""}
    one = run("fleet", "--raw", "both.csv", "--where", "unit_of_test=B", "--format", "json", "-q")
    assert [row["sensor"] for row in json.loads(one.out)] == ["both"]
    two = run("fleet", "--raw", "both.csv", logs[2], "--sensor-column", "5", "--format", "json", "-q")
    assert [row["sensor"] for row in json.loads(two.out)] == ["both/A", "both/B", "s3"]
    assert json.loads(two.out)[2]["verdict"] == "failed"


def test_a_raw_log_from_standard_input(run, logs):
    text = Path(logs[0]).read_bytes()
    assert run("fleet", "--raw", "-", "-q", stdin=text).out.startswith("1 sensor: 1 good\n")
    refused = run("fleet", "--raw", "-", "--sensor-column", "device", stdin=text)
    assert (refused.code, "standard input is read once" in refused.err) == (2, True)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("--rate", "50"), "--rate needs --raw"),
        (("--raw", "--merge", "1", "--thin", "2"), "--merge and --thin: expected one of them"),
        (("--raw", "--columns", "a,b,c"), 'no column "a" in s1.csv'),
        (("--raw", "--gauge", "full"), "gauge: full: a fleet goes with"),
        (("--weights", "auto"), "--weights auto needs"),
    ],
)
def test_what_does_not_go_with_logs_is_refused(run, logs, arguments, part):
    done = run("fleet", *logs, *arguments)
    assert (done.code, done.out) == (2, "")
    assert part in done.err


def test_a_raw_log_twice_is_refused(run, logs):
    done = run("fleet", "--raw", logs[0], logs[0])
    assert (done.code, done.err) == (2, "accelcal: s1.csv: is given twice\n")


def test_slopes_and_robust_losses_go_with_raw_logs(run, logs):
    """A sensor that drifts is calibrated as by itself, slopes with temperature and all."""
    made = ("--raw", "--sensor", "mems", "--positions", "24", "--rate", "50", "--hold", "3", "--move", "1")
    assert run("simulate", *made, "--noise", "0.02", "-o", "long.csv").code == 0
    rows = np.loadtxt("long.csv", delimiter=",", skiprows=1)
    degrees = np.linspace(10.0, 40.0, len(rows))
    rows[:, 1:4] += 3.0 * (degrees - 25.0)[:, None]
    table = np.column_stack([rows, degrees])
    np.savetxt("warm.csv", table, delimiter=",", header="t,ax,ay,az,temperature", comments="", fmt="%.9g")
    Path("robust.yaml").write_text("robust: huber\ntemperature: true\n")
    done = run("fleet", "--raw", "warm.csv", logs[1], "--config", "robust.yaml", "-o", "results/", "-q")
    assert done.code == 0, done.out
    warm = load_result("results/warm.json")
    assert (warm.settings["robust"], warm.freedom) == ("huber", warm.poses - 15)
    assert (np.abs(warm.temperature.bias - 3.0) < 4.5 * warm.temperature.sigma_bias).all()
    assert warm.temperature.sigma_bias.max() < 0.5
    assert load_result("results/s2.json").temperature is None
