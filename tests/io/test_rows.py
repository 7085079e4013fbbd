"""Which rows are read, by `--where COLUMN=VALUE`; that lines keep their numbers; columns that never change."""

import io

import numpy as np
import pytest

from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.columns import restrict
from accelcal_cli.io.reader import ReadOptions, Selection, open_table
from accelcal_cli.io.readings import Readings, read_readings

TABLE = """# two sensors
device,ax,ay,az
0,1,2,3

1,4,5,6
# a comment
0,7,8,9
1,10,11,12
"""


def opened(text, *where):
    table = open_table("-", io.BytesIO(text.encode()))
    restrict(table, where)
    return table


PREAMBLE = "Logger 3\nSerial: 17\nRate: 100 Hz\n\n"
WHOLE = [f"{k % 2},{k}.5,{2 * k}.25,{k * k}.125" for k in range(1, 61)]
HEADER = "device,ax,ay,az"


def read(text, **options):
    """Read what is said of device 0, in a file whose first row is on line 6."""
    return read_readings(
        "-", stdin=io.BytesIO(text.encode()), options=ReadOptions(where=("device=0",), **options)
    )


def with_preamble(rows):
    return PREAMBLE + "\n".join([HEADER, *rows, ""])


def test_lines_keep_their_numbers_below_a_preamble():
    found = read(with_preamble(WHOLE))
    assert found.poses == found.form.rows == 30
    assert [found.where(0), found.where(29)] == ["line 7", "line 65"]
    assert any(note.startswith("3 lines above the table skipped") for note in found.notes)


def test_a_broken_row_is_named_by_its_line_and_left_out_on_request():
    rows = [*WHOLE[:9], "0,1,2", *WHOLE[9:], HEADER, "1,2,x,3"]
    with pytest.raises(DataError, match="line 15: has 3 cells"):
        read(with_preamble(rows))
    found = read(with_preamble(rows), skip_bad=True)
    assert (found.poses, found.form.rows_skipped) == (30, 1)  # what is wrong with device 1 does not matter
    assert "1 broken row left out (--skip-bad): line 15" in found.notes
    assert [found.where(3), found.where(4)] == ["line 13", "line 16"]


def test_too_many_broken_rows_are_refused_by_their_lines():
    rows = list(WHOLE)
    rows[1], rows[3], rows[5] = "0,,1,2", "0,a,1,2", "0,1"
    with pytest.raises(DataError, match=r"3 of 30 rows are broken, more than .*: lines 7, 9, 11"):
        read(with_preamble(rows), skip_bad=True)


def test_a_last_line_that_is_cut_off_is_forgiven():
    found = read(with_preamble(WHOLE) + "0,61.5,12")
    assert (found.poses, found.form.rows_skipped) == (30, 1)
    assert "the last line, 66, left out: it is cut off" in found.notes


def test_columns_are_judged_by_the_rows_that_are_read():
    """Rows of another kind, which come first, hold text where those of the sensor hold numbers."""
    rows = [f"1,gyro,none,{k},on" if k % 2 else f"0,{k}.5,{2 * k}.25,{k * k}.125,ok" for k in range(1, 61)]
    found = read("device,u,v,w,state\n" + "\n".join(rows) + "\n")
    assert (found.columns, found.poses) == (("u", "v", "w"), 30)


def test_lines_of_words_can_be_chosen_by_a_value():
    rows = [f"dev={k % 2} ax={k}.5 ay={2 * k}.25 az={k * k}.125" for k in range(1, 61)]
    found = read_readings(
        "-", stdin=io.BytesIO("\n".join([*rows, ""]).encode()), options=ReadOptions(where=("dev=0",))
    )
    assert (found.poses, found.where(0), found.where(29)) == (30, "line 2", "line 60")


def rows_of(table, columns=(1, 2, 3)):
    blocks = list(table.blocks(Selection(columns)))
    return np.concatenate([block.numbers for block in blocks])


def test_rows_that_meet_a_condition_and_their_lines():
    table = opened(TABLE, "device=1")
    assert rows_of(table).tolist() == [[4, 5, 6], [10, 11, 12]]
    assert [table.where(k) for k in range(2)] == ["line 5", "line 8"]


def test_conditions_add_up_and_numbers_are_numbers():
    assert rows_of(opened(TABLE, "device=0.0", "ax=7")).tolist() == [[7, 8, 9]]


def test_a_table_without_a_header():
    text = "\n".join(TABLE.splitlines()[2:]) + "\n"
    assert rows_of(opened(text, "1=0")).tolist() == [[1, 2, 3], [7, 8, 9]]


def test_a_bad_cell_of_another_sensor_does_not_matter_and_one_of_its_own_is_named():
    text = "kind,x,y,z\nacc,1,2,3\ngps,,,\nacc,4,5,6\nacc,4,oops,6\n"
    with pytest.raises(DataError, match=r'line 5, column "y": "oops"'):
        rows_of(opened(text, "kind=acc"))
    assert len(rows_of(opened(text.replace("oops", "5"), "kind=acc"))) == 3


def test_a_value_that_no_row_has_is_named_with_those_that_are_there():
    with pytest.raises(DataError, match=r'no row has column "device" = 7 .* holds 0, 1'):
        rows_of(opened(TABLE, "device=7"))


