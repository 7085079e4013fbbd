"""The command line as programs that are watched and killed."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]


def program(folder: Path, *arguments: str, launch: str = "", **options) -> subprocess.Popen[str]:
    """Start a module with its arguments; or a line of Python, with the arguments behind the first."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "error"}
    return subprocess.Popen(
        [sys.executable, *(("-c", launch, *arguments[1:]) if launch else ("-m", *arguments))],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.02)


def group(leader: int) -> bool:
    """Whether any process of a session's group is left."""
    try:
        os.killpg(leader, 0)
    except ProcessLookupError:
        return False
    return True
