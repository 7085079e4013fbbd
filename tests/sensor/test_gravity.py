"""Local gravity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from accelcal_cli.errors import UsageError
from accelcal_cli.sensor.gravity import check_gravity, normal_gravity


@pytest.mark.parametrize(
    ("latitude", "g"),
    [(0.0, 9.7803253359), (45.0, 9.8061977694), (90.0, 9.8321849379), (-90.0, 9.8321849379)],
)
def test_normal_gravity_on_the_ellipsoid(latitude, g):
    assert normal_gravity(latitude) == pytest.approx(g, abs=2e-10)


@given(st.floats(-90, 90))
def test_normal_gravity_is_somiglianas(latitude):
    """The closed form of Somigliana with the constants of WGS84."""
    s = np.sin(np.radians(latitude)) ** 2
    somigliana = 9.7803253359 * (1 + 0.00193185265241 * s) / np.sqrt(1 - 0.00669437999013 * s)
    assert normal_gravity(latitude) == pytest.approx(somigliana, abs=1e-9)
    assert normal_gravity(latitude) == pytest.approx(normal_gravity(-latitude), abs=1e-12)


@pytest.mark.parametrize("latitude", [0.0, 30.0, 60.0, 90.0])
def test_gravity_falls_with_height(latitude):
    """By about 3.086e-6 per second squared near the ground, and less than linearly."""
    ground, hill, mountain = (normal_gravity(latitude, h) for h in (0.0, 100.0, 5000.0))
    assert (ground - hill) / 100 == pytest.approx(3.086e-6, rel=5e-3)
    assert 0.99 < (ground - mountain) / (50 * (ground - hill)) < 1.0
    valley = normal_gravity(latitude, -400.0)  # the Dead Sea; no warning for being below the ellipsoid
    assert (valley - ground) / 400 == pytest.approx(3.086e-6, rel=5e-3)


@pytest.mark.parametrize(
    ("latitude", "height", "word"),
    [
        (91, 0, "--latitude 91"),
        (-90.1, 0, "--latitude"),
        (float("nan"), 0, "--latitude"),
        (0, 2e5, "--height"),
    ],
)
def test_places_that_do_not_exist_are_refused(latitude, height, word):
    with pytest.raises(UsageError, match=word):
        normal_gravity(latitude, height)


@pytest.mark.parametrize("g", [0.0, -9.8, float("nan"), float("inf")])
def test_gravity_that_cannot_be_is_refused(g):
    with pytest.raises(UsageError, match="--g"):
        check_gravity(g)


@pytest.mark.parametrize("g", [1.0, 9.81, 1.62])
def test_gravity_that_can_be_passes(g):
    assert check_gravity(g) == g
