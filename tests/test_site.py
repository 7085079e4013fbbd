"""The documentation as a site: built without a warning, whole, quiet in a browser, and usable by all."""

from __future__ import annotations

import functools
import http.server
import importlib.util
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import chromium
import pytest

ROOT = Path(__file__).parents[1]
NEEDED = ("mkdocs", "material", "mkdocstrings", "latex2mathml")
pytestmark = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in NEEDED), reason="needs the extra site"
)
LOOKED_AT = (
    "index.html",
    "gallery.html",
    "tutorials/first-calibration.html",
    "explanation/model-and-gauges.html",
    "reference/library.html",
    "reference/commands.html",
    "notebooks/readings-to-export.ipynb.html",
    "optimizers/de-pso.html",
)
AXE = (Path(os.environ.get("ACCELCAL_AXE", ROOT / "node_modules" / "axe-core")) / "axe.min.js").resolve()


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "DISABLE_MKDOCS_2_WARNING": "true"}
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    return folder


class Links(HTMLParser):
    """The targets and the anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.fetched: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.anchors.add(value)
            elif name == "href" and tag == "a" and value:
                self.targets.append(value)
            elif value and (name == "src" or (name == "href" and tag == "link")):
                self.fetched.append(value)


def test_every_link_leads_somewhere_and_nothing_is_fetched_from_elsewhere(site):
    pages = {path: Links(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    assert len(pages) > 50
    for path, page in pages.items():
        if path.name == "404.html":
            continue
        for target in page.fetched:
            assert not re.match(r"(https?:)?//", target), f"{path}: {target}"
        for target in (*page.targets, *page.fetched):
            parts = urlsplit(target)
            if parts.scheme:
                continue
            goal = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            goal = goal / "index.html" if goal.is_dir() else goal
            assert goal.exists(), f"{path}: {target}"
            if parts.fragment and goal in pages and not parts.fragment.startswith("__"):
                assert unquote(parts.fragment) in pages[goal].anchors, f"{path}: {target}"


def test_equations_citations_and_notebook_are_there(site):
    model = (site / "explanation" / "model-and-gauges.html").read_text(encoding="utf-8")
    assert model.count("<math") >= 3
    assert "```math" not in model
    assert 'bibliography.html#dpso2014"' in model
    assert 'id="dpso2014"' in (site / "bibliography.html").read_text(encoding="utf-8")
    notebook = (site / "notebooks" / "readings-to-export.ipynb.html").read_text(encoding="utf-8")
    assert "data:image/png;base64," in notebook
    assert "1693.52" in notebook
    library = (site / "reference" / "library.html").read_text(encoding="utf-8")
    assert 'id="accelcal_cli.calibration.calibrate.calibrate"' in library


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def address(site) -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (390, "light")])
def test_pages_are_quiet_and_fit(browser, address, width, scheme):
    """No error on the console, no request to elsewhere, nothing wider than the window, nothing serious for axe."""
    for page in LOOKED_AT:
        if page == LOOKED_AT[0]:  # a reader who comes for the first time
            browser.open("about:blank")
            browser.devtools("Storage.clearDataForOrigin", origin=address, storageTypes="all")
        browser.log("browser")
        browser.requests()
        browser.open(f"{address}/{page}", width=width, scheme=scheme)
        assert browser.log("browser") == [], page
        shown = browser.run("return document.body.getAttribute('data-md-color-scheme')")
        assert shown == {"light": "default", "dark": "slate"}[scheme]
        asked = browser.requests()
        assert asked, page
        assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == [], page
        assert browser.run("return document.documentElement.scrollWidth <= window.innerWidth + 1"), page
        if AXE.is_file():
            assert serious(browser) == [], page


def serious(browser: chromium.Browser) -> list[str]:
    """What axe finds in the page that keeps people from using it."""
    browser.devtools("Runtime.evaluate", expression=AXE.read_text(encoding="utf-8"))
    found = browser.devtools(
        "Runtime.evaluate",
        expression="axe.run(document, {resultTypes: ['violations']}).then(r => JSON.stringify(r.violations"
        ".filter(v => ['serious', 'critical'].includes(v.impact))"
        ".map(v => v.id + ': ' + v.nodes.slice(0, 3).map(n => n.target.join(' ') + ' ' + n.html.slice(0, 120)))))",
        awaitPromise=True,
        returnByValue=True,
    )
    violations: list[str] = json.loads(found["result"]["value"])
    return violations


def test_search_finds_a_page(browser, address):
    browser.open(f"{address}/index.html?q=misalignment", width=1280)
    for _ in range(50):
        if browser.run("return document.querySelectorAll('.md-search-result__item').length"):
            return
        browser.run("const end = Date.now() + 100; while (Date.now() < end) {}")
    raise AssertionError("the search finds nothing")
