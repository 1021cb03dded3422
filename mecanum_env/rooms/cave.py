"""Caves: chambers joined by winding passages, with curved walls and hardly a corner to hold on to."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from mecanum_env.rooms.floor_plan import FloorPlan, clearance_of
from mecanum_env.rooms.layout.assembly import START_M, choose_start, generator, unreached
from mecanum_env.rooms.layout.furniture import CELL_M
from mecanum_env.rooms.outlines.distance import distance_to_zero, largest_part
from mecanum_env.rooms.outlines.smooth_outline import facets, level_loops, rasterise, signed_area
from slam.settings import Config, Share, Span, require
from slam.types import Array, Bytes, Flags, Floats

__all__ = ["CaveConfig", "cave"]

Field = Floats  # single precision: a quarter of a million cells, and half a hundred passes over them

_ATTEMPTS = 60
_AREA_WIDTH = 1.05  # of area_m2: its upper limit by the lower, at least
_MARGIN_M = 0.2  # solid around the cave
_BOX = 1.6  # area of the box that the chambers' centres are placed in, by that of the cave
_SHARE = 0.55  # of the cave that is chambers, about; the rest is passages
_AROUND_M = 3.0  # rock around that box, more about large chambers …
_BORDER_M = 1.0  # … of which this much stays
_BEND = 0.16  # standard deviation of a passage's sideways bend, by its length
_CORE_M = 0.65  # half the width of a passage that no noise closes
_BLEND_PER_M = 5.0  # how sharply chambers and passages meet: 1 / radius of the fillet, about
_DISC_M = 0.6  # rolls through the whole cave: the walls bend around it where they are hollow
_ROLLS = 2
_TIP_M = 0.4  # rolls through the rock: what is thinner than twice that is gone
_LEAST_ROCK_M2 = 0.5  # a smaller lump of rock in the way is left out: the pillars are for that
_BLUR_CELLS, _SMOOTH_M = 4.0, 0.25  # of the field and along the walls
_PILLAR_M = (0.15, 0.4)  # radius
_PILLAR_GAP_M = 0.95  # between a pillar and everything else


@dataclass(frozen=True, kw_only=True)
class CaveConfig(Config):
    """Limits between which a cave is drawn, by seed."""

    area_m2: Annotated[tuple[float, float], Span("[30, 300]")] = (60.0, 150.0)  # free floor
    chamber_m: Annotated[tuple[float, float], Span("[1, 4]")] = (1.2, 2.3)  # radius of a chamber
    # Width of a passage, before the noise.
    passage_m: Annotated[tuple[float, float], Span("[1.3, 4]")] = (1.4, 2.2)
    loops: Share = 0.6  # probability of a passage beyond those that join every chamber
    roughness: Share = 0.5  # 0 smooth ovals and tubes, 1 as ragged as can be
    pillars: Annotated[tuple[int, int], Span("[0, 10]")] = (0, 3)

    def __post_init__(self) -> None:
        super().__post_init__()
        least, most = self.area_m2
        # Of 5 % width 11 of 12 intervals are met; a narrower one would cost seconds of drawing before this advice.
        require(most >= _AREA_WIDTH * least, f"CaveConfig.area_m2 needs most ≥ {_AREA_WIDTH} · least, got "
                                             f"{self.area_m2}; widen it")  # fmt: skip


def cave(config: CaveConfig, *, seed: int) -> FloorPlan:
    """Return the cave of a seed: the same one every time.

    Raises
    ------
    ValueError
        If 60 attempts give no cave within the limits of the config.
    """
    rng = generator(seed)
    low, high = config.area_m2
    target = float(rng.uniform(low, high))
    scale = 1.0  # of what is asked for, to come nearer with each attempt
    for _ in range(_ATTEMPTS):
        field = _drivable(_draw_rock(config, target * scale, rng))
        if field is None:
            continue
        area = float(np.count_nonzero(field > 0)) * CELL_M**2
        if not low <= area <= high:
            scale *= min(max(math.sqrt(target / area), 0.8), 1.25)
            continue
        plan = _plan(field, config, seed, rng)
        if plan is not None:
            return plan
    raise ValueError(f"no cave of {config.area_m2} m² found; widen area_m2 or make chamber_m smaller")


def _plan(field: Array, config: CaveConfig, seed: int, rng: np.random.Generator) -> FloorPlan | None:
    """Return the plan of a smooth field, None where it does not keep to what it must."""
    walls, size = _walls(field)
    floor = rasterise(walls, size, CELL_M)
    pillars = _pillars(floor, config, rng)
    free = floor & ~_under(pillars, size)
    clearance = clearance_of(free, CELL_M)
    reach, pocket = unreached(free, clearance)
    area = float(np.count_nonzero(free)) * CELL_M**2
    low, high = config.area_m2
    if pocket is not None or not low <= area <= high or clearance[reach].max() < START_M + CELL_M:
        return None
    plan = FloorPlan(
        name=f"cave-{seed}",
        walls=walls,
        circles=pillars,
        free=free,
        resolution=CELL_M,
        start=choose_start(clearance, reach, rng),
        start_clearance_m=START_M,
    )
    # Where rock came out very thin, or pieces much shorter than a cell, there may be a corner after all.
    return None if len(plan.corners) else plan


def _draw_rock(config: CaveConfig, area_m2: float, rng: np.random.Generator) -> Field:
    """Return a field ``(rows, cols)`` [m]: about how far the next wall is, negative in the rock."""
    aspect = float(rng.uniform(0.7, 1.4))
    width, depth = (math.sqrt(_BOX * area_m2 * a) for a in (aspect, 1.0 / aspect))
    mean = 0.5 * sum(config.chamber_m)
    count = max(2, round(_SHARE * area_m2 / (math.pi * mean**2)))
    radii = rng.uniform(*config.chamber_m, count)
    around = max(_AROUND_M, 1.3 * config.chamber_m[1])
    centres = _spread(count, (width, depth), rng) + around
    cols, rows = (math.ceil((v + 2 * around) / CELL_M) for v in (width, depth))
    x, y = ((np.arange(n, dtype=np.float32) + np.float32(0.5)) * np.float32(CELL_M) for n in (cols, rows))
    y = y[:, None]
    total = np.full((rows, cols), 1e-9, np.float32)
    for (cx, cy), radius in zip(centres.tolist(), radii.tolist(), strict=True):
        turn, stretch = float(rng.uniform(0.0, math.pi)), float(rng.uniform(1.0, 1.35))
        c, s = math.cos(turn), math.sin(turn)
        u, v = (c * (x - cx) + s * (y - cy)) / stretch, (c * (y - cy) - s * (x - cx)) * stretch
        total += np.exp(_BLEND_PER_M * (radius - np.sqrt(u * u + v * v)))
    core = np.full((rows, cols), -np.inf, np.float32)
    for a, b in _passages(centres, config.loops, rng):
        distance = _distance_to_line(_bent(centres[a], centres[b], rng), (rows, cols))
        total += np.exp(_BLEND_PER_M * (0.5 * float(rng.uniform(*config.passage_m)) - distance))
        core = np.maximum(core, _CORE_M - distance)
    field = np.log(total) / _BLEND_PER_M
    for spacing_m, height in ((1.8, 0.8), (0.9, 0.3)):
        field += config.roughness * height * _noise((rows, cols), spacing_m, rng)
    border = np.minimum(np.minimum(x, x[-1] - x), np.minimum(y, y[-1] - y))
    return np.asarray(np.minimum(np.maximum(field, core), border - _BORDER_M), np.float32)


def _spread(count: int, size: tuple[float, float], rng: np.random.Generator) -> Array:
    """Return points ``(count, 2)`` [m] in a box, each the farthest of some random ones from those before."""
    points = rng.uniform(0.0, size)[None]
    for _ in range(count - 1):
        offers = rng.uniform(0.0, size, (10, 2))
        gaps = np.sqrt(((offers[:, None] - points[None]) ** 2).sum(axis=2)).min(axis=1)
        points = np.vstack([points, offers[int(np.argmax(gaps))]])
    return points


def _passages(centres: Array, loops: float, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Return which chambers are joined: all, by the shortest passages, and some more neighbours."""
    squared = ((centres[:, None] - centres[None]) ** 2).sum(axis=2)
    pairs = sorted(itertools.combinations(range(len(centres)), 2), key=lambda p: float(squared[p]))
    group = list(range(len(centres)))
    joined: list[tuple[int, int]] = []
    for a, b in pairs:
        # Neighbours (Gabriel's): no third chamber within the circle over the line between the two.
        neighbours = all(squared[a, k] + squared[b, k] >= squared[a, b] for k in range(len(centres)))
        if group[a] != group[b]:
            group = [group[a] if g == group[b] else g for g in group]
            joined.append((a, b))
        elif neighbours and rng.random() < loops:
            joined.append((a, b))
    return joined


