"""Strict building of frozen dataclasses, and classes by name."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from accelcal_cli.errors import AccelcalError, ConfigError, did_you_mean
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.registry import Registry
from accelcal_cli.schema import build, check, setting


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
    assert build(Outer, {}, "f.yaml") == Outer()
    assert build(Outer, {"count": 7}, "f.yaml") == Outer(count=7)


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
    built = build(Outer, stated, "f.yaml")
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
    built = getattr(build(Outer, stated, "f.yaml"), key)
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
        ({"rate": "inf"}, ["rate", "finite"]),
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
        build(Outer, stated, "f.yaml")
    for word in words:
        assert word in str(error.value)


@given(st.integers(-100, 100))
def test_a_range_is_kept_to_the_last_number(count):
    if 1 <= count <= 10:
        assert build(Outer, {"count": count}, "x").count == count
    else:
        with pytest.raises(ConfigError):
            build(Outer, {"count": count}, "x")


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
        assert 1 <= build(Outer, stated, "f.yaml").count <= 10
    except ConfigError as error:
        message = str(error)
    assert message.startswith("f.yaml")


def test_the_constructor_keeps_the_ranges_too():
    with pytest.raises(ConfigError, match="count"):
        Outer(count=0)
    with pytest.raises(ConfigError, match="population"):
        OPTIMIZERS.get("de-pso")(population=3)


def test_an_unknown_name_is_answered_with_the_nearest_and_with_all():
    with pytest.raises(ConfigError) as error:
        OPTIMIZERS.get("de-ps0")
    assert 'unknown optimizer "de-ps0"' in str(error.value)
    assert 'did you mean "de-pso"?' in str(error.value)
    for name in OPTIMIZERS.names():
        assert name in str(error.value)


@pytest.mark.parametrize("name", ["", "base", "minimize", "../de", "de_pso", "DE", "os.path", "a b"])
def test_a_name_that_is_no_optimizer_is_refused(name):
    """Also the name of a module that holds none."""
    with pytest.raises(ConfigError, match="unknown optimizer"):
        OPTIMIZERS.get(name)


def test_a_registry_builds_by_name():
    built = OPTIMIZERS.build("de", {"weight": 0.7}, "my.yaml")
    assert (built.name, built.weight) == ("de", 0.7)
    with pytest.raises(ConfigError, match=r'my.yaml: unknown key "wieght" \(did you mean "weight"\?\)'):
        OPTIMIZERS.build("de", {"wieght": 0.7}, "my.yaml")


def test_one_name_loads_one_module(tmp_path, monkeypatch):
    """A module with a fault of its own says so, and is loaded only when it is asked for."""
    package = tmp_path / "things_of_a_test"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from accelcal_cli.registry import Registry\n"
        "THINGS = Registry(object, __name__, 'thing', 'accelcal.things')\n"
    )
    (package / "one_thing.py").write_text(
        "from things_of_a_test import THINGS\n@THINGS.register('one-thing')\nclass One:\n    pass\n"
    )
    (package / "broken.py").write_text("import a_package_that_does_not_exist\n")
    monkeypatch.syspath_prepend(tmp_path)
    import things_of_a_test

    things: Registry[Any] = things_of_a_test.THINGS
    assert things.get("one-thing").name == "one-thing"
    with pytest.raises(ModuleNotFoundError, match="a_package_that_does_not_exist"):
        things.get("broken")


GREY = "class Grey:\n    pass\n"
GOOD = "from accelcal_cli.errors import AccelcalError\nclass Good(AccelcalError):\n    pass\n"


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A function that installs a package of two modules, and returns a registry that has nothing of its own."""

    def install(module, base=object):
        folder = tmp_path / "site"
        info = folder / "a_things-1.2.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: a-things\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(
            "[accelcal.things]\ngrey-thing = a_things:Grey\ngood = good_things:Good\n"
        )
        (folder / "a_things.py").write_text(module)
        (folder / "good_things.py").write_text(GOOD)
        (folder / "no_things").mkdir()
        (folder / "no_things" / "__init__.py").write_text("")
        monkeypatch.syspath_prepend(folder)
        for name in ("a_things", "good_things", "no_things"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        return Registry[Any](base, "no_things", "thing", "accelcal.things")

    return install


def test_an_installed_class_is_found_by_the_name_of_its_entry_point(installed, tmp_path):
    things = installed(GREY)
    assert things.get("grey-thing").__name__ == "Grey"
    assert things.get("grey-thing").name == "grey-thing"
    assert things.names() == ["good", "grey-thing"]
    assert things.beside("grey-thing", ".yaml") is None
    (tmp_path / "site" / "grey-thing.yaml").write_text("parameters: {}\n")
    assert things.beside("grey-thing", ".yaml") == tmp_path / "site" / "grey-thing.yaml"
    assert things.beside("another", ".yaml") is None


@pytest.mark.parametrize(
    ("module", "reason"),
    [
        ("import nowhere_to_be_found\n", "cannot be loaded (ModuleNotFoundError: No module named 'nowhere"),
        ("def f(:\n", "cannot be loaded (SyntaxError: "),
        ("raise SystemExit(3)\n", "cannot be loaded (SystemExit: 3)"),
        ("raise ValueError('one\\n\\ntwo')\n", "cannot be loaded (ValueError: one two)"),
        ("Other = 1\n", "cannot be loaded (AttributeError: "),
        ("def Grey():\n    pass\n", "is not a complete subclass of AccelcalError"),
        (GREY, "is not a complete subclass of AccelcalError"),
    ],
)
def test_a_broken_package_says_so_in_one_line_and_only_where_it_is_used(installed, module, reason):
    things = installed(module, AccelcalError)
    assert things.get("good").name == "good"
    place = 'thing "grey-thing" of the installed package a-things 1.2, entry point accelcal.things: '
    for _ in range(2):
        with pytest.raises(ConfigError) as error:
            things.get("grey-thing")
        assert str(error.value).startswith(f"{place}a_things:Grey {reason}")
        assert "\n" not in str(error.value)
    assert things.names() == ["good"]
    assert things.faults == {"grey-thing": str(error.value)}
    with pytest.raises(ConfigError, match=r'unknown thing "grey"; known: good$'):
        things.get("grey")


def test_entry_points_are_looked_up_only_for_a_name_that_is_not_built_in():
    line = (
        "import sys; from accelcal_cli.optimization.optimizer import OPTIMIZERS; "
        "from accelcal_cli.config import shipped_parameters; "
        "loaded = 'importlib.metadata' in sys.modules; OPTIMIZERS.get('de-pso'); shipped_parameters('de-pso'); "
        "print(loaded or 'importlib.metadata' not in sys.modules, '_entry_points' in vars(OPTIMIZERS))"
    )
    outcome = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=True)
    assert outcome.stdout == "True False\n"


def test_did_you_mean():
    assert did_you_mean("Huber", ["huber", "soft-l1"]) == ' (did you mean "huber"?)'
    assert did_you_mean("zzz", ["huber", "soft-l1"]) == ""
    assert did_you_mean("x", []) == ""
    assert issubclass(ConfigError, AccelcalError)
