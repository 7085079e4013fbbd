"""A fleet: each sensor as if it were alone, whatever its company."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from simulated import MEMS, noise

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.distributions import chi_square_chance, student_chance
from accelcal_cli.calibration.fleet import FAILED, calibrate_each, calibrate_fleet, standouts
from accelcal_cli.calibration.problem import compress_each, fit_ellipsoid, least_squares
from accelcal_cli.calibration.settings import BoxSettings, Nominal, Settings
from accelcal_cli.errors import AccelcalError, ConfigError, DataError
from accelcal_cli.io.fleet import read_fleet
from accelcal_cli.io.readings import Readings, read_readings
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.simulation import Sensor, Spread, draw
from accelcal_cli.views.blocks import Table
from accelcal_cli.views.fleet import blocks, counts, sensors

G = 9.81
LM = Settings(optimizer="levenberg-marquardt", g=G)
TYPE = Sensor(K_a=((100.0, 0, 0), (0, 100.0, 0), (0, 0, 100.0)), spread=Spread(0.02, 0.01, 0.3))
LINE = re.compile(r"line \d+")
SCHEMES = {
    "faces-edges": poses.faces_edges(),
    "turns": poses.turns(),
    "fibonacci 40": poses.fibonacci(40),
    "twice": np.repeat(poses.faces_edges(), 2, axis=0),
    "nine": poses.fibonacci(9),
    "eight": poses.fibonacci(8),
    "faces": poses.faces(),
    "faces many": np.repeat(poses.faces(), 4, axis=0),
    "one plane": np.array([[np.cos(t), np.sin(t), 0.0] for t in np.linspace(0, 6, 15)]),
    "cap": poses.fibonacci(200)[:14],
    "two": poses.faces()[:2],
    "one": poses.faces()[:1],
    "equal": np.repeat(poses.faces()[:1], 12, axis=0),
    "wide cap": poses.fibonacci(120)[:20],
}
"""Good, weak, undetermined and useless sets of poses, of many lengths."""


def said_of(notices):
    """What is said, whatever the rows and the files are called."""
    return [
        (one.key, one.severity, LINE.sub("", one.text), re.sub(r"\S+\.csv", "", one.remedy))
        for one in notices
    ]


def rows_of(u, number, sigma=0.01):
    """Return the readings of drawn sensor `number` in directions u, shape (J, 3)."""
    model = draw(TYPE, [number], 4)
    force = G * u + noise(len(u), sigma, number)
    if (u == u[0]).all():
        force = force[:1].repeat(len(u), axis=0)
    return force @ model.K[0].T + model.D[0]


def write(path, tables, header="sensor,ax,ay,az"):
    """Write a table of readings by label, shape (J, 3), one sensor after the other or, `mixed`, row by row."""
    lines = [f"{label},{','.join(map(repr, row))}" for label, rows in tables.items() for row in rows.tolist()]
    path.write_text("\n".join([header, *lines]) + "\n")
    return str(path)


def lines_of(path):
    return Path(path).read_text().splitlines()


@pytest.fixture
def mixed(tmp_path):
    """Every scheme twice, once noisy, in one table whose rows are shuffled."""
    tables = {
        f"{name}/{sigma:g}": rows_of(u, k, sigma)
        for k, (name, u) in enumerate(SCHEMES.items())
        for sigma in (0.001, 0.3)
    }
    path = tmp_path / "mixed.csv"
    lines = [(label, j, row) for label, rows in tables.items() for j, row in enumerate(rows.tolist())]
    order = np.argsort(Streams(3, [0]).uniform(len(lines), 1)[0, :, 0])
    at = {label: iter(range(len(rows))) for label, rows in tables.items()}
    text = ["sensor,ax,ay,az"]
    for i in order:  # the rows of a sensor keep their order
        label = lines[i][0]
        text.append(f"{label},{','.join(map(repr, tables[label][next(at[label])].tolist()))}")
    path.write_text("\n".join(text) + "\n")
    return str(path), tables


@pytest.mark.parametrize(
    "settings",
    [
        LM,
        dataclasses.replace(LM, gauge="symmetric"),
        dataclasses.replace(LM, gauge="upper", seed=5),
        dataclasses.replace(LM, nominal=Nominal((101.0, 99.0, 100.0)), box=BoxSettings(0.01, 0.01, 0.01)),
    ],
    ids=["lower", "symmetric", "upper", "walls"],
)
def test_every_sensor_is_calibrated_as_if_it_were_alone(mixed, tmp_path, settings):
    path, tables = mixed
    readings = read_fleet([path])
    fleet = calibrate_fleet(readings, settings)
    assert readings.sensors == tuple(dict.fromkeys(line.split(",")[0] for line in lines_of(path)[1:]))
    seen, told = set(), 0
    for r, label in enumerate(readings.sensors):
        seen.add(fleet.verdict[r])
        alone = tmp_path / "alone.csv"
        alone.write_text("ax,ay,az\n" + "\n".join(",".join(map(repr, row)) for row in tables[label].tolist()))
        if fleet.verdict[r] == FAILED:
            with pytest.raises(DataError):
                calibrate(read_readings(alone), settings)
            assert fleet.reason[r].startswith("Nothing to calibrate: ")
            assert np.isnan(fleet.K_a[r]).all()
            continue
        one = calibrate(read_readings(alone), settings)
        assert fleet.verdict[r] == one.verdict, label
        assert fleet.poses[r] == one.poses
        words = " ".join(one.reasons)
        assert fleet.reason[r].split(" The least cost")[0].split("No other pose")[0].strip() in words
        assert said_of(fleet.warnings[r]) == said_of(one.warnings)
        dop = np.array(list(one.dop.parameters.values()))
        if one.verdict == "undetermined":
            np.testing.assert_array_equal(np.isinf(fleet.dop[r]), np.isinf(dop))
            np.testing.assert_array_equal(np.isnan(fleet.sigma_k[r]), np.isnan(one.sigma.K_a))
            np.testing.assert_array_equal(np.isnan(fleet.sigma_d[r]), np.isnan(one.sigma.D_a))
            told += np.isfinite(fleet.sigma_d[r]).all()  # of an open direction whose noise is small
            continue
        scale = one.K_a[0, 0]
        np.testing.assert_allclose(fleet.K_a[r], one.K_a, rtol=1e-9, atol=1e-9 * scale)
        np.testing.assert_allclose(fleet.D_a[r], one.D_a, rtol=1e-9, atol=1e-9 * G * scale)
        np.testing.assert_allclose(fleet.sigma_k[r], one.sigma.K_a, rtol=1e-8)
        np.testing.assert_allclose(fleet.sigma_d[r], one.sigma.D_a, rtol=1e-8)
        np.testing.assert_allclose(fleet.dop[r], dop, rtol=1e-8)
        np.testing.assert_allclose(fleet.rms_before[r], one.rms_before, rtol=1e-9)
        if one.freedom:
            np.testing.assert_allclose([fleet.rms[r], fleet.s[r]], [one.rms, one.s], rtol=1e-7)
        named = [p.where for p in one.poses_fit if p.pose in one.outliers]
        assert bool(fleet.outlying[r]) == bool(named)
    assert {"undetermined", FAILED} <= seen
    assert told == (settings.nominal is None)
    assert ("good" in seen) == (settings.nominal is None)


def test_the_whole_records_are_those_of_calibrate(mixed, tmp_path):
    path, tables = mixed
    readings = read_fleet([path])
    kept = {}
    fleet = calibrate_fleet(readings, LM, lambda number, record: kept.setdefault(number, record))
    assert sorted(kept) == [r for r in range(len(readings.sensors)) if fleet.verdict[r] != FAILED]
    assert all(fleet.warnings[number] == record.warnings for number, record in kept.items())
    r = readings.sensors.index("turns/0.001")
    alone = tmp_path / "alone.csv"
    alone.write_text(
        "ax,ay,az\n" + "\n".join(",".join(map(repr, row)) for row in tables["turns/0.001"].tolist())
    )
    one, record = calibrate(read_readings(alone), LM), kept[r]
    np.testing.assert_allclose(record.K_a, one.K_a, rtol=1e-9, atol=1e-9 * one.K_a[0, 0])
    np.testing.assert_allclose(record.covariance, one.covariance, rtol=1e-7, atol=1e-9 * one.covariance.max())
    assert (record.verdict, record.poses, record.before, record.optimizer) == (
        one.verdict,
        one.poses,
        one.before,
        one.optimizer,
    )
    assert record.data["source"] == f'{path}, sensor "turns/0.001"'
    lines = [int(p.where.split()[1]) for p in record.poses_fit]
    table = lines_of(path)
    assert [float(table[n - 1].split(",")[1]) for n in lines] == tables["turns/0.001"][:, 0].tolist()


def test_a_sensor_does_not_see_its_company(tmp_path):
    tables = {f"S{k}": rows_of(poses.faces_edges(), k) for k in range(5)}
    whole = calibrate_fleet(read_fleet([write(tmp_path / "a.csv", tables)]), LM)
    tables["S1"] = tables["S1"] * np.array([1.0, 1.0, 1e12])  # no sensor
    tables["S3"] = tables["S3"][:1].repeat(12, axis=0)
    spoilt = calibrate_fleet(read_fleet([write(tmp_path / "b.csv", tables)]), LM)
    assert spoilt.verdict.tolist() == ["weak", "undetermined", "weak", FAILED, "weak"]
    for r in (0, 2, 4):
        np.testing.assert_array_equal(spoilt.K_a[r], whole.K_a[r])
        np.testing.assert_array_equal(spoilt.sigma_d[r], whole.sigma_d[r])


@pytest.mark.parametrize("weights", ["n", "sd"])
def test_weights_are_those_of_calibrate(tmp_path, weights):
    lines, own = ["sensor,ax,ay,az,n,sx,sy,sz"], {}
    for k, J in enumerate((12, 14, 24)):
        u = poses.fibonacci(J)
        more = np.column_stack([np.arange(1, J + 1), 0.5 + Streams(k, [9]).uniform(J, 3)[0]])
        own[f"S{k}"] = [",".join(map(repr, row)) for row in np.column_stack([rows_of(u, k), more]).tolist()]
        lines += [f"S{k},{row}" for row in own[f"S{k}"]]
    path = tmp_path / "n.csv"
    path.write_text("\n".join(lines))
    settings = dataclasses.replace(LM, weights=weights)
    readings = read_fleet([str(path)])
    kept = {}
    fleet = calibrate_fleet(readings, settings, lambda number, record: kept.setdefault(number, record))
    for r, label in enumerate(readings.sensors):
        alone = tmp_path / "alone.csv"
        alone.write_text("\n".join(["ax,ay,az,n,sx,sy,sz", *own[label]]))
        one = calibrate(read_readings(alone), settings)
        np.testing.assert_allclose(fleet.K_a[r], one.K_a, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(fleet.sigma_k[r], one.sigma.K_a, rtol=1e-7)
        np.testing.assert_allclose(kept[r].s, one.s, rtol=1e-7)
        np.testing.assert_allclose(kept[r].residual_noise_ratio, one.residual_noise_ratio, rtol=1e-7)
    assert not np.allclose(fleet.K_a[0], calibrate_fleet(readings, LM).K_a[0], rtol=1e-9)


def test_weights_that_a_sensor_lacks_are_refused_with_its_name(tmp_path):
    path = write(tmp_path / "a.csv", {"left": rows_of(poses.turns(), 1)})
    with pytest.raises(DataError, match='sensor "left", as all others: --weights n needs a column "n"'):
        calibrate_fleet(read_fleet([path]), dataclasses.replace(LM, weights="n"))


def test_a_sensor_that_gives_no_weights_fails_alone(tmp_path):
    """The others are calibrated as if it were not there."""
    rows = np.column_stack([rows_of(poses.turns(), 1), np.full((len(poses.turns()), 4), 2.0)])
    without = rows.copy()
    without[5, 4:] = 0.0
    path = write(tmp_path / "a.csv", {"left": rows, "right": without}, "sensor,ax,ay,az,n,sx,sy,sz")
    fleet = calibrate_fleet(read_fleet([path]), dataclasses.replace(LM, weights="sd"))
    assert fleet.verdict.tolist() == ["good", FAILED]
    assert fleet.reason[1].startswith('--weights sd needs a column "n" and standard deviations above zero')
    alone = write(tmp_path / "b.csv", {"left": rows}, "sensor,ax,ay,az,n,sx,sy,sz")
    one = calibrate_fleet(read_fleet([alone]), dataclasses.replace(LM, weights="sd"))
    np.testing.assert_array_equal(fleet.K_a[0], one.K_a[0])


def test_a_standard_deviation_of_zero_is_no_weight(tmp_path):
    rows = np.column_stack([rows_of(poses.turns(), 1), np.full((len(poses.turns()), 4), 2.0)])
    rows[3, 4:] = 0.0
    path = write(tmp_path / "a.csv", {"stuck": rows}, "sensor,ax,ay,az,n,sx,sy,sz")
    with pytest.raises(DataError, match=r"--weights sd needs .* above zero"):
        calibrate_fleet(read_fleet([path]), dataclasses.replace(LM, weights="sd"))


def test_the_least_cost_of_the_ellipsoid_is_where_the_gradient_vanishes():
    sets = np.stack([rows_of(poses.turns(), k, 0.05) for k in range(20)])
    triangle = compress_each(sets)
    K, d = least_squares(triangle)
    near, _ = fit_ellipsoid(triangle)
    x = (sets - triangle.centre[:, None]) / triangle.scale[:, None, None]

    def cost(K, d):
        f = np.linalg.solve(K[:, None], (x - d[:, None])[..., None])[..., 0]
        return np.sum((1.0 - np.sum(f * f, axis=2)) ** 2, axis=1)

    least = cost(K, d)
    assert (least < cost(near, d)).all()
    for i, j in ((0, 0), (1, 0), (2, 1), (2, 2)):
        for step in (1e-4, -1e-4):
            moved = K.copy()
            moved[:, i, j] += step
            assert (cost(moved, d) > least).all()
    for k in range(3):
        for step in (1e-4, -1e-4):
            moved = d.copy()
            moved[:, k] += step
            assert (cost(K, moved) > least).all()


def test_without_noise_the_least_cost_is_the_sensor():
    output = MEMS.output(G * poses.fibonacci(15))
    triangle = compress_each(output[None])
    K, d = least_squares(triangle)
    truth = MEMS.in_gauge("lower")
    np.testing.assert_allclose(K[0] * triangle.scale[0] / G, truth.K, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(d[0] * triangle.scale[0] + triangle.centre[0], truth.D, rtol=1e-11, atol=1e-12)


def test_readings_without_an_ellipsoid_have_no_least_cost():
    sets = np.stack([MEMS.output(G * np.repeat(poses.faces(), 2, axis=0)), rows_of(poses.faces_edges(), 1)])
    K, d = least_squares(compress_each(sets))
    assert np.isnan(K[0]).all()
    assert np.isnan(d[0]).all()
    assert np.isfinite(K[1]).all()


def test_student_and_chi_square_agree_with_scipy():
    from scipy.special import chdtrc, stdtr

    t = np.array([0.5, 3.0, 4.0, 6.0])
    for n in (1, 2, 3, 8, 11, 40, 999, 5000):
        np.testing.assert_allclose(student_chance(t, np.full(4, n)), 2.0 * stdtr(n, -t), rtol=1e-6)
        x = n * np.array([0.5, 1.0, 1.5, 2.0])
        np.testing.assert_allclose(chi_square_chance(x, np.full(4, n)), chdtrc(n, x), rtol=1e-9)


def each(count=4):
    """Readings of sensors with counts and scatter, the second with a temperature, and reasons in place of some."""
    rng = np.random.default_rng(8)
    made = []
    for k in range(count):
        rows = rows_of(np.concatenate([poses.turns(), poses.fibonacci(8 + k)]), k)
        degrees = np.linspace(5.0, 45.0, len(rows)) if k == 1 else None
        more = {"count": np.full(len(rows), 50.0), "scatter": rng.uniform(0.5, 1.5, (len(rows), 3))}
        made.append(Readings.from_array(rows, source=f"S{k}", temperature=degrees, **more))
    bare = Readings.from_array(rows_of(poses.turns(), 9))
    return [made[0], "no still pose", made[1], bare, *made[2:]]


@pytest.mark.parametrize("robust", ["none", "huber"])
def test_sensors_one_by_one_are_what_calibrate_makes_of_them(robust):
    """To the last bit, weights by a shared error and slopes with temperature included; what there is not has failed."""
    settings, readings = dataclasses.replace(LM, weights="auto", robust=robust), each()
    kept = {}
    fleet = calibrate_each(readings, settings, kept.__setitem__)
    assert fleet.number.tolist() == [0, 1, 2, 3, 4, 5]
    assert [r for r in range(6) if fleet.verdict[r] == FAILED] == [1, 3]
    assert fleet.reason[1] == "No still pose."
    assert fleet.reason[3].startswith("--weights auto needs the number of readings")
    assert fleet.poses.tolist()[1:4:2] == [0, 24]
    assert sorted(kept) == [0, 2, 4, 5]
    for r, record in kept.items():
        assert record.record() == calibrate(readings[r], settings).record()
        np.testing.assert_array_equal(fleet.K_a[r], record.K_a)
        assert (fleet.s[r], fleet.freedom[r]) == (record.s, record.freedom)
    assert fleet.freedom[2] == fleet.poses[2] - 15
    assert kept[2].temperature is not None
    with pytest.raises(ConfigError, match="gauge: full"):
        calibrate_each(readings, dataclasses.replace(settings, gauge="full"))


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """Sixty sensors; number 7 has another scale factor, 20 a bias, 33 twenty times the noise of the others."""
    tables = {f"S{k:02}": rows_of(poses.turns(), k, 0.2 if k == 33 else 0.01) for k in range(60)}
    tables["S07"] = tables["S07"] * np.array([1.0, 1.2, 1.0])
    tables["S20"] = tables["S20"] + np.array([0.0, 0.0, 400.0])
    readings = read_fleet([write(tmp_path_factory.mktemp("odd") / "odd.csv", tables)])
    return readings.sensors, calibrate_fleet(readings, LM)


def test_sensors_that_stand_out_are_named_and_no_others(odd):
    labels, fleet = odd
    found = standouts(fleet, G)
    assert {(labels[one.at], one.name) for one in found} == {
        ("S07", "scale factor y"),
        ("S20", "bias z"),
        ("S33", "noise of one pose, s"),
    }
    by = {labels[one.at]: one for one in found}
    assert by["S07"].z > 5
    assert by["S33"].z is None
    assert by["S33"].value > 10 * by["S33"].middle > 0
    assert by["S33"].middle == pytest.approx(0.01, rel=0.2)


def test_a_sensor_of_few_poses_may_be_farther_off(tmp_path):
    """Equal sensors; the one whose ten poses tell less is as far off as its sigma allows, and is not named."""
    cap = poses.fibonacci(60)[:20]
    named = 0
    for trial in range(3):
        sets = {f"S{k}": (poses.turns() if k else cap, 100 * trial + k) for k in range(30)}
        tables = {k: MEMS.output(G * u + noise(len(u), 0.01, seed)) for k, (u, seed) in sets.items()}
        fleet = calibrate_fleet(read_fleet([write(tmp_path / "a.csv", tables)]), LM)
        assert fleet.determined.all()
        assert fleet.dop[0].max() > 4 * fleet.dop[1].max()
        named += len(standouts(fleet, G))
    assert named == 0


@pytest.fixture(scope="module")
def clipped(tmp_path_factory):
    """Thirty sensors; of number 7 the z axis stops at two thirds of g, of number 12 one pose slipped."""
    tables = {f"S{k:02}": rows_of(poses.turns(), k) for k in range(30)}
    tables["S07"] = np.minimum(tables["S07"], [np.inf, np.inf, 650.0])
    tables["S12"] = tables["S12"] * np.where(np.arange(24) == 5, 1.01, 1.0)[:, None]
    path = write(tmp_path_factory.mktemp("clipped") / "clipped.csv", tables)
    return read_fleet([path]), tables


def test_a_broken_sensor_has_the_warnings_of_calibrate(clipped, tmp_path):
    readings, tables = clipped
    kept = {}
    fleet = calibrate_fleet(readings, LM, lambda number, record: kept.setdefault(number, record))
    assert set(fleet.verdict) == {"good", "suspect"}
    assert [readings.sensors[r] for r in np.flatnonzero(fleet.warned)] == ["S07", "S12"]
    assert [readings.sensors[r] for r in np.flatnonzero(fleet.verdict == "suspect")] == ["S07", "S12"]
    for r, label in ((7, "S07"), (12, "S12")):
        alone = tmp_path / "alone.csv"
        alone.write_text("ax,ay,az\n" + "\n".join(",".join(map(repr, row)) for row in tables[label].tolist()))
        one = calibrate(read_readings(alone), LM)
        assert one.warnings
        assert said_of(kept[r].warnings) == said_of(one.warnings)
        assert fleet.warnings[r] == kept[r].warnings
    assert "Outlier: line 295 does not fit the other poses" in fleet.warnings[12][0].text
    assert counts(fleet) == "30 sensors: 28 good, 2 suspect, 2 of them with a note or a warning"
    (table,) = [
        t
        for t in blocks(fleet, readings.sensors, [], G, verbose=True)
        if isinstance(t, Table) and t.title == "Warnings"
    ]
    assert [row[0] for row in table.rows] == ["S07", "S12"]
    assert table.rows[0][1] == pytest.approx(100 * fleet.s[7] / G)
    assert table.rows[0][3] == "Clipped readings"
    assert table.rows[1][2:] == ("line 295", "Outlier")
    rows = sensors(fleet, readings.sensors, []).records()
    assert [row["sensor"] for row in rows if row["warnings"]] == ["S07", "S12"]


@pytest.mark.parametrize("header", ["pose,ax,ay,az", "ax,ay,az", "time,ax,ay,az", "ax,ay,az,n,sx,sy,sz"])
def test_warnings_of_scatter_and_of_logs_are_those_of_calibrate(tmp_path, header):
    """Samples of each pose that say less than its error; 600 rows that creep, or have times; counts and deviations."""
    u = np.repeat(poses.turns(), 25, axis=0)
    fine = {"S1": noise(600, 0.01, 1), "S2": noise(600, 0.01, 2), "S3": noise(600, 0.01, 3)}
    fine["S2"] += 0.05 * np.repeat(noise(24, 1.0, 4), 25, axis=0)
    cells = []
    for label, extra in fine.items():
        rows = MEMS.output(G * u + extra)
        if header.endswith("sz"):
            rows = np.column_stack(
                [rows.reshape(24, 25, 3).mean(axis=1), np.full((24, 4), [25, 0.01, 0.01, 0.01])]
            )
        if header[0] in "pt":
            rows = np.column_stack(
                [np.arange(600) // 25 if header[0] == "p" else 0.01 * np.arange(600), rows]
            )
        cells += [(label, ",".join(map(repr, row))) for row in rows.tolist()]
    path = tmp_path / "many.csv"
    path.write_text("\n".join([f"sensor,{header}", *(f"{label},{row}" for label, row in cells)]))
    readings = read_fleet([str(path)])
    kept = {}
    fleet = calibrate_fleet(readings, LM, lambda number, record: kept.setdefault(number, record))
    said = {}
    for r, label in enumerate(readings.sensors):
        alone = tmp_path / "alone.csv"
        alone.write_text("\n".join([header, *(row for own, row in cells if own == label)]))
        one = calibrate(read_readings(alone), LM)
        said[label] = [notice.text for notice in one.warnings]
        assert said_of(kept[r].warnings) == said_of(one.warnings)
        assert fleet.warnings[r] == kept[r].warnings
    scattered = any("what the scatter within the poses explains" in text for text in said["S2"])
    assert scattered == (header[0] == "p" or header.endswith("sz"))
    logged = any("600 rows are a log" in text for text in said["S1"])
    assert logged == (header in ("ax,ay,az", "time,ax,ay,az"))


def test_doubtful_readings_are_told_as_calibrate_tells_them(tmp_path):
    """A dead axis, two equal axes, copies of a third of the poses and of two, and a gravity of no planet."""
    tables = {f"S{k}": rows_of(poses.turns(), k) for k in range(5)}
    tables["S0"][:, 1] = 7.0
    tables["S1"][:, 2] = tables["S1"][:, 0]
    tables["S2"][:8] = tables["S2"][16:]
    tables["S3"][:2] = tables["S3"][22:]
    write(tmp_path / "odd.csv", tables)
    readings = read_fleet([str(tmp_path / "odd.csv")])
    for settings, told in ((LM, ["S0", "S1", "S2"]), (dataclasses.replace(LM, g=98.1), list(tables))):
        kept = {}
        fleet = calibrate_fleet(
            readings, settings, lambda number, record, kept=kept: kept.update({number: record})
        )
        assert [readings.sensors[r] for r in np.flatnonzero(fleet.warned)] == told
        assert all(fleet.warnings[r] == kept[r].warnings for r in kept)
        for word, at in (
            ('"ay" is 7 in every', 0),
            ('"ax" and "az" are equal', 1),
            ("8 of 24 poses repeat", 2),
        ):
            assert word in fleet.warnings[at][0].text


def test_a_few_sensors_are_no_fleet_to_stand_out_from(tmp_path):
    tables = {f"S{k}": rows_of(poses.turns(), k) for k in range(9)}
    tables["S3"] *= 2.0
    fleet = calibrate_fleet(read_fleet([write(tmp_path / "a.csv", tables)]), LM)
    assert standouts(fleet, G) == []


def test_equal_sensors_without_noise_do_not_stand_out(tmp_path):
    tables = {f"S{k}": MEMS.output(G * poses.turns()) for k in range(30)}
    fleet = calibrate_fleet(read_fleet([write(tmp_path / "a.csv", tables)]), LM)
    assert standouts(fleet, G) == []


def test_the_table_has_a_row_for_each_sensor(odd):
    labels, fleet = odd
    table = sensors(fleet, labels, standouts(fleet, G))
    records = {record["sensor"]: record for record in table.records()}
    assert list(records) == list(labels)
    assert records["S07"]["stands_out"] == "scale factor y"
    assert records["S08"]["stands_out"] == ""
    assert records["S08"]["K_21"] == fleet.K_a[8, 1, 0]
    assert records["S08"]["dop_bias_z"] == fleet.dop[8, 8]
    assert all(len(row) == len(table.columns) for row in table.rows)


def test_the_summary_tells_what_is_wrong(mixed):
    path, _ = mixed
    readings = read_fleet([path])
    fleet = calibrate_fleet(readings, LM)
    brief = [t.title for t in blocks(fleet, readings.sensors, [], G) if isinstance(t, Table)]
    assert brief == ["Not good", "Fleet"]
    tables = {
        t.title: t for t in blocks(fleet, readings.sensors, [], G, verbose=True) if isinstance(t, Table)
    }
    assert list(tables) == ["Not good", "Fleet", "Worst fit", "Warnings"]
    first = tables["Not good"].rows[0]
    assert first[1] == FAILED
    assert "only one pose" in first[2] or "equal" in first[2]
    assert "and" in tables["Not good"].notes[0].lower()
    assert counts(fleet).startswith("28 sensors: ")
    worst = [row[1] for row in tables["Worst fit"].rows]
    assert worst == sorted(worst, reverse=True)
    assert worst[0] == np.nanmax(np.where(fleet.determined, fleet.rms, np.nan))


@pytest.mark.parametrize(
    "wrong",
    [
        {"gauge": "full"}, {"runs": 2},
        {"optimizer": "de"}, {"polish": False},
    ],
    ids=str,
)  # fmt: skip
def test_what_a_fleet_cannot_do_is_refused(wrong):
    settings = dataclasses.replace(LM, **wrong)
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        calibrate_fleet(None, settings)


def test_slabs_and_batches_change_nothing(mixed, monkeypatch):
    path, _ = mixed
    whole = calibrate_fleet(read_fleet([path]), LM)
    monkeypatch.setattr("accelcal_cli.io.batches.SLAB", 30)
    monkeypatch.setattr("accelcal_cli.io.batches.BATCH", 40)
    parts = calibrate_fleet(read_fleet([path]), LM)
    np.testing.assert_array_equal(parts.number, whole.number)
    assert parts.verdict.tolist() == whole.verdict.tolist()
    known = whole.determined
    np.testing.assert_allclose(parts.K_a[known], whole.K_a[known], rtol=1e-12, atol=1e-10)


def test_every_fault_is_one_of_ours(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("sensor,ax,ay,az\n")
    with pytest.raises(AccelcalError, match="no readings below"):
        read_fleet([str(path)])
