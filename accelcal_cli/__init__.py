"""accelcal: calibrate three-axis accelerometers without a turntable.

The public library, loaded when first used so that `accelcal --help` need not wait for numpy:

    from accelcal_cli import Settings as Settings
    from accelcal_cli import calibrate as calibrate
    from accelcal_cli import read_readings as read_readings
    result = calibrate(read_readings("data.csv"), Settings(g=9.81))
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from accelcal_cli.calibration.calibrate import calibrate as calibrate
    from accelcal_cli.calibration.result import Calibration as Calibration
    from accelcal_cli.calibration.settings import Settings as Settings
    from accelcal_cli.calibration.settings import load_settings as load_settings
    from accelcal_cli.errors import AccelcalError as AccelcalError
    from accelcal_cli.io.readings import Readings as Readings
    from accelcal_cli.io.readings import read_readings as read_readings
    from accelcal_cli.optimization.minimize import minimize as minimize
    from accelcal_cli.optimization.optimizer import OPTIMIZERS as OPTIMIZERS
    from accelcal_cli.optimization.problem import Problem as Problem
    from accelcal_cli.sensor.model import ErrorModel as ErrorModel
    from accelcal_cli.sensor.simulation import load_sensor as load_sensor

__version__ = "0.1.0"

_HOMES = {
    "AccelcalError": "errors",
    "Calibration": "calibration.result",
    "ErrorModel": "sensor.model",
    "OPTIMIZERS": "optimization.optimizer",
    "Problem": "optimization.problem",
    "Readings": "io.readings",
    "Settings": "calibration.settings",
    "calibrate": "calibration.calibrate",
    "load_sensor": "sensor.simulation",
    "load_settings": "calibration.settings",
    "minimize": "optimization.minimize",
    "read_readings": "io.readings",
}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    """Import a public name from where it lives, at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
