"""Samples: what a label says of an attitude."""

from __future__ import annotations

import pytest

from accelcal_cli.calibration.sample import axis_up


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("+x up", (0, 1)),
        ("-x up", (0, -1)),
        ("x_down", (0, -1)),
        ("-z down", (2, 1)),
        ("Y axis up", (1, 1)),
        ("pose 3: z-up", (2, 1)),
        ('position "-y up, tilted 45 degrees towards +z"', (1, -1)),
        ("face_x_up_2", (0, 1)),
        ("02", None),
        ("xup", (0, 1)),
        ("upside down", None),
        ("corner between +x, -y and +z up", (2, 1)),
        ("z upper", None),
        ("matrix up", None),
    ],
)
def test_what_a_label_says_is_up(label, expected):
    assert axis_up(label) == expected
