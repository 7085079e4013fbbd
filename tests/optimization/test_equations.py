"""One step of each optimizer, and the same step written out by hand from the equations of its source.

Every number is computed for one particle and one coordinate at a time, from the same random numbers, on a few points.
Whoever changes an equation changes both, or sees the difference here.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.algorithms.akpso import AdaptiveKalmanSwarm
from accelcal_cli.optimization.algorithms.de_pso import HybridSwarm
from accelcal_cli.optimization.algorithms.foa import FruitFly
from accelcal_cli.optimization.algorithms.full_foa import FullFruitFly
from accelcal_cli.optimization.algorithms.ifoa import ImprovedFruitFly
from accelcal_cli.optimization.algorithms.kpso import KalmanSwarm
from accelcal_cli.optimization.algorithms.newton import Newton
from accelcal_cli.optimization.algorithms.pso import ParticleSwarm
from accelcal_cli.optimization.optimizer import Status
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams

P, D = 6, 3


class Bowl(Problem):
    """sum c_j (x_j - o_j)^2 + 0.1 (x_1 - x_2)^2 over a box that differs from coordinate to coordinate."""

    name = "bowl"

    def __init__(self):
        self.lower, self.upper = np.array([-1.0, -4.0, 2.0]), np.array([3.0, 6.0, 5.0])
        self.c, self.o = np.array([1.0, 3.0, 0.5]), np.array([0.4, -1.2, 3.1])

    def cost(self, x):
        return ((x - self.o) ** 2 * self.c).sum(axis=-1) + 0.1 * (x[..., 0] - x[..., 1]) ** 2

    def at(self, point):
        return float(self.cost(np.asarray(point, float)[None, None])[0, 0])


BOX = Bowl()


def start(population=P, seed=1):
    return BOX.lower + (BOX.upper - BOX.lower) * Streams(seed, [0]).uniform(population, D)


def clip(value, low, high):
    return min(max(value, low), high)


def into_the_box(x):
    return [clip(x[j], BOX.lower[j], BOX.upper[j]) for j in range(D)]


def costs(points):
    return np.array([BOX.at(point) for point in points])


def replaced(memory, memory_cost, x, fx):
    """The best that each has seen, and the best of all."""
    memory = np.array([x[i] if fx[i] < memory_cost[i] else memory[i] for i in range(len(x))])
    memory_cost = np.minimum(fx, memory_cost)
    return memory, memory_cost, memory[int(np.argmin(memory_cost))]


def swarm_velocity(x, v, memory, leader, r1, r2, w, c1, c2, speed):
    """[dpso2014] eq. 1 of one particle, each coordinate cut to the limit."""
    out = []
    for j in range(D):
        limit = speed * 0.5 * (BOX.upper[j] - BOX.lower[j])
        new = w * v[j] + c1 * r1[j] * (leader[j] - x[j]) + c2 * r2[j] * (memory[j] - x[j])
        out.append(clip(new, -limit, limit))
    return out


def spread(numbers, randoms):
    """The random numbers of one particle for its D coordinates."""
    return numbers if randoms == "coordinate" else [numbers[0]] * D


# Particle swarms


@pytest.mark.parametrize("randoms", ["coordinate", "particle"])
def test_pso(randoms):
    optimizer = ParticleSwarm(
        population=P, inertia=0.8, social=1.7, cognitive=1.1, speed=0.4, randoms=randoms
    )
    rng, twin = Streams(7, [0]), Streams(7, [0])
    state = optimizer.init(BOX, start(), rng)
    x, v = state.x[0], np.zeros((P, D))
    memory, memory_cost, leader = replaced(x, np.full(P, np.inf), x, costs(x))
    width = D if randoms == "coordinate" else 1
    for _ in range(4):
        state = optimizer.step(BOX, state, rng)
        u = twin.uniform(P, 2 * width)[0]
        r1, r2 = ([spread(row, randoms) for row in part] for part in (u[:, :width], u[:, width:]))
        v = np.array([
            swarm_velocity(x[i], v[i], memory[i], leader, r1[i], r2[i], 0.8, 1.7, 1.1, 0.4) for i in range(P)
        ])  # fmt: skip
        x = np.array([into_the_box(x[i] + v[i]) for i in range(P)])
        memory, memory_cost, leader = replaced(memory, memory_cost, x, costs(x))
        np.testing.assert_allclose(state.x[0], x, rtol=1e-12)
        np.testing.assert_allclose(state.velocity[0], v, rtol=1e-10, atol=1e-14)
        np.testing.assert_allclose(state.leader[0], leader, rtol=1e-12)


def curve(k, iterations, low, high, a=30.0, b=0.88):
    """[dpso2014] eq. 7 and 9."""
    return high - (high - low) / (1 + a * b ** (100 * k / iterations))


@pytest.mark.parametrize("randoms", ["coordinate", "particle"])
@pytest.mark.parametrize("best", ["swarm", "evolution"])
def test_de_pso(randoms, best):
    """Both halves are led by the better of their two best points, whichever half it is in."""
    half, rest, iterations = 5, 5, 40
    optimizer = HybridSwarm(population=10, iterations=iterations, speed=0.4, weight=0.6, randoms=randoms)
    rng, twin = Streams(7, [0]), Streams(7, [0])
    state = optimizer.init(BOX, start(10), rng)
    points = state.x[0].copy(order="K")
    points[0 if best == "swarm" else 7] = [0.41, -1.19, 3.1]  # next to the minimum
    state = dataclasses.replace(
        state, x=points[None], memory=points[None], fx=costs(points)[None], memory_cost=costs(points)[None],
        leader=np.array([[0.41, -1.19, 3.1]]),
    )  # fmt: skip
    x, v = points, np.zeros((half, D))
    memory, memory_cost, leader = replaced(x, np.full(10, np.inf), x, costs(x))
    width = D if randoms == "coordinate" else 1
    for k in range(4):
        state = optimizer.step(BOX, state, rng)
        u = twin.uniform(rest, 2 * width + D + 3)[0]
        w, beta = curve(k, iterations, 0.2, 1.4), curve(k, iterations, 0.1, 1.0)
        new = []
        for i in range(half):
            r1, r2 = spread(u[i, :width], randoms), spread(u[i, width : 2 * width], randoms)
            v[i] = swarm_velocity(x[i], v[i], memory[i], leader, r1, r2, w, 2.0, 2.0, 0.4)
            new.append(into_the_box(x[i] + v[i]))
        evolving = memory[half:]
        for i in range(rest):
            others = [(i + 1 + n) % rest for n in range(rest - 1)]
            n = others[int(u[i, -3] * (rest - 1))]
            others.remove(n)
            m = others[int(u[i, -2] * (rest - 2))]
            forced = int(u[i, -1] * D)
            trial = []
            for j in range(D):
                mutant = (
                    beta * evolving[i, j] + (1 - beta) * leader[j] + 0.6 * (evolving[n, j] - evolving[m, j])
                )
                taken = u[i, 2 * width + j] > 0.4 or j == forced
                trial.append(mutant if taken else evolving[i, j])
            new.append(into_the_box(trial))
        x = np.array(new)
        memory, memory_cost, leader = replaced(memory, memory_cost, x, costs(x))
        np.testing.assert_allclose(state.x[0], x, rtol=1e-12)
        np.testing.assert_allclose(state.velocity[0], v, rtol=1e-10, atol=1e-14)
        np.testing.assert_allclose(state.leader[0], leader, rtol=1e-12)


# Kalman swarms


@pytest.mark.parametrize("randoms", ["coordinate", "particle"])
def test_kpso(randoms):
    """[monson2004]: predict, observe a random point up to twice as far as the best, update, predict, sample."""
    optimizer, q = KalmanSwarm(population=P, noise=0.003, randoms=randoms), 0.006
    rng, twin = Streams(7, [0]), Streams(7, [0])
    state = optimizer.init(BOX, start(), rng)
    half = 0.5 * (BOX.upper - BOX.lower)
    x = state.x[0]
    mean = [[np.array([(x[i, j] - BOX.lower[j]) / half[j] - 1, 0.0]) for j in range(D)] for i in range(P)]
    covariance = q * np.eye(2)
    leader, least = x[int(np.argmin(costs(x)))], costs(x).min()
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    for _ in range(4):
        state = optimizer.step(BOX, state, rng)
        u, normal = twin.uniform(P, D if randoms == "coordinate" else 1)[0], twin.normal(P, D)[0]
        predicted = F @ covariance @ F.T + q * np.eye(2)
        gain = predicted @ H.T / (H @ predicted @ H.T + q)
        covariance = predicted - gain @ H @ predicted
        new = np.empty((P, D))
        for i in range(P):
            for j in range(D):
                target = x[i, j] + 2 * spread(u[i], randoms)[j] * (leader[j] - x[i, j])
                z = (target - BOX.lower[j]) / half[j] - 1
                m = F @ mean[i][j]
                mean[i][j] = m + gain[:, 0] * (z - m[0])
                ahead = (F @ mean[i][j])[0] + math.sqrt(covariance[0, 0]) * normal[i, j]
                new[i, j] = clip(BOX.lower[j] + half[j] * (ahead + 1), BOX.lower[j], BOX.upper[j])
        x, fx = new, costs(new)
        if fx.min() < least:
            leader, least = x[int(np.argmin(fx))], fx.min()
        np.testing.assert_allclose(state.x[0], x, rtol=1e-12)
        np.testing.assert_allclose(state.rate[0], [[m[1] for m in row] for row in mean], rtol=1e-10)
        np.testing.assert_allclose(state.covariance[0], covariance, rtol=1e-12)
        np.testing.assert_allclose(state.leader[0, 0], leader, rtol=1e-12)


def transition(phi1, phi2, w, size):
    """Phi of (x, v, p, g), [akpso2015] section 2; with two states p and g are inputs."""
    full = np.array([
        [1 - phi1 - phi2, w, phi2, phi1], [-phi1 - phi2, w, phi2, phi1], [0, 0, 1, 0], [0, 0, 0, 1],
    ])  # fmt: skip
    return full[:size, :size], full


class Filters:
    """AKPSO with matrices, one filter for each particle and coordinate."""

    def __init__(self, optimizer, x, v):
        self.o, self.x, self.v, k = optimizer, x.copy(), v.copy(), optimizer.kalman_dim
        self.P = np.tile(optimizer.noise * np.eye(k), (P, D, 1, 1))
        self.memory, self.memory_cost, self.leader = replaced(x, np.full(P, np.inf), x, costs(x))
        swarm = np.stack([x, v, self.memory, np.broadcast_to(self.leader, x.shape)], axis=2)
        middle = 0.5 * (BOX.lower + BOX.upper)
        zero = np.stack([np.broadcast_to(c, x.shape) for c in (middle, np.zeros(D), middle, middle)], axis=2)
        self.S = zero if optimizer.first_state == "zero" else swarm

    def step(self, u, normal):
        o, width = self.o, D if self.o.randoms == "coordinate" else 1
        r = [
            np.array([spread(row, o.randoms) for row in u[:, n * width : (n + 1) * width]]) for n in range(4)
        ]
        at = np.empty((P, D))
        for i in range(P):
            for j in range(D):
                if o.bests == "reset":
                    self.S[i, j, 2:] = self.memory[i, j], self.leader[j]
                at[i, j] = self._filter(i, j, [part[i, j] for part in r], normal)
        self.x = at
        self.memory, self.memory_cost, self.leader = replaced(self.memory, self.memory_cost, at, costs(at))

    def _filter(self, i, j, r, normal):
        o, half = self.o, 0.5 * (BOX.upper[j] - BOX.lower[j])
        k, w, limit = o.kalman_dim, o.inertia, o.speed * half
        Phi, whole = transition(o.social * r[0], o.cognitive * r[1], w, k)
        x, v, p, g = self.x[i, j], self.v[i, j], self.memory[i, j], self.leader[j]
        zv = clip(w * v + o.social * r[2] * (g - x) + o.cognitive * r[3] * (p - x), -limit, limit)
        z = np.array([x + zv, zv])
        H = (
            np.eye(4)[:2]
            if o.observation == "state"
            else transition(o.social * r[2], o.cognitive * r[3], w, k)[1][:2]
        )
        X = whole @ self.S[i, j]
        e = z - H @ X
        Q, R, H = o.noise * np.eye(k), o.noise * np.eye(2), H[:, :k]
        predicted = Phi @ self.P[i, j] @ Phi.T
        if o.memory == "fixed":
            predicted = math.exp(o.fading) * (predicted + Q)
        else:
            beyond = e @ e / (2 * half * half) - np.trace(R) - 2 * o.noise
            predicted = clip(beyond / (predicted[0, 0] + predicted[1, 1]), 1.0, math.exp(5)) * predicted + Q
        K = predicted @ H.T @ np.linalg.inv(H @ predicted @ H.T + R)
        X[:k] += K @ e
        self.P[i, j] = (np.eye(k) - K @ H) @ predicted
        X[0], X[1] = clip(X[0], BOX.lower[j], BOX.upper[j]), clip(X[1], -limit, limit)
        self.S[i, j], self.v[i, j] = X, X[1]
        if o.position == "estimate":
            return X[0]
        sampled = X[0] + half * math.sqrt(2 * self.P[i, j][0, 0]) * normal[i, j]
        return clip(sampled, BOX.lower[j], BOX.upper[j])


READINGS = [
    {"kalman_dim": 2},
    {"kalman_dim": 4},
    {"kalman_dim": 4, "fading": 0.7},
    {"kalman_dim": 2, "randoms": "particle"},
    {"kalman_dim": 4, "randoms": "particle"},
    {"kalman_dim": 2, "observation": "step"},
    {"kalman_dim": 4, "observation": "step"},
    {"kalman_dim": 2, "first_state": "zero"},
    {"kalman_dim": 4, "first_state": "zero"},
    {"kalman_dim": 2, "position": "sampled"},
    {"kalman_dim": 4, "memory": "adaptive", "noise": 1e-4},
    {"kalman_dim": 2, "memory": "adaptive", "noise": 1e-4},
    {"kalman_dim": 4, "bests": "filtered"},
    {"kalman_dim": 4, "bests": "filtered", "first_state": "zero", "position": "sampled"},
]


@pytest.mark.parametrize("reading", READINGS, ids=str)
def test_akpso(reading):
    """[akpso2015] eq. 11 to 20, in every reading of the lost formulas."""
    optimizer = AdaptiveKalmanSwarm(
        population=P, inertia=0.6, social=1.7, cognitive=1.1, speed=0.4, **reading
    )
    rng, twin = Streams(7, [0]), Streams(7, [0])
    state = optimizer.init(BOX, start(), rng)
    half = 0.5 * (BOX.upper - BOX.lower)
    filters = Filters(optimizer, state.x[0], 0.4 * half * (2 * twin.uniform(P, D)[0] - 1))
    np.testing.assert_allclose(state.velocity[0], filters.v)
    for _ in range(4):
        state = optimizer.step(BOX, state, rng)
        u = twin.uniform(P, 4 * (D if optimizer.randoms == "coordinate" else 1))[0]
        filters.step(u, twin.normal(P, D)[0] if optimizer.position == "sampled" else None)
        np.testing.assert_allclose(state.x[0], filters.x, rtol=1e-9)
        np.testing.assert_allclose(state.velocity[0], filters.v, rtol=1e-7, atol=1e-12)
        found = np.moveaxis(state.covariance[0], (0, 1), (2, 3))
        np.testing.assert_allclose(found, filters.P, rtol=1e-7, atol=1e-14)
        np.testing.assert_allclose(state.leader[0], filters.leader, rtol=1e-9)


# Fruit flies


@pytest.mark.parametrize("outside", ["wall", "swarm"])
@pytest.mark.parametrize("place", ["point", "plane"])
def test_foa(place, outside):
    """[pan2012] steps 1 to 6."""
    optimizer = FruitFly(population=P, radius=0.3, start=place, outside=outside)
    rng, twin = Streams(7, [0]), Streams(7, [0])
    first = start()
    state = optimizer.init(BOX, first, rng)
    if place == "plane":
        u = twin.uniform(1, 2 * D)[0, 0]
        X, Y = 0.3 * (2 * u[:D] - 1), 0.3 * (2 * u[D:] - 1)
    else:
        angle = 2 * math.pi * twin.uniform(1, D)[0, 0]
        X, Y = np.cos(angle) / np.abs(first[0, 0]), np.sin(angle) / np.abs(first[0, 0])
    smell = BOX.at(into_the_box([1 / math.hypot(X[j], Y[j]) for j in range(D)]))
    stayed = moved = 0
    for _ in range(5):
        state = optimizer.step(BOX, state, rng)
        u = 2 * twin.uniform(P, 2 * D)[0] - 1
        flies, candidates = [], []
        for i in range(P):
            x, y, S = np.empty(D), np.empty(D), np.empty(D)
            for j in range(D):
                x[j], y[j] = X[j] + 0.3 * u[i, j], Y[j] + 0.3 * u[i, D + j]
                S[j] = 1 / math.hypot(x[j], y[j])
                if outside == "swarm" and not BOX.lower[j] <= S[j] <= BOX.upper[j]:
                    x[j], y[j], stayed = X[j], Y[j], stayed + 1
                    S[j] = 1 / math.hypot(x[j], y[j])
            flies.append((x, y))
            candidates.append(into_the_box(S))
        found = costs(candidates)
        if found.min() < smell:
            (X, Y), smell, moved = flies[int(np.argmin(found))], found.min(), moved + 1
        np.testing.assert_allclose(state.x[0], candidates, rtol=1e-12)
        np.testing.assert_allclose(state.axis[0, 0], np.concatenate([X, Y]), rtol=1e-12)
        assert state.smell[0] == pytest.approx(smell, rel=1e-12)
    assert moved
    assert stayed or outside == "wall"


def exponent(sigma, smell, rounding):
    decades = math.log10(sigma / smell)
    if decades < 0:
        return 0
    return {
        "floor": math.floor(decades),
        "round": round(decades),
        "ceil": math.ceil(decades),
        "1+floor": 1 + math.floor(decades),
        "fixed": 0,
    }[rounding]


@pytest.mark.parametrize("rounding", ["floor", "round", "ceil", "1+floor", "fixed"])
def test_ifoa_and_its_fixed_radius(rounding):
    """[ifoa2021] steps 2' and 3', the radius Delta alpha^p in the units and groups of the unknowns."""

    class Grouped(Bowl):
        units = property(lambda self: np.array([2.0, 2.0, 0.5]))
        groups = property(lambda self: np.array([0, 1, 1]))

    problem = Grouped()
    settings = {"population": P, "radius": 1.5, "shrink": 0.5, "threshold": 60.0, "radius_scale": (1.0, 3.0)}
    optimizer = (
        FullFruitFly(**settings) if rounding == "fixed" else ImprovedFruitFly(rounding=rounding, **settings)
    )
    rng, twin = Streams(7, [0]), Streams(7, [0])
    state = optimizer.init(problem, start(), rng)
    axis, smell, seen = state.x[0, 0], BOX.at(state.x[0, 0]), set()
    for _ in range(25):
        state = optimizer.step(problem, state, rng)
        u = 2 * twin.uniform(P, D)[0] - 1
        p = exponent(60.0, smell, rounding)
        seen.add(p)
        delta = [1.5 / 2.0, 3 * 1.5 / 2.0, 3 * 1.5 / 0.5]
        flies = np.array(
            [into_the_box([axis[j] + delta[j] * 0.5**p * u[i, j] for j in range(D)]) for i in range(P)]
        )
        if costs(flies).min() < smell:
            axis, smell = flies[int(np.argmin(costs(flies)))], costs(flies).min()
        np.testing.assert_allclose(state.x[0], flies, rtol=1e-12)
        np.testing.assert_allclose(state.axis[0, 0], axis, rtol=1e-12)
        assert (state.status == Status.RUNNING).all()
    assert len(seen) > 1 or rounding == "fixed"


def test_the_threshold_of_ifoa_is_the_median_of_the_start():
    optimizer = ImprovedFruitFly(population=P)
    state = optimizer.init(BOX, start(), Streams(7, [0]))
    assert state.threshold[0] == pytest.approx(np.median(costs(state.x[0])))
    radius = optimizer.reach(BOX)[0, 0]
    np.testing.assert_allclose(radius, 0.4 * 0.5 * (BOX.upper[0] - BOX.lower[0]))


# Newton


class Quartic(Bowl):
    """sum c_j (x_j - o_j)^4 / 12 + (x_1 - o_1)(x_2 - o_2) / 10, whose derivatives are written down."""

    def cost(self, x):
        y = x - self.o
        return (self.c * y**4).sum(axis=-1) / 12 + 0.1 * y[..., 0] * y[..., 1] + 5 * y[..., 1] ** 2

    def gradient_hessian(self, x):
        y = x - self.o
        g = self.c * y**3 / 3
        g = g + 0.1 * np.stack([y[..., 1], y[..., 0], 0 * y[..., 0]], axis=-1)
        g[..., 1] += 10 * y[..., 1]
        H = (self.c * y**2)[..., None] * np.eye(3)
        H[..., 0, 1] = H[..., 1, 0] = 0.1
        H[..., 1, 1] += 10
        return g, H


def test_newton():
    """[skog2006]: theta - H^-1 grad L, at the wall of the box where it would leave it."""
    problem, optimizer = Quartic(), Newton(population=P)
    x = start()
    state = optimizer.init(problem, x, Streams(7, [0]))
    new = []
    for i in range(P):
        y = x[0, i] - problem.o
        g = [y[0] ** 3 / 3 + 0.1 * y[1], y[1] ** 3 + 0.1 * y[0] + 10 * y[1], 0.5 * y[2] ** 3 / 3]
        a, b, d, e = y[0] ** 2, 0.1, 3 * y[1] ** 2 + 10, 0.5 * y[2] ** 2
        determinant = a * d - b * b
        step = [(d * g[0] - b * g[1]) / determinant, (a * g[1] - b * g[0]) / determinant, g[2] / e]
        new.append(into_the_box(x[0, i] - step))
    after = optimizer.step(problem, state, Streams(7, [0]))
    np.testing.assert_allclose(after.x[0], new, rtol=1e-9)
    np.testing.assert_allclose(after.fx[0], problem.cost(np.array(new)[None])[0], rtol=1e-9)
    assert after.status.tolist() == [Status.RUNNING]
    assert (after.x != np.clip(x, problem.lower, problem.upper)).any()


def test_newton_converges_fails_and_keeps_a_point_whose_hessian_is_singular():
    problem, optimizer = Quartic(), Newton(population=1, step_tolerance=1e-6)
    flat = np.array([[[problem.o[0] + 1.0, problem.o[1], problem.o[2]]]])  # the third curvature is 0
    state = optimizer.init(problem, flat, Streams(7, [0]))
    after = optimizer.step(problem, state, Streams(7, [0]))
    assert after.status.tolist() == [Status.FAILED]
    np.testing.assert_array_equal(after.x, flat)

    bowl = Bowl()
    state = optimizer.init(bowl, start(1), Streams(7, [0]))
    for expected in (Status.RUNNING, Status.CONVERGED):
        for _ in range(1 if expected == Status.RUNNING else 3):
            state = optimizer.step(bowl, state, Streams(7, [0]))
        assert state.status.tolist() == [expected]


def test_newton_has_converged_when_every_coordinate_of_the_step_is_small():
    """Small is a part of the widest side of the box, here 10."""
    problem, x = Bowl(), start(1)
    state = Newton(population=1).init(problem, x, Streams(7, [0]))
    step = np.abs(Newton(population=1).step(problem, state, Streams(7, [0])).x - x)[0, 0]
    assert step.max() > 1.5 * step.min()
    for part, expected in ((1.01, Status.CONVERGED), (0.99, Status.RUNNING)):
        optimizer = Newton(population=1, step_tolerance=part * step.max() / 10.0)
        assert optimizer.step(problem, state, Streams(7, [0])).status.tolist() == [expected]


@pytest.mark.parametrize(
    ("settings", "message"), [({"fading": 9.0}, "fading"), ({"bests": "filtered"}, "needs kalman_dim: 4")]
)
def test_akpso_refuses_what_it_cannot_do(settings, message):
    with pytest.raises(ConfigError, match=message):
        AdaptiveKalmanSwarm(**settings)
