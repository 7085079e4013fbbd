"""A capture in a browser: the page's files, what it is told while the capture runs, and what it may do at its end."""

from __future__ import annotations

import io
import ipaddress
import threading
import time
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.detection.capture import Capture, CaptureStatus
from accelcal_cli.errors import UsageError
from accelcal_cli.exporters.base import EXPORTERS, export
from accelcal_cli.output.live import HEADER, pose_rows
from accelcal_cli.output.machine import result_text
from accelcal_cli.output.server import Server
from accelcal_cli.schema import to_mapping
from accelcal_cli.views.capture import final_tables, moment, progress

PER_SECOND = 15
"""Moments that a page is told at most."""

LINGER = 60.0
"""Seconds that the end is served on for after the last page was closed."""

PATIENCE = 0.1
"""Seconds between looks at whether somebody is there still."""

TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}

OWN = {"poses": "poses.csv", "result": "result.yaml"}
"""What is ours to take away, beside the formats of other tools, and the name of the file."""


def _page_files() -> dict[str, tuple[str, bytes]]:
    """Return content type and content of the page's files by path."""
    found = {}
    for file in (files("accelcal_cli.output") / "page").iterdir():
        stem, _, ending = file.name.rpartition(".")
        if ending in TYPES:
            path = "/" if stem == "index" else f"/{file.name}"
            found[path] = f"{TYPES[ending]}; charset=utf-8", file.read_bytes()
    return found


class LivePage:
    """Shows a capture to browsers; it never waits for one.

    Attributes:
        stopping: set when a page asks for the end of the capture.
    """

    def __init__(self, capture: Capture, bind: str, port: int) -> None:
        """Serve a capture.

        Args:
            capture: to show; bind: address of this machine; port: 0 for any that is free.

        Raises:
            UsageError: they cannot be used.
        """
        self.capture = capture
        self.stopping, self._closing = threading.Event(), threading.Event()
        self.result: Calibration | None = None
        self._ended = False
        self._due = 0.0
        actions = {"/stop": self._stop, "/export": self._export, "/close": self._close}
        self.server = Server(bind, port, _page_files(), actions)
        self.server.start()
        self.server.publish("progress", self._progress())

    def see(self, status: CaptureStatus) -> None:
        """Tell what the sensor is doing now, and of each pose that was taken."""
        taken, now = status.state == "taken", time.monotonic()
        if taken:
            self.server.publish("progress", self._progress())
        if taken or (self.server.pages and now >= self._due):
            self.server.publish("moment", to_mapping(moment(self.capture, status)))
            self._due = (
                max(self._due, now - 1.0 / PER_SECOND) + 1.0 / PER_SECOND
            )  # as often, whatever comes in chunks

    def finish(self, said: str, result: Calibration | None) -> None:
        """Tell how it ended, and offer the result where there is one."""
        self.result, self._ended = result, True
        formats = [name for name in EXPORTERS.names() if not EXPORTERS.get(name).binary]
        offered = [*OWN, *formats] if result is not None else ["poses"] if self.capture.poses else []
        tables = [] if result is None else final_tables(result)
        self.server.publish("progress", self._progress())
        self.server.publish("end", {"said": said, "tables": tables, "exports": offered})

    def linger(self) -> None:
        """Serve the end until a page says that it is done, or none has been open for `LINGER`; at once if none was."""
        while self.server.opened and not self._closing.wait(PATIENCE):
            if not self.server.pages and time.monotonic() - self.server.left > LINGER:
                return

    @property
    def is_shared(self) -> bool:
        """Whether other machines reach the page."""
        return not ipaddress.ip_address(self.server.bind).is_loopback

    def qr_code(self) -> str:
        """Return the address as a QR code of blocks for a terminal, for the camera of a telephone.

        Raises:
            UsageError: segno is missing.
        """
        try:
            import segno
        except ImportError:
            raise UsageError("a QR code of the address needs segno: python -m pip install segno") from None
        text = io.StringIO()
        segno.make(self.server.address, micro=False).terminal(text, compact=True)
        return text.getvalue()

    def close(self) -> None:
        """Serve no more."""
        self.server.close()

    def _progress(self) -> dict[str, Any]:
        found = progress(self.capture)
        return {**to_mapping(found), "count": found.count, "outlook": found.outlook, "missing": found.missing}

    def _stop(self, _: Mapping[str, Any]) -> dict[str, Any]:
        self.stopping.set()
        return {}

    def _close(self, _: Mapping[str, Any]) -> dict[str, Any]:
        if not self._ended:
            raise UsageError("the capture has not ended")
        self._closing.set()
        return {}

    def _export(self, stated: Mapping[str, Any]) -> dict[str, Any]:
        """Return a result as the text of a file; its name is ours, and nothing is written here."""
        if not self._ended:
            raise UsageError("the capture has not ended")
        to = str(stated.get("to"))
        if to == "poses":
            text = "".join([HEADER, *pose_rows(self.capture.poses)])
            return {"name": OWN[to], "text": text, "warnings": []}
        if self.result is None:
            raise UsageError("there is no calibration to export")
        if to == "result":
            return {"name": OWN[to], "text": result_text(self.result, json=False), "warnings": []}
        made = export(self.result, to)
        return {
            "name": f"{to}{EXPORTERS.get(to).suffix}",
            "text": str(made),
            "warnings": list(made.warnings),
        }
