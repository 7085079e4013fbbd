"""From the plain values of a record back to the parts of a calibration, each checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from accelcal_cli.calibration import record as records
from accelcal_cli.calibration.parts import Dop, PoseFit, Sigma
from accelcal_cli.calibration.quality import Verdict
from accelcal_cli.calibration.settings import LARGEST
from accelcal_cli.calibration.temperature import Temperature
from accelcal_cli.errors import DataError
from accelcal_cli.sensor.model import GAUGES
from accelcal_cli.streams import Float

SHAPES = {
    "K_a": (3, 3),
    "D_a": (3,),
    "K_A": (3, 3),
    "f_0": (3,),
    "covariance": (9, 9),
    "information": (9, 9),
    "nominal_scale": (3,),
    "nominal_bias": (3,),
}
WHOLE = ("K_a", "D_a", "K_A", "f_0", "information")
"""Arrays in which a missing number is a fault of the file."""

SENTENCES = ("reasons", "suggestions", "cautions", "notes")

CHOICES = {"gauge": GAUGES, "verdict": get_args(Verdict)}
NUMBERS_OR_NAN = ("s", "rms", "rms_before", "cost", "cost_search")

KINDS: dict[str, tuple[tuple[type, ...], str]] = {
    **dict.fromkeys(("freedom", "poses", "evaluations", "runs", "runs_agreeing"), ((int,), "a whole number")),
    **dict.fromkeys(
        ("reasons", "suggestions", "cautions", "notes", "outliers", "poses_fit"), ((list,), "a list")
    ),
    **dict.fromkeys(("data", "settings"), ((dict,), "a mapping")),
    **dict.fromkeys(("before", "optimizer", "version"), ((str,), "text")),
    **dict.fromkeys(("noise_ratio", "noise_chance"), ((int, float, type(None)), "a number")),
}


def checked(name: str, value: Any, where: str) -> Any:
    """Return a part of the result from the plain value of its record.

    Args:
        name: of the field of `Calibration`; value: as JSON or YAML have it.
        where: the file, for the message.

    Raises:
        DataError: another kind or shape, or a part missing.
    """
    try:
        records.check_size(value)
        return _rebuild(name, value)
    except OverflowError:
        raise DataError(
            f"{where}: not a calibration result: {name}: holds a number that is too large"
        ) from None
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise DataError(f"{where}: not a calibration result: {name}: {reason}") from None


def _rebuild(name: str, value: Any) -> Any:
    if name in SHAPES:
        return _matrix(name, value)
    if name in KINDS:
        records.of_kind(value, *KINDS[name])
    if name in SENTENCES:
        for entry in value:
            records.of_kind(entry, (str,), "text")
    if name == "sigma":
        return Sigma(records.array(value["K_a"], (3, 3)), records.array(value["D_a"], (3,)))
    if name in CHOICES and value not in CHOICES[name]:
        raise ValueError(f"{value!r} is not one of {', '.join(CHOICES[name])}")
    if name == "g" and not 0 < records.of_kind(value, (int, float), "a positive number") < math.inf:
        raise ValueError(f"{value!r} where a positive number was expected")
    if name == "temperature" and value is not None:
        return Temperature.from_record(value)
    if name == "dop":
        parameters = {key: records.or_infinite(v) for key, v in value["parameters"].items()}
        kinds = {
            kind: records.or_infinite(value[kind]) for kind in ("misalignment", "scale", "bias", "worst")
        }
        return Dop(**kinds, parameters=parameters)
    if name == "poses_fit":
        return tuple(_pose_fit(row) for row in value)
    if name == "convergence":
        return tuple((int(n), float(cost)) for n, cost in value)
    if name in NUMBERS_OR_NAN:
        return records.or_nan(value)
    return tuple(value) if isinstance(value, list) else value


def _pose_fit(row: Mapping[str, Any]) -> PoseFit:
    """Return one pose; a key too many or too few is a TypeError."""
    direction = records.array(row["direction"], (3,), whole=True)
    known: dict[str, Any] = {k: math.nan if v is None else v for k, v in row.items()}
    return PoseFit(**{**known, "direction": tuple(direction.tolist())})


def _matrix(name: str, value: Any) -> Float:
    found = records.array(value, SHAPES[name], whole=name in WHOLE)
    if name == "K_a" and not (np.abs(found) <= LARGEST).all():
        raise ValueError(f"holds a number beyond {LARGEST:g}")
    if name == "K_a" and not (np.abs(found).max() >= 1 / LARGEST and np.linalg.matrix_rank(found) == 3):
        raise ValueError("is singular; expected an invertible matrix")
    return found
