"""Every exporter keeps the contract, and a bad one fails it for the right reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import exporter_contract as contract
import numpy as np
import pytest
from simulated import MEMS, readings

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration, Temperature
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, Exporter
from accelcal_cli.schema import setting
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel

G = 9.8
NAMES = EXPORTERS.names()
GAUGES = dict.fromkeys(NAMES, ("lower", "symmetric", "full")) | {"kalibr": ("lower",)}
"""Kalibr's file states any sensor in gauge lower, whose body axes are others."""


@cache
def result(scale=1.0, gauge="lower") -> Calibration:
    model = ErrorModel(scale * MEMS.K, scale * MEMS.D)
    settings = Settings(optimizer="levenberg-marquardt", g=G, gauge=gauge)
    return calibrate(readings(poses.turns(), model=model, g=G, sigma=1e-3), settings)


@pytest.fixture(scope="module")
def metres():
    return result()


@pytest.fixture(scope="module")
def with_slopes(metres):
    scale, bias = np.array([4e-4, -3e-4, 2e-4]), np.array([3e-3, -2e-3, 5e-3])
    return replace(metres, temperature=Temperature(25.0, 12.0, 40.0, scale, bias, *[bias] * 4, np.ones(6)))


@pytest.mark.parametrize("name", NAMES)
def test_the_contract(name, metres, with_slopes):
    cls = EXPORTERS.get(name)
    assert cls.name == name
    contract.describes_itself(cls)
    contract.writes_the_same_bytes(cls, metres)
    contract.is_text_unless_binary(cls, metres)
    contract.names_its_origin(cls, metres)
    contract.refuses_or_tells_what_it_cannot_hold(cls, with_slopes)


@pytest.mark.parametrize("scale", [1.0, 415.0])
@pytest.mark.parametrize(
    ("name", "gauge"), [(name, gauge) for name in contract.READERS for gauge in GAUGES[name]]
)
def test_the_round_trip(name, scale, gauge):
    contract.gives_the_force(EXPORTERS.get(name), result(scale, gauge), scale, contract.READERS[name])


@pytest.mark.parametrize("name", contract.READERS)
def test_the_round_trip_at_two_temperatures(name, with_slopes):
    read = contract.READERS[name]
    contract.gives_the_force_at_other_temperatures(EXPORTERS.get(name), with_slopes, read)


def test_every_format_of_ours_is_read_back():
    ours = {name for name in NAMES if EXPORTERS.get(name).__module__.startswith("accelcal_cli.")}
    assert ours == set(contract.READERS)


@dataclass(frozen=True)
class Bad(Exporter):
    """A format of the tests."""

    suffix = ".txt"

    def content(self, result):
        return base.comment(self.header(result)).encode()


class Nameless(Bad):
    """No sentence"""


class NoSuffix(Bad):
    """A format."""

    suffix = "txt"


@dataclass(frozen=True)
class Reserved(Bad):
    """A format."""

    output: str = setting("", "a file")


@dataclass(frozen=True)
class Undocumented(Bad):
    """A format."""

    depth: int = 3


@dataclass(frozen=True)
class OtherMeaning(Bad):
    """A format."""

    instance: int | None = setting(None, "times it is written")


class Changing(Bad):
    """A format."""

    calls = 0

    def content(self, result):
        Changing.calls += 1
        return f"{Changing.calls}\n".encode()


class Unfinished(Bad):
    """A format."""

    def content(self, result):
        return super().content(result).rstrip()


class Anonymous(Bad):
    """A format."""

    def content(self, result):
        return b"1 2 3\n"


class Silent(Bad):
    """A format."""

    def warnings(self, result):
        return ()


class SilentFile(Bad):
    """A format."""

    def content(self, result):
        return base.comment(base.origin(result)).encode()


def test_the_contract_is_kept_by_a_plain_format(metres, with_slopes):
    contract.describes_itself(Bad)
    contract.writes_the_same_bytes(Bad, metres)
    contract.is_text_unless_binary(Bad, metres)
    contract.names_its_origin(Bad, metres)
    contract.refuses_or_tells_what_it_cannot_hold(Bad, with_slopes)


@pytest.mark.parametrize(
    ("cls", "reason"),
    [
        (Nameless, "one sentence"),
        (NoSuffix, "a dot and a word"),
        (Reserved, "output is an option of the command"),
        (Undocumented, "depth is not made with schema.setting"),
        (OtherMeaning, "instance: another meaning"),
    ],
)
def test_a_class_that_describes_itself_badly_fails(cls, reason):
    with pytest.raises(AssertionError, match=reason):
        contract.describes_itself(cls)


@pytest.mark.parametrize(
    ("cls", "part", "reason"),
    [
        (Changing, contract.writes_the_same_bytes, "two exports differ"),
        (Unfinished, contract.is_text_unless_binary, "the last line"),
        (Anonymous, contract.names_its_origin, "no "),
    ],
)
def test_a_class_that_writes_badly_fails(cls, part, reason, metres):
    with pytest.raises(AssertionError, match=reason):
        part(cls, metres)


def test_a_class_that_drops_slopes_silently_fails(with_slopes):
    with pytest.raises(AssertionError, match="nothing tells of the slopes"):
        contract.refuses_or_tells_what_it_cannot_hold(Silent, with_slopes)
    with pytest.raises(AssertionError, match="the file does not tell of the slopes"):
        contract.refuses_or_tells_what_it_cannot_hold(SilentFile, with_slopes)


def test_a_wrong_sign_fails_the_round_trip(metres):
    def read(content, reading, degrees):
        return -contract.READERS["ros"](content, reading, degrees)

    with pytest.raises(AssertionError):
        contract.gives_the_force(EXPORTERS.get("ros"), metres, 1.0, read)


@pytest.mark.parametrize("name", ["px4", "ardupilot", "c-header", "numpy"])
def test_a_wrong_reference_temperature_fails_the_round_trip(name, with_slopes):
    def read(content, reading, degrees):
        return contract.READERS[name](content, reading, None if degrees is None else degrees + 0.5)

    with pytest.raises(AssertionError):
        contract.gives_the_force_at_other_temperatures(EXPORTERS.get(name), with_slopes, read)
