"""Options: groups, panels, and choices that are those of the library."""

import inspect
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer.main

from accelcal_cli.calibration import settings
from accelcal_cli.cli import benchmark, calibrate, compare, navigate, options, running
from accelcal_cli.cli.main import NAMES, app, expand, help_text
from accelcal_cli.exporters.base import EXPORTERS
from accelcal_cli.navigation.filter import FILTERS
from accelcal_cli.navigation.gravity_map import PRESETS
from accelcal_cli.optimization import optimizer
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.planning import FIXTURES
from accelcal_cli.sensor.model import Gauge
from accelcal_cli.sensor.poses import SCHEMES
from accelcal_cli.studies.functions import FUNCTIONS

COMMANDS = {name: typer.main.get_command(app).commands[name] for name in NAMES}


def test_the_choices_are_those_of_the_library():
    assert typing.get_args(Gauge) == options.GAUGES
    assert typing.get_args(settings.Weights) == options.WEIGHTS
    assert typing.get_args(settings.Robust) == options.ROBUST
    assert typing.get_args(settings.Attitudes) == options.ATTITUDES
    assert set(SCHEMES) == set(options.SCHEMES)
    assert FIXTURES == options.FIXTURES
    assert optimizer.PRESETS == calibrate.PRESETS == running.PRESETS
    assert tuple(FUNCTIONS) == benchmark.FUNCTIONS
    assert {*PRESETS} == {*navigate.MAPS}
    assert set(compare.UNKNOWNS) <= set(options.GAUGES)


@pytest.mark.parametrize(
    ("names", "registry"),
    [
        (options.optimizers, OPTIMIZERS),
        (options.filters, FILTERS),
        (options.exporters, EXPORTERS),
    ],
)
def test_names_that_are_listed_without_an_import_are_those_of_the_registry(names, registry):
    assert names() == registry.names()


def test_a_group_stands_for_its_options():
    @dataclass(frozen=True)
    class Place:
        latitude: Annotated[float | None, typer.Option()] = None
        height: Annotated[float, typer.Option()] = 0.0

    calls = []

    def command(name: str, place: Place, loud: bool = False) -> None:
        """Do it."""
        calls.append((name, place, loud))

    spelled = expand(command)
    assert list(inspect.signature(spelled).parameters) == ["name", "latitude", "height", "loud"]
    assert spelled.__doc__ == "Do it."
    spelled(name="a", latitude=3.0, height=0.0, loud=True)
    assert calls == [("a", Place(3.0), True)]
    assert options.stated(**vars(Place(3.0))) == {"latitude": 3.0, "height": 0.0}


def test_the_last_of_several_names_is_completed():
    assert options.several_of(["pso", "de"])("ade,") == ["ade,pso", "ade,de"]


@pytest.mark.parametrize("name", NAMES)
def test_every_option_has_a_panel_and_says_what_it_takes(name):
    for parameter in COMMANDS[name].params:
        if parameter.name != "help":
            assert parameter.rich_help_panel, parameter.name
            assert "{" not in help_text(parameter, None, parameter.help), parameter.name
            assert parameter.help[0].isupper() or parameter.help[0] == "{", parameter.name
            assert parameter.help.endswith("."), parameter.name


def test_no_command_imports_another():
    for name in NAMES:
        module = Path(options.__file__).with_name(f"{name}.py").read_text("utf-8")
        for other in NAMES:
            assert f"accelcal_cli.cli import {other}" not in module
            assert f"accelcal_cli.cli.{other}" not in module
