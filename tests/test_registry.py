"""Classes by name: one module is loaded for one name, and an unknown name is answered with the nearest."""

from __future__ import annotations

from typing import Any

import pytest

from accelcal_cli.errors import AccelcalError, ConfigError, did_you_mean
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.registry import Registry


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
        "from accelcal_cli.registry import Registry\nTHINGS = Registry(__name__, 'thing')\n"
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


def test_did_you_mean():
    assert did_you_mean("Huber", ["huber", "soft-l1"]) == ' (did you mean "huber"?)'
    assert did_you_mean("zzz", ["huber", "soft-l1"]) == ""
    assert did_you_mean("x", []) == ""
    assert issubclass(ConfigError, AccelcalError)
