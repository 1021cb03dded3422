"""The floor under the wheels: how far from every surface its places are, and where it is slippery."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numba import njit

from mecanum_env.config import NoiseConfig
from slam.types import Array, Floats

if TYPE_CHECKING:
    from mecanum_env.rooms.floor_plan import FloorPlan

__all__ = ["Floor", "build_floor"]

_PATCH_RADIUS_M = (0.25, 0.8)


@dataclass(frozen=True, eq=False)
class Floor:
    """What a raster over the plan knows of the places a robot may come to."""

    friction: Floats  # (rows, cols) μ
    clearance: Floats  # (rows, cols) [m]: no surface is nearer to any point of the cell
    patches: Array  # (p, 4) slippery discs: x, y, radius [m], μ
    raster: Array  # (3,) world x, y of the lower-left corner, cells per metre


def build_floor(plan: FloorPlan, noise: NoiseConfig, rng: np.random.Generator) -> Floor:
    """Return the floor of a plan: its distance field, and slippery patches drawn until they cover their share.

    Parameters
    ----------
    plan
        The geometry; the raster is that of ``plan.free``, widened to hold every surface.
    noise
        ``friction``, ``patch_share``, ``patch_friction``.
    rng
        Four numbers are drawn a patch, none where the share is zero.
    """
    resolution = plan.resolution
    samples = _surface_samples(plan, 0.5 * resolution)
    origin = np.asarray(plan.origin, dtype=np.float64)
    rows, cols = plan.free.shape
    cells = np.floor((samples - origin) / resolution).astype(np.int64)  # (n, 2) column, row
    pad = 1
    if len(cells):
        pad += max(0, -int(cells.min()), int((cells - (cols - 1, rows - 1)).max()))
    empty = np.ones((rows + 2 * pad, cols + 2 * pad), np.uint8)
    empty[cells[:, 1] + pad, cells[:, 0] + pad] = 0
    if len(cells):
        distance = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    else:
        distance = np.full(empty.shape, 1e6, np.float32)
    # A surface point is within a quarter cell of a sample, a sample within half a diagonal of its cell's centre,
    # and so is the asking point: 0.25 + 2 · 0.7072 = 1.664 cells, and a bit for float32.
    clearance = np.maximum((distance - 1.68) * resolution, 0.0).astype(np.float32)
    raster = np.array([origin[0] - pad * resolution, origin[1] - pad * resolution, 1.0 / resolution])
    friction = np.full(empty.shape, noise.friction, np.float32)
    patches = _draw_patches(plan, noise, rng, friction[pad : pad + rows, pad : pad + cols])
    return Floor(friction, clearance, patches, raster)


def _surface_samples(plan: FloorPlan, spacing: float) -> Array:
    """Return points on every surface ``(n, 2)``, no further than ``spacing`` from the next."""
    parts = [_segment_samples(plan.segments, spacing)]
    for x, y, radius in plan.circles:
        angles = np.linspace(0.0, 2.0 * math.pi, max(8, math.ceil(2.0 * math.pi * radius / spacing) + 1))
        parts.append(np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)]))
    return np.vstack(parts)


@njit(cache=True, nogil=True, error_model="numpy")
def _segment_samples(segments: Array, spacing: float) -> Array:
    """Return points on segments ``(s, 4)``, both ends of each among them."""
    steps = np.empty(segments.shape[0], np.int64)
    for k in range(segments.shape[0]):
        x1, y1, x2, y2 = segments[k]
        steps[k] = max(1, math.ceil(math.hypot(x2 - x1, y2 - y1) / spacing))
    out = np.empty((steps.sum() + steps.shape[0], 2))
    n = 0
    for k in range(segments.shape[0]):
        x1, y1, x2, y2 = segments[k]
        for i in range(steps[k]):
            out[n, 0], out[n, 1] = x1 + i * ((x2 - x1) / steps[k]), y1 + i * ((y2 - y1) / steps[k])
            n += 1
        out[n, 0], out[n, 1] = x2, y2
        n += 1
    return out


def _draw_patches(plan: FloorPlan, noise: NoiseConfig, rng: np.random.Generator, friction: Floats) -> Array:
    """Draw slippery discs into ``friction`` until they cover their share of the free cells; return them."""
    rows, cols = plan.free.shape
    x0, y0 = plan.origin
    wanted = noise.patch_share * np.count_nonzero(plan.free)
    covered = np.zeros_like(plan.free)
    patches: list[tuple[float, float, float, float]] = []
    done = 0
    while done < wanted and len(patches) < 100_000:
        u = rng.random(4)
        x, y = x0 + u[0] * cols * plan.resolution, y0 + u[1] * rows * plan.resolution
        radius = _PATCH_RADIUS_M[0] + u[2] * (_PATCH_RADIUS_M[1] - _PATCH_RADIUS_M[0])
        mu = noise.patch_friction[0] + u[3] * (noise.patch_friction[1] - noise.patch_friction[0])
        patches.append((x, y, radius, mu))
        j0, j1 = (int(np.clip((x - x0 + d) / plan.resolution, 0, cols)) for d in (-radius, radius))
        i0, i1 = (int(np.clip((y - y0 + d) / plan.resolution, 0, rows)) for d in (-radius, radius))
        cx = x0 + (np.arange(j0, j1) + 0.5) * plan.resolution - x
        cy = y0 + (np.arange(i0, i1) + 0.5) * plan.resolution - y
        disc = cx**2 + cy[:, None] ** 2 <= radius**2
        window = friction[i0:i1, j0:j1]
        window[disc] = np.minimum(window[disc], np.float32(mu))
        fresh = disc & plan.free[i0:i1, j0:j1] & ~covered[i0:i1, j0:j1]
        covered[i0:i1, j0:j1] |= disc
        done += int(np.count_nonzero(fresh))
    return np.array(patches).reshape(-1, 4)
