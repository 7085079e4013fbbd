"""Pictures of poses with letters: the sphere of directions as a map, and a box that is held as a pose is.

With dots of Braille where the encoding has them, else with ASCII characters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations, groupby, product
from operator import itemgetter

import numpy as np
from rich.text import Text

from accelcal_cli.arrays import Float
from accelcal_cli.detection.capture import NEAR
from accelcal_cli.output.console import DOTS
from accelcal_cli.sensor.poses import AXES

MAP_WIDTH, MAP_HEIGHT = 36, 9
"""Cells of the map: nine columns are 90 degrees, and the rows have equal areas."""

WEST = -135.0
"""Longitude of the left edge, degrees: no face of the sensor lies on an edge."""

BOX_WIDTH, BOX_HEIGHT = 18, 9


@dataclass(frozen=True)
class Marks:
    """What stands for the parts of a map."""

    empty: str
    covered: str
    planned: str
    taken: str
    next: str
    now: str


UNICODE = Marks("·", "░", "○", "●", "◎", "✚")
ASCII = Marks(".", ":", "o", "#", "O", "+")

STYLES = {
    "empty": "dim",
    "covered": "green",
    "planned": "",
    "taken": "bold green",
    "next": "bold cyan",
    "now": "bold",
}


def map_cell(direction: Sequence[float] | Float) -> tuple[int, int]:
    """Return row and column of a direction on the map, a cylinder of equal areas with +z above."""
    x, y, z = direction
    row = min(int((1.0 - z) / 2.0 * MAP_HEIGHT), MAP_HEIGHT - 1)
    turned = (math.degrees(math.atan2(y, x)) - WEST) % 360.0
    return max(row, 0), int(turned / 360.0 * MAP_WIDTH) % MAP_WIDTH


def _cell_directions() -> Float:
    """Return the direction of the middle of each cell, shape (rows, columns, 3)."""
    z = 1.0 - 2.0 * (np.arange(MAP_HEIGHT) + 0.5) / MAP_HEIGHT
    angle = np.radians(WEST + 360.0 * (np.arange(MAP_WIDTH) + 0.5) / MAP_WIDTH)
    radius = np.sqrt(1.0 - z**2)[:, None]
    flat = np.broadcast_to(z[:, None], (MAP_HEIGHT, MAP_WIDTH))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), flat], axis=-1)


CELLS = _cell_directions()


def draw_map(
    planned: Sequence[Sequence[float]],
    taken: Sequence[Sequence[float]],
    missing: Sequence[int],
    following: int | None,
    now: Sequence[float] | None,
    *,
    unicode: bool,
) -> list[Text]:
    """Return the sphere as MAP_HEIGHT lines, the axes beside and under them, and what the marks mean.

    Args:
        planned, taken: directions; missing: numbers of the planned ones that are to be taken yet.
        following: number of the one to take next; now: direction that is held, None when there is none.
        unicode: whether more than ASCII may be used.
    """
    marks = UNICODE if unicode else ASCII
    kinds = np.full((MAP_HEIGHT, MAP_WIDTH), "empty", dtype="<U8")
    if len(taken):
        near = (CELLS @ np.array(taken).T).max(axis=-1) >= math.cos(math.radians(NEAR))
        kinds[near] = "covered"
    for index in missing:
        kinds[map_cell(planned[index])] = "planned"
    for direction in taken:
        kinds[map_cell(direction)] = "taken"
    if following is not None:
        kinds[map_cell(planned[following])] = "next"
    if now is not None:
        kinds[map_cell(now)] = "now"
    sides = {0: "+z ", MAP_HEIGHT - 1: "-z "}
    lines = []
    for number, row in enumerate(kinds.tolist()):
        line = Text(sides.get(number, "   "))
        for kind, cells in groupby(enumerate(row), itemgetter(1)):
            columns = [column for column, _ in cells]
            mark = getattr(marks, kind)
            line.append(
                "".join(mark if kind != "empty" or c % 3 == 1 else " " for c in columns), STYLES[kind]
            )
        lines.append(line)
    lines.append(Text("   " + "".join(f"{face:^9}" for face in ("-y", "+x", "+y", "-x"))))
    legend = Text("   ")
    for kind, word in (("planned", "planned"), ("taken", "taken"), ("next", "next"), ("now", "held now")):
        legend.append(getattr(marks, kind), STYLES[kind]).append(f" {word}  ")
    return [*lines, legend]


@dataclass
class Canvas:
    """A picture of dots in characters; coordinates are -1 to 1, to the right and up."""

    width: int
    height: int
    braille: bool
    bits: list[list[int]] = field(init=False)
    letters: dict[tuple[int, int], str] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        """Begin with an empty picture."""
        self.bits = [[0] * self.width for _ in range(self.height)]

    def line(self, start: Sequence[float], end: Sequence[float]) -> None:
        """Draw a straight line."""
        steps = 2 * max(2 * self.width, 4 * self.height)
        for k in range(steps + 1):
            part = k / steps
            self.dot(start[0] + part * (end[0] - start[0]), start[1] + part * (end[1] - start[1]))

    def dot(self, x: float, y: float) -> None:
        """Draw a dot."""
        column = min(max(round((x + 1.0) / 2.0 * (2 * self.width - 1)), 0), 2 * self.width - 1)
        row = min(max(round((1.0 - y) / 2.0 * (4 * self.height - 1)), 0), 4 * self.height - 1)
        self.bits[row // 4][column // 2] |= DOTS[column % 2][row % 4]

    def write(self, x: float, y: float, text: str) -> None:
        """Write a text with its middle at a point, over the dots."""
        column = round((x + 1.0) / 2.0 * (self.width - 1) - (len(text) - 1) / 2.0)
        row = min(max(round((1.0 - y) / 2.0 * (self.height - 1)), 0), self.height - 1)
        for k, letter in enumerate(text):
            self.letters[row, min(max(column + k, 0), self.width - 1)] = letter

    def lines(self) -> list[str]:
        """Return the picture."""

        def cell(row: int, column: int) -> str:
            bits = self.bits[row][column]
            empty = chr(0x2800 + bits) if self.braille else "."
            return self.letters.get((row, column), empty if bits else " ")

        return ["".join(cell(row, column) for column in range(self.width)) for row in range(self.height)]


def attitude(direction: Sequence[float]) -> Float:
    """Return the rotation from body to world that holds a direction up, by the shortest way from z up, shape (3, 3)."""
    x, y, z = direction
    if z < -0.999999:
        return np.diag([1.0, -1.0, -1.0])
    v = np.array([y, -x, 0.0])  # the axis, as long as the sine of the angle
    skew = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1.0 + z))


AZIMUTH, ELEVATION, SIZE = math.radians(-65.0), math.radians(24.0), 0.54
"""From where a box is seen, and half of its edge."""


def _camera() -> Float:
    """Return the rows right, up and towards the eye, in the world, shape (3, 3)."""
    eye = np.array(
        [
            math.cos(ELEVATION) * math.cos(AZIMUTH),
            math.cos(ELEVATION) * math.sin(AZIMUTH),
            math.sin(ELEVATION),
        ]
    )
    right = np.cross([0.0, 0.0, 1.0], eye)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(eye, right), eye])


CAMERA = _camera()


@lru_cache(maxsize=2)  # the pose to take next stays for seconds
def draw_box(direction: tuple[float, float, float], *, unicode: bool) -> tuple[str, ...]:
    """Return a box that is held with a direction up: the edges and the names of the faces that one sees."""
    canvas = Canvas(BOX_WIDTH, BOX_HEIGHT, unicode)
    turn = CAMERA @ attitude(direction)  # from the body to the screen
    faces = [(axis, sign) for axis in range(3) for sign in (1.0, -1.0) if sign * turn[2, axis] > 0.05]
    corners = np.array(list(product((1.0, -1.0), repeat=3)))
    for one, other in combinations(corners, 2):
        if np.abs(one - other).sum() == 2.0 and any(
            one[axis] == sign and other[axis] == sign for axis, sign in faces
        ):
            canvas.line(SIZE * (turn @ one)[:2], SIZE * (turn @ other)[:2])
    for axis, sign in faces:
        x, y = SIZE * sign * turn[:2, axis]
        canvas.write(x, y, f"{'+' if sign > 0 else '-'}{AXES[axis]}")
    return tuple(canvas.lines())
