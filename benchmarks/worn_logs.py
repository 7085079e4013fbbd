"""A simulated week of a worn accelerometer, and Axivity files by the published format.

A wrist that rests, moves and sleeps, and a watch that lies on a table for hours; its temperature follows the skin and
the room; the bias of the sensor follows the temperature and wanders by itself, so that rests near in time err alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.io.formats.cwa import BLOCK, DATA, DEGREE, HEADER, LAYOUT, PACKED, ZERO_DEGREES

CONTROL = 10
"""Hz: directions and movements are drawn at this rate, and joined by straight lines."""

HOUR = 3600
START = 1_750_000_000
"""s since 1970: 2025-06-15."""

REST, MOVE, OFF = 0, 1, 2


@dataclass(frozen=True)
class WornSensor:
    """True errors, g and degrees Celsius: output = (1 + k t) K f + D + b t + wandering + noise, t = T - reference."""

    K: Float = field(
        default_factory=lambda: np.array([[1.018, 0, 0], [0.0025, 0.987, 0], [-0.003, 0.002, 1.009]])
    )
    D: Float = field(default_factory=lambda: np.array([0.021, -0.034, 0.042]))
    scale_slope: Float = field(default_factory=lambda: np.array([1.5e-4, -1.0e-4, 2.0e-4]))
    bias_slope: Float = field(default_factory=lambda: np.array([6e-4, -4e-4, 8e-4]))
    reference: float = 30.0
    noise: float = 0.0035
    wander: float = 3e-4
    wander_time: float = 1800.0


@dataclass(frozen=True)
class WornChunk:
    """An hour: output in g, shape (n, 3); temperature of each second, shape (s,); state of each second, shape (s,)."""

    output: Float
    temperature: Float
    state: Int


def simulate_worn(sensor: WornSensor, days: float, rate: int, seed: int) -> Iterator[WornChunk]:
    """Yield a recording hour by hour; `rate` in Hz is a multiple of CONTROL."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    hours = round(days * 24)
    state, direction = _plan(hours * HOUR, rng)
    skin, sway, push, drift = 32.0, np.zeros(3), np.zeros(3), np.zeros(3)
    for hour in range(hours):
        part = slice(hour * HOUR, (hour + 1) * HOUR)
        now = state[part]
        day = np.sin(2 * np.pi * (hour + np.arange(HOUR) / HOUR) / 24)
        goal = np.where(now == OFF, 21.0, 32.0 + 1.5 * day)
        warm, _ = lfilter([1 / 1200], [1, -1 + 1 / 1200], goal, zi=[skin * (1 - 1 / 1200)])
        skin = float(warm[-1])
        kind = np.repeat(now, CONTROL)[:, None]
        swaying, sway = _wandering(rng, HOUR * CONTROL, CONTROL * 20.0, sway)
        pushing, push = _wandering(rng, HOUR * CONTROL, CONTROL * 0.3, push)
        u = np.repeat(direction[part], CONTROL, axis=0) + np.where(kind == REST, 0.004, 0.0) * swaying
        u += np.where(kind == MOVE, 0.4, 0.0) * pushing
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        u += np.where(kind == MOVE, 0.15, np.where(kind == REST, 0.001, 0.0)) * rng.standard_normal(u.shape)
        drifting, drift = _wandering(rng, HOUR, sensor.wander_time, drift)
        output = _output(
            sensor, u, np.repeat(warm, CONTROL), np.repeat(sensor.wander * drifting, CONTROL, axis=0)
        )
        yield WornChunk(_dense(output, rate // CONTROL, sensor.noise, rng), warm, now)


def _wandering(rng: np.random.Generator, n: int, steps: float, last: Float) -> tuple[Float, Float]:
    """Return noise of unit variance that forgets within so many steps, shape (n, 3), and its last value, shape (3,)."""
    from scipy.signal import lfilter

    decay = np.exp(-1 / steps)
    path, _ = lfilter(
        [np.sqrt(1 - decay**2)], [1, -decay], rng.standard_normal((n, 3)), axis=0, zi=decay * last[None]
    )
    return path, path[-1]


def _output(sensor: WornSensor, force: Float, degrees: Float, drift: Float) -> Float:
    """Return the output without noise, shape (n, 3)."""
    t = (degrees - sensor.reference)[:, None]
    return (1 + sensor.scale_slope * t) * (force @ sensor.K.T) + sensor.D + sensor.bias_slope * t + drift


def _dense(output: Float, times: int, noise: float, rng: np.random.Generator) -> Float:
    """Return so many times the rows, joined by straight lines, with noise, shape (n times, 3)."""
    dense = np.empty((len(output) * times, 3))
    follow = np.vstack([output[1:], output[-1:]])
    for k in range(times):
        dense[k::times] = output + (k / times) * (follow - output)
    return dense + noise * rng.standard_normal(dense.shape, dtype=np.float32)


def _plan(seconds: int, rng: np.random.Generator) -> tuple[Int, Float]:
    """Return state, shape (s,), and direction of gravity, shape (s, 3), of every second."""
    state, direction = np.empty(seconds, dtype=np.int64), np.empty((seconds, 3))
    at, moving, here = 0, True, np.array([0.0, 0.0, 1.0])
    off_until = 0
    while at < seconds:
        night = (at // HOUR) % 24 >= 16
        if moving:
            length = int(rng.exponential(8 if night else 60)) + 3
            kind = MOVE
        else:
            length = int(rng.exponential(900 if night else (600 if rng.random() < 0.3 else 60))) + 5
            kind = REST
            here = rng.standard_normal(3) * [0.9, 0.8, 0.9] + [0.0, 0.1, 0.3]
            here = here / np.linalg.norm(here)
            if not night and at > off_until and rng.random() < 0.004:  # taken off, about once a day
                kind, length = OFF, int(rng.uniform(1, 8) * HOUR)
                off_until = at + length + 10 * HOUR
        end = min(at + length, seconds)
        state[at:end] = kind
        direction[at:end] = here
        at, moving = end, not moving
    return state, direction


def write_cwa(
    path: Path,
    chunks: Iterator[WornChunk],
    rate: int = 100,
    *,
    actual: float | None = None,
    packing: int = PACKED,
) -> None:
    """Write an Axivity file; the sensor takes `actual` rows per second where it says `rate`."""
    count = 120 if packing == PACKED else 80
    with path.open("wb") as file:
        file.write(cwa_header(rate))
        rest, warm, row = np.empty((0, 3)), np.empty(0), 0
        for chunk in chunks:
            rows = np.concatenate([rest, chunk.output])
            degrees = np.concatenate(
                [warm, np.repeat(chunk.temperature, len(chunk.output) // len(chunk.temperature))]
            )
            whole = len(rows) // count * count
            shape = (-1, count)
            file.write(
                cwa_blocks(
                    rows[:whole].reshape(*shape, 3),
                    degrees[:whole].reshape(shape)[:, 0],
                    row,
                    rate,
                    actual or rate,
                    packing,
                ).tobytes()
            )
            rest, warm, row = rows[whole:], degrees[whole:], row + whole


def cwa_header(rate: int, *, gyro: bool = False) -> bytes:
    """Return the header of an Axivity file of +-8 g."""
    header = bytearray(b"\xff" * HEADER)
    header[:4] = b"MD\xfc\x03"
    header[4] = 0x64 if gyro else 0x17
    header[5:7] = (12345).to_bytes(2, "little")
    header[11:13] = (0).to_bytes(2, "little")
    header[35] = 2 if gyro else 0
    header[36] = _code(rate)
    header[64:512] = b" " * 448
    return bytes(header)


def cwa_blocks(
    output: Float,
    temperature: Float,
    first: int,
    rate: int,
    actual: float,
    packing: int,
    gyro: Float | None = None,
) -> np.ndarray:
    """Return blocks of data: output in g, shape (P, rows, 3), gyro in degrees per second; `first` row's number.

    The time stamp is that of row 75 of a block, with its fraction, and `offset` moved to the whole second before it.
    """
    blocks, count = np.zeros(len(output), LAYOUT), output.shape[1]
    blocks["kind"], blocks["length"] = DATA, BLOCK - 4
    stamped = min(75, count - 1)
    time = START + (first + stamped + count * np.arange(len(output))) / actual
    seconds = np.floor(time)
    fraction = np.floor((time - seconds) * 32768).astype(np.int64)
    blocks["fraction"] = fraction | 0x8000
    blocks["sequence"] = first // count + np.arange(len(output))
    blocks["stamp"] = _stamp(seconds)
    blocks["offset"] = stamped - np.floor(fraction / 32768 * rate)
    blocks["temperature"] = np.round((temperature - ZERO_DEGREES) / DEGREE)
    blocks["rate"], blocks["count"] = _code(rate), count
    axes = 3 if gyro is None else 6
    blocks["packing"] = axes << 4 | packing
    if packing == PACKED:
        samples: np.ndarray = _pack(np.round(output * 256))
    else:
        blocks["light"] = 4 << 13 | (2 << 10 if gyro is not None else 0)
        force = np.round(output * 4096)
        parts = force if gyro is None else np.concatenate([np.round(gyro / 2000 * 32768), force], axis=2)
        samples = np.clip(parts, -32768, 32767).astype("<i2").reshape(len(output), -1)
    raw = np.zeros((len(output), 480), np.uint8)
    filled = np.ascontiguousarray(samples).view(np.uint8).reshape(len(output), -1)
    raw[:, : filled.shape[1]] = filled
    blocks["samples"] = raw.view("V480")[:, 0]
    return sealed(blocks)


def sealed(blocks: np.ndarray) -> np.ndarray:
    """Set the checksums of blocks."""
    blocks["checksum"] = 0
    words = blocks.view("<u2").reshape(-1, BLOCK // 2)
    blocks["checksum"] = (-words.sum(axis=1, dtype=np.int64)) & 0xFFFF
    return blocks


def _pack(numbers: Float) -> np.ndarray:
    """Return 32-bit words of three numbers of 10 bits with a common exponent."""
    whole = np.clip(numbers, -2048, 2047).astype(np.int64)
    size = np.maximum(whole, -whole - 1).max(axis=2)
    exponent = (size >= 512).astype(np.int64) + (size >= 1024)
    short = whole >> exponent[..., None]
    word = exponent << 30
    for k in range(3):
        word |= (short[..., k] & 0x3FF) << (10 * k)
    return word.astype("<u4")


def _stamp(seconds: Float) -> np.ndarray:
    day = seconds.astype(np.int64).astype("datetime64[s]")
    month, date = day.astype("datetime64[M]"), day.astype("datetime64[D]")
    months = month.astype(np.int64)
    clock = (day - date).astype(np.int64)
    parts = (
        (months // 12 - 30) << 26,
        (months % 12 + 1) << 22,
        ((date - month).astype(np.int64) + 1) << 17,
        (clock // 3600) << 12,
        (clock // 60 % 60) << 6,
        clock % 60,
    )
    return np.bitwise_or.reduce(parts).astype("<u4")


def _code(rate: int) -> int:
    return {25: 8, 50: 9, 100: 10, 200: 11, 400: 12}[rate] | 1 << 6
