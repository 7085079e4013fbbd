"""How often `accelcal verify` calls sensors changed: `python -m benchmarks.verify_level [sensors] [pairs]`.

First of estimates drawn from their distribution, which is quick and shows many cases; then of pairs of simulated
readings that are calibrated and verified as the command does it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.distributions import Noise, Pair, combined
from accelcal_cli.calibration.observability import design
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.verification.verify import verify

LEVEL = 0.05
G, NOISE = 9.80665, 2e-3
"""Local gravity and the noise of one pose, m/s^2, of the simulated readings."""
SETS = {
    "12": poses.faces_edges(),
    "24": poses.turns(),
    "12 twice": np.repeat(poses.faces_edges(), 2, axis=0),
    "6": poses.faces(),
    "6 twice": np.repeat(poses.faces(), 2, axis=0),
    "6 four times": np.repeat(poses.faces(), 4, axis=0),
    "40": poses.fibonacci(40),
    "48": np.repeat(poses.turns(), 2, axis=0),
    "60": poses.fibonacci(60),
}
CASES = (
    *(
        (old, new, 1.0, 0.0)
        for old, new in (("12", "12"), ("24", "12"), ("24", "24"), ("12 twice", "12 twice"))
    ),
    ("60", "12", 1.0, 0.0),
    *((old, new, 2.0, 0.0) for old, new in (("24", "24"), ("24", "12"), ("60", "12"))),
    *(
        (old, new, 1.0, 5.0)
        for old, new in (("12", "12"), ("24", "24"), ("12 twice", "12 twice"), ("60", "24"))
    ),
)
"""Poses of the old readings and the new, noise of the new over the old, shift of one bias in sigma."""


def cofactor(u: Float) -> Float:
    A = design(u)
    return np.linalg.inv(A.T @ A)


def rate(old: str, new: str, ratio: float, shift: float, sensors: int) -> float:
    """Return the part that is called changed, of estimates drawn from their distribution."""
    A, B, n_a, n_b = cofactor(SETS[old]), cofactor(SETS[new]), len(SETS[old]) - 9, len(SETS[new]) - 9
    z = Streams(5, [0], purpose=3).normal(sensors, 9 + n_a + n_b)[0]
    V = A + ratio**2 * B
    d = z[:, :9] @ np.linalg.cholesky(V).T
    d[:, 8] += shift * np.sqrt(V[8, 8])
    a, b = (z[:, 9 : 9 + n_a] ** 2).mean(axis=1), ratio**2 * (z[:, 9 + n_a :] ** 2).mean(axis=1)
    changed = 0
    for j in range(sensors):
        pair = Pair.of(Noise(float(a[j]), n_a), Noise(float(b[j]), n_b))
        single = [pair.chance(d[j, [p]], A[[p]][:, [p]], B[[p]][:, [p]]) for p in range(9)]
        changed += combined(np.array([*single, pair.chance(d[j], A, B)])) < LEVEL
    return changed / sensors


@dataclass(frozen=True)
class Case:
    """Sensors that are calibrated from readings, read again, and verified.

    Attributes:
        name: of the case; old, new: poses of both readings, of SETS.
        settings: of the calibration.
        counts: least and largest number of readings behind a pose, None for single readings without scatter.
        shared: noise that the readings of a pose share, m/s^2.
        degrees: lowest and highest temperature of the old poses, and that of the new ones, None for none.
        turned: whether the sensor is mounted otherwise for the new readings; aligned: whether its axes are
            perpendicular.
        scale, angle, bias: change of one of them in between: parts, rad, g.
    """

    name: str
    old: str = "24"
    new: str = "24"
    settings: dict[str, object] = field(default_factory=dict)
    counts: tuple[int, int] | None = None
    shared: float = NOISE
    degrees: tuple[float, float, float] | None = None
    turned: bool = False
    aligned: bool = False
    scale: float = 0.0
    angle: float = 0.0
    bias: float = 0.0


READING, DRIFT = 0.02, 2e-4
"""Noise of one reading of those behind a pose, m/s^2, and drift of the bias and of the scale factors per degree, m/s^2
and part."""

AUTO, ALIGNED = {"weights": "auto"}, {"misalignment": False}
UNCHANGED = (
    Case("equal noise"),
    Case("equal noise", "24", "12"),
    Case("equal noise", "12", "12"),
    *(
        Case(f"auto, n 20 to 3000, {share:g} mg shared", old, new, AUTO, (20, 3000), share * 1e-3 * G)
        for share in (0.0, 0.03, 0.2)
        for old, new in (("24", "24"), ("40", "12"))
    ),
    Case("n, n 20 to 3000", settings={"weights": "n"}, counts=(20, 3000), shared=0.0),
    Case("sd, n 20 to 3000", settings={"weights": "sd"}, counts=(20, 3000), shared=0.0),
    Case("none, n 20 to 3000", counts=(20, 3000), shared=0.0),
    Case("slopes, 15 to 45, new at 45", "48", degrees=(15.0, 45.0, 45.0)),
    Case("slopes, 25 to 35, new at 50", "48", degrees=(25.0, 35.0, 50.0)),
    Case("slopes, 15 to 45, new at 45", "40", degrees=(15.0, 45.0, 45.0)),
    Case("slopes, auto, new at 45", "48", settings=AUTO, counts=(20, 3000), degrees=(15.0, 45.0, 45.0)),
    Case("no misalignment, faces", "6 four times", "6 twice", ALIGNED, aligned=True),
    Case("no misalignment, 12 v 6 faces", "12 twice", "6 twice", ALIGNED, aligned=True),
    Case("other gauge, re-mounted", settings={"gauge": "symmetric"}, turned=True),
    Case("gauge full, re-mounted", settings={"gauge": "full"}, turned=True),
    Case("huber", settings={"robust": "huber"}),
    Case("huber", "40", "24", settings={"robust": "huber"}),
    Case("huber", "24", "12", settings={"robust": "huber"}),
    Case("soft-l1", settings={"robust": "soft-l1"}),
    Case("new: six faces", "24", "6"),
    Case("new: six faces, auto", "24", "6", AUTO, (20, 3000)),
)
CHANGED = (
    Case("bias 0.6 mg", bias=0.6e-3),
    Case("scale factor 1 000 ppm", scale=1e-3),
    Case("misalignment 2 mrad", angle=2e-3),
    Case("bias 0.6 mg, auto", settings=AUTO, counts=(20, 3000), bias=0.6e-3),
    Case("bias 0.6 mg, huber", settings={"robust": "huber"}, bias=0.6e-3),
)


def whole(case: Case, pairs: int) -> tuple[float, float]:
    """Return the part of simulated sensors that is called changed, and the part where the verdict is inconclusive."""
    words = [verdict(case, number) for number in range(pairs)]
    return words.count("changed") / pairs, words.count("inconclusive") / pairs


def verdict(case: Case, number: int) -> str:
    """Return the verdict on one sensor."""
    random = np.random.default_rng([number, 20])
    K = np.eye(3) + (
        np.diag(0.01 * random.normal(size=3)) if case.aligned else 0.01 * random.normal(size=(3, 3))
    )
    D = 0.2 * random.normal(size=3)
    later = K @ np.linalg.qr(random.normal(size=(3, 3)))[0] if case.turned else K.copy()
    later[2] *= 1.0 + case.scale
    later[2, 0] += case.angle * K[2, 2]
    moved = D + np.array([0.0, 0.0, case.bias * G * K[2, 2]])
    low, high, then = case.degrees or (0.0, 0.0, 0.0)
    before = SETS[case.old]
    degrees = random.permutation(np.linspace(low, high, len(before)))
    old = drawn(case, ErrorModel(K, D), before, degrees, random)
    result = calibrate(old, Settings(g=G, optimizer="levenberg-marquardt", **case.settings))  # type: ignore[arg-type]
    after = SETS[case.new]
    new = drawn(case, ErrorModel(later, moved), after, np.full(len(after), then), random)
    return verify(result, new, LEVEL).verdict


def drawn(case: Case, sensor: ErrorModel, u: Float, degrees: Float, random: np.random.Generator) -> Readings:
    """Return readings of a sensor in the directions u, shape (J, 3), at temperatures, shape (J,)."""
    noise, count, scatter, cross = case.shared * random.normal(size=u.shape), None, None, None
    if case.counts is not None:
        count = np.rint(np.exp(random.uniform(*np.log(case.counts), len(u))))
        noise = noise + READING / np.sqrt(count)[:, None] * random.normal(size=u.shape)
        S = READING**2 * np.array([covariance(int(n), random) for n in count])
        S = sensor.K @ S @ sensor.K.T
        scatter, cross = np.sqrt(np.einsum("jaa->ja", S)), S[:, [0, 0, 1], [1, 2, 2]]
    output = sensor.output(G * u + noise)
    if case.degrees is None:
        return Readings.from_array(output, count=count, scatter=scatter, cross=cross)
    t = (degrees - 30.0)[:, None]
    output = (
        (output - sensor.D) * (1.0 + 0.1 * DRIFT * t * [1.0, -0.5, 0.8])
        + sensor.D
        + DRIFT * t * [1.0, -1.0, 0.5]
    )
    return Readings.from_array(output, count=count, scatter=scatter, cross=cross, temperature=degrees)


def covariance(n: int, random: np.random.Generator) -> Float:
    """Return the sample covariance of n readings of variance 1, shape (3, 3), by Bartlett's decomposition."""
    L = np.diag(np.sqrt(random.chisquare(n - 1 - np.arange(3))))
    L[1, 0], L[2, 0], L[2, 1] = random.normal(size=3)
    return L @ L.T / (n - 1)


def main(sensors: int = 4000, pairs: int = 1000) -> None:
    print("| old poses | new poses | noise, new / old | shift of one bias | called changed |")
    print("| --- | --- | --- | --- | --- |")
    for old, new, ratio, shift in CASES:
        share = rate(old, new, ratio, shift, sensors)
        print(f"| {old} | {new} | {ratio:g} | {shift:g} sigma | {share:.1%} |", flush=True)
    print(f"\nFrom readings, {pairs:,} sensors each:\n")
    print("| case | old poses | new poses | called changed | inconclusive |")
    print("| --- | --- | --- | --- | --- |")
    for case in (*UNCHANGED, *CHANGED):
        called, open_ = whole(case, pairs)
        print(f"| {case.name} | {case.old} | {case.new} | {called:.1%} | {open_:.1%} |", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))
