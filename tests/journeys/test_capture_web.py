"""A capture beside a page in a browser: the poses are those of the terminal, whatever page, line and noise do."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator

import pytest
from hand_held import PLANNED, Device, hand, held, text_of
from test_site import AXE, serious

RATE = 200
TIMES = ("--columns", "2,3,4", "--rate", str(RATE), "--window", "0.2", "--hold", "0.4")
STILL, MOVING = 100, 30
"""Readings that a pose is held for, and on the way to the next."""

NOISE = (b"\xff\xfe#garb\x00age\n", b"12;\n", b"7;0.1;0.2\n", b"\r\n", b"<script>alert(1)</script>\n")
"""What a bad line makes of a line now and then."""

FEWEST_FRAMES = 8
"""Moments per second that reach a page while other tests share the processor; on its own it is 15."""


@pytest.fixture
def device() -> Iterator[Device]:
    pytest.importorskip("serial")
    found = Device()
    yield found
    found.unplug()


@pytest.fixture
def start(tmp_path, environment):
    """Start the command as a program; it is ended with the test."""
    started = []

    def begin(*arguments, **streams):
        command = [sys.executable, "-m", "accelcal_cli", "capture", *arguments]
        streams = {
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
            **streams,
        }
        program = subprocess.Popen(command, cwd=tmp_path, env={**environment, "TERM": "xterm"}, **streams)
        started.append(program)
        return program

    yield begin
    for program in started:
        if program.poll() is None:
            program.kill()
        program.communicate()


def address_of(program) -> str:
    """The address of its page."""
    line = program.stderr.readline().decode()
    found = re.fullmatch(r"accelcal: open (http://127\.0\.0\.1:\d+/#[\w-]{43})\n", line)
    assert found, line
    return found[1]


class Page:
    """A page without a browser."""

    def __init__(self, address):
        place, self.token = address.removeprefix("http://").split("/#")
        self.host, _, self.port = place.partition(":")
        self.connection, self.answer = self._ask("GET", "/events")

    def _ask(self, method, path, body=None):
        connection = http.client.HTTPConnection(self.host, int(self.port), timeout=60)
        headers = {"Authorization": f"Bearer {self.token}", "Content-Type": "application/json"}
        connection.request(method, path, body, headers)
        return connection, connection.getresponse()

    def post(self, path, **stated):
        """The answer to an action."""
        connection, answer = self._ask("POST", path, json.dumps(stated))
        with contextlib.closing(connection):
            return json.load(answer)

    def events(self):
        """Every event as it comes: name and value."""
        name = ""
        while line := self.answer.readline():
            kind, _, text = line.decode().rstrip("\n").partition(": ")
            if kind == "event":
                name = text
            elif kind == "data":
                yield name, json.loads(text)

    def until(self, wanted):
        """The first event that is wanted."""
        return next(value for name, value in self.events() if wanted(name, value))

    def close(self):
        self.answer.close()
        self.connection.close()


def noisy(data):
    """Lines with broken ones between them."""
    lines = data.splitlines(keepends=True)
    return b"".join(
        line + (NOISE[k // 40 % len(NOISE)] if k > 60 and k % 40 == 0 else b"")
        for k, line in enumerate(lines)
    )


def on_a_terminal(start, tmp_path, data):
    """The rows of a capture that a terminal shows live."""
    screen, slave = pty.openpty()
    program = start("--port", "-", *TIMES, "-o", "terminal.csv", stdin=subprocess.PIPE, stderr=slave)
    os.close(slave)
    program.stdin.write(data)
    program.stdin.close()
    program.stdin = None
    shown = b""
    with contextlib.suppress(OSError):  # that is how the end of a pseudo-terminal reads
        while chunk := os.read(screen, 65536):
            shown += chunk
    os.close(screen)
    assert program.wait() == 0
    assert shown.count(b"\a") == 12
    return (tmp_path / "terminal.csv").read_bytes()


def wait_for(browser, script, what):
    deadline = time.monotonic() + 60
    while not browser.run(f"return {script}"):
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


def test_a_browser_shows_what_the_terminal_takes(browser, device, start, tmp_path):
    """At 200 Hz over a noisy line, with a page that is closed, one that comes again, and a second one."""
    clean = text_of(hand(held(PLANNED, 3.0), still=STILL, moving=MOVING))
    program = start("--port", device.name, *TIMES, "-o", "poses.csv", "--result", "result.yaml", "--web")
    address = address_of(program)
    browser.log("browser")
    browser.requests()
    browser.open(address, width=1280)
    wait_for(browser, "document.getElementById('link').textContent === 'live'", "the page is not live")
    sending = device.send(noisy(clean), RATE)
    with contextlib.closing(Page(address)) as other:
        wait_for(browser, "(document.documentElement.dataset.moments || 0) > 5", "no moments")
        begun = time.monotonic()
        before = int(browser.run("return document.documentElement.dataset.moments"))
        check(browser)
        time.sleep(max(0.0, 2.0 - time.monotonic() + begun))
        after = int(browser.run("return document.documentElement.dataset.moments"))
        assert (after - before) / (time.monotonic() - begun) >= FEWEST_FRAMES
        browser.open("about:blank")  # closed in the middle of a pose
        time.sleep(1.0)
        browser.open(address, width=390, scheme="dark")
        wait_for(browser, "document.getElementById('list').children.length === 12", "no list of poses")
        counted = Counter()
        for name, value in other.events():
            counted[name] += 1
            if name == "progress":
                taken = len(value["taken"])
            if name == "end":
                break
        assert taken == 12
        assert counted["progress"] > 6
    sending.join()
    wait_for(browser, "!document.getElementById('end').hidden", "no end")
    assert browser.run("return document.getElementById('verdict').textContent") == "good"
    assert browser.run("return document.querySelectorAll('#list .taken').length") == 12
    export(browser, program)
    check(browser)
    browser.open(address, width=1280, scheme="dark")
    wait_for(browser, "!document.getElementById('end').hidden", "the end is not shown again")
    check(browser)
    origin = address.partition("#")[0]
    asked = [url for url in browser.requests() if not url.startswith(("about:", "data:", "blob:"))]
    assert [url for url in asked if not url.startswith(origin)] == []
    assert not [url for url in asked if "?" in url]
    assert browser.log("browser") == []
    browser.run("document.getElementById('close').click()")
    assert program.wait(60) == 0
    assert (tmp_path / "poses.csv").read_bytes() == on_a_terminal(start, tmp_path, clean)
    assert (tmp_path / "result.yaml").exists()


def check(browser):
    """Nothing is wider than the window, and axe finds nothing serious."""
    assert browser.run("return document.documentElement.scrollWidth <= window.innerWidth + 1")
    if AXE.is_file():
        assert serious(browser) == []


def export(browser, program):
    """Take a result away as a user does."""
    browser.run(
        "document.getElementById('to').value = 'c-header'; document.getElementById('form').requestSubmit()"
    )
    wait_for(browser, "!document.getElementById('text').hidden", "no text of the export")
    assert "#define" in browser.run("return document.getElementById('text').textContent")
    assert browser.run("return document.getElementById('save').disabled") is False


def test_a_page_without_the_token_says_so(browser, device, start):
    program = start("--port", device.name, *TIMES, "--web")
    address = address_of(program)
    browser.open(address.partition("#")[0] + "#wrong")
    wait_for(browser, "document.getElementById('link').className === 'lost'", "no refusal")
    assert "lacks the token" in browser.run("return document.getElementById('link').textContent")
    assert browser.run("return document.documentElement.dataset.moments || 0") == 0
    browser.log("browser")  # which tells of the refusal
    program.send_signal(signal.SIGINT)
    assert program.wait(60) == 130


def test_a_lost_line_loses_no_pose_and_the_page_tells(device, start, tmp_path):
    program = start("--port", device.name, *TIMES, "-o", "poses.csv", "--web")
    with contextlib.closing(Page(address_of(program))) as page:
        page.until(lambda name, _: name == "progress")
        device.send(text_of(hand(PLANNED[:4], still=STILL, moving=MOVING)))
        page.until(lambda name, value: name == "progress" and len(value["taken"]) == 4)
        device.unplug()
        end = page.until(lambda name, _: name == "end")
        assert end[
            "said"
        ] == f"{device.name}: the port is gone; 4 poses in poses.csv, 8 planned are missing; " + (
            "their calibration is undetermined"
        )
        assert page.post("/export", to="poses")["text"] == (tmp_path / "poses.csv").read_text()
        assert program.poll() is None
        page.post("/close")
        _, err = program.communicate(timeout=60)
    assert program.returncode == 2
    assert err.decode().splitlines()[-1] == f"accelcal: {end['said']}"


def test_a_page_may_end_the_capture(device, start, tmp_path):
    program = start("--port", device.name, *TIMES, "-o", "poses.csv", "--web", "-q")
    with contextlib.closing(Page(address_of(program))) as page:
        device.send(text_of(hand(PLANNED[:4], still=STILL, moving=MOVING)), 2000)
        page.until(lambda name, value: name == "progress" and len(value["taken"]) == 2)
        page.post("/stop")
        page.until(lambda name, _: name == "end")
        page.post("/close")
    assert program.wait(60) == 1
    assert 3 <= len((tmp_path / "poses.csv").read_text().splitlines()) <= 5


def test_ctrl_c_does_not_wait_for_pages(device, start):
    program = start("--port", device.name, *TIMES, "--web", "-q")
    with contextlib.closing(Page(address_of(program))) as page:
        page.until(lambda name, _: name == "progress")
        device.send(text_of(hand(PLANNED[:1], still=40, moving=MOVING)), RATE)
        page.until(lambda name, _: name == "moment")
        program.send_signal(signal.SIGINT)
        _, err = program.communicate(timeout=60)
    assert program.returncode == 130
    assert err == b"accelcal: interrupted; no pose was taken\n"
