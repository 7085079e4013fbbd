"""Every wrong input: exit 2, one line that says what, where and what was expected, and no file left behind."""

import errno
import os
import resource
from pathlib import Path

import pytest
from refusals import refused

RESULT = ("-o", "result.yaml")

FILES = {
    "empty.csv": "",
    "header.csv": "Nx,Ny,Nz\n",
    "word.csv": "Nx,Ny,Nz\n1,2,3\n4,oops,6\n",
    "nan.csv": "Nx,Ny,Nz\n1,2,3\n4,5,nan\n",
    "inf.csv": "Nx,Ny,Nz\n1,2,3\n-inf,5,6\n",
    "huge.csv": "Nx,Ny,Nz\n1,2,3\n1e200,5,6\n",
    "gap.csv": "Nx,Ny,Nz\n1,2,3\n4,,6\n",
    "short.csv": "Nx,Ny,Nz\n1,2,3\n4,5\n7,8,9\n",
    "two.csv": "x,y\n1,2\n3,4\n",
    "wide.csv": "1,2,3,4\n4,5,6,7\n",
    "equal.csv": "Nx,Ny,Nz\n" + "1,2,3\n" * 20,
    "one.csv": "Nx,Ny,Nz\n1,2,3\n",
    "namesakes.csv": "Nx,Ny,Nx\n1,2,3\n4,5,6\n",
    "latin.csv": b"Nx,Ny,Nz\n1,2,3\n\xe9,5,6\n",
    "zeros.csv": b"\0" * 5000,
    "packed.csv": b"\x1f\x8b\x08\0\0\0\0\0",
    "not.parquet": "Nx,Ny,Nz\n1,2,3\n",
    "unknown.yaml": "optimiser: de\n",
    "type.yaml": "runs: many\n",
    "boolean.yaml": "polish: perhaps\n",
    "list.yaml": "optimizer: [de]\n",
    "syntax.yaml": "runs: 3\nbox: {scale: 0.1\ngauge: lower\n",
    "twice.yaml": "runs: 3\ngauge: lower\nruns: 4\n",
    "latin.yaml": b"optimizer: d\xe9\n",
    "nothing.yaml": "",
    "optimizer.yaml": "optimizer: de\n",
    "number.yaml": "3\n",
    "keys.yaml": "3: 4\n",
    "python.yaml": "g: !!python/object/apply:os.getcwd []\n",
    "parameter.yaml": "parameters: {populaton: 50}\n",
    "parameters.yaml": "parameters: 50\n",
    "population.yaml": "parameters: {population: 1}\n",
    "endless.yaml": "parameters: {population: 1" + "0" * 400 + "}\n",
    "box.yaml": "box: {scale: 2}\n",
    "box-key.yaml": "box: {scales: 0.1}\n",
    "nominal.yaml": "nominal: {scale: [1, 2]}\n",
    "nominal-zero.yaml": "nominal: {scale: [1, 2, 0]}\n",
    "nominal-inf.yaml": "nominal: {scale: [1, 2, .inf]}\n",
    "nominal-large.yaml": "nominal: {scale: [1, 2, 1.0e+300]}\n",
    "g.yaml": "g: -9.8\n",
    "g-nan.yaml": "g: .nan\n",
    "g-endless.yaml": "g: 1" + "0" * 400 + "\n",
    "singular.yaml": "K_a: [[1, 0, 0], [0, 1, 0], [0, 0, 0]]\n",
    "no-matrix.yaml": "noise: 1\n",
    "fleet.csv": "sensor,Nx,Ny,Nz\n" + "".join(f"{s},{k % 7},{k % 5},{k}\n" for s in "AB" for k in range(12)),
    "fleet-word.csv": "sensor,Nx,Ny,Nz\nA,1,2,3\nA,4,oops,6\n",
    "fleet-gap.csv": "sensor,Nx,Ny,Nz\nA,1,2,3\n,4,5,6\n",
    "fleet-rows.csv": "id,Nx,Ny,Nz\n1,1,2,3\n2,4,5,6\n3,4,4,4\n",
    "fleet-two.csv": "device,serial,Nx,Ny,Nz\nA,A,1,2,3\n",
    "fleet-axes.csv": "sensor,a,b,c,d\nA,1,2,3,4\n",
    "fleet-bare.csv": "A,1,2,3\nA,4,5,6\n",
}

