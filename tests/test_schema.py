"""Mappings to frozen dataclasses and back, strictly."""

from __future__ import annotations

import dataclasses
import math
import pickle
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.schema import Limits, array, check, from_mapping, frozen, setting, to_mapping


@dataclass(frozen=True)
class Inner:
    width: float = setting(0.1, "a width", above=0, high=0.9)

    def __post_init__(self):
        check(self)


@dataclass(frozen=True)
class Outer:
    count: int = setting(3, "how many", low=1, high=10)
    rate: float = setting(0.5, "a rate", low=0.0, high=1.0)
    on: bool = setting(True, "whether")
    word: str = setting("a", "a word")
    kind: Literal["rand/1", "best/1"] = setting("rand/1", "a kind")
    triple: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "three numbers")
    many: tuple[int, ...] = setting((), "any number of whole numbers")
    inner: Inner = field(default_factory=Inner)
    maybe: Inner | None = setting(None, "one or none")
    free: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        check(self)


def test_defaults_fill_what_is_not_stated():
    assert from_mapping(Outer, {}, "f.yaml") == Outer()
    assert from_mapping(Outer, {"count": 7}, "f.yaml") == Outer(count=7)


def test_every_kind_of_value_is_built():
    stated = {
        "count": 4,
        "rate": 1,
        "on": False,
        "word": "b",
        "kind": "best/1",
        "triple": [1, 2.5, 3],
        "many": [1, 2],
        "inner": {"width": 0.2},
        "maybe": {"width": 0.3},
        "free": {"anything": [1, "x"]},
    }
    built = from_mapping(Outer, stated, "f.yaml")
    assert built == Outer(
        4,
        1.0,
        False,
        "b",
        "best/1",
        (1.0, 2.5, 3.0),
        (1, 2),
        Inner(0.2),
        Inner(0.3),
        {"anything": [1, "x"]},
    )
    assert [type(v) for v in (built.rate, *built.triple)] == [float] * 4


@pytest.mark.parametrize(
    ("stated", "value"),
    [
        ({"count": 1e1}, 10),
        ({"count": 3.0}, 3),
        ({"rate": "1e-6"}, 1e-6),  # YAML 1.1 reads it as text
        ({"rate": 1}, 1.0),
        ({"maybe": None}, None),
    ],
)
def test_what_is_meant_passes(stated, value):
    (key,) = stated
    built = getattr(from_mapping(Outer, stated, "f.yaml"), key)
    assert built == value
    assert type(built) is type(value)


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"cuont": 3}, ["f.yaml", "cuont", 'did you mean "count"?', "known:"]),
        ({"Rate": 0.5}, ["Rate", 'did you mean "rate"?']),
        ({"xyzzy": 1}, ["xyzzy", "known: count, rate"]),
        ({1: 1}, ["unknown key"]),
        ({"count": 2.5}, ["f.yaml: count", "whole number", "2.5"]),
        ({"count": "3"}, ["count", "whole number", "'3'"]),
        ({"count": True}, ["count", "whole number", "True"]),
        ({"count": None}, ["count", "whole number", "None"]),
        ({"count": [3]}, ["count", "whole number"]),
        ({"count": 0}, ["f.yaml", "count", "0 is too small", "at least 1"]),
        ({"count": 11}, ["count", "11 is too large", "at most 10"]),
        ({"count": float("inf")}, ["count", "whole number"]),
        ({"rate": True}, ["rate", "a number", "True"]),
        ({"rate": "fast"}, ["rate", "a number", "'fast'"]),
        ({"rate": float("nan")}, ["rate", "nan", "finite"]),
        ({"rate": ".inf"}, ["rate", "number"]),
        ({"rate": "inf"}, ["rate", "number", "'inf'"]),
        ({"rate": 1.0001}, ["rate", "too large", "at most 1"]),
        ({"on": 1}, ["on", "true or false", "1"]),
        ({"on": "yes"}, ["on", "true or false"]),
        ({"word": 5}, ["word", "text", "5"]),
        ({"kind": "rand/2"}, ["kind", "rand/2", "rand/1, best/1", "did you mean"]),
        ({"kind": 1}, ["kind", "rand/1, best/1"]),
        ({"kind": ["rand/1"]}, ["kind", "rand/1, best/1"]),
        ({"triple": [1, 2]}, ["triple", "3 values", "2"]),
        ({"triple": 1}, ["triple", "a list", "1"]),
        ({"triple": "123"}, ["triple", "a list"]),
        ({"triple": [1, "x", 3]}, ["triple[1]", "a number"]),
        ({"many": [1, 2.5]}, ["many[1]", "whole number"]),
        ({"inner": 3}, ["inner", "mapping", "3"]),
        ({"inner": None}, ["inner", "mapping"]),
        ({"inner": {"widht": 0.2}}, ["f.yaml: inner", "widht", 'did you mean "width"?']),
        ({"inner": {"width": 0}}, ["f.yaml: inner", "width", "more than 0"]),
        ({"maybe": {"width": 2}}, ["f.yaml: maybe", "width", "at most 0.9"]),
        ({"maybe": 1}, ["maybe", "mapping"]),
        ({"free": 1}, ["free", "1"]),
    ],
)
def test_what_is_not_meant_is_refused_with_the_place_and_the_expectation(stated, words):
    with pytest.raises(ConfigError) as error:
        from_mapping(Outer, stated, "f.yaml")
    for word in words:
        assert word in str(error.value)


@given(st.integers(-100, 100))
def test_a_range_is_kept_to_the_last_number(count):
    if 1 <= count <= 10:
        assert from_mapping(Outer, {"count": count}, "x").count == count
    else:
        with pytest.raises(ConfigError):
            from_mapping(Outer, {"count": count}, "x")


