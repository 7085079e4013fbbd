"""A result as plain text, for reading."""

from __future__ import annotations

from dataclasses import dataclass

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.exporters.base import Exporter, rows
from accelcal_cli.schema import setting


@dataclass(frozen=True)
class Text(Exporter):
    """Plain text: K_a and D_a in output units."""

    suffix = ".txt"

    digits: int = setting(9, "significant digits of every number", low=1, high=17)

    def content(self, result: Calibration) -> bytes:
        """Return the origin and the numbers, a matrix row per line."""
        numbers = ["K_a", *map(self._line, rows(result.K_a)), "D_a", self._line(result.D_a)]
        lines = [*self.header(result), *numbers]
        return ("\n".join(lines) + "\n").encode()

    def _line(self, values: list[float]) -> str:
        return "  ".join(f"{value:.{self.digits}g}" for value in values)