CALIBRATE = {
    # what: (arguments, parts of the message)
    "missing file": (["god.csv"], ["god.csv", "no such file", 'did you mean "good.csv"']),
    "missing folder": (["no/good.csv"], ["no/good.csv", "no such file", '"no" does not exist']),
    "directory": (["folder"], ["folder", "is a directory", "expected"]),
    "empty file": (["empty.csv"], ["empty.csv", "empty", "expected"]),
    "header only": (["header.csv"], ["header.csv", "no readings below"]),
    "word in a number cell": (["word.csv"], ["word.csv, line 3", '"Ny"', '"oops" is not a number']),
    "nan": (["nan.csv"], ["nan.csv, line 3", '"Nz"', "not a finite number"]),
    "inf": (["inf.csv"], ["inf.csv, line 3", '"Nx"', "not a finite number"]),
    "too large": (["huge.csv"], ["huge.csv, line 3", '"Nx"', "too large", "1e+100"]),
    "empty cell": (["gap.csv"], ["gap.csv, line 3", '"Ny"', "a number was expected"]),
    "short row": (["short.csv"], ["short.csv, line 3", "2 cells", "header has 3"]),
    "too few columns": (["two.csv"], ["two.csv", "2 columns", "three"]),
    "which columns": (["wide.csv"], ["wide.csv", "4 columns", "--columns"]),
    "no such column": (["good.csv", "--columns", "Nx,Ny,Nw"], ["--columns", '"Nw"', "did you mean"]),
    "no such number": (["good.csv", "--columns", "1,2,9"], ["--columns", "no column 9", "1 to 3"]),
    "two columns": (["good.csv", "--columns", "1,2"], ["--columns", "three columns", "not 2"]),
    "one column twice": (["good.csv", "--columns", "1,2,1"], ["--columns", "twice"]),
    "all equal": (["equal.csv"], ["equal.csv", "20 readings are equal", "(1, 2, 3)"]),
    "one pose": (["one.csv"], ["one.csv", "only one pose", "twelve poses"]),
    "not UTF-8": (["latin.csv"], ["latin.csv, line 3", '"é" is not a number']),
    "binary": (["zeros.csv"], ["zeros.csv, line 1", "binary"]),
    "compressed": (["packed.csv"], ["packed.csv", "gzip"]),
    "not Parquet": (["not.parquet"], ["not.parquet", "Parquet"]),
    "empty standard input": (["-"], ["<stdin>", "empty"]),
    "no data": ([], ["missing argument", "calibrate --help"]),
    "two files": (["good.csv", "good.csv"], ["unexpected extra argument"]),
    "negative g": (["good.csv", "--g", "-9.8"], ["--g -9.8", "expected", "9.78 to 9.84"]),
    "zero g": (["good.csv", "--g", "0"], ["--g 0", "expected"]),
    "nan g": (["good.csv", "--g", "nan"], ["--g nan", "expected"]),
    "infinite g": (["good.csv", "--g", "inf"], ["--g inf", "expected"]),
    "enormous g": (["good.csv", "--g", "1e300"], ["--g 1e+300", "expected"]),
    "g in words": (["good.csv", "--g", "high"], ["--g", "valid"]),
    "two gravities": (["good.csv", "--g", "9.8", "--latitude", "50"], ["--g and --latitude", "not both"]),
    "latitude": (["good.csv", "--latitude", "91"], ["--latitude 91", "-90 to 90"]),
    "nan latitude": (["good.csv", "--latitude", "nan"], ["--latitude nan", "-90 to 90"]),
    "height alone": (["good.csv", "--height", "100"], ["--height", "--latitude"]),
    "height": (["good.csv", "--latitude", "5", "--height", "1e9"], ["--height", "expected metres"]),
    "two columns of one name": (["namesakes.csv"], ["namesakes.csv", "two columns", '"Nx"', "--columns"]),
    "population": (["good.csv", "--population", "1"], ["population: 1", "at least 8"]),
    "iterations": (["good.csv", "--iterations", "0"], ["iterations: 0", "at least 1"]),
    "runs": (["good.csv", "--runs", "0"], ["runs: 0", "at least 1"]),
    "seed": (["good.csv", "--seed", "-1"], ["seed: -1", "at least 0"]),
    "seed in words": (["good.csv", "--seed", "x"], ["--seed", "valid"]),
    "optimizer": (["good.csv", "--optimizer", "psoo"], ['"psoo"', 'did you mean "pso"', "known: "]),
    "gauge": (["good.csv", "--gauge", "lwer"], ["gauge", "lwer", 'did you mean "lower"', "symmetric"]),
    "format": (["good.csv", "--format", "jsn"], ["--format", '"jsn"', 'did you mean "json"', "table"]),
    "robust": (["good.csv", "--robust", "hubr"], ["robust", "hubr", 'did you mean "huber"', "soft-l1"]),
    "weights": (["good.csv", "--weights", "all"], ["weights", "all", "none, n, sd"]),
    "weights without counts": (["good.csv", "--weights", "sd"], ["good.csv", "--weights sd", 'column "n"']),
    "nan tolerance": (["good.csv", "--tolerance", "nan"], ["--tolerance nan", "positive"]),
    "negative tolerance": (["good.csv", "--tolerance", "-1"], ["--tolerance -1", "positive"]),
    "unknown option": (["good.csv", "--optimzer", "de"], ["--optimzer", "--optimizer"]),
    "option without value": (["good.csv", "--g"], ["--g", "argument"]),
    "missing config": (["good.csv", "--config", "no.yaml"], ["no.yaml", "no such file"]),
    "config is a folder": (["good.csv", "--config", "folder"], ["folder", "is a directory"]),
    "unknown key": (["good.csv", "--config", "unknown.yaml"], ["unknown.yaml", '"optimiser"', '"optimizer"']),
    "type": (["good.csv", "--config", "type.yaml"], ["type.yaml: runs", "whole number", "'many'"]),
    "boolean": (["good.csv", "--config", "boolean.yaml"], ["boolean.yaml: polish", "true or false"]),
    "list": (["good.csv", "--config", "list.yaml"], ["list.yaml: optimizer", "expected text"]),
    "syntax": (["good.csv", "--config", "syntax.yaml"], ["syntax.yaml, line 3, column "]),
    "duplicate key": (["good.csv", "--config", "twice.yaml"], ["twice.yaml, line 3", '"runs"', "twice"]),
    "config not UTF-8": (["good.csv", "--config", "latin.yaml"], ["latin.yaml", "UTF-8"]),
    "empty config": (["good.csv", "--config", "nothing.yaml"], ["nothing.yaml", "keys and values"]),
    "config without keys": (["good.csv", "--config", "number.yaml"], ["number.yaml", "keys and values"]),
    "key is a number": (["good.csv", "--config", "keys.yaml"], ["keys.yaml, line 1", "key 3 is not text"]),
    "python in YAML": (["good.csv", "--config", "python.yaml"], ["python.yaml, line 1", "tag"]),
    "parameter": (["good.csv", "--config", "parameter.yaml"], ['"populaton"', 'did you mean "population"']),
    "parameters": (["good.csv", "--config", "parameters.yaml"], ["parameters", "mapping"]),
    "population in YAML": (["good.csv", "--config", "population.yaml"], ["population: 1", "at least 8"]),
    "endless g": (["good.csv", "--config", "g-endless.yaml"], ["g-endless.yaml: g", "too large"]),
    "endless number": (["good.csv", "--config", "endless.yaml"], ["population", "too large"]),
    "box": (["good.csv", "--config", "box.yaml"], ["box.yaml: box: scale: 2", "at most 0.9"]),
    "box key": (["good.csv", "--config", "box-key.yaml"], ['"scales"', 'did you mean "scale"']),
    "nominal": (["good.csv", "--config", "nominal.yaml"], ["nominal: scale", "expected 3 values, not 2"]),
    "nominal zero": (["good.csv", "--config", "nominal-zero.yaml"], ["nominal", "positive"]),
    "nominal inf": (
        ["good.csv", "--config", "nominal-inf.yaml"],
        ["nominal: scale[2]", "not a finite number"],
    ),
    "nominal large": (["good.csv", "--config", "nominal-large.yaml"], ["nominal", "1e+30"]),
    "g in YAML": (["good.csv", "--config", "g.yaml"], ["g.yaml: g: -9.8", "at least"]),
    "nan g in YAML": (["good.csv", "--config", "g-nan.yaml"], ["g-nan.yaml: g", "not a finite number"]),
    "output folder": (["good.csv", "-o", "no/result.yaml"], ["no/result.yaml", "no such folder: no"]),
    "output suffix": (["good.csv", "-o", "result.txt"], ["result.txt", ".yaml, .yml, .json"]),
    "output is a folder": (["good.csv", "-o", "folder"], ["folder", "is a directory"]),
    "output is a YAML folder": (["good.csv", "-o", "folder.yaml"], ["folder.yaml", "is a directory"]),
    "two results": (["good.csv", "-o", "-", "--format", "json"], ["-o -", "--format json"]),
}

