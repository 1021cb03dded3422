"""A scan held against the patches in reach: point to line, each beam against one patch, with what that tells.

Iterated closest points with the distance to the surface's line (Chen and Medioni 1992; Censi 2008), robust by
Geman and McClure's loss. What the beams on one patch tell about the pose relative to it is kept apart from what
the others do, as a quadratic form with the information of the beams' own noise alone: the error of the patch is
the patch's, and is shared by every scan that is held against it. Along a wall the form is flat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.graph.surfaces import BeamEnds
from slam.types import Array, Indices

__all__ = ["Alignment", "Links", "SurfaceMap", "align", "lasting", "links"]

_CELL_M = 0.25
_SLACK_M = 0.03  # by which a beam may end beyond a surface point's own reach
_REF_VAR = 0.004**2  # [m²] of a patch's own error, as far as weights of the alignment go
_LEAST_COS = 0.8  # between a beam's normal and that of the surface it is held against


class SurfaceMap:
    """Surface points of several patches in one frame, in buckets.

    Attributes
    ----------
    points, normals : Array
        ``(m, 2)`` [m] in the map's frame.
    reach : Array
        ``(m,)`` [m] along the surface to either side that a point stands for.
    patch : Indices
        ``(m,)`` number of the patch.
    """

    def __init__(self, points: Array, normals: Array, reach: Array, patch: Indices) -> None:
        self.points, self.normals, self.reach, self.patch = points, normals, reach, patch
        low = points.min(axis=0) - _CELL_M if len(points) else np.zeros(2)
        high = points.max(axis=0) + _CELL_M if len(points) else np.zeros(2)
        self.x0, self.y0 = (float(v) for v in low)
        self.cols, self.rows = (int(v) + 1 for v in np.ceil((high - low) / _CELL_M))
        self.starts, self.items = _buckets(points, self.x0, self.y0, self.rows, self.cols)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where a scan fits the surface map."""

    pose: Array  # (3,)
    beside: Indices  # (n,) the surface point each beam is held against, or -1
    share: float  # of the beams that are held against one
    in_sight: float  # of those beams that a surface point is near, the share that agrees with it


@dataclass(frozen=True, slots=True)
class Links:
    """What an aligned scan tells about its pose relative to each patch that it saw: ½(d-z)ᵀH(d-z) + gᵀ(d-z)."""

    patches: Indices  # (g,) numbers
    relative: Array  # (g, 3) z: the scan's pose as seen from the patch's frame
    info: Array  # (g, 3, 3) H
    gradient: Array  # (g, 3)


def align(
    surfaces: SurfaceMap, ends: BeamEnds, start: Array, *, prior: Array, prior_info: Array, gate_m: float,
    iterations: int = 10,
) -> Alignment:  # fmt: skip
    """Return where a scan fits best near ``start`` ``(3,)``, given a prior pose ``(3,)`` with its information.

    ``gate_m`` is how far from its surface a beam's end may be at first; it shrinks.
    """
    pose = np.array(start, np.float64)
    beside = np.full(len(ends), -1, np.int64)
    counts = np.zeros(2)
    _align(
        surfaces.points, surfaces.normals, surfaces.reach, surfaces.x0, surfaces.y0, surfaces.rows, surfaces.cols,
        surfaces.starts, surfaces.items, ends.points, ends.normals, ends.var, pose, prior, np.asarray(prior_info),
        gate_m, iterations, beside, counts,
    )  # fmt: skip
    n = max(len(ends), 1)
    return Alignment(pose, beside, counts[0] / n, counts[0] / max(counts[1], 1.0))