def _bent(a: Array, b: Array, rng: np.random.Generator) -> Array:
    """Return points ``(k, 2)`` [m] along a bent line between two places."""
    along = b - a
    aside = np.array([-along[1], along[0]])
    sway = np.clip(rng.normal(0.0, _BEND, 2), -2 * _BEND, 2 * _BEND)
    t = np.linspace(0.0, 1.0, 24)[:, None]
    return np.asarray(a + t * along + (sway[0] * np.sin(math.pi * t) + sway[1] * np.sin(2 * math.pi * t)) * aside)


def _distance_to_line(points: Array, shape: tuple[int, int]) -> Field:
    """Return each cell's distance [m] ``shape`` to a line through points."""
    canvas = np.ones(shape, np.uint8)
    pixels = np.floor(points / CELL_M).astype(np.int32)
    cv2.polylines(canvas, [pixels[:, None]], False, 0, 1, cv2.LINE_8)
    return _distance(canvas)


def _noise(shape: tuple[int, int], spacing_m: float, rng: np.random.Generator) -> Field:
    """Return smooth noise of unit variance at its nodes, which are ``spacing_m`` apart."""
    rows, cols = (math.ceil(n * CELL_M / spacing_m) + 1 for n in shape)
    nodes = rng.standard_normal((rows, cols)).astype(np.float32)
    return np.asarray(cv2.resize(nodes, shape[::-1], interpolation=cv2.INTER_CUBIC), np.float32)


