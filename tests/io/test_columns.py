"""Columns are found by their names, and never guessed."""

from __future__ import annotations

import io

import pytest

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.readings import Readings, read_readings


def read(header: str, columns: list[str] | None = None) -> Readings:
    """Read a table of two rows, column k holding k+1 and 10k+2."""
    width = header.count(",") + 1
    rows = [",".join(str(k + 1) for k in range(width)), ",".join(str(10 * k + 2) for k in range(width))]
    return read_readings("-", columns, stdin=io.BytesIO("\n".join([header, *rows]).encode()))


@pytest.mark.parametrize(
    "names",
    [
        "ax,ay,az",
        "AX,AY,AZ",
        "ax_g,ay_g,az_g",
        "ax [m/s^2],ay [m/s^2],az [m/s^2]",
        "ax (g),ay (g),az (g)",
        "ax_mps2,ay_mps2,az_mps2",
        "ax_m_s2,ay_m_s2,az_m_s2",
        "ax_raw,ay_raw,az_raw",
        "ax_mean,ay_mean,az_mean",
        "Nx,Ny,Nz",
        "x,y,z",
        "X,Y,Z",
        "acc_x,acc_y,acc_z",
        "AccX,AccY,AccZ",
        "accel_x,accel_y,accel_z",
        "Acceleration x (m/s^2),Acceleration y (m/s^2),Acceleration z (m/s^2)",
        "accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2]",
        "linear_acceleration.x,linear_acceleration.y,linear_acceleration.z",
        "field.linear_acceleration.x,field.linear_acceleration.y,field.linear_acceleration.z",
        "x_acc,y_acc,z_acc",
        "X-Axis,Y-Axis,Z-Axis",
    ],
)
def test_names_of_the_output(names: str) -> None:
    readings = read(f"time,{names},gx,gy,gz,mx")
    assert readings.columns == tuple(names.split(","))
    assert readings.output().tolist() == [[2, 3, 4], [12, 22, 32]]


def test_axes_may_come_in_any_order() -> None:
    assert read("z,y,x").output().tolist() == [[3, 2, 1], [22, 12, 2]]


@pytest.mark.parametrize(
    ("header", "field"),
    [
        ("sx,sy,sz", "scatter"),
        ("std_x,std_y,std_z", "scatter"),
        ("sd_x,sd_y,sd_z", "scatter"),
        ("ax_std,ay_std,az_std", "scatter"),
        ("sigma_ax,sigma_ay,sigma_az", "scatter"),
        ("fx,fy,fz", "reference"),
        ("f_x,f_y,f_z", "reference"),
        ("ref_x,ref_y,ref_z", "reference"),
        ("fx [m/s^2],fy [m/s^2],fz [m/s^2]", "reference"),
    ],
)
def test_optional_triples(header: str, field: str) -> None:
    readings = read(f"ax,ay,az,{header}")
    assert getattr(readings, field).tolist() == [[4, 5, 6], [32, 42, 52]]
    assert readings.notes == ("columns " + ", ".join(f'"{name}"' for name in header.split(",")) + " found",)


@pytest.mark.parametrize("name", ["T", "temp", "Temperature", "temp_c", "T [degC]", "temperature (C)"])
def test_temperature(name: str) -> None:
    temperature = read(f"t,ax,ay,az,{name}").temperature
    assert temperature is not None
    assert temperature.tolist() == [5, 42]


@pytest.mark.parametrize("name", ["t", "time", "T (s)", "T_start"])
def test_time_is_no_temperature(name: str) -> None:
    assert read(f"ax,ay,az,{name}").temperature is None


@pytest.mark.parametrize("name", ["n", "N", "count", "samples", "n_samples"])
def test_count(name: str) -> None:
    count = read(f"{name},ax,ay,az").count
    assert count is not None
    assert count.tolist() == [1, 2]