@pytest.mark.parametrize("text", ["device", "=3", "device=", "nothing=3"])
def test_a_condition_that_is_none(text):
    with pytest.raises(UsageError, match="--where"):
        opened(TABLE, text)


def test_long_tables_are_filtered_by_polars_alike(tmp_path):
    """Beyond the head of a file whole blocks are filtered at once."""
    rng = np.random.default_rng(1)
    numbers = rng.integers(-9999, 9999, (60_000, 3))
    device = rng.integers(0, 3, 60_000)
    lines = [f"{d},{a},{b},{c}" for d, (a, b, c) in zip(device.tolist(), numbers.tolist(), strict=True)]
    path = tmp_path / "long.csv"
    path.write_text("\n".join(["device,ax,ay,az", *lines]) + "\n")
    table = open_table(path)
    restrict(table, ["device=2"])
    kept = np.flatnonzero(device == 2)
    assert np.array_equal(rows_of(table), numbers[kept])
    table.close()
    assert [table.where(k) for k in (0, 999, len(kept) - 1)] == [
        f"line {kept[k] + 2}" for k in (0, 999, len(kept) - 1)
    ]


def test_parquet(tmp_path):
    pl = pytest.importorskip("polars")
    frame = pl.DataFrame({"device": ["a", "b", "a"], "ax": [1.0, 2.0, 3.0], "ay": [1.0] * 3, "az": [2.0] * 3})
    frame.write_parquet(tmp_path / "log.parquet")
    table = open_table(tmp_path / "log.parquet")
    restrict(table, ["device=a"])
    assert rows_of(table).tolist() == [[1, 1, 2], [3, 1, 2]]
    table.close()
    assert table.where(1) == "row 3"


def two_sensors(tmp_path, header="device", values=("A 1", "B")):
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(24, 3))
    text = [f"{header},ax,ay,az"] + [
        ",".join([values[k % 2], *map(repr, row)]) for k, row in enumerate(rows.tolist())
    ]
    path = tmp_path / "two.csv"
    path.write_text("\n".join(text) + "\n")
    return path


@pytest.mark.parametrize("header", ["device", "sensor_id", "I", "imu", "instance", "serial"])
def test_several_sensors_are_refused_with_a_way_out(tmp_path, header):
    path = two_sensors(tmp_path, header)
    with pytest.raises(
        DataError, match=rf'column "{header}" has 2 values \(A 1, B\).*--where .{header}=A 1.'
    ):
        read_readings(path)
    assert read_readings(path, options=ReadOptions(where=(f"{header}=A 1",))).poses == 12


def test_kinds_of_poses_are_no_sensors_and_kinds_of_sensors_are(tmp_path):
    assert read_readings(two_sensors(tmp_path, "type", ("face", "edge"))).poses == 24
    with pytest.raises(DataError, match="--where type=accelerometer"):
        read_readings(two_sensors(tmp_path, "type", ("gyroscope", "accelerometer")))


def test_a_number_of_its_own_for_each_row_is_no_sensor(tmp_path):
    path = tmp_path / "sn.csv"
    rows = np.random.default_rng(3).normal(size=(24, 3)).tolist()
    path.write_text("sn,ax,ay,az\n" + "\n".join(f"{k},{a},{b},{c}" for k, (a, b, c) in enumerate(rows)))
    assert read_readings(path).poses == 24


TURNS = np.round(9.8 * np.cos(np.arange(12)), 3)


def test_two_columns_that_never_change_are_refused() -> None:
    rows = "".join(f"{x},0.12,9.81,{k}\n" for k, x in enumerate(TURNS))
    seen = r'columns "ay" and "az" never change \(0\.12 and 9\.81 in all rows\) while "ax" does: .* with --columns'
    with pytest.raises(DataError, match=seen):
        read_readings("-", stdin=io.BytesIO(("ax,ay,az,u\n" + rows).encode()))
    log = open_raw_log("-", stdin=io.BytesIO(("ax,ay,az,u\n" + rows * 50).encode()))
    with pytest.raises(DataError, match=seen):
        list(log.blocks())
    with pytest.raises(DataError, match=r'columns "1" and "3" never change'):
        Readings.from_array(np.column_stack([np.zeros(12), TURNS, np.ones(12)]))


def test_columns_that_change_late_or_little_are_not_refused() -> None:
    late = np.column_stack([TURNS, np.zeros(12), np.r_[np.zeros(11), 5.0]])
    assert Readings.from_array(late).poses == 12
    still = np.column_stack(
        [np.zeros(12), np.zeros(12), 64 + np.arange(12) % 3]
    )  # a coarse sensor in one pose
    assert Readings.from_array(still).poses == 12
    rows = np.r_[np.repeat([[9.0, 0, 0]], 900, axis=0), np.repeat([[-9.0, 1, 1]], 900, axis=0)]
    text = "ax,ay,az\n" + "".join(f"{x},{y},{z}\n" for x, y, z in rows)
    log = open_raw_log("-", stdin=io.BytesIO(text.encode()))
    assert sum(map(len, log.blocks())) == 1800