SIMULATE = {
    "no positions": (["--positions", "0"], ["--positions", "0 is not in the range"]),
    "positions in words": (["--positions", "many"], ["--positions", "'many'"]),
    "too many": (["--positions", "100000", "--samples", "100000"], ["--positions", "at most 100,000,000"]),
    "unknown scheme": (["--scheme", "face"], ["--scheme", '"face"', 'did you mean "faces"']),
    "scheme of other size": (["--scheme", "faces"], ["--scheme", "has 6 poses, not 12"]),
    "unknown sensor": (["--sensor", "mem"], ['"mem"', 'did you mean "mems"', "dpso"]),
    "missing sensor": (["--sensor", "no.yaml"], ["no.yaml", "no such file"]),
    "singular sensor": (["--sensor", "singular.yaml"], ["singular.yaml", "K_a: singular"]),
    "sensor without matrix": (["--sensor", "no-matrix.yaml"], ["no-matrix.yaml", "K_a: missing"]),
    "negative noise": (["--noise", "-1"], ["--noise -1", "expected 0 to 100"]),
    "nan noise": (["--noise", "nan"], ["--noise nan", "expected 0 to 100"]),
    "negative g": (["--g", "-1"], ["--g -1", "expected"]),
    "latitude": (["--latitude", "91"], ["--latitude 91", "-90 to 90"]),
    "seed": (["--seed", "-1"], ["--seed", "-1"]),
    "no sensors": (["--sensors", "0"], ["--sensors", "0 is not in the range"]),
    "sensors of a log": (["--sensors", "3", "--raw"], ["--sensors", "--raw"]),
    "too many sensors": (["--sensors", "10000000"], ["--sensors 10000000", "at most 100,000,000"]),
    "output folder": (["-o", "no/data.csv"], ["no/data.csv", "no such folder"]),
    "output is a folder": (["-o", "folder"], ["folder", "is a directory"]),
    "truth folder": (["--truth", "no/t.yaml", "-o", "data.csv"], ["no/t.yaml", "no such folder"]),
    "one file for both": (["--truth", "t.yaml", "-o", "t.yaml"], ["t.yaml", "another file"]),
}

