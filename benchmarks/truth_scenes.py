"""What the truth studies draw, how they hand it over, and how they judge the answer.

A `Scene` is a random sensor held in random or exact attitudes. A `Recording` is the text that a person would have of
it, with the truth behind. `observe` calibrates it through the public functions; `holds` compares the intervals of the
result with the truth. `plain_fit` is an independent least-squares fit that says what a fault does to the parameters.
"""

from __future__ import annotations

import io
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.random import SFC64, Generator, SeedSequence

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.detection.detect import DetectSettings, detect
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.errors import AccelcalError
from accelcal_cli.io.readings import Readings, read_readings
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel

MILLI_G = 9.80665e-3
SCALE, MISALIGNMENT, BIAS = 0.02, 0.02, 0.05
"""Largest scale-factor error, misalignment in rad and bias in g of a random sensor."""

FAMILY = 0.01
"""Chance that any of the intervals of one result misses an honest truth, after widening (Bonferroni)."""

OPTIMIZER = "levenberg-marquardt"
"""The minimum does not depend on the search; this one takes 10 ms instead of 100."""

Task = TypeVar("Task")
Answer = TypeVar("Answer")

NAMES = ("ax", "ay", "az")

WORDS = {
    "several-sensors": r"several sensors|two sensors|--where|sensors in one",
    "log": r"--raw|accelcal detect",
    "duplicate-rows": r"repeat another|duplicate|copies",
    "zero-rows": r"zeros?\b",
    "frozen": r"frozen|stuck",
    "clipped": r"clipped|saturat",
    "gravity-removed": r"gravity (is |was |has been )?(removed|missing)|no gravity|does not turn|linear acceleration",
    "never-moved": r"never moved|never turned|was never turned",
    "wrong-gravity": r"neither gravity on Earth",
    "outliers": r"[Oo]utliers?:",
    "residuals": r"[Rr]esiduals are",
    "noise-bias": r"noise of one reading",
    "dead-axis": r"axis is dead|dead axis",
    "box": r"search box",
    "poses": r"do not determine|Weakly determined|fix no ellipsoid|leave no degrees|fewer than",
    "few-attitudes": r"too few attitudes|distinct attitudes|fewer than \d+; |still poses? in",
    "tremor": r"trembl|tremor",
    "correlated": r"correlat",
}
"""How sentences without a key name a cause: refusals, and results of versions that had no keys."""


def stream(*key: int | str) -> Generator:
    """Return the generator of a key; every draw of every study has its own."""
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    return Generator(SFC64(SeedSequence(words)))


def spread(rng: Generator, count: int) -> Float:
    """Return `count` attitudes that determine all parameters well: a scheme, or held by hand near one, (count, 3)."""
    schemes = {
        12: (poses.edges, poses.faces_edges, poses.icosahedron),
        24: (poses.turns, lambda: poses.fibonacci(24)),
    }.get(count, (lambda: poses.fibonacci(count),))
    u = schemes[rng.integers(len(schemes))]()
    by_hand = rng.integers(3)
    if by_hand:  # near the scheme
        u = unit(u + np.radians(rng.choice([3.0, 8.0])) * rng.normal(size=u.shape))
    if by_hand == 2:  # whose axes are not those of the sensor
        u = u @ rotation(rng).T
    return np.asarray(u)


