"""The traps: faults that real recordings have, each with its honest counterpart, the same poses and noise without it.

`TRAPS` is all of them. A trap makes a pair of recordings of a scene, and names the keys of notes or warnings of which
one has to name the cause.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.random import Generator

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.settings import Nominal
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import STANDARD_GRAVITY, ErrorModel
from benchmarks.truth_logs import LOGS, Pair, gyroscope, like, tremble
from benchmarks.truth_scenes import MILLI_G, Scene, random_sensor, rotation, spread, text_of, tilted, unit

REPEATED = 20
"""Rows of a pose where a trap does not ask for more; every other draw has one."""

Matters = Literal["shift", "attitudes", "always"]


@dataclass(frozen=True)
class Trap:
    """A kind of fault.

    Attributes:
        name: of the table; make: a faulty and an honest recording of a scene.
        keys: of which one names the cause.
        counts: attitudes; rows: of each, None for one and REPEATED in turn.
        matters: `shift` where it moves a parameter by 3 sigma; `attitudes` where they are the fault, which has to be
            named unless the intervals hold; `always` where there is nothing to compare.
        shown: whether the rows show it whatever the residuals are.
    """

    name: str
    make: Callable[[Scene], Pair]
    keys: frozenset[str]
    counts: tuple[int, ...] = (12, 24)
    rows: int | None = None
    matters: Matters = "shift"
    shown: bool = False


POOR = ("few-attitudes", "poses", "box", "noise-bias")
GROSS = ("outliers", "residuals", "large-misalignment", "box")


def held(scene: Scene, u: Float, rows: int | None = None) -> tuple[Float, Float]:
    """Return true force and noise of rows in the attitudes u, both shape (J * rows, 3)."""
    f = scene.g * np.repeat(u, rows or scene.rows, axis=0)
    return f, scene.noises(len(f))


def attitudes(
    choose: Callable[[Generator, int], Float], rows: int | None = None, labelled: bool = True
) -> Callable[[Scene], Pair]:
    """Return a trap of attitudes that cannot tell the parameters, beside as many well-spread ones."""

    def make(scene: Scene) -> Pair:
        n = rows or scene.rows
        made = []
        for u in (choose(scene.rng, scene.count), well_spread(scene.rng, scene.count)):
            f, z = held(scene, u, n)
            labels = scene.labels(len(u), n) if labelled else None
            made.append(scene.recording(scene.model.output(f + z), labels))
        return made[0], made[1]

    return make


def well_spread(rng: Generator, count: int) -> Float:
    """Return attitudes near a scheme, or many at random, shape (count, 3)."""
    return spread(rng, count) if count <= 100 else unit(rng.normal(size=(count, 3)))


def cap(degrees: float) -> Callable[[Generator, int], Float]:
    """Return a choice of attitudes within a half-angle of a random axis."""

    def choose(rng: Generator, count: int) -> Float:
        z = rng.uniform(np.cos(np.radians(degrees)), 1.0, count)
        angle = rng.uniform(0, 2 * np.pi, count)
        radius = np.sqrt(1 - z * z)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1) @ rotation(rng).T

    return choose


def corners(rng: Generator, count: int) -> Float:
    return unit(np.resize(poses.corners(), (count, 3)) + 0.01 * rng.normal(size=(count, 3)))


def about(axes: int, wobble: float = 1.0) -> Callable[[Generator, int], Float]:
    """Return a choice of attitudes turned about one or more axes of the sensor, with a wobble in degrees."""

    def choose(rng: Generator, count: int) -> Float:
        angle = 2 * np.pi * (np.arange(count) * axes / count + rng.uniform())
        flat = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
        which = np.arange(count) * axes // count + rng.integers(3)
        u = np.stack([np.roll(row, k % 3) for row, k in zip(flat, which.tolist(), strict=True)])
        return tilted(u, *np.radians(wobble) * rng.normal(size=(2, count)))

    return choose


def half_sphere(rng: Generator, count: int) -> Float:
    """Return attitudes in one half of the sphere, half of them within 15 degrees of its edge."""
    z = np.concatenate(
        [rng.uniform(0, np.sin(np.radians(15)), count // 2), rng.uniform(0, 1, count - count // 2)]
    )
    angle = 2 * np.pi * rng.permutation(count) / count
    radius = np.sqrt(1 - z * z)
    return np.roll(
        np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1), rng.integers(3), axis=1
    )


def faces(rng: Generator, count: int) -> Float:
    del rng, count
    return poses.faces()


def poor(rng: Generator, count: int) -> Float:
    """Return attitudes whose dilution of precision is 40 to 150."""
    rows, columns = np.tril_indices(3)
    while True:
        u = cap(float(rng.uniform(35, 80)))(rng, count)
        A = np.hstack([u[:, rows] * u[:, columns], u])
        if 40 < np.sqrt(np.diagonal(np.linalg.inv(A.T @ A)).max()) < 150:
            return u


def two_planes(scene: Scene) -> Pair:
    """Rows about two axes in any order with four spikes; honest: about three axes without."""
    made = []
    for axes, spikes in ((2, 4), (3, 0)):
        u = scene.rng.permutation(about(axes, 2.0)(scene.rng, scene.count))
        f, z = held(scene, u, 1)
        output = scene.model.output(f + z)
        hit = scene.rng.choice(len(u), spikes, replace=False)
        output[hit] *= scene.rng.uniform(1.5, 8.0, (spikes, 1))
        made.append(scene.recording(output))
    return made[0], made[1]


def changed(change: Callable[[Scene, Float, Float], Float]) -> Callable[[Scene], Pair]:
    """Return a trap of well-spread poses whose outputs are changed; `change` takes the true forces and the outputs."""

    def make(scene: Scene) -> Pair:
        f, z = held(scene, spread(scene.rng, scene.count))
        output, labels = scene.model.output(f + z), scene.labels()
        return scene.recording(change(scene, f, output), labels), scene.recording(output, labels)

    return make


def chosen(scene: Scene, most: int) -> Bool:
    """Return which rows belong to 1 to `most` random poses, as a mask."""
    hit = scene.rng.choice(scene.count, scene.rng.integers(1, most + 1), replace=False)
    return np.isin(np.arange(scene.count * scene.rows) // scene.rows, hit)


def dead(scene: Scene, _: Float, output: Float) -> Float:
    """One axis reads its bias, with or without noise."""
    out, i = output.copy(), scene.rng.integers(3)
    noisy = scene.rng.integers(2)
    out[:, i] = scene.model.D[i] + noisy * scene.size * scene.noise * scene.rng.normal(size=len(out))
    return out


def swapped(scene: Scene, _: Float, output: Float) -> Float:
    """Two axes are exchanged in up to a quarter of the poses."""
    out, pair = output.copy(), scene.rng.choice(3, 2, replace=False)
    hit = np.flatnonzero(chosen(scene, scene.count // 4))
    out[np.ix_(hit, pair)] = out[np.ix_(hit, pair[::-1])]
    return out


def flipped(scene: Scene, _: Float, output: Float) -> Float:
    """One axis has the other sign in up to a quarter of the poses."""
    out = output.copy()
    out[chosen(scene, scene.count // 4), scene.rng.integers(3)] *= -1
    return out


def clipped(axes: int) -> Callable[[Scene, Float, Float], Float]:
    """Return the change of a sensor that ends 2 % below the third largest reading of an axis, in so many axes."""

    def change(scene: Scene, _: Float, output: Float) -> Float:
        out = output.copy()
        peak = np.sort(np.abs(out.reshape(scene.count, scene.rows, 3).mean(axis=1)), axis=0)[-3]
        end = float(np.round(0.98 * peak.min()) if scene.size > 100 else np.round(0.98 * peak.min(), 2))
        for i in scene.rng.choice(3, axes, replace=False):
            limit = end if axes == 3 else float(np.round(0.98 * peak[i], 0 if scene.size > 100 else 2))
            out[:, i] = np.clip(out[:, i], -limit, limit)
        return out

    return change


def zeros(scene: Scene, _: Float, output: Float) -> Float:
    """The sensor sleeps in up to a sixth of the poses: all rows of it are zero, or a quarter of them."""
    out, hit = output.copy(), chosen(scene, scene.count // 6)
    if scene.rows > 1 and scene.rng.integers(2):
        hit &= np.arange(len(out)) % 4 == 3
    out[hit] = 0.0
    return out


def frozen(scene: Scene, _: Float, output: Float) -> Float:
    """One axis repeats its last reading through a quarter of the poses."""
    out, length = output.copy(), len(output) // 4
    first = int(scene.rng.integers(1, scene.count * 3 // 4)) * scene.rows
    i = scene.rng.integers(3)
    out[first : first + length, i] = out[first - 1, i]
    return out


def spikes(scene: Scene, _: Float, output: Float) -> Float:
    """1 % to 25 % of the rows are 1.3 to 10 times too large."""
    out, n = output.copy(), len(output)
    most = max(1, min(n // 4, n - 15)) if n < 100 else n // 4
    hit = scene.rng.choice(n, max(1, int(scene.rng.uniform(0.01, most / n) * n)), replace=False)
    out[hit] *= scene.rng.choice([1.3, 1.6, 2.0, 3.0, 10.0], (len(hit), 1))
    return out


def quantised(scene: Scene, _: Float, output: Float) -> Float:
    """Steps of 16 mg."""
    step = 16 * MILLI_G * scene.size
    return np.asarray(np.round(output / step) * step)


def nonlinear(power: int) -> Callable[[Scene, Float, Float], Float]:
    """Return the change of a sensor off its line by 0.5 % of g at 1 g, by the second or third power."""

    def change(scene: Scene, f: Float, output: Float) -> Float:
        sign = scene.rng.choice([-1.0, 1.0], 3)
        return np.asarray(output + sign * 0.005 * scene.size * scene.g * (f / scene.g) ** power)

    return change


def drifting(scene: Scene, _: Float, output: Float) -> Float:
    """Each bias drifts evenly by 10 to 40 mg through the session, through zero in its middle."""
    total = scene.rng.uniform(10, 40, 3) * scene.rng.choice([-1.0, 1.0], 3) * MILLI_G * scene.size
    return np.asarray(output + np.linspace(-0.5, 0.5, len(output))[:, None] * total)


def mixed_units(scene: Scene) -> Pair:
    """Some poses of a table in m/s^2 are in g."""
    model, size = random_sensor(scene.rng, "m/s^2")
    scene = Scene(scene.rng, model, size, scene.g, scene.noise, scene.count, scene.rows)

    def change(scene: Scene, _: Float, output: Float) -> Float:
        return np.where(chosen(scene, scene.count // 4)[:, None], output / STANDARD_GRAVITY, output)

    return changed(change)(scene)


def wrong_gravity(scene: Scene) -> Pair:
    """g is stated 1 % off for a sensor of which the nominal scale is stated, and holds to 0.1 %."""
    model, size = random_sensor(scene.rng, scale=0.001)
    scene = Scene(scene.rng, model, size, scene.g, scene.noise, scene.count, scene.rows)
    f, z = held(scene, spread(scene.rng, scene.count))
    output, nominal = model.output(f + z), Nominal((size, size, size))
    off = scene.g * (1 + 0.01 * scene.rng.choice([-1, 1]))
    faulty = scene.recording(
        output, scene.labels(), settings={"nominal": nominal, "g": off}, plain=scene.g / off * output
    )
    return faulty, scene.recording(output, scene.labels(), settings={"nominal": nominal})


def g_in_cm(scene: Scene) -> Pair:
    """g is stated in cm/s^2 for a table in m/s^2."""
    model, size = random_sensor(scene.rng, "m/s^2")
    scene = Scene(scene.rng, model, size, scene.g, scene.noise, scene.count, scene.rows)
    f, z = held(scene, spread(scene.rng, scene.count))
    output = model.output(f + z)
    faulty = scene.recording(output, scene.labels(), settings={"g": 100 * scene.g}, plain=output / 100)
    return faulty, scene.recording(output, scene.labels())


def labelled_up(sign: Callable[[Generator], Float]) -> Callable[[Scene], Pair]:
    """Return a trap of poses labelled by the axis that is up, of a sensor whose outputs have other signs."""

    def make(scene: Scene) -> Pair:
        u = poses.faces_edges() if scene.count == 12 else poses.fixture_directions()[: scene.count]
        f, z = held(scene, u)
        labels = [poses.describe(row).replace(",", " ") for row in np.repeat(u, scene.rows, axis=0)]
        signs = sign(scene.rng)
        mirrored = ErrorModel(signs[:, None] * scene.model.K, signs * scene.model.D)
        return (
            scene.recording(mirrored.output(f + z), labels, truth=mirrored),
            scene.recording(scene.model.output(f + z), labels),
        )

    return make


def two_sensors(order: Literal["stamps", "alternating", "blocks"]) -> Callable[[Scene], Pair]:
    """Return a trap of two sensors in one table, both read in every pose; honest: one of them."""

    def make(scene: Scene) -> Pair:
        other = like(scene)
        f, z = held(scene, spread(scene.rng, scene.count), 1)
        first, second = scene.model.output(f + z), other.output(f + scene.noises(len(f)))
        pair = np.stack([first, second], axis=0 if order == "blocks" else 1).reshape(-1, 3)
        columns: dict[str, list[object]] = {}
        if order == "stamps":
            columns = {
                "time": [f"{5 * (k // 2)}.0" for k in range(len(pair))],
                "device": [k % 2 for k in range(len(pair))],
            }
        return scene.recording(pair, columns=columns), scene.recording(first)

    return make


def without_gravity(scene: Scene) -> Pair:
    """A phone's linear acceleration: nothing but noise."""
    f, z = held(scene, spread(scene.rng, scene.count))
    labels = scene.labels()
    return scene.recording(scene.size * z, labels), scene.recording(scene.model.output(f + z), labels)


