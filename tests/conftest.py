"""Fixtures of the whole suite."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

hypothesis.settings.register_profile("accelcal", deadline=None, max_examples=25, derandomize=True)
hypothesis.settings.load_profile("accelcal")

os.environ["SOURCE_DATE_EPOCH"] = "1764547200"
"""Results that are compared have one date, whenever they are made."""

SHARED = Path(__file__).parents[2] / "shared" / "data"
"""Real recordings, kept beside the project and not part of it."""


@pytest.fixture
def shared_data() -> Path:
    """Folder of the real recordings; without it the test is skipped."""
    if not SHARED.is_dir():
        pytest.skip("the real recordings are not beside the project")
    return SHARED
