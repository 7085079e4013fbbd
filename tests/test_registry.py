"""Classes by name: one module is loaded for one name, and an unknown name is answered with the nearest."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from accelcal_cli.errors import AccelcalError, ConfigError, did_you_mean
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.registry import Registry
from accelcal_cli.schema import from_mapping


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
    built = from_mapping(OPTIMIZERS.get("de"), {"weight": 0.7}, "my.yaml")
    assert (built.name, built.weight) == ("de", 0.7)
    with pytest.raises(ConfigError, match=r'my.yaml: unknown key "wieght" \(did you mean "weight"\?\)'):
        from_mapping(OPTIMIZERS.get("de"), {"wieght": 0.7}, "my.yaml")


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
        "import sys; from accelcal_cli.optimization.optimizer import OPTIMIZERS, shipped_parameters; "
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