def rotation(rng: Generator) -> Float:
    """Return a random rotation, shape (3, 3)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diagonal(r))
    return np.asarray(q * np.sign(np.linalg.det(q)))


def unit(v: Float) -> Float:
    """Return vectors of length 1, shape (..., 3)."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def tilted(u: Float, a: Float, b: Float) -> Float:
    """Return directions turned by the small angles a and b, shape (n,), about two axes across each, shape (n, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(u), axis=1)]
    first = unit(np.cross(u, helper))
    second = np.cross(u, first)
    return unit(u + np.tan(a)[:, None] * first + np.tan(b)[:, None] * second)


def random_sensor(rng: Generator, kind: str | None = None, scale: float = SCALE) -> tuple[ErrorModel, float]:
    """Return a sensor with random errors, and the output of 1 m/s^2; its output is in counts or in m/s^2."""
    kind = kind or str(rng.choice(["counts", "m/s^2"]))
    size = {"counts": float(rng.choice([16384, 8192, 4096])) / 9.80665, "m/s^2": 1.0}[kind]
    K = np.eye(3) + MISALIGNMENT * rng.uniform(-1, 1, (3, 3))
    np.fill_diagonal(K, 1 + scale * rng.uniform(-1, 1, 3))
    return ErrorModel(size * K, size * 9.80665 * BIAS * rng.uniform(-1, 1, 3)), size


@dataclass(frozen=True, eq=False)
class Scene:
    """A sensor, its noise and how it is read.

    Attributes:
        rng: of everything random; model: the truth; size: output of 1 m/s^2 of its nominal sensor.
        g: local gravity; noise: of one row and axis, m/s^2.
        count: attitudes; rows: of each attitude, averaged by label if more than one.
    """

    rng: Generator
    model: ErrorModel
    size: float
    g: float
    noise: float
    count: int
    rows: int

    @staticmethod
    def of(rng: Generator, noise: float, count: int, rows: int) -> Scene:
        """Draw a scene with noise in milli-g."""
        model, size = random_sensor(rng)
        return Scene(rng, model, size, float(rng.uniform(9.78, 9.83)), noise * MILLI_G, count, rows)

    def noises(self, count: int) -> Float:
        """Return white noise of rows, m/s^2, shape (count, 3)."""
        return self.noise * self.rng.normal(size=(count, 3))

    def labels(self, count: int | None = None, rows: int | None = None) -> list[str] | None:
        """Return the label of each row, None where every row is a pose."""
        rows = rows or self.rows
        return [f"p{k // rows + 1}" for k in range((count or self.count) * rows)] if rows > 1 else None

    def recording(
        self,
        output: Float,
        labels: list[str] | None = None,
        *,
        columns: Mapping[str, Iterable[object]] | None = None,
        names: tuple[str, str, str] = NAMES,
        header: bool = True,
        raw: bool = False,
        truth: ErrorModel | None = None,
        plain: Float | None = None,
        settings: Mapping[str, object] | None = None,
    ) -> Recording:
        """Return the recording of rows of output, shape (n, 3); `plain` is by default the means of labels."""
        table: dict[str, Iterable[object]] = dict(columns or {})
        if labels is not None:
            table = {"position": labels, **table}
        table |= {name: [self.digits(v) for v in output[:, i]] for i, name in enumerate(names)}
        if plain is None:
            plain = output if labels is None else means(output, labels)
        per_pose = len(output) / len(plain)
        stated = {
            "optimizer": OPTIMIZER,
            "g": self.g,
            "weights": "auto" if raw else "none",
            **(settings or {}),
        }
        return Recording(
            text_of(table, header),
            Settings(**stated),  # type: ignore[arg-type]
            truth or self.model,
            self.g,
            raw,
            plain,
            self.noise / np.sqrt(per_pose),
            known_noise=per_pose > 1,
        )

    def digits(self, value: float) -> str:
        """Return an output as sensors print it: whole counts, or m/s^2 to a hundred thousandth."""
        return f"{value:.0f}" if self.size > 100 else f"{value:.5f}"


@dataclass(frozen=True, eq=False)
class Recording:
    """A table or log as text, and the truth behind it.

    Attributes:
        text: the file; settings: of its calibration; truth: the sensor; g: true local gravity, m/s^2.
        raw: whether its poses have to be found first.
        plain: what a plain fit would take for readings, shape (J, 3); noise: of one of them along an axis, m/s^2.
        known_noise: whether rows repeat within the poses, so that the readings tell their noise.
        columns: the stated output columns, or None.
    """

    text: bytes
    settings: Settings
    truth: ErrorModel
    g: float
    raw: bool
    plain: Float
    noise: float
    known_noise: bool = False
    columns: tuple[str, str, str] | None = None


def text_of(table: Mapping[str, Iterable[object]], header: bool = True) -> bytes:
    """Return columns as CSV."""
    rows = zip(*table.values(), strict=True)
    lines = [",".join(map(str, row)) for row in rows]
    return "\n".join([*([",".join(table)] if header else []), *lines, ""]).encode()


def means(output: Float, labels: list[str]) -> Float:
    """Return the mean of each label in order of first occurrence, shape (J, 3)."""
    index: dict[str, int] = {}
    codes = np.array([index.setdefault(label, len(index)) for label in labels])
    counts = np.bincount(codes)
    return np.stack([np.bincount(codes, output[:, i]) / counts for i in range(3)], axis=1)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What calibrating a recording came to.

    Attributes:
        verdict: that of the result, or `refused`; keys: of notes and warnings, and of causes that sentences name.
        said: the sentences; result: None where refused.
    """

    verdict: str
    keys: frozenset[str]
    said: tuple[str, ...]
    result: Calibration | None = field(default=None, repr=False)

    @property
    def trusted(self) -> bool:
        """Whether the exit code would be 0."""
        return self.verdict in ("good", "weak")


