"""Bags of ROS 2 in sqlite3 (.db3), alone or in the folder that ``ros2 bag record`` made."""

from __future__ import annotations

from accelcal_cli.io.formats.base import LOG_FORMATS
from accelcal_cli.io.formats.ros import RosBag


@LOG_FORMATS.register("rosbag2")
class Rosbag2(RosBag):
    """A bag of ROS 2 in sqlite3."""

    title = "a ROS 2 bag (sqlite3)"
    suffix = ".db3"

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Return whether it is a database with the tables of rosbag2."""
        return head.startswith(b"SQLite format 3\0") and b"topics" in head and b"messages" in head