FLEET = {
    "missing file": (["flet.csv"], ["flet.csv", "no such file", 'did you mean "fleet.csv"']),
    "missing second file": (["fleet.csv", "no.csv", "--sensor-column", "sensor"], ["no.csv", "no such file"]),
    "a file twice": (["good.csv", "good.csv"], ["good.csv", "given twice"]),
    "no data": ([], ["missing argument", "fleet --help"]),
    "no sensor column": (
        ["good.csv"],
        ["good.csv", "labels the sensor", "serial", "--sensor-column", '"Nx"'],
    ),
    "no such sensor column": (
        ["fleet.csv", "--sensor-column", "sensr"],
        ["--sensor-column", '"sensr"', 'did you mean "sensor"'],
    ),
    "a reading as sensor column": (
        ["fleet.csv", "--sensor-column", "Ny"],
        ["--sensor-column", '"Ny"', "fleet.csv", "not a label"],
    ),
    "two sensor columns": (["fleet-two.csv"], ['"device" or "serial"', "--sensor-column"]),
    "no header": (["fleet-bare.csv"], ["no header", "--sensor-column 1"]),
    "a sensor in every row": (["fleet-rows.csv"], ["fleet-rows.csv", "every row", "--sensor-column"]),
    "which columns": (["fleet-axes.csv"], ["fleet-axes.csv", "--columns"]),
    "word in a number cell": (
        ["fleet-word.csv"],
        ["fleet-word.csv, line 3", '"Ny"', '"oops" is not a number'],
    ),
    "empty label": (["fleet-gap.csv"], ["fleet-gap.csv, line 3", '"sensor"', "is empty", "label"]),
    "header only": (["header.csv", "--sensor-column", "1"], ["header.csv", "no readings below"]),
    "empty standard input": (["-"], ["<stdin>", "empty"]),
    "not Parquet": (["not.parquet"], ["not.parquet", "Parquet"]),
    "gauge": (["fleet.csv", "--gauge", "lwer"], ["gauge", "lwer", 'did you mean "lower"']),
    "gauge full": (["fleet.csv", "--gauge", "full"], ["gauge: full", "lower, upper, symmetric"]),
    "weights": (["fleet.csv", "--weights", "all"], ["weights", "all", "none, n, sd"]),
    "weights auto": (["fleet.csv", "--weights", "auto"], ["--weights auto needs", "columns n, sx, sy, sz"]),
    "weights without counts": (["fleet.csv", "--weights", "n"], ["fleet.csv", 'sensor "A"', "--weights n"]),
    "optimizer": (["fleet.csv", "--config", "optimizer.yaml"], ["optimizer", "levenberg-marquardt"]),
    "unknown key": (
        ["fleet.csv", "--config", "unknown.yaml"],
        ["unknown.yaml", '"optimiser"', '"optimizer"'],
    ),
    "negative g": (["fleet.csv", "--g", "-9.8"], ["--g -9.8", "expected", "9.78 to 9.84"]),
    "two gravities": (["fleet.csv", "--g", "9.8", "--latitude", "50"], ["--g and --latitude", "not both"]),
    "nan tolerance": (["fleet.csv", "--tolerance", "nan"], ["--tolerance nan", "positive"]),
    "format": (["fleet.csv", "--format", "jsn"], ["--format", '"jsn"', 'did you mean "json"']),
    "output suffix": (["fleet.csv", "-o", "all.txt"], ["all.txt", ".csv, .parquet, .json", "folder"]),
    "output folder": (["fleet.csv", "-o", "no/all.csv"], ["no/all.csv", "no such folder: no"]),
    "output folder of a folder": (["fleet.csv", "-o", "no/all/"], ["no/all/", "no such folder: no"]),
    "output is a file": (["fleet.csv", "-o", "good.csv/"], ["good.csv/", "is a file", "folder"]),
    "output holds files": (["fleet.csv", "-o", "full"], ["full", "holds files already", "empty folder"]),
}