def gyroscope_taken(scene: Scene) -> Pair:
    """Of a table with a gyroscope's columns and those of acceleration the former are stated; honest: the latter."""
    f, z = held(scene, spread(scene.rng, scene.count), 1)
    output, rates = scene.model.output(f + z), gyroscope(scene.rng, len(f))
    made = []
    for columns in (("u", "v", "w"), ("x", "y", "z")):
        table = {name: [f"{v:.5f}" for v in column] for name, column in zip("uvw", rates.T, strict=True)}
        table |= {
            name: [scene.digits(v) for v in column] for name, column in zip("xyz", output.T, strict=True)
        }
        recording = replace(scene.recording(output), text=text_of(table), columns=columns)
        made.append(recording)
    return made[0], made[1]


def trembling(milliradians: float) -> Callable[[Scene], Pair]:
    """Return a trap of poses in a hand that trembles at 9 Hz; rows come at 100 Hz."""

    def make(scene: Scene) -> Pair:
        f, z = held(scene, spread(scene.rng, scene.count))
        shaken = tremble(scene.rng, f, scene.rows, milliradians / 1000)
        labels = scene.labels()
        return scene.recording(scene.model.output(shaken + z), labels), scene.recording(
            scene.model.output(f + z), labels
        )

    return make


def turning(scene: Scene) -> Pair:
    """Each hold turns slowly and evenly by 3 to 10 degrees."""
    f, z = held(scene, spread(scene.rng, scene.count))
    angle = np.radians(scene.rng.uniform(3, 10, scene.count)) * scene.rng.choice([-1.0, 1.0], scene.count)
    swept = (angle[:, None] * np.linspace(-0.5, 0.5, scene.rows)).ravel()
    moved = scene.g * tilted(f / scene.g, swept, np.zeros(len(f)))
    labels = scene.labels()
    return scene.recording(scene.model.output(moved + z), labels), scene.recording(
        scene.model.output(f + z), labels
    )