def test_scatter_of_another_sensor_is_not_used() -> None:
    assert read("ax,ay,az,x_std,y_std,z_std,Nx_std,Ny_std,Nz_std").scatter is not None
    assert read("ax,ay,az,Nx_std,Ny_std,Nz_std").scatter is None


def test_triple_without_an_axis_is_named() -> None:
    assert 'column "fx" not used: no reference for all three axes' in read("ax,ay,az,fx,fy").notes


@pytest.mark.parametrize("header", ["u,v,w", "t,u,v,w", "n,u,v,w", "u,v,w,sx,sy,sz,T"])
def test_three_unknown_columns_are_taken(header: str) -> None:
    readings = read(header)
    assert readings.columns == ("u", "v", "w")
    assert 'columns "u", "v", "w" taken as x, y, z' in readings.notes[0]


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("ax,ay,az,Nx,Ny,Nz", 'could be "ax", "ay", "az" or "Nx", "Ny", "Nz"; say which with --columns'),
        ("ax [g],ay [g],az [g],ax [m/s^2],ay [m/s^2],az [m/s^2]", "say which with --columns"),
        ("ax,ay,az,ax", 'more than one column could be "ax"'),
        ("u,v,w,p", r'no column names such as ax.*\(there are "u", "v", "w", "p"\)'),
        ("ax,ay", "has 2 columns where three"),
        ("fx,fy,fz", "no column names such as ax, ay, az"),
        ("1,2,3,4", "has 4 columns and no header; .*--columns 1,2,3"),
        ("1,2", "has 2 columns where three"),
    ],
)
def test_doubt_is_an_error(header: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(header)


@pytest.mark.parametrize(
    ("columns", "first"),
    [
        (["a", "B", "t"], [2, 3, 1]),
        (["A", "b", "T"], [2, 3, 1]),
        (["2", "3", "4"], [2, 3, 4]),
        (["2,3,4"], [2, 3, 4]),
        ([" 2", "3 ", "x"], [2, 3, 5]),
    ],
)
def test_stated_columns(columns: list[str], first: list[float]) -> None:
    assert read("t,a,B,c,x [g]", columns).output()[0].tolist() == first


def test_a_name_that_is_a_number_goes_before_the_number() -> None:
    data = b",0,1,2\n0,1.5,2.5,3.5\n1,2.5,3.5,4.5\n"
    readings = read_readings("-", ["2", "1", "0"], stdin=io.BytesIO(data))
    assert readings.columns == ("2", "1", "0")
    assert readings.output()[0].tolist() == [3.5, 2.5, 1.5]


def test_stated_reference_columns_are_the_output() -> None:
    readings = read("ax,ay,az,fx,fy,fz", ["fx", "fy", "fz"])
    assert readings.reference is None
    assert readings.output()[0].tolist() == [4, 5, 6]


@pytest.mark.parametrize(
    ("header", "columns", "message"),
    [
        ("ax,ay,az", ["ax", "ay", "aq"], 'no column "aq" in <stdin> .did you mean "a.".'),
        ("ax,ay,az", ["ax", "ay", "foo bar"], 'no column "foo bar".*there are "ax", "ay", "az"'),
        ("ax,ay,az", ["ax", "ay", "AX"], '"AX" is asked for twice'),
        ("ax,ay,az", ["ax", "ay", "1"], '"1" is asked for twice'),
        ("ax,ay,az", ["ax", "ay"], "three columns were expected .* not 2"),
        ("ax,ay,az", ["ax", "ay", "4"], "no column 4; <stdin> has columns 1 to 3"),
        ("ax,ay,az", ["ax", "ay", "0"], "no column 0"),
        ("ax,ay,az", ["ax", "ay", ""], 'no column ""'),
        ("ax,ay,az,ax", ["ax", "ay", "az"], "could be column 1 or 4"),
        ("1,2,3", ["ax", "ay", "az"], 'no column "ax": <stdin> has no header; give numbers from 1 to 3'),
    ],
)
def test_bad_column_arguments(header: str, columns: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        read(header, columns)
