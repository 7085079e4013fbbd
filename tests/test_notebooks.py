"""The notebooks of the documentation run, and show what they show."""

from __future__ import annotations

from typing import Any

import pytest
from notebooks import NOTEBOOKS, executed

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")


def shown(notebook: Any) -> list[list[str]]:
    """The lines of text that each cell shows; of pictures only that there is one."""
    return [
        [
            line.strip()
            for output in cell.get("outputs", ())
            for line in (output.get("text") or output["data"].get("text/plain", "")).splitlines()
        ]
        for cell in notebook.cells
    ]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_what_it_shows(path):
    from test_docs import same

    before, now = (shown(notebook) for notebook in (nbformat.read(path, as_version=4), executed(path)))
    for told, printed in zip(before, now, strict=True):
        assert len(told) == len(printed)
        for a, b in zip(told, printed, strict=True):
            assert same(a, b), f"{a}\n{b}\nrun `python tests/notebooks.py` and look at what it changed"
    assert sum(map(bool, before)) >= 10


def test_there_is_a_notebook():
    assert NOTEBOOKS