def wobbling(scene: Scene) -> Pair:
    """Each labelled pose is placed five times, 20 to 50 mrad rms off in each direction."""
    f, z = held(scene, spread(scene.rng, scene.count))
    off = scene.rng.uniform(0.02, 0.05) * scene.rng.normal(size=(2, scene.count * 5))
    placed = scene.g * tilted(f / scene.g, *np.repeat(off, scene.rows // 5, axis=1))
    labels = scene.labels()
    return scene.recording(scene.model.output(placed + z), labels), scene.recording(
        scene.model.output(f + z), labels
    )


def flicker(scene: Scene) -> Pair:
    """Noise whose power falls as 1/f; honest: white noise of the same size. Labelled poses or rows, in turn.

    Its mean over the session is a bias, of which no reading tells a part from the rest: it is that of the sensor.
    """
    f, z = held(scene, spread(scene.rng, scene.count))
    n = len(f)
    spectrum = np.fft.rfft(scene.rng.normal(size=(n, 3)), axis=0)
    spectrum /= np.sqrt(np.maximum(np.arange(len(spectrum)), 1))[:, None]
    spectrum[0] = 0.0
    pink = np.fft.irfft(spectrum, n, axis=0)
    pink *= scene.noise / pink.std(axis=0)
    labels = scene.labels() if scene.rng.integers(2) else None
    return scene.recording(scene.model.output(f + pink), labels), scene.recording(
        scene.model.output(f + z), labels
    )


def robustly(make: Callable[[Scene], Pair]) -> Callable[[Scene], Pair]:
    """Return the same trap calibrated with a robust loss."""

    def robust(scene: Scene) -> Pair:
        faulty, honest = make(scene)
        return tuple(  # type: ignore[return-value]
            replace(one, settings=replace(one.settings, robust="huber")) for one in (faulty, honest)
        )

    return robust


def _trap(name: str, make: Callable[[Scene], Pair], *keys: str, **more: object) -> Trap:
    return Trap(name, make, frozenset(keys), **more)  # type: ignore[arg-type]


MOVED = ("tremor", "residuals", "correlated", "moved")
MIRROR = ("negative-axes", "mirrored", "negative", "handedness", "sign", "left-handed", "orientation")

TRAPS: tuple[Trap, ...] = (
    *(_trap(f"cap of {a} degrees", attitudes(cap(a)), *POOR, matters="attitudes") for a in (20, 40, 60)),
    *(
        _trap(f"cap of {a} degrees", attitudes(cap(a)), *POOR, counts=(2000,), rows=1, matters="attitudes")
        for a in (20, 40, 60)
    ),
    _trap("corners only", attitudes(corners), *POOR, matters="attitudes", counts=(16, 24)),
    _trap("turned about one axis", attitudes(about(1)), *POOR, matters="attitudes"),
    _trap("turned about two axes", attitudes(about(2)), *POOR, matters="attitudes"),
    _trap("half sphere to its edge", attitudes(half_sphere), *POOR, matters="attitudes"),
    _trap("six faces, 60 rows each", attitudes(faces, 60, False), *POOR, matters="attitudes", counts=(12,)),
    _trap(
        "poor attitudes, 3 600 rows", attitudes(poor, 300, False), *POOR, matters="attitudes", counts=(12,)
    ),
    _trap(
        "two planes with spikes",
        two_planes,
        *POOR,
        "outliers",
        "large-misalignment",
        counts=(3800,),
        rows=1,
        matters="attitudes",
    ),
    _trap("dead axis", changed(dead), "dead-axis", "box", "poses", shown=True),
    _trap("mixed units", mixed_units, *GROSS, "mixed-units"),
    _trap("g 1 % off, nominal stated", wrong_gravity, "wrong-gravity", "box", shown=True),
    _trap("g in cm/s^2", g_in_cm, "wrong-gravity", shown=True),
    _trap("axes swapped in some poses", changed(swapped), *GROSS, "swapped"),
    _trap("sign flipped in some poses", changed(flipped), *GROSS, "flipped", "mirrored"),
    _trap(
        "negative sensor, labelled",
        labelled_up(lambda _: -np.ones(3)),
        *MIRROR,
        matters="always",
        shown=True,
    ),
    _trap(
        "left-handed sensor, labelled",
        labelled_up(lambda rng: np.where(np.arange(3) == rng.integers(3), -1.0, 1.0)),
        *MIRROR,
        matters="always",
        shown=True,
    ),
    _trap("clipped in one axis", changed(clipped(1)), "clipped", shown=True),
    _trap("clipped in three axes", changed(clipped(3)), "clipped", shown=True),
    _trap("rows of zeros", changed(zeros), "zero-rows", shown=True),
    _trap("one axis frozen", changed(frozen), "frozen", shown=True),
    *(
        _trap(
            f"two sensors, {order}",
            two_sensors(order),
            "several-sensors",
            *(GROSS if order == "blocks" else ()),
            rows=1,
            shown=order != "blocks",
        )
        for order in ("stamps", "alternating", "blocks")
    ),
    _trap("gravity removed", without_gravity, "gravity-removed", "never-moved", shown=True),
    _trap(
        "gyroscope taken",
        gyroscope_taken,
        "gravity-removed",
        "never-moved",
        "gyroscope",
        rows=1,
        shown=True,
        matters="always",
    ),
    *(_trap(f"tremor of {t} mrad", trembling(t), "tremor", rows=100, shown=True) for t in (10, 20, 50)),
    _trap("temperature drift", changed(drifting), "residuals", "correlated", "drift", rows=REPEATED),
    _trap("1/f noise, many rows", flicker, "correlated", "residuals", rows=150, shown=True),
    _trap("spikes", changed(spikes), *GROSS),
    _trap("spikes, --robust huber", robustly(changed(spikes)), *GROSS),
    _trap("spikes in 300 rows", changed(spikes), *GROSS, counts=(300,), rows=1),
    _trap("spikes in 300 rows, --robust huber", robustly(changed(spikes)), *GROSS, counts=(300,), rows=1),
    _trap("quantised at 16 mg", changed(quantised), "residuals", "quantised", rows=REPEATED),
    _trap("quadratic of 0.5 %", changed(nonlinear(2)), "residuals", "nonlinear", rows=REPEATED),
    _trap("cubic of 0.5 %", changed(nonlinear(3)), "residuals", "nonlinear", rows=REPEATED),
    _trap("holds that turn", turning, *MOVED, rows=100, shown=True),
    _trap("placement wobble", wobbling, *MOVED, rows=100, shown=True),
    *(
        _trap(name, make, *keys, counts=(14,), rows=1, matters="always", shown=True)
        for name, make, keys in LOGS
    ),
)

INVISIBLE = {
    "a mirrored or negative sensor, poses without labels": (
        "only |f| is compared with g, and it is the same for f, -f and a mirrored f; a label that says which axis is "
        "up, or a reference, tells"
    ),
    "a cubic nonlinearity on the twelve edges": (
        "every axis is at 0 or at 0.71 g there, where a third power is a change of scale factor; some faces tell"
    ),
    "a negated pose of a sensor without bias": "|f| of the negated reading is the same",
    "a swap of axes that read the same in that pose, or nearly": "the swapped reading is the reading",
    "g off by some per cent, no nominal sensor stated": "it equals a scale factor off by as much",
    "an attitude held exactly where the label says, or not": "no attitude enters the fit, only |f|",
    "smooth faults of single readings, one per pose": (
        "drift, nonlinearity and coarse steps look like noise where nothing repeats; they widen the interval"
    ),
}
"""Faults that the modulus, or the given poses, cannot show, and why; draws of them that shift nothing are left out."""