def links(surfaces: SurfaceMap, ends: BeamEnds, found: Alignment, frames: Array, common_var: Array) -> Links:
    """Return what an alignment tells of the pose relative to each patch.

    Parameters
    ----------
    frames : Array
        ``(p, 3)`` the patches' frames, by number, as the surface map was made with.
    common_var : Array
        ``(p,)`` [m²] of what the beams of one scan on one patch have in common: the model's own error.
    """
    count = len(frames)
    relative, info, gradient = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3))
    beams = np.zeros(count, np.int64)
    _links(
        surfaces.points, surfaces.normals, surfaces.patch, ends.points, ends.var, found.pose, found.beside, frames,
        common_var, relative, info, gradient, beams,
    )  # fmt: skip
    seen = np.flatnonzero(beams > 0)
    return Links(seen, relative[seen], info[seen], gradient[seen])


def lasting(way_m: float, turn_rad: float, *, key_m: float, key_rad: float, most: float) -> float:
    """Return by how much the model's error counts more because it is still that of a scan so far away.

    It changes with the place that a surface is seen from: looking twice from one place tells no more of it.
    """
    apart = way_m / key_m + abs(turn_rad) / key_rad
    return min(max(1.0 / max(apart, 1e-3), 1.0), most)


@njit(cache=True, nogil=True, error_model="numpy")
def _buckets(points: Array, x0: float, y0: float, rows: int, cols: int) -> tuple[Indices, Indices]:
    m = points.shape[0]
    starts, items = np.zeros(rows * cols + 1, np.int64), np.empty(m, np.int64)
    cell = np.empty(m, np.int64)
    for k in range(m):
        col, row = int((points[k, 0] - x0) / _CELL_M), int((points[k, 1] - y0) / _CELL_M)
        cell[k] = row * cols + col
        starts[cell[k] + 1] += 1
    for c in range(rows * cols):
        starts[c + 1] += starts[c]
    filled = starts[:-1].copy()
    for k in range(m):
        items[filled[cell[k]]] = k
        filled[cell[k]] += 1
    return starts, items


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _robust(e: float, var: float) -> float:
    """Return Geman and McClure's weight of a residual."""
    q = 1.0 + e * e / (9.0 * var)
    return 1.0 / (q * q)


@njit(cache=True, nogil=True, error_model="numpy")
def _align(
    points: Array, normals: Array, reach: Array, x0: float, y0: float, rows: int, cols: int, starts: Indices,
    items: Indices, ends: Array, end_normals: Array, var: Array, pose: Array, guess: Array,
    prior_info: Array, gate_m: float, iterations: int, beside: Indices, counts: Array,
) -> None:  # fmt: skip
    h, g, step = np.empty((3, 3)), np.empty(3), np.empty(3)
    gate = gate_m
    for iteration in range(iterations + 1):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        d0, d1, d2 = pose[0] - guess[0], pose[1] - guess[1], wrap_scalar(pose[2] - guess[2])
        for a in range(3):
            g[a] = prior_info[a, 0] * d0 + prior_info[a, 1] * d1 + prior_info[a, 2] * d2
            for b in range(3):
                h[a, b] = prior_info[a, b]
        held = near = 0.0
        for k in range(ends.shape[0]):
            rx, ry = c * ends[k, 0] - s * ends[k, 1], s * ends[k, 0] + c * ends[k, 1]
            x, y = pose[0] + rx, pose[1] + ry
            nx, ny = c * end_normals[k, 0] - s * end_normals[k, 1], s * end_normals[k, 0] + c * end_normals[k, 1]
            col, row = math.floor((x - x0) / _CELL_M), math.floor((y - y0) / _CELL_M)
            best, least, close = -1, 1e9, False
            for i in range(max(row - 1, 0), min(row + 2, rows)):
                first, last = max(col - 1, 0), min(col + 1, cols - 1)
                if first > last:
                    continue
                for at in range(starts[i * cols + first], starts[i * cols + last + 1]):
                    j = items[at]
                    if normals[j, 0] * nx + normals[j, 1] * ny < _LEAST_COS:
                        continue
                    dx, dy = x - points[j, 0], y - points[j, 1]
                    e = normals[j, 0] * dx + normals[j, 1] * dy
                    t = abs(normals[j, 0] * dy - normals[j, 1] * dx)
                    if t > reach[j] + _SLACK_M:
                        continue
                    close = close or abs(e) < _CELL_M
                    cost = e * e + 0.1 * t * t
                    if abs(e) <= max(gate, 4.0 * math.sqrt(var[k] + _REF_VAR)) and cost < least:
                        best, least = j, cost
            beside[k] = best
            near += close
            if best < 0:
                continue
            held += 1.0
            mx, my = normals[best, 0], normals[best, 1]
            e = mx * (x - points[best, 0]) + my * (y - points[best, 1])
            total = var[k] + _REF_VAR
            w = _robust(e, total + 0.1 * gate * gate) / total
            j2 = my * rx - mx * ry
            g[0] += w * mx * e
            g[1] += w * my * e
            g[2] += w * j2 * e
            h[0, 0] += w * mx * mx
            h[0, 1] += w * mx * my
            h[1, 1] += w * my * my
            h[0, 2] += w * mx * j2
            h[1, 2] += w * my * j2
            h[2, 2] += w * j2 * j2
        counts[0], counts[1] = held, near
        if iteration == iterations:
            break
        h[1, 0], h[2, 0], h[2, 1] = h[0, 1], h[0, 2], h[1, 2]
        for a in range(3):
            h[a, a] += 1e-3
        step[:] = np.linalg.solve(h, g)
        pose[0] -= step[0]
        pose[1] -= step[1]
        pose[2] = wrap_scalar(pose[2] - step[2])
        small = abs(step[0]) + abs(step[1]) + 3.0 * abs(step[2]) < 2e-4
        if small and gate == 0.0:
            break
        gate = 0.0 if gate < 0.02 or small else 0.5 * gate


