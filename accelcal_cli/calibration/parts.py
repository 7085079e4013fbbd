"""The parts of a calibration's record: sigma, dilution of precision, poses."""

from __future__ import annotations

from dataclasses import dataclass

from accelcal_cli.calibration.quality import BIAS, MISALIGNMENT, PARAMETERS, SCALE
from accelcal_cli.streams import Float


@dataclass(frozen=True, eq=False)
class Sigma:
    """One-sigma of the parameters; NaN where the poses do not determine them.

    Attributes:
        K_a: shape (3, 3), output units per m/s^2.
        D_a: shape (3,), output units.
    """

    K_a: Float
    D_a: Float


@dataclass(frozen=True)
class Dop:
    """Dilution of precision: the error of a parameter, as m/s^2 at 1 g, over the noise of one pose in m/s^2.

    Attributes:
        misalignment, scale, bias: the largest of each kind.
        worst: the largest of all.
        parameters: each of the nine by its name.
    """

    misalignment: float
    scale: float
    bias: float
    worst: float
    parameters: dict[str, float]

    @classmethod
    def of(cls, dop: Float) -> Dop:
        """Return the record of the dilution of precision of the nine parameters, shape (9,)."""
        misalignment, scale, bias = (float(dop[kind].max()) for kind in (MISALIGNMENT, SCALE, BIAS))
        return cls(
            misalignment, scale, bias, float(dop.max()), dict(zip(PARAMETERS, dop.tolist(), strict=True))
        )


@dataclass(frozen=True)
class PoseFit:
    """One pose. Units: m/s^2 (units of g when g = 1).

    Attributes:
        pose: its number, from 0; where: its line or label in the input.
        residual: |f| - g; with known attitudes |f| - |reference|.
        studentised: residual over its standard deviation, by the s of the other poses; with known attitudes by the s
            of all poses.
        leverage: part of its own residual that the fit absorbs.
        left_out: the residual that a fit without the pose would leave.
        residual_before: |f| - g before calibration.
        direction: unit vector of the specific force, gauge `lower`.
    """

    pose: int
    where: str
    residual: float
    studentised: float
    leverage: float
    left_out: float
    residual_before: float
    direction: tuple[float, float, float]
