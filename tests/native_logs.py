"""Writers of native logs, by the formats that their makers publish: what the readers are tested with."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import polars as pl

from accelcal_cli.arrays import Float

COMBINED = (
    "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;int32_t accelerometer_timestamp_relative;"
    "float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;uint8_t accelerometer_clipping;uint8_t[3] _padding0"
)
ACCEL = (
    "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;float temperature;"
    "uint32_t error_count;uint8_t[3] clip_counter;uint8_t[5] _padding0"
)
SELECTION = "uint64_t timestamp;uint32_t accel_device_id;uint32_t gyro_device_id;uint8_t[8] _padding0"
IMU = ("QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz")
OLD_IMU = ("QffffffIIfBBHH", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz")
STRUCTS = dict(zip("bBMhHiILqQfdgcCeEnNZ", [*"bBBhHiIiqQfdehHiI", "4s", "16s", "64s"], strict=True))


def ulog_message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog_parameter(name: str, value: float) -> bytes:
    kind, code = ("int32_t", "i") if isinstance(value, int) else ("float", "f")
    key = f"{kind} {name}".encode()
    return ulog_message("P", bytes([len(key)]) + key + struct.pack(f"<{code}", value))


def write_ulg(
    path: Path,
    sensors: Mapping[tuple[str, int], tuple[Float, Float]],
    parameters: Mapping[str, float] | None = None,
    devices: Sequence[int] = (2424842, 3670050),
    *,
    selected: int | None = None,
    dropouts: Sequence[int] = (),
    changed: Mapping[str, float] | None = None,
    resumed: bool = False,
) -> Path:
    """Write a PX4 log.

    Args:
        sensors: by topic and instance the times, s, shape (n,), and the acceleration, m/s^2, shape (n, 3).
        parameters: with which the log begins; changed: those that change in its middle.
        devices: ids of the accelerometers by instance; selected: the one that is combined, the first when None.
        dropouts: durations, ms; resumed: the second half stands behind a message that is cut off.
    """
    head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1000)
    start = b""
    for name, fields in (
        ("sensor_combined", COMBINED),
        ("sensor_accel", ACCEL),
        ("sensor_selection", SELECTION),
    ):
        start += ulog_message("F", f"{name}:{fields}".encode())
    for name, value in (parameters or {}).items():
        start += ulog_parameter(name, value)
    start += ulog_message("I", b"\x10char[4] sys_uuid" + b"ab12")
    numbers = {key: number for number, key in enumerate([*sensors, ("sensor_selection", 0)], 3)}
    for (name, instance), number in numbers.items():
        start += ulog_message("A", struct.pack("<BH", instance, number) + name.encode())
    chosen = devices[0] if selected is None else selected
    row = struct.pack("<HQII", numbers["sensor_selection", 0], 1_000_000, chosen, 7)
    start += ulog_message("D", row)
    rows = []
    for key, (times, force) in sensors.items():
        for t, f in zip(times.tolist(), force.tolist(), strict=True):
            micro = round(1e6 * t) + 1_234_567
            if key[0] == "sensor_combined":
                body = struct.pack("<Q3fIi3fIB", micro, *(0.01, 0.02, 0.03), 4000, 0, *f, 4000, 0)
            else:
                temperature = 20.0 + t / 100
                body = struct.pack(
                    "<QQI3ffI3B", micro, micro - 400, devices[key[1]], *f, temperature, 0, 0, 0, 0
                )
            rows.append((t, numbers[key], ulog_message("D", struct.pack("<H", numbers[key]) + body)))
    rows.sort(key=lambda item: item[0])
    messages = [message for _, _, message in rows]
    middle = len(messages) // 2
    between = b"".join(ulog_message("O", struct.pack("<H", ms)) for ms in dropouts)
    between += b"".join(ulog_parameter(name, value) for name, value in (changed or {}).items())
    before, after = b"".join(messages[:middle]), b"".join(messages[middle:])
    cut = messages[middle][:11] if resumed else b""
    flags = bytes([0] * 8 + [1 if resumed else 0] + [0] * 7)
    offset = len(head) + 43 + len(start) + len(before) + len(between) + len(cut)
    flags += struct.pack("<3Q", offset if resumed else 0, 0, 0)
    path.write_bytes(head + ulog_message("B", flags) + start + before + between + cut + after)
    return path


def flash_format(number: int, name: str, letters: str, columns: str) -> bytes:
    size = 3 + struct.calcsize("<" + "".join(STRUCTS[letter] for letter in letters))
    return b"\xa3\x95\x80" + struct.pack(
        "<BB4s16s64s", number, size, name.encode(), letters.encode(), columns.encode()
    )


def flash_message(number: int, letters: str, *values: object) -> bytes:
    return b"\xa3\x95" + bytes([number]) + struct.pack("<" + "".join(STRUCTS[c] for c in letters), *values)


def write_flash(
    path: Path,
    sensors: Mapping[int, tuple[Float, Float]],
    parameters: Mapping[str, float] | None = None,
    *,
    old: bool = False,
    changed: Mapping[str, float] | None = None,
) -> Path:
    """Write an ArduPilot log: by number of the sensor the times, s, shape (n,), and the acceleration, m/s^2, (n, 3).

    `old` logs have a kind of message for each sensor, IMU and IMU2; others a column I.
    """
    letters, columns = OLD_IMU if old else IMU
    data = flash_format(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    data += flash_format(129, "PARM", "QNf", "TimeUS,Name,Value")
    data += flash_format(130, "ATT", "QccH", "TimeUS,Roll,Pitch,Yaw")
    for k in range(2 if old else 1):
        data += flash_format(140 + k, "IMU" + "2" * k, letters, columns)
    data += b"".join(flash_message(129, "QNf", 5, n.encode(), v) for n, v in (parameters or {}).items())
    rows = []
    for k, (times, force) in sensors.items():
        for t, f in zip(times.tolist(), force.tolist(), strict=True):
            rest = (0.01, 0.02, 0.03, *f, 0, 0, 20.0 + t / 100, 1, 1, 1000, 1000)
            micro = round(1e6 * t) + 7_000_000
            own = flash_message(140 + (k if old else 0), letters, micro, *(() if old else (k,)), *rest)
            rows.append((t, k, own + flash_message(130, "QccH", micro, 1, 2, 3)))
    rows.sort(key=lambda item: item[:2])
    middle = len(rows) // 2
    data += b"".join(message for _, _, message in rows[:middle])
    data += b"".join(flash_message(129, "QNf", 5, n.encode(), v) for n, v in (changed or {}).items())
    path.write_bytes(data + b"".join(message for _, _, message in rows[middle:]))
    return path


def write_bag(
    path: Path,
    topics: Mapping[str, tuple[Float, Float]],
    form: str,
    *,
    stamped: bool = True,
    frame: str = "imu_link",
) -> Path:
    """Write a bag with sensor_msgs/Imu; return its one file. `form` is rosbag1, rosbag2 or mcap."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if form == "rosbag1" else Stores.ROS2_HUMBLE)
    types = store.types
    if form == "rosbag1":
        from rosbags.rosbag1 import Writer as Writer1

        writer = Writer1(path)
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(path, version=8, storage_plugin=plugin)
    nothing = np.zeros(9)
    with writer:
        rows = []
        for topic, (times, force) in topics.items():
            link = writer.add_connection(topic, "sensor_msgs/msg/Imu", typestore=store)
            for t, f in zip(times.tolist(), force.tolist(), strict=True):
                rows.append((t, link, f))
        for t, link, f in sorted(rows, key=lambda item: item[0]):
            nano = round(1e9 * t) + 1_700_000_000_123_456_789
            own = nano if stamped else 0
            stamp = types["builtin_interfaces/msg/Time"](sec=own // 10**9, nanosec=own % 10**9)
            counted = {"seq": 3} if form == "rosbag1" else {}
            message = types["sensor_msgs/msg/Imu"](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **counted),
                orientation=types["geometry_msgs/msg/Quaternion"](x=0, y=0, z=0, w=1),
                orientation_covariance=nothing,
                angular_velocity=types["geometry_msgs/msg/Vector3"](x=0.01, y=0.02, z=0.03),
                angular_velocity_covariance=nothing,
                linear_acceleration=types["geometry_msgs/msg/Vector3"](x=f[0], y=f[1], z=f[2]),
                linear_acceleration_covariance=nothing,
            )
            write = store.serialize_ros1 if form == "rosbag1" else store.serialize_cdr
            writer.write(link, nano + 1_000_000, write(message, "sensor_msgs/msg/Imu"))
    return path if form == "rosbag1" else next(f for f in path.iterdir() if f.suffix in (".db3", ".mcap"))


def write_arrow(path: Path, times: Float, force: Float, *, stream: bool = False, rows: int = 1000) -> Path:
    """Write a table as Arrow IPC, in record batches of so many rows."""
    columns = {"time": times, **{f"a{axis}": force[:, k] for k, axis in enumerate("xyz")}}
    frame = pl.DataFrame({**columns, "label": [f"p{k // 50}" for k in range(len(times))]})
    parts = pl.concat([frame[k : k + rows] for k in range(0, len(frame), rows)], rechunk=False)
    (parts.write_ipc_stream if stream else parts.write_ipc)(path)
    return path
