"""Raw logs: which columns they have, what their time is, and where they are wrong."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from raw_logs import opened, simulated, text

from accelcal_cli.detection.rawlog import open_raw_log, sensors_of
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.clock import Clock, SoundTimes, unit_of
from accelcal_cli.io.reader import ReadOptions
from accelcal_cli.io.rows import RowBlock

LOG, _ = simulated(2, hold=4.0)
A, W, T = LOG[:, :3], LOG[:, 3:6], LOG[:, 6:]


def read(log):
    rows = np.concatenate(list(log.blocks()))
    log.close()
    return rows


@pytest.mark.parametrize(
    ("names", "columns", "gyro", "time"),
    [
        ("t,ax,ay,az", (1, 2, 3), None, 0),
        ("ax,ay,az", (0, 1, 2), None, None),
        ("time [s],acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z", (1, 2, 3), (4, 5, 6), 0),
        ("timestamp_ms,gx,gy,gz,accX,accY,accZ,mag_x", (4, 5, 6), (1, 2, 3), 0),
        (
            "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],accelerometer_m_s2[0],accelerometer_m_s2[1],"
            "accelerometer_m_s2[2]",
            (4, 5, 6),
            (1, 2, 3),
            0,
        ),
        ("seconds,wx,wy,ax,ay,az", (3, 4, 5), None, 0),
    ],
)
def test_names_tell_the_columns(names, columns, gyro, time):
    width = names.count(",") + 1
    rows = np.arange(40.0).reshape(-1, 1) * 0.01 + np.zeros((1, width))
    log = opened(text(rows, names))
    assert (log.columns.output, log.columns.gyro, log.columns.time) == (columns, gyro, time)
    log.close()


@pytest.mark.parametrize(
    ("parts", "columns", "gyro", "time"),
    [
        ([A], (0, 1, 2), None, None),
        ([T, A], (1, 2, 3), None, 0),
        ([A, W], (0, 1, 2), (3, 4, 5), None),
        ([T, A, W], (1, 2, 3), (4, 5, 6), 0),
    ],
)
def test_without_names_their_number_tells(parts, columns, gyro, time):
    log = opened(text(np.hstack(parts), names=""))
    assert (log.columns.output, log.columns.gyro, log.columns.time) == (columns, gyro, time)
    assert "no header: columns" in log.notes[0]
    np.testing.assert_allclose(read(log)[:, :3], A, rtol=1e-7)


def test_a_first_column_that_decreases_is_no_time():
    with pytest.raises(DataError, match=r"4 columns and no header, and the first is not time.*--columns"):
        opened(text(np.hstack([W[:, :1], A]), names=""))
    with pytest.raises(DataError, match="5 columns and no header; expected 3"):
        opened(text(np.hstack([T, W[:, :1], A]), names=""))
    log = opened(text(np.hstack([W[:, :1], A]), names=""), ["2", "3", "4"])
    assert log.columns.time is None
    log.close()


def test_what_is_stated_wins():
    data = text(np.hstack([T, A, W, A]), names="t,ax,ay,az,wx,wy,wz,bx,by,bz")
    log = opened(data, ["bx", "by", "bz"], ["none"], "none")
    assert (log.columns.output, log.columns.gyro, log.columns.time) == ((7, 8, 9), None, None)
    assert log.columns.names == ("bx", "by", "bz")
    log.close()
    log = opened(data, ["8", "9", "10"], ["2", "3", "4"], "t")
    assert (log.columns.output, log.columns.gyro, log.columns.time) == ((7, 8, 9), (1, 2, 3), 0)
    log.close()
    with pytest.raises(UsageError, match='--gyro: no column "wq"'):
        opened(data, None, ["wq", "wy", "wz"])
    with pytest.raises(UsageError, match='--time: no column "tt"'):
        opened(data, None, None, "tt")
    with pytest.raises(UsageError, match="asked for twice"):
        opened(data, ["ax", "ay", "az"], ["ax", "ay", "az"])


@pytest.mark.parametrize(
    ("step", "rate", "unit"),
    [(0.01, 100.0, "s"), (10, 100.0, "ms"), (2500, 400.0, "us"), (5e6, 200.0, "ns"), (0.5, 2.0, "s")],
)
def test_the_unit_of_time_is_told_by_its_step(step, rate, unit):
    clock = Clock.of(1e4 + step * np.arange(50.0))
    assert clock.rate == pytest.approx(rate, rel=1e-6)
    assert clock.unit == unit


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("t", None),
        ("timestamp", None),
        ("time", None),
        ("axis", None),
        ("timestamp_ms", "ms"),
        ("time [us]", "us"),
        ("Time (s)", "s"),
        ("seconds", "s"),
        ("t_ns", "ns"),
        ("millis", "ms"),
    ],
)
def test_the_name_of_a_time_column_may_tell_its_unit(name, unit):
    assert unit_of(name) == unit


def test_a_millisecond_a_row_is_no_row_number():
    rows = np.hstack([np.arange(len(A))[:, None], A])
    assert opened(text(rows, names="t_ms,ax,ay,az")).clock == Clock(1000.0, "ms")
    assert opened(text(rows, names="t,ax,ay,az")).clock == Clock()
    assert Clock.of(10.0 * np.arange(9), "s").unit == "ms"  # no log has a row in ten seconds


def with_dates(form, sep=","):
    """The log with its time written as dates that begin shortly before midnight."""
    start = np.datetime64("2026-02-28T23:59:58.500")
    stamps = start + np.round(T[:, 0] * 1e6).astype("timedelta64[us]")
    lines = [sep.join([form(str(s)), *(repr(float(v)) for v in a)]) for s, a in zip(stamps, A, strict=True)]
    return "\n".join([sep.join(["time", "ax", "ay", "az"]), *lines, ""]).encode()


@pytest.mark.parametrize(
    "form",
    [
        str,
        lambda stamp: stamp.replace("T", " "),
        lambda stamp: stamp + "Z",
        lambda stamp: stamp[:-3] + "-05:00",
        lambda stamp: f'"{stamp}+0100"',
    ],
)
def test_dates_are_seconds_from_the_first_row(form):
    log = opened(with_dates(form))
    assert log.clock.rate == pytest.approx(100.0)
    assert any("seconds from the first row" in note for note in log.notes)
    np.testing.assert_allclose(read(log), np.hstack([A, T - T[0]]), atol=1e-9)


def test_dates_with_a_decimal_comma():
    log = opened(with_dates(lambda stamp: stamp.replace(".", ","), sep=";"))
    np.testing.assert_allclose(read(log)[:, 3:], T - T[0], atol=1e-9)


@pytest.mark.parametrize("late", [3, 900])
@pytest.mark.parametrize("wrong", ["now", "2026-02-30T00:00:00", "12:30:01.5", "2026-02-28T23:59:59+01:00"])
def test_a_date_that_is_none_is_named(wrong, late):
    lines = with_dates(str).split(b"\n")
    lines[late] = wrong.encode() + lines[late][lines[late].index(b",") :]
    with pytest.raises(DataError, match=f'line {late + 1}, column "time": ".*" is not a time; .*--time none'):
        read(opened(b"\n".join(lines)))


def test_dates_that_go_back_are_named():
    lines = with_dates(str).split(b"\n")
    lines[500], lines[501] = lines[501], lines[500]
    with pytest.raises(DataError, match=r"line 502: time 4.99 comes after 5; expected"):
        read(opened(b"\n".join(lines)))


def test_dates_in_parquet(tmp_path):
    import polars

    start = np.datetime64("2026-02-28T23:59:58.500000", "us")
    frame = polars.DataFrame(A, schema=["ax", "ay", "az"]).with_columns(
        polars.Series("time", start + np.round(T[:, 0] * 1e6).astype("timedelta64[us]"))
    )
    frame.write_parquet(tmp_path / "log.parquet")
    log = open_raw_log(tmp_path / "log.parquet")
    np.testing.assert_allclose(read(log), np.hstack([A, T - T[0]]), atol=1e-9)


def test_row_numbers_are_no_time():
    rows = np.hstack([np.arange(1.0, len(A) + 1)[:, None], A])
    log = opened(text(rows, names=""))
    assert log.clock.rate is None
    assert log.columns.time is None
    assert any("counts rows" in note for note in log.notes)
    np.testing.assert_allclose(read(log), A, rtol=1e-7)


def test_time_that_goes_back_is_named_by_its_line():
    back = T.copy()
    back[700:] -= 5.0
    log = opened(text(np.hstack([back, A]), names="t,ax,ay,az"))
    with pytest.raises(DataError, match=r"<stdin>, line 702: time 2 comes after 6.99; expected.*--time none"):
        read(log)
    log.close()


def test_time_may_stand_still():
    """Loggers with coarse clocks write one time for several rows."""
    coarse = np.round(T, 1)
    assert len(read(opened(text(np.hstack([coarse, A]), names="t,ax,ay,az")))) == len(A)


def test_a_bad_cell_is_named():
    rows = text(np.hstack([T, A]), names="t,ax,ay,az").replace(b"\n0.05,", b"\n0.05,x", 1)
    with pytest.raises(DataError, match='line 7, column "ax"'):
        opened(rows)
    with pytest.raises(DataError, match="has a header but no rows"):
        opened(b"t,ax,ay,az\n")


def test_parquet_reads_as_text_does(tmp_path):
    import polars

    path = tmp_path / "log.parquet"
    polars.DataFrame(np.hstack([T, A]), schema=["t", "ax", "ay", "az"]).write_parquet(path)
    log = open_raw_log(path)
    np.testing.assert_array_equal(read(log), np.hstack([A, T]))


STYLES = {
    "ISO": str,
    "clock": lambda stamp: stamp[11:],
    "day first": lambda stamp: f"{stamp[8:10]}.{stamp[5:7]}.{stamp[:4]} {stamp[11:]}",
    "integers": lambda stamp: str(np.datetime64(stamp, "ns").astype(np.int64)),
}


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize(
    "wrong", ["now", "early", "late", "13.13.2026 25:61:00", "2026-02-28T23:59:59+01:00"]
)
@pytest.mark.parametrize("row", [2, 500, 999, 1500, 2000])
def test_a_row_of_a_wrong_time_is_a_broken_one(style, wrong, row):
    times = np.arange(2000) * 0.01
    form = STYLES[style]

    def stamp(seconds):
        return form(
            str(np.datetime64("2026-02-28T12:00:00.000") + np.timedelta64(round(1e3 * seconds), "ms"))
        )

    texts = [stamp(t) for t in times]
    texts[row - 1] = {"early": stamp(times[row - 1] - 50), "late": stamp(times[row - 1] + 50)}.get(
        wrong, wrong
    )
    lines = [f"{t},{k},{k % 7},{k % 11 + 1}" for k, t in enumerate(texts)]
    data = "\n".join(["time,ax,ay,az", *lines, ""]).encode()
    end = row == 2000 and wrong == "late"  # nothing comes after it
    if not end:
        with pytest.raises(DataError, match=rf"line {row + 1}\b|line {row + 2}\b") as told:
            read(opened(data))
        assert "--skip-bad" in str(told.value) or row == 2000
    log = opened(data, options=ReadOptions(skip_bad=True))
    rows = read(log)
    if not end:
        np.testing.assert_array_equal(rows[:, 0], np.delete(np.arange(2000), row - 1))
        scale = 1e-9 if style == "integers" else 1.0
        np.testing.assert_allclose(scale * rows[:, -1], np.delete(times, row - 1), atol=1e-9)
        assert f"1 broken row left out (--skip-bad): line {row + 1}" in log.notes
        assert log.form.rows_skipped == 1
        assert log.where(1998) == f"line {2001 if row < 2000 else 2000}"
        assert log.where(0) == "line 2"


def test_time_that_stays_behind_is_an_error_with_broken_rows_left_out_too():
    back = T.copy()
    back[700:] -= 5.0
    log = opened(text(np.hstack([back, A]), names="t,ax,ay,az"), options=ReadOptions(skip_bad=True))
    with pytest.raises(DataError, match=r"line 702: time 2 comes after 6.99; expected") as told:
        read(log)
    assert "--skip-bad" not in str(told.value)


def test_single_falls_are_left_out_across_blocks():
    """Whatever the blocks, the same rows stay."""
    rng = np.random.default_rng(5)
    time = np.arange(400) * 0.01
    wrong = rng.choice(np.arange(2, 398), 12, replace=False)
    wrong = wrong[np.abs(np.subtract.outer(wrong, wrong) + 9 * np.eye(12)).min(axis=0) > 3]
    time[wrong] += rng.choice([-3.0, 3.0], len(wrong))

    class Table:
        out: list[int]

        def __init__(self):
            self.out = []

        def leave_out(self, row):
            self.out.append(row)

    for size in (1, 2, 3, 7, 400):
        blocks = [
            RowBlock(k, np.column_stack([np.arange(400.0), time])[k : k + size]) for k in range(0, 400, size)
        ]
        table = Table()
        sound = SoundTimes(table)
        rows = np.concatenate([block.numbers for block in sound.of(blocks)])
        assert sorted(table.out) == sorted(wrong)
        assert [sound.rows.line(k) for k in range(len(rows))] == rows[:, 0].tolist()


@pytest.mark.parametrize("large", [False, True], ids=["small", "large"])
def test_the_sensors_of_a_log_are_the_values_of_a_column(tmp_path, large):
    """Also of a column of text, of one without a header, and of rows that --where keeps."""
    rows = [f"{k / 100:.2f},{k % 7},1.5,9.8,{'BA'[k % 2]},{k % 3}\n" for k in range(60_000 if large else 60)]
    path = tmp_path / "log.csv"
    path.write_text("t,ax,ay,az,device,slot\n" + "".join(rows))
    assert sensors_of(path) == (("B", "device=B"), ("A", "device=A"))
    assert sensors_of(path, "slot") == (("0", "slot=0"), ("1", "slot=1"), ("2", "slot=2"))
    assert sensors_of(path, options=ReadOptions(where=("device=A",))) == (("A", "device=A"),)
    with pytest.raises(UsageError, match='no column "nope"'):
        sensors_of(path, "nope")
    path.write_text("".join(rows))
    assert sensors_of(path) == ()
    assert sensors_of(path, "5") == (("B", "5=B"), ("A", "5=A"))


def test_a_name_with_an_equals_sign_is_chosen_by_its_number(tmp_path):
    columns = {"ax": [1.0, 2.0], "ay": [1.0, 2.0], "az": [1.0, 2.0], "id=": ["p", "q"]}
    pl.DataFrame(columns).write_parquet(tmp_path / "log.parquet")
    assert sensors_of(tmp_path / "log.parquet", "id=") == (("p", "4=p"), ("q", "4=q"))


def test_a_column_that_counts_is_no_label_of_sensors(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("device,ax,ay,az\n" + "".join(f"{k},1,2,3\n" for k in range(1500)))
    with pytest.raises(DataError, match='"device" has more than 1,000 values'):
        sensors_of(path)