@pytest.fixture
def folder(good, tmp_path):
    """A folder with every kind of wrong file."""
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a.json").write_text("{}")
    return tmp_path


@pytest.mark.parametrize("what", CALIBRATE)
def test_calibrate_refuses(run, folder, what):
    arguments, parts = CALIBRATE[what]
    before = sorted(os.listdir(folder))
    own = () if "-o" in arguments else RESULT
    refused(run("calibrate", *arguments[:1], *own, *arguments[1:]), parts)
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize("what", SIMULATE)
def test_simulate_refuses(run, folder, what):
    arguments, parts = SIMULATE[what]
    before = sorted(os.listdir(folder))
    refused(run("simulate", *arguments), parts)
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize("what", FLEET)
def test_fleet_refuses(run, folder, what):
    arguments, parts = FLEET[what]
    before = sorted(os.listdir(folder))
    refused(run("fleet", *arguments), parts)
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ("apply", "good.csv", "result.yaml"),
        ("verify", "good.csv", "result.yaml"),
        ("export", "good.csv", "--to", "px4"),
        ("report", "good.csv", "-o", "page.html"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_readings_are_no_result_file(run, folder, arguments):
    Path("result.yaml").write_text("")
    before = sorted(os.listdir(folder))
    refused(run(*arguments), ["good.csv", "result file of a calibration was expected"])
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize(
    ("arguments", "part"),
    [(["calibrat"], "'calibrate'"), (["--nope"], "--nope"), (["--version=3"], "--version")],
)
def test_an_unknown_command_or_option_is_refused(run, arguments, part):
    refused(run(*arguments), [part])


def test_a_folder_without_permission_is_refused_before_the_work(run, good, monkeypatch):
    monkeypatch.setattr("accelcal_cli.output.files.os.access", lambda *_: False)  # root may write anywhere
    monkeypatch.setattr(
        "accelcal_cli.calibration.calibrate.calibrate", lambda *_: pytest.fail("worked in vain")
    )
    refused(run("calibrate", good, *RESULT), ["result.yaml", "permission denied"])


def test_a_full_disk_leaves_nothing_behind(run, good, tmp_path):
    Path("result.json").write_text("the old one")
    before = sorted(os.listdir(tmp_path))
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))  # a write beyond 1000 bytes fails
    try:
        outcome = run("calibrate", good, "-o", "result.json")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    refused(outcome, ["result.json", "cannot be written", os.strerror(errno.EFBIG).lower()])
    assert sorted(os.listdir(tmp_path)) == before
    assert Path("result.json").read_text() == "the old one"
