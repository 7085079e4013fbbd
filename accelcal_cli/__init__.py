"""accelcal: calibrate three-axis accelerometers without a turntable.

The public library. Each name is loaded when it is first used, so that `accelcal --help` need not wait for numpy:

    >>> import accelcal_cli as accelcal
    >>> readings = accelcal.simulate("mems", positions=24, seed=3).output  # or a file, a frame, an array
    >>> result = accelcal.calibrate(readings)
    >>> result.verdict
    'good'

What the commands do, the functions do: `calibrate`, `detect`, `verify`, `plan`, `apply`, `export`, `report`, `fleet`,
`simulate`. Readings come from files, from frames of polars, pandas or Arrow, or from arrays.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from accelcal_cli.calibration.apply import apply as apply
    from accelcal_cli.calibration.calibrate import calibrate as calibrate
    from accelcal_cli.calibration.calibrate import calibrate_many as calibrate_many
    from accelcal_cli.calibration.fleet import fleet as fleet
    from accelcal_cli.calibration.result import Calibration as Calibration
    from accelcal_cli.calibration.settings import Settings as Settings
    from accelcal_cli.calibration.settings import load_settings as load_settings
    from accelcal_cli.detection.detect import detect as detect
    from accelcal_cli.detection.rawlog import read_log as read_log
    from accelcal_cli.errors import AccelcalError as AccelcalError
    from accelcal_cli.exporters.base import EXPORTERS as EXPORTERS
    from accelcal_cli.exporters.base import export as export
    from accelcal_cli.io.readings import Readings as Readings
    from accelcal_cli.io.readings import read_readings as read_readings
    from accelcal_cli.optimization.minimize import minimize as minimize
    from accelcal_cli.optimization.optimizer import OPTIMIZERS as OPTIMIZERS
    from accelcal_cli.optimization.problem import Problem as Problem
    from accelcal_cli.output.report import report as report
    from accelcal_cli.planning import plan as plan
    from accelcal_cli.sensor.model import ErrorModel as ErrorModel
    from accelcal_cli.sensor.simulation import load_sensor as load_sensor
    from accelcal_cli.sensor.simulation import simulate as simulate
    from accelcal_cli.verification.verify import verify as verify

__version__ = "0.1.0"

_HOMES = {
    "AccelcalError": "errors",
    "Calibration": "calibration.result",
    "EXPORTERS": "exporters.base",
    "ErrorModel": "sensor.model",
    "OPTIMIZERS": "optimization.optimizer",
    "Problem": "optimization.problem",
    "Readings": "io.readings",
    "Settings": "calibration.settings",
    "apply": "calibration.apply",
    "calibrate": "calibration.calibrate",
    "calibrate_many": "calibration.calibrate",
    "detect": "detection.detect",
    "export": "exporters.base",
    "fleet": "calibration.fleet",
    "load_sensor": "sensor.simulation",
    "load_settings": "calibration.settings",
    "minimize": "optimization.minimize",
    "plan": "planning",
    "read_log": "detection.rawlog",
    "read_readings": "io.readings",
    "report": "output.report",
    "simulate": "sensor.simulation",
    "verify": "verification.verify",
}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    """Import a public name from where it lives, at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, for completion."""
    return sorted(__all__)
