"""Fixtures of the whole suite."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import chromium
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


ROOT = Path(__file__).parents[1]


@pytest.fixture
def cluster(tmp_path):
    """The address of a Dask scheduler with two workers, processes of their own on this machine."""
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    port = address.rpartition(":")[2]
    quiet = {"PYTHONWARNINGS": "default"}
    commands = [
        ["scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"],
        *[["worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny"]] * 2,
    ]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, **quiet, "PYTHONPATH": path}
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *command],
            cwd=tmp_path,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for command in commands
    ]
    yield address, processes
    for process in processes:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def browser() -> Iterator[chromium.Browser]:
    """A session of headless Chromium for the tests of a file."""
    path = chromium.browser()
    if path is None:
        pytest.skip("no chromium and chromedriver here: apt-get install chromium chromium-driver")
    with chromium.session(path) as session:
        yield session