def _drivable(field: Field) -> Array | None:
    """Return a smooth field for the part of a cave that a disc can roll through, None where it fits nowhere."""
    free = np.asarray(field > 0, np.bool_)
    for _ in range(_ROLLS):
        rolled = _rolled(free)
        if rolled is None:
            return None
        # The same from the other side takes off the rock's tips and thin walls; it may open narrow gaps anew.
        rock = _distance(~rolled) > _TIP_M
        free = np.asarray(_distance(~rock) > _TIP_M)
    signed = _distance(free) - _distance(~free)
    return np.asarray(cv2.GaussianBlur(signed, (0, 0), _BLUR_CELLS), np.float64)


def _rolled(free: Flags) -> Flags | None:
    """Return what a disc sweeps that rolls through the largest part of free space it can."""
    reach = largest_part(clearance_of(free, CELL_M) >= _DISC_M)
    return None if reach is None else np.asarray(_distance(~reach) <= _DISC_M)


def _distance(mask: Flags | Bytes) -> Field:
    """Return how far [m] each cell of a mask is from the nearest one that is not of it."""
    return np.asarray(distance_to_zero(mask) * CELL_M, np.float32)


def _walls(field: Array) -> tuple[Array, tuple[int, int]]:
    """Return walls ``(n, 4)`` [m] where a field is zero, and columns and rows of the raster around them."""
    lines = level_loops(field, CELL_M, smooth_m=_SMOOTH_M)
    loops = [facets(line) for line in lines if abs(signed_area(line)) >= _LEAST_ROCK_M2]
    points = np.vstack(loops)
    # By whole cells: the field's lattice becomes the plan's.
    shift = np.floor((points.min(axis=0) - _MARGIN_M) / CELL_M) * CELL_M
    size = np.ceil((points.max(axis=0) + _MARGIN_M - shift) / CELL_M).astype(np.int64)
    loops = [np.round(loop - shift, 6) for loop in loops]
    walls = np.vstack([np.hstack([loop, np.roll(loop, -1, axis=0)]) for loop in loops])
    return walls, (int(size[0]), int(size[1]))


def _pillars(free: Flags, config: CaveConfig, rng: np.random.Generator) -> Array:
    """Return round pillars ``(n, 3)``: x, y, radius [m], that can be driven around."""
    pillars = np.zeros((0, 3))
    for _ in range(int(rng.integers(config.pillars[0], config.pillars[1] + 1))):
        radius = float(rng.uniform(*_PILLAR_M))
        clearance = clearance_of(free & ~_under(pillars, free.shape[::-1]), CELL_M)
        places = np.flatnonzero(clearance >= radius + _PILLAR_GAP_M)
        if places.size:
            row, col = divmod(int(places[int(rng.integers(places.size))]), free.shape[1])
            pillar = ((col + 0.5) * CELL_M, (row + 0.5) * CELL_M, radius)
            pillars = np.round(np.vstack([pillars, pillar]), 6)
    return pillars


def _under(pillars: Array, size: tuple[int, int]) -> Flags:
    """Cells whose centres pillars stand on."""
    x, y = (np.arange(n) + 0.5 for n in size)
    mask = np.zeros(size[::-1], np.bool_)
    for px, py, radius in pillars:
        mask |= (x * CELL_M - px) ** 2 + (y[:, None] * CELL_M - py) ** 2 <= radius**2
    return mask
