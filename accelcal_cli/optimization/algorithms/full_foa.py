"""Full-parameter FOA: the fruit fly algorithm with S = X and a radius that never shrinks [ifoa2021].

The IFOA paper's intermediate step: negative parameters can be reached, but the fixed radius stops the progress
once the swarm is nearer to the minimum than a lucky fly can see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.algorithms.ifoa import FlyState, ImprovedFruitFly
from accelcal_cli.optimization.optimizer import OPTIMIZERS


@OPTIMIZERS.register("full-foa")
@dataclass(frozen=True)
class FullFruitFly(ImprovedFruitFly):
    """IFOA with a fixed radius: p = 0."""

    paper = "ifoa2021"
    converges = False

    def exponent(self, state: FlyState) -> Float:
        """Return p = 0 for every run, shape (R,)."""
        return np.zeros(len(state.smell))
