"""Draw floor plans that are like no building the robot was developed on (``python examples/draw_floors.py DIR``).

Nine of 380 to 1860 m², as ROS maps (PGM and YAML, cells of 0.05 m): rings and winding corridors whose walls curve,
honeycombs and rooms at any angle, halls with columns, shelves, furniture. ``mecanum benchmark --floor-plans DIR``
explores them; a plan of your own is drawn like these.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

CELL_M = 0.05
SHIFT = 4  # fractional bits of the coordinates that OpenCV draws at
THICK_M, DOOR_M = 0.15, 1.1
YAML = """image: {}.pgm
resolution: {}
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def at(x: float, y: float) -> tuple[int, int]:
    """Return a point [m] as OpenCV takes it."""
    return round(x / CELL_M * 2**SHIFT), round(y / CELL_M * 2**SHIFT)


class Floor:
    """What is inside, and the walls in it, both as images; lengths in metres."""

    def __init__(self, width: float, height: float, *, room: bool = False) -> None:
        """Begin with nothing, or with one room as large as the image, but for a metre to all sides."""
        shape = int(height / CELL_M), int(width / CELL_M)
        self.inside, self.walls = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        if room:
            cv2.rectangle(self.inside, at(1, 1), at(width - 1, height - 1), 1, -1, cv2.LINE_8, SHIFT)
            self.box(1, 1, width - 1, height - 1)

    def wall(self, *points: tuple[float, float]) -> None:
        """Draw walls from each point to the next."""
        for p, q in pairwise(points):
            cv2.line(self.walls, at(*p), at(*q), 1, int(THICK_M / CELL_M), cv2.LINE_8, SHIFT)

    def box(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Draw four walls."""
        self.wall((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))

    def block(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Draw something solid."""
        cv2.rectangle(self.walls, at(x0, y0), at(x1, y1), 1, -1, cv2.LINE_8, SHIFT)

    def door(self, x: float, y: float, width: float = DOOR_M) -> None:
        """Take the walls away round a point."""
        cv2.circle(self.walls, at(x, y), int(width / 2 / CELL_M * 2**SHIFT), 0, -1, cv2.LINE_8, SHIFT)

    def opening(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Take the walls away in a rectangle."""
        cv2.rectangle(self.walls, at(x0, y0), at(x1, y1), 0, -1, cv2.LINE_8, SHIFT)

    def save(self, path: Path, *, closed: bool) -> None:
        """Write the largest part that hangs together; ``closed``: all round it is a wall, drawn or not."""
        free = (self.inside & ~self.walls & 1).astype(np.uint8)
        _, label = cv2.connectedComponents(free, connectivity=4)
        free = label == np.argmax(np.bincount(label[label > 0]))
        wall = self.walls.astype(bool)
        if closed:
            wall = cv2.dilate(free.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool) & ~free
        image = np.full(free.shape, 205, np.uint8)
        image[free], image[wall] = 254, 0
        cv2.imwrite(str(path.with_suffix(".pgm")), image)
        path.with_suffix(".yaml").write_text(YAML.format(path.name, CELL_M))


def ring(_: np.random.Generator) -> Floor:
    """Draw a corridor that goes round, with rooms to both sides."""
    floor, centre, radii = Floor(46, 46), (23.0, 23.0), (8.0, 13.9, 16.3, 22.0)
    for radius, value in ((22.0, 1), (8.0, 0)):
        cv2.circle(floor.inside, at(*centre), int(radius / CELL_M * 2**SHIFT), value, -1, cv2.LINE_8, SHIFT)
    for radius in radii:
        cv2.circle(floor.walls, at(*centre), int(radius / CELL_M * 2**SHIFT), 1, 3, cv2.LINE_8, SHIFT)

    def on(radius: float, turn: float) -> tuple[float, float]:
        return centre[0] + radius * math.cos(turn), centre[1] + radius * math.sin(turn)

    turns = 2 * math.pi * np.arange(14) / 14
    for k, turn in enumerate(turns):
        floor.wall(on(16.3, turn), on(22, turn))
        if k % 2 == 0:
            floor.wall(on(8, turn), on(13.9, turn))
    for k, turn in enumerate(turns + 2 * math.pi * 0.4 / 14):
        for radius in (16.3, 13.9) if k % 2 == 0 else (16.3,):
            for along in np.linspace(turn, turn + DOOR_M / radius, 40):
                floor.door(*on(radius, along), 0.5)
    return floor


def honeycomb(_: np.random.Generator) -> Floor:
    """Draw rooms with six walls each, some of which have doors."""
    floor, side, rng = Floor(40, 32), 3.2, np.random.default_rng(5)
    centres = [
        (4 + i * 1.5 * side, 4 + j * math.sqrt(3) * side + (i % 2) * math.sqrt(3) * side / 2)
        for i in range(6)
        for j in range(5)
    ]
    for x, y in centres:
        ends = [(x + side * math.cos(k * math.pi / 3), y + side * math.sin(k * math.pi / 3)) for k in range(7)]
        cv2.fillPoly(floor.inside, [np.array([at(*p) for p in ends[:6]], np.int32)], 1, cv2.LINE_8, SHIFT)
        floor.wall(*ends)
    for a, p in enumerate(np.array(centres)):
        for q in np.array(centres)[:a]:
            if math.hypot(*(p - q)) < math.sqrt(3) * side + 0.1 and rng.random() < 0.6:
                floor.door(*(p + q) / 2)
    return floor


def atrium(_: np.random.Generator) -> Floor:
    """Draw a hall with columns and a pool, and rooms all round it."""
    floor = Floor(44, 34, room=True)
    floor.box(7, 7, 37, 27)
    for x in np.arange(7, 43, 5.2):
        floor.wall((x, 1), (x, 7))
        floor.wall((x, 27), (x, 33))
    for y in np.arange(7, 30, 5):
        floor.wall((1, y), (7, y))
        floor.wall((37, y), (43, y))
    doors = [(x, y) for x in np.arange(9.2, 37, 5.2) for y in (7, 27)]
    doors += [(x, y) for y in np.arange(9.5, 27, 5) for x in (7, 37)]
    doors += [(4, 7), (40, 7), (4, 27), (40, 27), (7, 4), (37, 4), (7, 30), (37, 30)]
    for door in doors:
        floor.door(*door)
    for x in np.arange(11, 36, 6):
        for y in (12, 22):
            cv2.circle(floor.walls, at(x, y), int(0.3 / CELL_M * 2**SHIFT), 1, -1, cv2.LINE_8, SHIFT)
    axes = int(4 / CELL_M * 2**SHIFT), int(2 / CELL_M * 2**SHIFT)
    cv2.ellipse(floor.walls, at(22, 17), axes, 0, 0, 360, 1, -1, cv2.LINE_8, SHIFT)
    return floor


def winding(_: np.random.Generator) -> Floor:
    """Draw a corridor that bends one way and then the other, with rooms to both sides."""
    floor, x = Floor(60, 24), np.linspace(2, 58, 400)
    y = 12 + 6 * np.sin(2 * np.pi * (x - 2) / 28)
    slope = np.gradient(y, x)
    way = np.array([at(*p) for p in zip(x, y, strict=True)], np.int32)
    cv2.polylines(floor.inside, [way], False, 1, int(2.4 / CELL_M), cv2.LINE_8, SHIFT)
    for k in range(20, 400, 40):
        side, turn = 1 if (k // 40) % 2 else -1, np.arctan2(slope[k], 1)
        centre = x[k] - np.sin(turn) * side * 4.0, y[k] + np.cos(turn) * side * 4.0
        room = (centre[0] / CELL_M, centre[1] / CELL_M), (4.5 / CELL_M, 4 / CELL_M), np.degrees(turn)
        cv2.fillPoly(floor.inside, [cv2.boxPoints(room).astype(np.int32)], 1)
        cv2.line(floor.inside, at(x[k], y[k]), at(*centre), 1, int(1.0 / CELL_M), cv2.LINE_8, SHIFT)
    floor.walls = cv2.dilate(floor.inside, np.ones((5, 5), np.uint8)) & ~floor.inside & 1
    return floor


def warehouse(_: np.random.Generator) -> Floor:
    """Draw two rows of shelves."""
    floor = Floor(50, 36, room=True)
    for x in np.arange(5, 46, 3.2):
        floor.block(x, 5, x + 1, 15.5)
        floor.block(x, 18.5, x + 1, 31)
    return floor


def corridor(_: np.random.Generator) -> Floor:
    """Draw sixty-eight metres of corridor, and seven large rooms."""
    floor = Floor(70, 16, room=True)
    for y in (7, 9):
        floor.wall((1, y), (69, y))
    for x, y0, y1 in ((12, 1, 7), (40, 1, 7), (69, 1, 7), (25, 9, 15), (60, 9, 15)):
        floor.wall((x, y0), (x, y1))
    for x, y in ((5, 7), (35, 7), (62, 7), (20, 9), (64, 9), (45, 9)):
        floor.opening(x - 0.5, y - 0.2, x + 0.5, y + 0.2)
    return floor


def garage(_: np.random.Generator) -> Floor:
    """Draw a hall of 60 by 32 m with a pillar every six."""
    floor = Floor(62, 34, room=True)
    for x in np.arange(7, 60, 6):
        for y in np.arange(6, 32, 5):
            floor.block(x, y, x + 0.4, y + 0.4)
    floor.block(28, 14, 34, 20)
    return floor


def any_angle(rng: np.random.Generator) -> Floor:
    """Draw rooms with walls at any angle: the Voronoi cells of points that lie evenly."""
    floor, points = Floor(44, 34, room=True), rng.uniform([3, 3], [41, 31], (26, 2))
    place = np.stack(np.meshgrid(np.linspace(1, 43, 210), np.linspace(1, 33, 160)), -1)
    for _ in range(12):  # Lloyd's iteration
        nearest = np.argmin(((place[..., None, :] - points) ** 2).sum(-1), -1)
        points = np.array([place[nearest == k].mean(0) for k in range(len(points))])
    cells = cv2.Subdiv2D((0, 0, 44, 34))
    for x, y in points:
        cells.insert((float(x), float(y)))
    sides: dict[tuple[tuple[float, float], ...], int] = {}
    for cell in cells.getVoronoiFacetList([])[0]:
        for p, q in zip(cell, np.roll(cell, -1, axis=0), strict=True):
            side = tuple(sorted((tuple(np.round(p, 3)), tuple(np.round(q, 3)))))
            sides[side] = sides.get(side, 0) + 1
    for p, q in sides:
        floor.wall(tuple(np.clip(p, 1, [43, 33])), tuple(np.clip(q, 1, [43, 33])))
    for (p, q), rooms in sides.items():
        if rooms == 2 and np.hypot(*(np.array(p) - q)) > 2.5 and rng.random() < 0.7:
            floor.door(*(np.array(p) + q) / 2, 1.2)
    return floor


def furnished(rng: np.random.Generator) -> Floor:
    """Draw offices along a corridor, with furniture that stands as it pleases."""
    floor = Floor(40, 26, room=True)
    for y in (11.5, 14):
        floor.wall((1, y), (39, y))
    for x in np.arange(7, 38, 6.4):
        floor.wall((x, 1), (x, 11.5))
        floor.wall((x - 2, 14), (x - 2, 25))
    for x in np.arange(3.5, 39, 6.4):
        floor.opening(x, 11.2, x + 1, 11.8)
    for x in np.arange(2.5, 39, 6.4):
        floor.opening(x, 13.7, x + 1, 14.3)
    for _ in range(45):
        x, y = rng.uniform([2, 2], [38, 24])
        if 10 < y < 15.5:
            continue
        size, turn = tuple(rng.uniform(0.5, 1.6, 2) / CELL_M), float(rng.uniform(0, 90))
        cv2.fillPoly(floor.walls, [cv2.boxPoints(((x / CELL_M, y / CELL_M), size, turn)).astype(np.int32)], 1)
    return floor


FLOORS: dict[str, Callable[[np.random.Generator], Floor]] = {
    "ring": ring, "winding": winding, "atrium": atrium, "honeycomb": honeycomb, "warehouse": warehouse,
    "corridor": corridor, "garage": garage, "any_angle": any_angle, "furnished": furnished,
}  # fmt: skip
CLOSED = "corridor", "garage", "any_angle", "furnished"


def main(folder: Path) -> None:
    """Write the plans."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(8)
    for name, draw in FLOORS.items():
        draw(rng).save(folder / name, closed=name in CLOSED)
    print(f"{len(FLOORS)} plans in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/floors"))