def readings_of(recording: Recording) -> Readings:
    """Return the readings as the command would read them."""
    if not recording.raw:
        return read_readings("-", recording.columns, stdin=io.BytesIO(recording.text))
    log = open_raw_log("-", stdin=io.BytesIO(recording.text))
    fewest = 12 if recording.settings.misalignment else 6
    return detect(log, DetectSettings(g=recording.settings.g, least_poses=fewest)).readings()


def observe(recording: Recording) -> Outcome:
    """Calibrate a recording as `accelcal calibrate` does."""
    try:
        result = calibrate(readings_of(recording), recording.settings)
    except AccelcalError as error:
        said: tuple[str, ...] = (str(error),)
        return Outcome("refused", named_in(said), said)
    except Exception as error:  # a defect: counted as one, and the study goes on
        return Outcome("crashed", frozenset(), (f"{type(error).__name__}: {error}",))
    return outcome_of(result)


def outcome_of(result: Calibration) -> Outcome:
    """Return the verdict and what is said."""
    notices = getattr(result, "warnings", None)
    words = tuple(map(str, notices if notices is not None else result.cautions))
    keys = {notice.key for notice in notices or ()}
    if notices is None:
        keys |= named_in(words)
    if result.verdict in ("weak", "undetermined"):  # why is said by the reasons, which have no keys
        keys |= named_in(result.reasons)
    return Outcome(result.verdict, frozenset(keys), (*words, *result.reasons), result)


def named_in(sentences: Iterable[str]) -> frozenset[str]:
    """Return the causes that sentences name."""
    text = "\n".join(sentences)
    return frozenset(key for key, pattern in WORDS.items() if re.search(pattern, text))


def half_widths(result: Calibration) -> tuple[Float, Float]:
    """Return half the 95 % intervals of K_a, shape (3, 3), and D_a, shape (3,); 1.96 sigma where none is stated."""
    interval = getattr(result, "interval", None)
    if interval is None:
        return 1.96 * result.sigma.K_a, 1.96 * result.sigma.D_a
    return np.asarray(interval.K_a), np.asarray(interval.D_a)


def inside(result: Calibration, truth: ErrorModel) -> Float:
    """Return 1 for every 95 % interval that holds the truth, 0 for others, NaN for parameters without, shape (p,)."""
    error, half, _ = deviations(result, truth)
    return np.where(np.isfinite(half), np.abs(error) <= half, np.nan)


def deviations(result: Calibration, truth: ErrorModel) -> tuple[Float, Float, Float]:
    """Return error, half interval and sigma of every estimated parameter, shape (p,), in the gauge of the result."""
    there = truth.in_gauge(result.gauge)
    half_K, half_D = half_widths(result)
    error = np.concatenate([(result.K_a - there.K).ravel(), result.D_a - there.D])
    half, sigma = np.append(half_K.ravel(), half_D), np.append(result.sigma.K_a.ravel(), result.sigma.D_a)
    estimated = ~(half == 0)  # zeros of the gauge
    return error[estimated], half[estimated], sigma[estimated]


@cache
def _factors(parameters: int) -> tuple[Float, Float]:
    from scipy.stats import t

    freedom = np.geomspace(1, 1e5, 200)
    usual = t.ppf(0.975, freedom)
    return usual[::-1], (t.ppf(1 - FAMILY / (2 * parameters), freedom) / usual)[::-1]


def holds(result: Calibration, truth: ErrorModel) -> bool:
    """Whether every interval holds the truth, each widened so that all of them do with a chance of 1 - FAMILY.

    The freedom of Student's t is what the ratio of interval and sigma says.
    """
    error, half, sigma = deviations(result, truth)
    usual, wider = _factors(len(error))
    factor = np.interp(half / sigma, usual, wider)
    within: Bool = np.abs(error) <= factor * half
    return bool(within[np.isfinite(half)].all())