@njit(cache=True, nogil=True, error_model="numpy")
def _links(
    points: Array, normals: Array, patch: Indices, ends: Array, var: Array, pose: Array, beside: Indices,
    frames: Array, common_var: Array, relative: Array, info: Array, gradient: Array, beams: Indices,
) -> None:  # fmt: skip
    count = frames.shape[0]
    weight = np.zeros(count)
    for p in range(count):
        c, s = math.cos(frames[p, 2]), math.sin(frames[p, 2])
        dx, dy = pose[0] - frames[p, 0], pose[1] - frames[p, 1]
        relative[p, 0], relative[p, 1] = c * dx + s * dy, c * dy - s * dx
        relative[p, 2] = wrap_scalar(pose[2] - frames[p, 2])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for k in range(ends.shape[0]):
        j = beside[k]
        if j < 0:
            continue
        p = patch[j]
        rx, ry = c * ends[k, 0] - s * ends[k, 1], s * ends[k, 0] + c * ends[k, 1]
        nx, ny = normals[j, 0], normals[j, 1]
        e = nx * (pose[0] + rx - points[j, 0]) + ny * (pose[1] + ry - points[j, 1])
        w = _robust(e, var[k] + _REF_VAR) / var[k]
        cp, sp = math.cos(frames[p, 2]), math.sin(frames[p, 2])
        a, b = cp * nx + sp * ny, cp * ny - sp * nx  # the normal in the patch's frame
        t = ny * rx - nx * ry
        beams[p] += 1
        weight[p] += w
        gradient[p, 0] += w * a * e
        gradient[p, 1] += w * b * e
        gradient[p, 2] += w * t * e
        info[p, 0, 0] += w * a * a
        info[p, 0, 1] += w * a * b
        info[p, 1, 1] += w * b * b
        info[p, 0, 2] += w * a * t
        info[p, 1, 2] += w * b * t
        info[p, 2, 2] += w * t * t
    for p in range(count):
        if beams[p] == 0:
            continue
        scale = 1.0 / (1.0 + common_var[p] * weight[p])
        info[p, 1, 0], info[p, 2, 0], info[p, 2, 1] = info[p, 0, 1], info[p, 0, 2], info[p, 1, 2]
        for a in range(3):
            gradient[p, a] *= scale
            for b in range(3):
                info[p, a, b] *= scale
