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
    """One pose: `where` in the input, |f| - g before leaving it out and after, leverage, studentised residual;
    |f| - g before calibration, and the unit direction of the specific force, gauge `lower`."""

    pose: int
    where: str
    residual: float
    studentised: float
    leverage: float
    left_out: float
    residual_before: float
    direction: tuple[float, float, float]
