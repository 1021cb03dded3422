"""Corridor systems, as in a building's cavities: nothing to see but the corners where corridors cross."""

from __future__ import annotations

import math

import numpy as np

from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.rooms.layout.assembly import generator
from mecanum_env.rooms.layout.corridor_layout import (
    PAPER_D,
    Corridor,
    CorridorsConfig,
    Sizes,
    draw_layout,
    sizes_of,
)
from mecanum_env.rooms.outlines.rectilinear import raster, surfaces

__all__ = ["PAPER_D", "CorridorsConfig", "corridors"]

_MARGIN_M = 0.2  # solid around the corridors
_HEADINGS = ((0.0, -math.pi), (0.5 * math.pi, -0.5 * math.pi))  # along x, along y


def corridors(config: CorridorsConfig, *, seed: int) -> FloorPlan:
    """Return the corridors of a seed: the same ones every time.

    Raises
    ------
    ValueError
        If no network of the config's lengths was found.
    """
    rng = generator(seed)
    sizes = sizes_of(config)
    network = draw_layout(config, rng)
    start = _choose_start(network, sizes, rng)
    boxes = np.array([c.box(sizes.half) for c in network], np.int64)
    margin = round(_MARGIN_M / sizes.cell_m)
    shift = margin - boxes[:, :2].min(axis=0)
    boxes += np.tile(shift, 2)
    cols, rows = boxes[:, 2:].max(axis=0) + margin
    x, y = ((v + d) * sizes.cell_m for v, d in zip(start[:2], shift.tolist(), strict=True))
    kind = "corridors" if config.map is None else f"corridors-map{config.map}"
    return FloorPlan(
        name=f"{kind}-{seed}",
        walls=np.round(surfaces(boxes) * sizes.cell_m, 6),
        free=raster(boxes, (cols, rows)),
        resolution=sizes.cell_m,
        start=(round(x, 6), round(y, 6), start[2]),
        # Half a cell off the centre line, less what the coordinates are rounded by.
        start_clearance_m=(sizes.half - 0.5) * sizes.cell_m - 1e-5,
    )


def _choose_start(network: list[Corridor], sizes: Sizes, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a random pose x, y [cells], θ [rad] on a centre line, heading along it.

    It is the centre of a cell beside the line: then the lattice of the map, which begins here, does not have the
    walls right between its cells.
    """
    ends = np.cumsum([c.length for c in network])
    at = int(rng.integers(int(ends[-1])))
    index = int(np.searchsorted(ends, at, side="right"))
    corridor = network[index]
    along = corridor.high - (int(ends[index]) - at) + 0.5
    across = corridor.line + (0.5 if rng.random() < 0.5 else -0.5)
    x, y = (across, along) if corridor.upright else (along, across)
    return x, y, _HEADINGS[corridor.upright][int(rng.integers(2))]