@given(
    st.dictionaries(
        st.sampled_from(["count", "rate", "on", "kind", "triple", "inner", "maybe", "other"]),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
            lambda inner: (
                st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2)
            ),
            max_leaves=4,
        ),
    )
)
def test_any_mapping_is_built_or_refused_with_a_message(stated):
    message = "f.yaml: built"
    try:
        assert 1 <= from_mapping(Outer, stated, "f.yaml").count <= 10
    except ConfigError as error:
        message = str(error)
    assert message.startswith("f.yaml")


def test_the_constructor_keeps_the_ranges_too():
    with pytest.raises(ConfigError, match="count"):
        Outer(count=0)
    with pytest.raises(ConfigError, match="population"):
        OPTIMIZERS.get("de-pso")(population=3)


@dataclass(frozen=True)
class Part:
    size: Annotated[float, Limits(none=math.inf)]


@dataclass(frozen=True, eq=False)
class Record:
    matrix: Annotated[Float, array(2, 3, largest=10.0)]
    gaps: Annotated[Float, array(2, none=math.nan)]
    part: Part
    many: tuple[Part, ...]
    named: Annotated[dict[str, float], Limits(none=math.nan)]
    words: Annotated[tuple[str, ...], Limits(older=("old",))]
    free: dict[str, Any]
    maybe: float | None = None


PLAIN = {
    "matrix": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
    "gaps": [1.5, None],
    "part": {"size": None},
    "many": [{"size": 1.0}, {"size": None}],
    "named": {"a": 1.0, "b": None},
    "words": ["new"],
    "free": {"x": [1, {"y": None}]},
    "maybe": None,
}


def test_a_record_comes_back_from_its_mapping():
    record = from_mapping(Record, PLAIN, "r")
    assert record.matrix.shape == (2, 3)
    assert np.isnan(record.gaps[1])
    assert (record.part, record.many) == (Part(math.inf), (Part(1.0), Part(math.inf)))
    assert math.isnan(record.named["b"])
    assert to_mapping(record) == PLAIN
    assert list(to_mapping(record)) == list(PLAIN)


def test_an_older_or_a_newer_record_is_read():
    older = {key: value for key, value in PLAIN.items() if key not in ("words", "maybe")}
    assert from_mapping(Record, older, "r").words == ("old",)
    newer = {**PLAIN, "later": 1, "part": {"size": 2.0, "later": 1}}
    assert from_mapping(Record, newer, "r", extra=True).part == Part(2.0)
    with pytest.raises(ConfigError, match='r: part: unknown key "later"; known: size'):
        from_mapping(Record, newer, "r")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"matrix": [[1, 2, 3]]}, "r: matrix: expected 2 x 3 numbers; matrix: expected 2 values, not 1"),
        ({"matrix": [[1, 2, 3], [4, None, 6]]}, "matrix[1][1]: expected a number, not None"),
        ({"matrix": [[1, 2, 3], [4, 11, 6]]}, "matrix[1][1]: 11.0 is too large; expected at most 10"),
        ({"matrix": 3}, "r: matrix: expected 2 x 3 numbers; matrix: expected a list, not 3"),
        ({"gaps": [1, math.inf]}, "gaps[1]: inf is not a finite number"),
        ({"part": {}}, "r: part: missing: size"),
        ({"part": 1}, "r: part: expected a mapping of keys, not 1"),
        ({"many": [{"size": 1}, {"size": "a"}]}, "r: many[1]: size: expected a number, not 'a'"),
        ({"named": {"a": []}}, "r: named: a: expected a number, not []"),
        ({"words": ["a", 1]}, "r: words[1]: expected text, not 1"),
        ({"free": {"x": {"y": 10**400}}}, "r: free: x: y: 1000000"),
        ({"maybe": 10**400}, "is too large for a floating-point number"),
    ],
)
def test_a_fault_of_a_record_is_named_with_its_place(changed, words):
    with pytest.raises(ConfigError) as error:
        from_mapping(Record, {**PLAIN, **changed}, "r")
    assert words in str(error.value)
    assert len(str(error.value)) < 200


def test_what_is_missing_is_named():
    with pytest.raises(ConfigError, match="r: missing: matrix, free"):
        from_mapping(Record, {k: v for k, v in PLAIN.items() if k not in ("matrix", "free")}, "r")


@frozen()
class Point:
    """A record with a hidden and an uncompared field."""

    x: float
    note: str = field(default="", compare=False)
    cache: list[int] = field(default_factory=list, compare=False, repr=False)


@frozen(eq=False)
class Cloud:
    """A record of an array, which has no truth value to compare."""

    x: np.ndarray


def test_a_frozen_record_is_a_frozen_dataclass():
    point = Point(1.0, "here")
    assert (point, hash(point)) == (Point(1.0), hash(Point(1.0)))
    assert point != Point(2.0)
    assert point != 1.0
    assert repr(point) == "Point(x=1.0, note='here')"
    assert dataclasses.replace(point, x=2.0) == Point(2.0)
    assert pickle.loads(pickle.dumps(point)) == point
    for change in (lambda: setattr(point, "x", 3.0), lambda: delattr(point, "x")):
        with pytest.raises(dataclasses.FrozenInstanceError, match="x"):
            change()
    assert point.x == 1.0


def test_a_record_without_equality_is_itself_alone():
    cloud = Cloud(np.zeros(2))
    assert cloud == cloud
    assert cloud != Cloud(cloud.x)
    assert len({cloud, Cloud(cloud.x)}) == 2
