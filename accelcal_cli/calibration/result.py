"""The result of a calibration: one frozen record that carries its units, its uncertainty and its origin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.calibration import record as records
from accelcal_cli.calibration.parts import Dop, PoseFit, Sigma
from accelcal_cli.calibration.quality import ALIGNED, UNDETERMINED
from accelcal_cli.calibration.rebuild import checked
from accelcal_cli.calibration.temperature import Temperature
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.streams import Float

SCHEMA = "accelcal/calibration/1"
"""Name and version of the record; a reader refuses what it does not know."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated accelerometer. Units: f in m/s^2 (units of g when g = 1), N in output units.

    Attributes:
        K_a: pulse-equivalent matrix, shape (3, 3), output units per m/s^2, in `gauge`.
        D_a: bias, shape (3,), output units.
        K_A: inverse matrix, shape (3, 3); f_0 = K_A D_a, shape (3,), m/s^2.
        gauge: lower, upper, symmetric or full.
        sigma: one-sigma of K_a and D_a.
        dop: dilution of precision.
        verdict: good, weak or undetermined; `reasons` says why in sentences.
        suggestions: poses that would mend it.
        cautions: sentences about residuals and search that do not change the verdict, which is of the poses.
        cost_search: L after the search, cost: L after the polish (the same without one), (m/s^2)^4.
        rms, rms_before: of |f| - g after and before, m/s^2; `before` says what the readings were taken for.
        s: standard deviation of one pose's modulus, m/s^2, with known attitudes of one axis; NaN without freedom.
        freedom: J - 9 degrees of freedom, J - 15 with slopes with temperature, 3 J - 12 with known attitudes.
        noise_ratio, noise_chance: s over what the scatter within the poses predicts, and the chance of so large a
            ratio; None where nothing tells them.
        covariance: of the nine parameters in gauge `lower`, (m/s^2)^2, shape (9, 9); NaN where they have no sigma.
        information: J^T J of the nine parameters, shape (9, 9): what the poses say of them; never without a number.
        nominal_scale, nominal_bias: what the engineering view is relative to, output units per m/s^2 and output
            units, shape (3,): the stated nominal sensor, or round numbers and no bias.
        poses: J.
        evaluations: of the cost, search and polish together.
        runs, runs_agreeing: searches made, and how many ended in the best one's minimum.
        poses_fit: residuals pose by pose (all up to 1000 poses, the worst 20 of more).
        outliers: numbers of the poses that do not fit, from 0.
        convergence: best cost so far against evaluations, of the best run, thinned.
        optimizer: its name; settings: everything needed to repeat the run.
        g: local gravity, m/s^2, or 1.
        data: source, sha256, columns of the readings.
        notes: sentences about the data and the search that a user should know.
        version: of accelcal; schema: SCHEMA.
        temperature: slopes with temperature, when the readings determine them.
    """

    K_a: Float
    D_a: Float
    K_A: Float
    f_0: Float
    gauge: str
    sigma: Sigma
    dop: Dop
    verdict: str
    reasons: tuple[str, ...]
    suggestions: tuple[str, ...]
    cautions: tuple[str, ...]
    cost_search: float
    cost: float
    rms: float
    rms_before: float
    before: str
    s: float
    freedom: int
    noise_ratio: float | None
    noise_chance: float | None
    covariance: Float
    information: Float
    nominal_scale: Float
    nominal_bias: Float
    poses: int
    evaluations: int
    runs: int
    runs_agreeing: int
    poses_fit: tuple[PoseFit, ...]
    outliers: tuple[int, ...]
    convergence: tuple[tuple[int, float], ...]
    optimizer: str
    settings: dict[str, Any]
    g: float
    data: dict[str, Any]
    notes: tuple[str, ...]
    version: str
    schema: str = SCHEMA
    temperature: Temperature | None = None

    @property
    def model(self) -> ErrorModel:
        """The sensor in the result's gauge."""
        return ErrorModel(self.K_a, self.D_a)

    @property
    def unit(self) -> str:
        """Unit of the specific force: g when the readings were calibrated against g = 1."""
        return "g" if self.g == 1.0 else "m/s^2"

    @property
    def held(self) -> NDArray[np.bool_]:
        """Which of the nine parameters were not estimated but taken as zero, shape (9,)."""
        return np.zeros(9, dtype=bool) if self.settings.get("misalignment", True) else ALIGNED

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which of the nine parameters are not determined, shape (9,).

        Definition: in an undetermined result, dilution of precision above 25, or no sigma.
        """
        if self.verdict != "undetermined":
            return np.zeros(9, dtype=bool)
        poor: NDArray[np.bool_] = np.array(list(self.dop.parameters.values())) > UNDETERMINED
        return poor | np.isnan(np.diagonal(self.covariance))

    def check_determined(self, name: str, *, force: bool = False) -> None:
        """Refuse to be used where the poses left parameters undetermined, unless forced.

        Raises:
            UsageError: the verdict is undetermined; `name` is named in the message.
        """
        if self.verdict == "undetermined" and not force:
            why = f" ({self.reasons[0].rstrip('.')})" if self.reasons else ""
            raise UsageError(
                f"{name}: its verdict is undetermined{why}; calibrate anew, or use it with --force"
            )

    def record(self) -> dict[str, Any]:
        """Return the record as plain mappings, lists, numbers and text; NaN and inf become None."""
        plain: dict[str, Any] = records.plain(self)
        return plain

    @classmethod
    def from_record(cls, record: Mapping[str, Any], where: str) -> Calibration:
        """Return the calibration of a record.

        Raises:
            DataError: not a record of this schema, or a part missing.
        """
        if record.get("schema") != SCHEMA:
            raise DataError(f'{where}: schema is {record.get("schema")!r}; expected "{SCHEMA}"')
        record = {"temperature": None, "cautions": [], **record}
        missing = [f.name for f in fields(cls) if f.name not in record]
        if missing:
            raise DataError(f"{where}: not a whole calibration result; missing: {', '.join(missing)}")
        return cls(**{f.name: checked(f.name, record[f.name], where) for f in fields(cls)})
