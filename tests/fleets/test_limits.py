"""Limits per parameter: which sensors keep them, why the others do not, and files that state them wrongly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars
import pytest

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.fleet import Fleet, fleet
from accelcal_cli.calibration.settings import Nominal, Settings
from accelcal_cli.errors import ConfigError
from accelcal_cli.fleets.limits import check_limits, load_limits
from accelcal_cli.sensor import poses

G = 9.8
SETTINGS = Settings(optimizer="levenberg-marquardt", g=G, nominal=Nominal(scale=(100.0, 100.0, 100.0)))


@pytest.fixture
def sensors() -> tuple[dict[str, np.ndarray], Fleet]:
    """A good sensor, one with a bias of 80 mg along y, one 3 % too sensitive along z, and one that never moved."""
    rng = np.random.default_rng(3)
    force = G * poses.turns() + 1e-3 * rng.standard_normal((24, 3))
    bias, scale = np.array([0.0, 0.08 * G, 0.0]), np.array([1.0, 1.0, 1.03])
    made = {"good": 100 * force, "biased": 100 * (force + bias), "keen": 100 * force * scale}
    made["still"] = np.repeat(100 * force[:1], 12, axis=0)
    return made, fleet({k: v for k, v in made.items() if k != "still"}, g=G)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "limits.yaml"
    path.write_text(text)
    return path


def test_who_is_beyond_a_limit_and_why(tmp_path, sensors):
    made, calibrated = sensors
    text = "limits:\n  bias: 50 mg\n  scale: 1 %\n  misalignment: 0.5 deg\n  noise: 1 mg\n  rms: 0.1 m/s^2\n"
    check = check_limits(calibrated, load_limits(written(tmp_path, text), SETTINGS), SETTINGS)
    assert check.passed.tolist() == [True, False, False]
    assert check.counts() == {"bias": 1, "scale": 1, "misalignment": 0, "noise": 0, "rms": 0}
    assert check.reason(0) == ""
    assert check.reason(2).startswith("scale factor z 3.0")
    one = calibrate(made["biased"], g=G)
    half = 1e3 * calibrated.coverage[1] * one.sigma.D_a[1] / 100 / G
    words = check.reason(1)
    assert words.startswith("bias y 80.0")
    assert words.endswith("is beyond 50 mg")
    low, high = (float(word) for word in words.partition("interval ")[2].partition(")")[0].split(" to "))
    assert low < 80.0 < high
    assert (high - low) / 2 == pytest.approx(half, rel=0.1)


def test_units_are_sizes_of_one_another(tmp_path, sensors):
    _, calibrated = sensors
    values = {}
    for stated in ("80 mg", "0.08 g", "80000 ug", "80000 µg", "0.784 m/s^2"):
        limits = load_limits(written(tmp_path, f"limits: {{bias: {stated}}}"), SETTINGS)
        check = check_limits(calibrated, limits, SETTINGS)
        values[stated] = check.value[1, 1] / limits["bias"].number
    np.testing.assert_allclose(list(values.values()), values["80 mg"], rtol=1e-12)
    for stated, size in (("10 mrad", 10.0), ("0.01 rad", 0.01), ("1 deg", 1.0)):
        limits = load_limits(written(tmp_path, f"limits: {{misalignment: {stated}}}"), SETTINGS)
        assert limits["misalignment"].number == size
    part, million = (
        check_limits(
            calibrated, load_limits(written(tmp_path, f"limits: {{scale: {s}}}"), SETTINGS), SETTINGS
        ).value
        for s in ("1 %", "1 ppm")
    )
    np.testing.assert_allclose(million, 1e4 * part, rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("bias: 50 mg\n", 'limits.yaml: expected the key "limits" with a mapping'),
        ("limit: {bias: 50 mg}\n", 'did you mean "limits"'),
        ("limits: {}\n", "limits: expected at least one of bias, scale"),
        ("limits: {biass: 50 mg}\n", r'unknown key "biass" \(did you mean "bias"'),
        ("limits: {bias: 50}\n", r"limits: bias: expected a number with its unit \(g, mg, ug, m/s\^2"),
        ("limits: {bias: 50 mgg}\n", 'limits: bias: unknown unit "mgg" .did you mean "mg"'),
        ("limits: {bias: 1 deg}\n", 'limits: bias: unknown unit "deg"'),
        ("limits: {rms: -1 mg}\n", "limits: rms: -1 is not above zero"),
        ("limits: {noise: [1, mg]}\n", "limits: noise: expected a number with its unit"),
        ("limits: [50 mg]\n", "expected the key"),
    ],
)
def test_a_file_that_states_them_wrongly_is_told_what_was_expected(tmp_path, text, said):
    with pytest.raises(ConfigError, match=said):
        load_limits(written(tmp_path, text), SETTINGS)


def test_a_limit_of_scale_needs_a_nominal_sensor(tmp_path):
    with pytest.raises(ConfigError, match="limits: scale: needs a nominal sensor"):
        load_limits(written(tmp_path, "limits: {scale: 1 %}"), Settings())


def test_columns_counts_and_exit_code(run_fleet, tmp_path, sensors):
    made, _ = sensors
    rows = [
        polars.DataFrame({"sensor": label, "ax": v[:, 0], "ay": v[:, 1], "az": v[:, 2]})
        for label, v in made.items()
    ]
    polars.concat(rows).write_csv(tmp_path / "fleet.csv")
    written(tmp_path, "limits: {bias: 50 mg}\n")
    line = ("fleet", "fleet.csv", "--g", str(G), "--limits", "limits.yaml", "-q")
    code, out, err = run_fleet(*line, "-o", "out.parquet")
    assert code == 1
    assert out.startswith("Limits: 2 of 4 sensors pass; beyond: bias 1\n")
    assert "accelcal: 2 of 4 sensors beyond the limits or without a value: biased, still\n" in err
    frame = polars.read_parquet(tmp_path / "out.parquet")
    assert frame.columns[-2:] == ["passed", "failed_limits"]
    assert frame["passed"].to_list() == ["true", "false", "true", "false"]
    assert frame["failed_limits"][1].startswith("bias y 80.0")
    assert frame["failed_limits"][3] == "not determined"
    lines = [
        text for text in (tmp_path / "fleet.csv").read_text().splitlines() if text[:4] not in ("bias", "stil")
    ]
    (tmp_path / "fleet.csv").write_text("\n".join(lines))
    assert run_fleet(*line)[0] == 0


@pytest.fixture
def run_fleet(tmp_path, monkeypatch, capsys):
    """Run the command line in this process, in an empty folder."""
    from accelcal_cli.cli.main import main

    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["accelcal", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        printed = capsys.readouterr()
        return int(stop.value.code or 0), printed.out, printed.err

    return call
