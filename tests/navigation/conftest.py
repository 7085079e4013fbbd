"""One small scenario for all navigation tests: the planned voyage on a coarse clock."""

from __future__ import annotations

import pytest

from accelcal_cli.navigation.gravity_map import PRESETS, generate
from accelcal_cli.navigation.ins import InsGrade
from accelcal_cli.navigation.scenario import simulate
from accelcal_cli.navigation.voyage import PlannedVoyage


@pytest.fixture(scope="session")
def rough():
    return generate(PRESETS["rough"], 1, "rough")


@pytest.fixture(scope="session")
def voyage(rough):
    """Six runs of the whole voyage, a measurement every 30 s."""
    return simulate(rough, PlannedVoyage(), InsGrade(), runs=range(6), seed=1, period=30.0)
