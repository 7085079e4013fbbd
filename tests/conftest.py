"""Fixtures shared by all tests."""

from __future__ import annotations

from pathlib import Path

import hypothesis
import pytest

hypothesis.settings.register_profile("accelcal", deadline=None, max_examples=25, derandomize=True)
hypothesis.settings.load_profile("accelcal")


@pytest.fixture
def shared_data() -> Path:
    """Folder of real recordings beside the project; tests that need it skip where it is absent."""
    folder = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real recordings are not on this machine")
    return folder