def plain_fit(output: Float, g: float, start: ErrorModel) -> ErrorModel | None:
    """Return the least-squares sensor of readings, shape (J, 3), in gauge `lower`; None where there is none near.

    Levenberg-Marquardt on |f| - g from the truth; independent of the library's solvers.
    """
    lower = start.in_gauge("lower")
    A, d, damping = np.linalg.inv(lower.K), lower.D.copy(), 1e-6
    rows, columns = np.tril_indices(3)
    f = (output - d) @ A.T
    e = np.linalg.norm(f, axis=1) - g
    for _ in range(60):
        u = f / np.maximum(np.linalg.norm(f, axis=1, keepdims=True), 1e-12)
        # Steps of A are relative, E in (I + E) A, and of d as force along the axes: all of one unit.
        J = np.hstack([u[:, rows] * f[:, columns] / g, -u @ A / np.diagonal(A)])
        M = J.T @ J
        step = np.linalg.lstsq(
            M + damping * np.diag(np.diagonal(M)) + 1e-14 * np.eye(9), -J.T @ e, rcond=None
        )[0]
        E = np.zeros((3, 3))
        E[rows, columns] = step[:6] / g
        tried_A, tried_d = A + E @ A, d + step[6:] / np.diagonal(A)
        tried_f = (output - tried_d) @ tried_A.T
        tried = np.linalg.norm(tried_f, axis=1) - g
        if not np.isfinite(tried).all():
            return None
        if tried @ tried <= e @ e:
            done = e @ e - tried @ tried <= 1e-14 * (e @ e)
            A, d, f, e, damping = tried_A, tried_d, tried_f, tried, damping / 10
            if done:
                break
        else:
            damping = max(damping, 1e-9) * 10
            if damping > 1e6:
                break
    if abs(np.linalg.det(A)) < 1e-6 * abs(np.linalg.det(np.linalg.inv(lower.K))):
        return None
    return ErrorModel(np.linalg.inv(A), d).in_gauge("lower")


@dataclass(frozen=True, eq=False)
class Fault:
    """What a fault does to a plain fit.

    Attributes:
        shift: of the worst parameter, in honest sigma; inf where the fit is lost.
        seen: whether the residuals of that fit show it: beyond the noise that repeated rows tell (p < 1e-6), twice as
            large as any accelerometer at rest leaves, or one pose beyond all chance.
    """

    shift: float
    seen: bool


def fault_of(faulty: Recording, honest: Recording) -> Fault:
    """Compare plain fits with and without the fault, of the same noise."""
    from scipy.stats import chi2

    truth, g = honest.truth.in_gauge("lower"), honest.g
    with_it = plain_fit(faulty.plain, g, truth)
    without = plain_fit(honest.plain, g, truth)
    if with_it is None or without is None:
        return Fault(np.inf, seen=True)
    inverse = np.linalg.inv(truth.K)
    E = g * (np.linalg.inv(with_it.K) - np.linalg.inv(without.K)) @ truth.K
    change = np.append(E[np.tril_indices(3)], np.diagonal(inverse) * (with_it.D - without.D))
    u = unit((honest.plain - without.D) @ np.linalg.inv(without.K).T)
    cofactor = np.linalg.pinv(_design(u).T @ _design(u))
    shift = float(np.max(np.abs(change) / (honest.noise * np.sqrt(np.diagonal(cofactor)))))
    f = (faulty.plain - with_it.D) @ np.linalg.inv(with_it.K).T
    e, freedom = np.linalg.norm(f, axis=1) - g, max(1, len(f) - 9)
    beyond = faulty.known_noise and chi2.sf(e @ e / honest.noise**2, freedom) < 1e-6
    large = np.sqrt(e @ e / freedom) > 0.01 * g
    return Fault(shift, bool(beyond or large or _stands_out(e, unit(f))))


def _design(u: Float) -> Float:
    rows, columns = np.tril_indices(3)
    return np.hstack([u[:, rows] * u[:, columns], -u])


def _stands_out(e: Float, u: Float) -> bool:
    """Whether a residual is beyond chance (Student's t of those left out, Bonferroni, p < 1e-4)."""
    from scipy.stats import t

    A = _design(u)
    freedom = len(e) - 10
    if freedom < 1:
        return False
    room = np.maximum(1 - np.sum(A @ np.linalg.pinv(A.T @ A) * A, axis=1), 1e-9)
    rest = np.maximum(e @ e - e**2 / room, 1e-3 * (e @ e)) / freedom
    return bool((2 * len(e) * t.sf(np.abs(e) / np.sqrt(room * rest), freedom)).min() < 1e-4)


def in_processes(function: Callable[[Task], Answer], tasks: Iterable[Task], jobs: int) -> Iterator[Answer]:
    """Yield the results of tasks in order, from `jobs` processes or from this one."""
    if jobs <= 1:
        yield from map(function, tasks)
        return
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(function, tasks)
