"""The stated lower bounds of the dependencies as constraints of pip, one a line: `python tests/lowest.py`."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def lowest() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    stated = [*project["dependencies"], *extras["cluster"], *extras["maps"]]
    found = [re.match(r"([\w.-]+)>=([\w.]+)", line) for line in stated]
    return [f"{match[1]}=={match[2]}" for match in found if match]


if __name__ == "__main__":
    sys.stdout.write("\n".join([*lowest(), ""]))
