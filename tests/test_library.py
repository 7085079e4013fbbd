"""The library as people use it in a notebook: a name for each task, any kind of table, results that show themselves."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import accelcal_cli as accelcal
from accelcal_cli.errors import ConfigError, DataError, UsageError
from accelcal_cli.views.quoted import quote

SAMPLE = Path(__file__).parents[1] / "docs" / "sample.csv"
NAMES = (
    *(
        "AccelcalError",
        "Calibration",
        "EXPORTERS",
        "ErrorModel",
        "OPTIMIZERS",
        "Problem",
        "Readings",
        "Settings",
    ),
    *("apply", "calibrate", "calibrate_many", "detect", "export", "fleet", "load_sensor", "minimize", "plan"),
    *("read_log", "read_readings", "report", "simulate", "verify"),
)


@pytest.fixture(scope="module")
def sample():
    return accelcal.calibrate(SAMPLE)


def doctested() -> list[str]:
    """The modules with examples, found by their source, so that nothing is imported that has none."""
    root = Path(accelcal.__file__).parent
    found = ["accelcal_cli"] if ">>> " in Path(accelcal.__file__).read_text() else []
    for module in pkgutil.walk_packages([str(root)], "accelcal_cli."):
        path = root.joinpath(*module.name.split(".")[1:]).with_suffix(".py")
        if path.is_file() and ">>> " in path.read_text():
            found.append(module.name)
    return found


@pytest.mark.parametrize("name", doctested())
def test_examples_of_docstrings_run(name):
    done = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert done.attempted
    assert done.failed == 0


def test_every_function_of_the_library_has_an_example():
    for name in NAMES:
        if name.islower() and name not in ("load_sensor", "minimize"):
            assert ">>> " in getattr(accelcal, name).__doc__, name


def test_the_names_are_there_and_nothing_else_is_listed():
    assert set(NAMES) <= set(dir(accelcal))
    assert all(hasattr(accelcal, name) for name in dir(accelcal))
    assert "importlib" not in dir(accelcal)


def test_completion_of_ipython_lists_the_api():
    completer = pytest.importorskip("IPython.core.completer")
    shell = completer.Completer(namespace={"accelcal": accelcal})
    listed = {word.rpartition(".")[2] for word in shell.attr_matches("accelcal.")}
    assert set(NAMES) <= listed


def test_importing_the_library_loads_nothing():
    script = "import sys, accelcal_cli; dir(accelcal_cli); print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("kind", ["polars", "lazy", "pandas", "arrow", "path"])
def test_a_table_of_any_kind_gives_the_numbers_of_the_file(kind, sample):
    frame = pl.read_csv(SAMPLE)
    if kind == "pandas":
        pandas = pytest.importorskip("pandas")
        data = pandas.read_csv(SAMPLE)
    elif kind == "arrow":
        pytest.importorskip("pyarrow")
        data = frame.to_arrow()
    else:
        data = {"polars": frame, "lazy": frame.lazy(), "path": str(SAMPLE)}[kind]
    result = accelcal.calibrate(data)
    assert np.array_equal(result.K_a, sample.K_a)
    assert np.array_equal(result.D_a, sample.D_a)
    assert np.array_equal(result.sigma.K_a, sample.sigma.K_a)
    assert [pose.where for pose in result.poses_fit] == [pose.where for pose in sample.poses_fit]


def test_an_array_gives_the_numbers_of_its_file(tmp_path):
    output = accelcal.simulate("mems", positions=24, seed=3).output
    path = tmp_path / "readings.csv"
    pl.DataFrame(output, schema=["x", "y", "z"]).write_csv(path)
    assert np.array_equal(accelcal.calibrate(output).K_a, accelcal.calibrate(path).K_a)
    assert np.array_equal(accelcal.calibrate(output.tolist()).K_a, accelcal.calibrate(path).K_a)


def test_text_columns_of_pandas_label_the_poses(sample):
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_csv(SAMPLE, dtype={"pose": str})
    assert np.array_equal(accelcal.calibrate(frame).K_a, sample.K_a)
    broken = frame.assign(pose=[None, *frame["pose"][1:]])
    with pytest.raises(DataError, match='row 1, column "pose": is empty'):
        accelcal.calibrate(broken)


def test_keys_of_the_settings_are_arguments(sample):
    assert accelcal.calibrate(SAMPLE, g=9.81, optimizer="levenberg-marquardt").g == 9.81
    place = accelcal.calibrate(SAMPLE, latitude=48.1, height=500, optimizer="levenberg-marquardt")
    assert place.g == pytest.approx(9.80746, abs=1e-5)
    settings = accelcal.Settings("levenberg-marquardt", g=9.81)
    assert accelcal.calibrate(SAMPLE, settings, g=9.8).g == 9.8
    with pytest.raises(ConfigError, match="gravity"):
        accelcal.calibrate(SAMPLE, settings, gravity=9.8)
    with pytest.raises(ConfigError, match="gravity"):
        accelcal.calibrate(SAMPLE, gravity=9.8)
    with pytest.raises(UsageError, match="--g and --latitude"):
        accelcal.calibrate(SAMPLE, g=9.8, latitude=48)


def test_readings_in_units_of_g_are_taken_so(tmp_path):
    output = accelcal.simulate("navigation", positions=24, g=1.0, seed=8).output
    scaled = output / 1.0
    path = tmp_path / "g.csv"
    pl.DataFrame(scaled, schema=["ax (g)", "ay (g)", "az (g)"]).write_csv(path)
    both = accelcal.calibrate_many([path, accelcal.simulate("mems", positions=24).output])
    assert [result.g for result in both] == [1.0, 9.80665]
    assert np.array_equal(both[0].K_a, accelcal.calibrate(path).K_a)


def test_a_detection_is_calibrated_as_the_command_does():
    log = accelcal.simulate("mems", positions=13, raw=True, seed=2)
    detection = accelcal.detect(log, min_poses=12, window=0.5)
    assert detection.rows.window == 50
    result = accelcal.calibrate(detection)
    assert result.settings["weights"] == "auto"
    assert result.data["rows"] == len(log)
    assert accelcal.calibrate(detection, misalignment=False).settings["weights"] == "n"


def test_a_calibration_prints_itself_on_fifteen_lines(sample):
    text = str(sample)
    assert text.startswith("good: 24 poses")
    assert "1693.43 ± 0.58" in text
    assert max(map(len, text.splitlines())) <= 100
    assert len(text.splitlines()) <= 15
    poor = accelcal.calibrate(accelcal.simulate("mems", positions=6).output)
    assert len(str(poor).splitlines()) <= 15
    assert "not determined" in str(poor)
    assert poor.reasons[0] in str(poor)


def test_a_calibration_shows_itself_in_a_notebook(sample):
    page = sample._repr_html_()
    assert "<td>1693.43 ± 0.58</td>" in page
    assert page.count("<table>") == page.count("</table>") == 2


def test_a_calibration_goes_to_a_file_and_back(sample, tmp_path):
    for name in ("result.yaml", "result.json"):
        sample.save(tmp_path / name)
        assert accelcal.Calibration.load(tmp_path / name).to_dict() == sample.to_dict()
    frame = sample.to_frame()
    assert frame.filter(pl.col("parameter") == "K_11")["value"].item() == sample.K_a[0, 0]
    assert frame.filter(pl.col("parameter") == "D_3")["interval"].item() == sample.interval.D_a[2]


def test_a_calibration_is_applied_to_arrays_and_logs(sample):
    frame = pl.read_csv(SAMPLE)
    force = sample.apply(frame.select("Nx", "Ny", "Nz").to_numpy())
    assert np.abs(np.linalg.norm(force, axis=1) - 9.80665).max() < 0.5
    table = accelcal.apply(sample, frame)
    assert np.array_equal(table.select("fx", "fy", "fz").to_numpy(), force)
    assert accelcal.apply(sample, SAMPLE).select("fx", "fy", "fz").to_numpy() == pytest.approx(
        force, rel=1e-12
    )
    assert sample.apply(force[0]).shape == (3,)


def test_slopes_with_temperature_are_applied():
    simulated = accelcal.simulate("mems", positions=24, samples=2, seed=1, noise=1e-3)
    degrees = np.where(np.arange(48) % 2, 20.0, 40.0)
    warm = simulated.output * (1 + 1e-4 * (degrees - 30.0))[:, None]
    frame = pl.DataFrame({"x": warm[:, 0], "y": warm[:, 1], "z": warm[:, 2], "temperature": degrees})
    result = accelcal.calibrate(frame)
    assert result.temperature is not None
    with_degrees, without = result.apply(warm, degrees), result.apply(warm)
    spread = [np.std(np.linalg.norm(force, axis=1)) for force in (with_degrees, without)]
    assert spread[0] < 0.5 * spread[1]


@pytest.mark.parametrize("name", ["plot_residuals", "plot_convergence", "plot_intervals"])
def test_a_calibration_draws_itself(sample, name):
    figure = pytest.importorskip("matplotlib.figure").Figure()
    axes = getattr(sample, name)(figure.subplots())
    assert axes.get_ylabel()
    assert axes.lines or axes.containers


def test_files_and_results_are_taken_alike(sample, tmp_path):
    path = tmp_path / "result.yaml"
    sample.save(path)
    assert accelcal.verify(path, SAMPLE).verdict == accelcal.verify(sample, SAMPLE).verdict
    assert accelcal.export(path, "ros").content == accelcal.export(sample, "ros").content
    assert len(accelcal.plan(path, add=2).directions) == len(accelcal.plan(SAMPLE, add=2).directions) == 2
    page = accelcal.report(path, tmp_path / "page.html", title="Desk 1")
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == page
    file = accelcal.export(sample, "c-header")
    file.save(tmp_path / "accel.h")
    assert (tmp_path / "accel.h").read_bytes() == file.content
    with pytest.raises(UsageError, match="not both"):
        accelcal.plan(sample, poses=30, add=3)


def test_a_fleet_is_calibrated_from_a_table_or_by_label():
    poses = {f"S{n}": accelcal.simulate("mems", positions=24, seed=n) for n in (1, 2, 3)}
    by_label = accelcal.fleet({label: one.to_frame() for label, one in poses.items()})
    table = pl.concat([one.to_frame().with_columns(sensor=pl.lit(label)) for label, one in poses.items()])
    from_table = accelcal.fleet(table)
    assert list(by_label.labels) == list(from_table.labels) == ["S1", "S2", "S3"]
    assert from_table.K_a == pytest.approx(by_label.K_a, rel=1e-9, abs=1e-9)
    assert from_table.to_frame()["verdict"].to_list() == ["good"] * 3


@pytest.mark.parametrize(
    ("value", "interval", "quoted"),
    [
        (1.0, 0.0996, ("1.00", "0.10")),
        (-0.0004, 0.12, ("0.00", "0.12")),
        (123456.0, 9960.0, ("123000", "10000")),
        (5.0, 0.0, ("5", "")),
        (5.0, float("nan"), ("5", "")),
        (1e-20, 1e-22, ("1e-20", "1.0e-22")),
        (1234.56789012, 1e-10, ("1234.56789", "1.0e-10")),
    ],
)
def test_values_are_quoted_to_two_digits_of_their_uncertainty(value, interval, quoted):
    assert quote(value, interval) == quoted
