"""The page of a capture: what it is told, what it may do, and what its files hold."""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from test_live import PLANNED, stream
from test_server import Stream, ask, bearer

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.detection.capture import Capture
from accelcal_cli.errors import UsageError
from accelcal_cli.exporters.base import EXPORTERS, export
from accelcal_cli.output import page as module
from accelcal_cli.output.machine import result_text
from accelcal_cli.output.page import LivePage
from accelcal_cli.output.server import BODY


@pytest.fixture
def page():
    made = LivePage(Capture(PLANNED, window=10, hold=30), "127.0.0.1", 0)
    yield made
    made.close()


def push(page, readings):
    """Show the page a capture of readings; return how often a moment was told."""
    told, real = [], page.server.publish

    def publish(name, value):
        told.append(name)
        real(name, value)

    page.server.publish = publish
    for reading in readings:
        status = page.capture.push(reading)
        if status is not None:
            page.see(status)
    page.server.publish = real
    return told.count("moment"), told.count("progress")


def events(page):
    """The latest of each kind, as a page that comes now gets it."""
    with contextlib.closing(Stream(page.server)) as listener:
        return dict(listener.event() for _ in page.server._values)


def post(page, path, stated):
    status, _, content = ask(
        page.server, path, "POST", json.dumps(stated).encode(), Authorization=bearer(page.server)
    )
    return status, json.loads(content)


def test_a_page_that_comes_late_gets_every_pose(page):
    push(page, stream(7))
    told = events(page)
    assert told["progress"]["numbers"] == [1, 2, 3, 4, 5, 6, 7, *[None] * 5]
    assert told["progress"]["count"] == "7 of 12 poses taken"
    assert told["progress"]["missing"] == 5
    assert len(told["progress"]["taken"]) == 7
    assert told["moment"]["state"] in ("again", "taken")


def test_it_is_told_every_pose_and_fifteen_moments_a_second(page, monkeypatch):
    clock = iter(np.arange(10_000) / 200)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with contextlib.closing(Stream(page.server)) as listener:
        assert listener.event()[0] == "progress"
        moments, poses = push(page, stream(12))  # 480 readings: 2.4 s
    assert poses == 12
    assert 35 <= moments <= 36 + 12 + 1


def test_moments_are_made_for_pages_alone(page):
    assert push(page, stream(12)) == (12, 12)


def test_nothing_is_exported_before_the_end(page):
    push(page, stream(3))
    for path in ("/export", "/close"):
        assert post(page, path, {"to": "poses"}) == (409, {"error": "the capture has not ended"})
    assert not page.stopping.is_set()
    assert post(page, "/stop", {}) == (200, {})
    assert page.stopping.is_set()


def test_the_end_offers_what_the_exporters_make(page):
    push(page, stream(12))
    result = calibrate(page.capture.readings())
    page.finish("12 poses", result)
    end = events(page)["end"]
    assert end["said"] == "12 poses"
    assert [table["title"] for table in end["tables"]][1:] == ["Engineering view", "Fit"]
    texts = [name for name in EXPORTERS.names() if not EXPORTERS.get(name).binary]
    assert end["exports"] == ["poses", "result", *texts]
    for name in ("c-header", "ros", "px4"):
        status, made = post(page, "/export", {"to": name})
        expected = export(result, name)
        assert (status, made["text"], made["warnings"]) == (200, str(expected), list(expected.warnings))
        assert made["name"] == f"{name}{EXPORTERS.get(name).suffix}"
    assert post(page, "/export", {"to": "result"})[1]["text"] == result_text(result, json=False)
    rows = post(page, "/export", {"to": "poses"})[1]["text"].splitlines()
    assert len(rows) == 13


@pytest.mark.parametrize("to", ["../../etc/passwd", "nothing", None, "x" * (BODY - 50)])
def test_the_page_names_formats_and_never_paths(page, to, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    push(page, stream(12))
    page.finish("12 poses", calibrate(page.capture.readings()))
    status, said = post(page, "/export", {"to": to})
    assert status == 409
    assert "error" in said
    assert list(tmp_path.iterdir()) == []


def test_an_undetermined_result_is_not_exported(page):
    push(page, stream(5))
    page.finish("5 poses", calibrate(page.capture.readings()))
    status, said = post(page, "/export", {"to": "px4"})
    assert (status, "undetermined" in said["error"]) == (409, True)
    assert post(page, "/export", {"to": "poses"})[0] == 200


def test_without_a_calibration_the_poses_are_offered(page):
    push(page, stream(1))
    page.finish("1 pose", None)
    assert events(page)["end"]["exports"] == ["poses"]
    assert post(page, "/export", {"to": "px4"})[0] == 409


def test_it_does_not_linger_where_no_page_was(page):
    page.finish("no pose was taken", None)
    page.linger()


def test_it_lingers_until_the_page_says_so(page):
    page.finish("no pose was taken", None)
    events(page)
    assert post(page, "/close", {}) == (200, {})
    page.linger()


def test_it_lingers_for_a_page_that_was_closed(page, monkeypatch):
    monkeypatch.setattr(module, "LINGER", 0.3)
    page.finish("no pose was taken", None)
    before = time.monotonic()
    events(page)
    page.linger()
    assert time.monotonic() - before >= 0.3


def test_a_qr_code_is_made_of_blocks_or_says_what_to_install(page, monkeypatch):
    assert not page.is_shared
    monkeypatch.setitem(sys.modules, "segno", None)
    with pytest.raises(UsageError, match="python -m pip install segno"):
        page.qr_code()


def test_the_qr_code_holds_the_address(page):
    segno = pytest.importorskip("segno")
    lines = page.qr_code().splitlines()
    size = segno.make(page.server.address, micro=False).symbol_size()[0]
    assert {len(line) for line in lines} == {size}


# The files


def test_the_files_say_what_they_are():
    kinds = {path: kind for path, (kind, _) in module._page_files().items()}
    assert kinds == {
        "/": "text/html; charset=utf-8",
        "/icon.svg": "image/svg+xml; charset=utf-8",
        "/page.css": "text/css; charset=utf-8",
        "/page.js": "text/javascript; charset=utf-8",
        "/picture.js": "text/javascript; charset=utf-8",
    }


def test_the_files_keep_to_their_policy():
    """No script or style within the page, nothing from elsewhere, and no text that becomes markup."""
    content = {path: data.decode() for path, (_, data) in module._page_files().items()}
    assert not re.search(r"<style|style=|\son\w+=|<script(?! src=\"/)", content["/"])
    for path, text in content.items():
        addresses = re.findall(
            r"(?:https?:)?//[\w.]+\.\w+\S*", re.sub(r"^\s*//.*$", "", text, flags=re.MULTILINE)
        )
        assert [a for a in addresses if "www.w3.org/2000/svg" not in a] == [], path
        assert not re.search(
            r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(|new Function", text
        ), path
