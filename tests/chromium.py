"""A headless Chromium, driven over the WebDriver protocol with nothing but the standard library."""

from __future__ import annotations

import base64
import http.client
import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
DRIVER = "chromedriver"
ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
)


def browser() -> str | None:
    """The path of a Chromium, or None when it or its driver is not there."""
    if shutil.which(DRIVER) is None:
        return None
    return next(filter(None, map(shutil.which, BROWSERS)), None)


class Browser:
    """A session: open pages, look at them, hear what they say and ask for."""

    def __init__(self, address: str, path: str) -> None:
        self.address = address
        options = {"binary": path, "args": list(ARGUMENTS)}
        capabilities = {
            "goog:chromeOptions": options,
            "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
        }
        answer = self._post("/session", {"capabilities": {"alwaysMatch": capabilities}})
        self.session = f"/session/{answer['sessionId']}"

    def open(self, page: Path | str, *, width: int = 1100, height: int = 900, scheme: str = "light") -> None:
        """Open a page, a file or an address, in a window of a width, with a colour scheme preferred."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.devtools("Emulation.setEmulatedMedia", features=features)
        self.devtools(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        self._post(f"{self.session}/url", {"url": page if isinstance(page, str) else page.as_uri()})

    def devtools(self, command: str, **parameters: Any) -> Any:
        """Run a command of the browser's developer tools."""
        return self._post(f"{self.session}/goog/cdp/execute", {"cmd": command, "params": parameters})

    def run(self, script: str) -> Any:
        """Return what a script in the page returns."""
        return self._post(f"{self.session}/execute/sync", {"script": script, "args": []})

    def log(self, kind: str) -> list[dict[str, Any]]:
        """Return the entries of a log ("browser": the console; "performance": the network) since the last call."""
        entries: list[dict[str, Any]] = self._post(f"{self.session}/se/log", {"type": kind})
        return entries

    def requests(self) -> list[str]:
        """Return the addresses asked for since the last call."""
        messages = [json.loads(entry["message"])["message"] for entry in self.log("performance")]
        return [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]

    def screenshot(self, file: Path, *, whole: bool = True) -> None:
        """Write a picture of the whole page, or of what the window shows."""
        answer = self.devtools("Page.captureScreenshot", captureBeyondViewport=whole, format="png")
        file.write_bytes(base64.b64decode(answer["data"]))

    def print(self, file: Path) -> None:
        """Write the page as it is printed, a PDF."""
        answer = self._post(f"{self.session}/print", {})
        file.write_bytes(base64.b64decode(answer))

    def pdf(self, file: Path) -> None:
        """Write the page as a person prints it, a PDF on the paper that the page asks for."""
        answer = self.devtools("Page.printToPDF", preferCSSPageSize=True)
        file.write_bytes(base64.b64decode(answer["data"]))

    def close(self) -> None:
        """End the session; a driver that is gone before it has answered has ended it, too."""
        with suppress(OSError, http.client.HTTPException):
            self._call("DELETE", self.session, None)

    def _post(self, path: str, body: Any) -> Any:
        return self._call("POST", path, body)

    def _call(self, method: str, path: str, body: Any) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.address + path, data, {"Content-Type": "application/json"})
        request.method = method
        try:
            with _direct.open(request, timeout=120) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            with error:
                raise AssertionError(error.read().decode()) from None


_direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))


@contextmanager
def session(path: str) -> Iterator[Browser]:
    """A browser, and its driver around it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    quiet = subprocess.DEVNULL
    driver = subprocess.Popen([DRIVER, f"--port={port}"], stdin=quiet, stdout=quiet, stderr=quiet)
    try:
        found = Browser(_ready(f"http://127.0.0.1:{port}"), path)
        try:
            yield found
        finally:  # or the browser outlives its driver
            found.close()
    finally:
        driver.terminate()
        driver.wait()


def _ready(address: str) -> str:
    """Wait until the driver answers."""
    for _ in range(600):
        try:
            with _direct.open(f"{address}/status", timeout=10):
                return address
        except (urllib.error.URLError, ConnectionError):
            time.sleep(0.1)
    raise AssertionError("chromedriver does not answer")
