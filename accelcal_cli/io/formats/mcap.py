"""Bags of ROS 2 in MCAP (.mcap), alone or in the folder that ``ros2 bag record`` made."""

from __future__ import annotations

from accelcal_cli.io.formats.base import LOG_FORMATS
from accelcal_cli.io.formats.ros import RosBag


@LOG_FORMATS.register("mcap")
class Mcap(RosBag):
    """A bag of ROS 2 in MCAP."""

    title = "an MCAP file of ROS 2"
    suffix = ".mcap"

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Return whether it begins with the magic of MCAP."""
        return head.startswith(b"\x89MCAP0\r\n")
