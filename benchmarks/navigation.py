"""What docs/explanation/gravity-navigation.md says of the filters, measured: `python -m benchmarks.navigation PART`.

Parts: `bound` (RMSE over the bound, with both priors), `periods` (the default filter on four maps), `disturbed`
(measurements with what nobody tells the filters), `records` (warnings of recorded voyages), `baselines`. `--runs` and
`--period` make them shorter.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.filter import FILTERS
from accelcal_cli.navigation.gravity_map import PRESETS, generate
from accelcal_cli.navigation.noise import Disturbance
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.navigation.scores import Scores, bound, counted, judge, score
from accelcal_cli.navigation.study import NavigationSettings
from accelcal_cli.notices import are_serious
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.schema import from_mapping

BLOCK = 50
"""Runs at once."""

DISTURBED = {
    "undisturbed": Disturbance(),
    "bias 3 mGal": Disturbance(bias=3.0),
    "bias 10 mGal": Disturbance(bias=10.0),
    "60 mGal for 10 min": Disturbance(jump=60.0),
    "map error 4.6 mGal": Disturbance(map_error=4.6),
    "Eotvos": Disturbance(eotvos=True),
}


def run(settings: NavigationSettings, name: str, runs: int, **parameters: object) -> tuple[Scenario, Scores]:
    """Return a scenario of one run, and the scores of a filter on all, in blocks.

    Args:
        settings: of the scenario; name: of the filter; runs: how many; parameters: of the filter.
    """
    form = from_mapping(FILTERS.get(name), parameters, name)
    parts = []
    for first in range(0, runs, BLOCK):
        block = range(first, min(first + BLOCK, runs))
        scenario = settings.scenario(settings.ins, block)
        with np.errstate(all="ignore"):
            estimates = form.run(scenario, Streams(settings.seed, block, Purpose.FILTER))
            parts.append(score(scenario, estimates))
    fields = {key: np.concatenate([getattr(part, key) for part in parts]) for key in vars(parts[0])}
    return settings.scenario(settings.ins, range(1)), Scores(**fields)


def interval(squares: Float) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the root of a mean square over runs."""
    rng = np.random.default_rng(0)
    means = squares[rng.integers(0, len(squares), (2000, len(squares)))].mean(axis=1)
    low, high = np.sqrt(np.percentile(means, [2.5, 97.5]))
    return float(low), float(high)


def line(label: str, scenario: Scenario, scores: Scores) -> str:
    """Return what is measured, in one line."""
    least = float(np.sqrt(bound(scenario)[counted(scenario)].sum(axis=1).mean()))
    squares = scores.north + scores.east
    low, high = (value / least for value in interval(squares))
    better = np.mean(squares < scores.ins)
    return (
        f"{label:42s} rmse {np.sqrt(squares.mean()):8.1f} m  bound {least:6.1f} m  ratio "
        f"{np.sqrt(squares.mean()) / least:6.2f} [{low:.2f} {high:.2f}]  "
        f"median {np.sqrt(np.median(squares)) / least:5.2f}  "
        f"NEES {scores.nees.mean():6.2f}  NIS {scores.nis.mean():6.2f}  lost {int(scores.lost.sum()):3d} of "
        f"{len(squares)}  below the INS {100 * better:.0f} %"
    )


def bounds(runs: int, period: float) -> Iterator[str]:
    """RMSE over the bound with both priors, on three maps."""
    for name, seed in (("rough", 1), ("rough", 2), ("moderate", 1)):
        for prior in ("independent", "tied"):
            settings = NavigationSettings(map=name, map_seed=seed, seed=1, period=period, prior=prior)
            for form in ("point-mass", "de-pf", "reference"):
                yield line(f"{name} {seed}, {prior}, {form}", *run(settings, form, runs))


def periods(runs: int, _: float) -> Iterator[str]:
    """The default filter on four rough maps, with measurements every 10, 60 and 300 s."""
    for period in (300.0, 60.0, 10.0):
        for seed in (1, 2, 3, 4):
            settings = NavigationSettings(map_seed=seed, seed=1, period=period)
            yield line(f"rough {seed}, {period:g} s, de-pf", *run(settings, "de-pf", runs))


def disturbed(runs: int, period: float) -> Iterator[str]:
    """Records with what nobody tells the filters; and Eotvos when they are told."""
    for form in ("de-pf", "point-mass"):
        for label, disturbance in DISTURBED.items():
            settings = NavigationSettings(map_seed=1, seed=1, period=period, disturbance=disturbance)
            yield line(f"{label}, {form}", *run(settings, form, runs))
        told = NavigationSettings(map_seed=1, seed=1, period=period, eotvos="corrected")
        yield line(f"Eotvos, told, {form}", *run(told, form, runs))
        plain = NavigationSettings(map_seed=1, seed=1, period=period)
        yield line(f"undisturbed, not robust, {form}", *run(plain, form, runs, robust=False))


def records(runs: int, period: float) -> Iterator[str]:
    """How many recorded voyages give a warning: the right map, that of another seed, and a clock an hour off."""
    settings = NavigationSettings(map_seed=1, seed=1, period=period)
    for form in ("de-pf", "point-mass"):
        for label in ("right", "another map", "clock an hour off"):
            warned = 0
            for first in range(0, runs, BLOCK):
                block = range(first, min(first + BLOCK, runs))
                scenario = settings.scenario(settings.ins, block)
                if label == "another map":
                    scenario = replace(scenario, gravity_map=generate(PRESETS["rough"], 2, "rough"))
                elif label != "right":
                    shift = round(3600.0 / period)
                    scenario = replace(scenario, measured=np.roll(scenario.measured, shift, axis=1))
                with np.errstate(all="ignore"):
                    estimates = FILTERS.get(form)().run(scenario, Streams(1, block, Purpose.FILTER))
                    found = score(scenario, estimates)
                columns = (found.nis, found.rejected, found.disturbed, found.sigma)
                for values in zip(*columns, strict=True):
                    said = judge(*map(float, values), settings.initial, scenario.epochs)
                    warned += are_serious(said)
            yield f"{label}, {form}: {warned} of {runs} with a warning"


def baselines(runs: int, period: float) -> Iterator[str]:
    """All filters with about as many look-ups of the map, robust or not."""
    settings = NavigationSettings(map_seed=1, seed=1, period=period)
    for form, parameters in (
        ("sitan", {}),
        ("reference", {}),
        ("point-mass", {"nodes": 31}),
        ("de-pf", {}),
        ("mpf", {"particles": 2200}),
        ("pf", {"particles": 1100}),
    ):
        scenario, scores = run(settings, form, runs, robust=False, **parameters)
        yield line(f"{form} {parameters or ''}", scenario, scores)


PARTS = {
    "bound": bounds,
    "periods": periods,
    "disturbed": disturbed,
    "records": records,
    "baselines": baselines,
}


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.navigation", description=__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--period", type=float, default=60.0)
    arguments = parser.parse_args()
    for text in PARTS[arguments.part](arguments.runs, arguments.period):
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
