"""SVG by hand: what is written is well-formed, and axes have round numbers."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np
import pytest

from accelcal_cli.output import svg
from accelcal_cli.output.figures import histogram, projected
from accelcal_cli.output.svg import Scale


def test_text_is_not_taken_for_markup():
    evil = "<script>\"&'"
    drawn = svg.picture("p", 10, 10, evil, svg.mark("k", evil, svg.words(0, 0, evil, style=evil)), kind=evil)
    root = ElementTree.fromstring(drawn)
    assert [node.tag for node in root.iter()] == ["svg", "title", "g", "title", "text"]
    assert {node.text for node in root.iter() if node.text} == {evil}
    assert root.get("data-kind") == root.find("g/text").get("class") == evil


@pytest.mark.parametrize(("low", "high"), [(-1.3, 7.9), (0.0, 1e-9), (-3e6, -1e6), (99.99, 100.01)])
def test_linear_ticks_are_few_and_on_the_axis(low, high):
    ticks = Scale(low, high, 0.0, 1.0).ticks()
    assert 2 <= len(ticks) <= 11
    assert all(low - 1e-9 * (high - low) <= t <= high + 1e-9 * (high - low) for t in ticks)
    np.testing.assert_allclose(np.diff(ticks), ticks[1] - ticks[0], rtol=1e-6)


@pytest.mark.parametrize(("low", "high"), [(0.1, 40.0), (3e-12, 9e4), (2.1, 2.4), (0.9, 1.1), (5.0, 30.0)])
def test_logarithmic_ticks_are_few_and_on_the_axis(low, high):
    ticks = Scale(low, high, 0.0, 1.0, log=True).ticks()
    assert 2 <= len(ticks) <= 9
    assert all(low * (1 - 1e-9) <= t <= high * (1 + 1e-9) for t in ticks)


def test_a_scale_keeps_what_is_beyond_at_its_ends():
    scale = Scale(1.0, 100.0, 10.0, 30.0, log=True)
    assert [scale(v) for v in (0.0, 1.0, 10.0, 100.0, math.inf)] == [10.0, 10.0, 20.0, 30.0, 30.0]
    assert Scale(2.0, 2.0, 0.0, 4.0)(2.0) == 2.0


def test_the_projection_has_equal_areas():
    """Of directions spread evenly, as many lie within any circle as its area says."""
    k = np.arange(20000) + 0.5
    z, turn = 1.0 - k / 10000.0, np.pi * (1.0 + 5**0.5) * k
    r = np.sqrt(1.0 - z**2)
    places = [projected(u) for u in np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)]
    radius = np.array([math.hypot(x, y) for half, x, y in places if half == 0])
    assert len(radius) == 10000
    for limit in (0.3, 0.6, 0.9):
        assert (radius < limit).mean() == pytest.approx(limit**2, abs=0.005)


@pytest.mark.parametrize("values", [[1.0], [2.0, 2.0, 2.0], [0.0, 0.0], list(range(100))])
def test_a_histogram_holds_every_sensor_once(values):
    labels = [f"S{k}" for k in range(len(values) + 1)]
    drawn = histogram("bias", "g", np.array([*values, math.nan]), labels, "h")
    titles = [node.text for node in ElementTree.fromstring(drawn).findall("g/title")]
    assert sum(int(t.split(": ")[1].split(" of ")[0]) for t in titles) == len(values)
    assert not any(labels[-1] in t.split(": ")[-1].split(", ") for t in titles)
