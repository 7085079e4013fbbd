"""What each column of a table is, by its name: reading, gyroscope, reference, scatter, count, label, time, temperature.

`recognise` gives every column its role. The names that are known as they are come first, then what `vocabulary.py`
makes of the others behind any prefix.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

from accelcal_cli.io.vocabulary import AXES, Quantity, describe, is_temperature, is_time, tokens_of

Triple = tuple[int, int, int]
Group = dict[str, tuple[list[int], list[int], list[int]]]
"""Columns of each axis, by family of names; a second column of one name opens a second triple."""

SHOWN = 20
"""Column names that a message lists at most."""

_SPREAD = frozenset({"std", "sd", "sigma", "stdev", "stddev"})
_SPREAD_GLUED = re.compile(r"(?:std|sd|sigma|s)([xyz])")

_ACCELERATION = ("acc", "accel", "acceleration", "accelerometer", "linearacceleration")
_OUTPUT = ("a", "ac", "gf", *_ACCELERATION, "fieldlinearacceleration", "accsmooth", "n", "out", "output", "")
_REFERENCE = ("f", "ref", "reference", "fref", "reff", "specificforce")
_TRUE = frozenset({"true", "truth", "known", "nominal", "reference"})
_GYRO = (
    *("w", "g", "gy", "gyr", "gyro", "gyroscope", "gyrorad"),
    *("omega", "angvel", "angularvelocity", "rotationrate"),
)
_CAPITAL_T = re.compile(r"T(?:_?(?:deg)?[cCkK]|\s*[\[(]\s*(?!m?s\b).*)?")  # t would be time
_ALONE = {
    "temperature": re.compile(r"temperature|temp"),
    "label": re.compile(
        r"pose|poses|poseid|poselabel|posename|position|positionid|pos|label|orientation|face"
    ),
    "count": re.compile(r"n|count|counts|samples|nsamples|numsamples|npoints"),
    "sensor": re.compile(
        r"(?:sensor|device|serial|imu|accelerometer|dut|node|board|chip|module|unit|part)"
        r"(?:id|no|nr|num|number|name|label|serial|serialno|serialnr|serialnumber|sn)|sensors?|device|serial|sn|imu|dut"
    ),
    "instance": re.compile(r"(?:imu|sensor|acc|accel)?instance(?:id|no|nr|num|number)?"),
    "kind": re.compile(r"(?:sensor|data|msg|message)?(?:type|kind)|topic|channel|measurement"),
    "other": re.compile(
        r"|t|time|timestamp|stamp|start|end|stop|tstart|tend|starttime|endtime|index|row|sec|seconds|id"
    ),
}
"""Roles of single columns, by their names without separators; those of `other` are not readings."""

_TIME = re.compile(r"(?:t|time|timestamp|stamp|sec|seconds)(?:ns|us|usec|ms|msec)?")
_SENSOR_PERHAPS = re.compile(r"id|uid|uuid|name|unit|part|chip|module|node|board|accelerometer")


@dataclass
class Roles:
    """Columns by role, counted from 0; a triple is (x, y, z)."""

    alone: defaultdict[str, list[int]] = field(
        default_factory=lambda: defaultdict(list)
    )  # by name of the role
    families: dict[str, Triple] = field(default_factory=dict)  # candidates for the output, by their names
    described: dict[str, Triple] = field(default_factory=dict)  # acceleration behind any prefix
    unknown: dict[str, Triple] = field(default_factory=dict)  # three axes of something
    scatter: dict[str, Triple] = field(default_factory=dict)  # by family, "" for any
    reference: Triple | None = None
    gyro: Triple | None = None
    doubtful: list[str] = field(default_factory=list)  # names that occur twice where one is needed
    partial: list[str] = field(default_factory=list)  # triples that lack an axis, in words

    def single(self) -> set[int]:
        """Return the columns that have a role by themselves."""
        return {k for role, columns in self.alone.items() if role != "perhaps sensor" for k in columns}

    def first(self, role: str) -> int | None:
        """Return the first single column of a role."""
        return next(iter(self.alone[role]), None)


def recognise(names: Sequence[str]) -> Roles:
    """Give every column its role by its name."""
    roles = Roles()
    groups: tuple[Group, Group, Group, Group] = ({}, {}, {}, {})
    output, spread, reference, gyro = groups
    for column, name in enumerate(names):
        words = tokens_of(name)
        key = "".join(words)
        if _TIME.fullmatch(key) or is_time(name):
            roles.alone["time"].append(column)
        if _SENSOR_PERHAPS.fullmatch(key):
            roles.alone["perhaps sensor"].append(column)
        if role := _role(name, key):
            roles.alone[role].append(column)
            continue
        if axis := _spread(words, key):
            _put(spread, axis, column)
        if (
            not axis
            and (truth := _TRUE & set(words))
            and (axis := _axis("".join(w for w in words if w not in truth), _OUTPUT))
        ):
            _put(reference, axis, column)
        for group, prefixes in ((reference, _REFERENCE), (output, _OUTPUT), (gyro, _GYRO)):
            if not axis and (axis := _axis(key, prefixes)):
                _put(group, axis, column)
    roles.families = {listed(names, triple): triple for _, triple in _triples(output)}
    roles.doubtful = [names[column] for column in _left_over(output, 1)]
    roles.scatter = dict(reversed(_triples(spread)))  # of two triples of one family the first stays
    roles.reference = next((triple for _, triple in _triples(reference)), None)
    roles.gyro = next((triple for _, triple in _triples(gyro)), None)
    roles.partial = [
        f'column "{names[k]}" not used: no {what} for all three axes'
        for group, what in ((spread, "standard deviation"), (reference, "reference"))
        for k in _left_over(group)
    ]
    assigned = {k for group in groups for axes in group.values() for axis in axes for k in axis}
    _describe_rest(names, [k for k in range(len(names)) if k not in assigned | roles.single()], roles)
    return roles


def _describe_rest(names: Sequence[str], columns: Sequence[int], roles: Roles) -> None:
    """Find triples among the columns whose names are not known as they are."""
    groups: dict[tuple[Quantity | None, str], dict[int, int]] = {}
    for column in columns:
        meaning = describe(names[column])
        place = meaning.axis if meaning.axis is not None else meaning.number
        told = place is not None or len(bare_name(names[column])) > 3
        if told and meaning.quantity not in (None, "acceleration"):
            roles.alone["other"].append(column)
        if place is not None:
            group = groups.setdefault((meaning.quantity, meaning.family + "#" * (meaning.axis is None)), {})
            group.setdefault(place, column)
    for (quantity, _), places in groups.items():
        order = sorted(places)
        if len(order) != 3 or order[2] - order[0] != 2:
            continue
        triple = (places[order[0]], places[order[1]], places[order[2]])
        if quantity == "turning":
            roles.gyro = roles.gyro or triple
        elif quantity in (None, "acceleration"):
            (roles.described if quantity else roles.unknown)[listed(names, triple)] = triple


def _role(name: str, key: str) -> str | None:
    """Return the role of a single column, None for an axis and for an unknown name."""
    if _CAPITAL_T.fullmatch(name.strip()):
        return "temperature"
    if name.strip() == "I":  # the instance, in the logs of ArduPilot
        return "instance"
    role = next((role for role, pattern in _ALONE.items() if pattern.fullmatch(key)), None)
    if role is None and is_temperature(name):
        return "temperature"
    return "other" if role is None and is_time(name) else role


def _axis(key: str, prefixes: Sequence[str]) -> tuple[str, str] | None:
    """Return family and axis of a key such as accx, xacc or xaxis."""
    if key[-1] in AXES and key[:-1] in prefixes:
        return key[:-1], key[-1]
    leading = key[0] in AXES and key[1:] in (*_ACCELERATION, "axis") and "a" in prefixes
    return (key[1:], key[0]) if leading else None


def _spread(words: Sequence[str], key: str) -> tuple[str, str] | None:
    """Return family and axis of a standard deviation; family "" where the name has none."""
    rest = "".join(word for word in words if word not in _SPREAD)
    if rest and len(rest) < len(key):
        return _axis(rest, _OUTPUT)
    glued = _SPREAD_GLUED.fullmatch(key)
    return ("", glued[1]) if glued else None


def _put(group: Group, place: tuple[str, str], column: int) -> None:
    family, axis = place
    group.setdefault(family, ([], [], []))[AXES.index(axis)].append(column)


def _triples(group: Group) -> list[tuple[str, Triple]]:
    """Return family and columns of every triple that has all axes."""
    return [(family, triple) for family, axes in group.items() for triple in zip(*axes, strict=False)]


def _left_over(group: Group, least: int = 0) -> list[int]:
    """Return the columns of incomplete triples; with `least` 1 those of a second triple and later ones alone."""
    ends = (axis[max(least, min(map(len, axes))) :] for axes in group.values() for axis in axes)
    return sorted(column for end in ends for column in end)


def listed(names: Sequence[str], columns: Sequence[int], between: str = ", ") -> str:
    """Return names of columns in quotes."""
    listed = between.join(f'"{names[k]}"' for k in columns[:SHOWN])
    return listed + (f" and {len(columns) - SHOWN} more" if len(columns) > SHOWN else "")


def bare_name(name: str) -> str:
    """Return a name without unit, in lower case."""
    return "".join(tokens_of(name))
