"""True corners of a floor plan: the points where its free space bends.

Around every end point of a surface the directions are sorted into free and solid ones; a corner is where the
free directions do not make up half a turn. That treats furniture against a wall rightly: the cupboard's front
edge is a convex corner, the foot of its side a concave one, its back is hidden.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.types import CONCAVE, CONVEX, Array, Flags, Indices

__all__ = ["find_corners"]

_TOUCH_M = 1e-3  # two surfaces meet when they are this near
_STRAIGHT_DEG = 5.0  # a smaller bend is no corner
_DIRECTIONS = 360
_LEFT, _BOTH = 0, 1  # on which sides of a wall free space lies


def find_corners(
    walls: Array, polygons: tuple[Array, ...], is_free: Callable[[Array], Flags], resolution: float
) -> tuple[Array, NDArray[np.int8]]:
    """Return corner points ``(n, 2)`` [m] and their kinds ``(n,)``: CONVEX, CONCAVE, or 0 between thin walls.

    Parameters
    ----------
    walls
        Surfaces ``(w, 4)``; turned so that free space is on their left, by the raster, where they are not.
    polygons
        Convex obstacles, counter-clockwise, ``(k, 2)`` each.
    is_free, resolution
        Tells of points ``(n, 2)`` [m] which lie in free cells ``(n,)``, and the size of these [m].
    """
    walls, sides = _orient(walls, is_free, resolution)
    edges = [np.hstack([p, np.roll(p, -1, axis=0)]) for p in polygons]
    edge_array = np.vstack(edges) if edges else np.zeros((0, 4))
    first = np.concatenate([[0], np.cumsum([len(p) for p in polygons])]).astype(np.int64)
    points = np.vstack([walls[:, :2], walls[:, 2:], edge_array[:, :2]])
    points = points[_unique_within(points)]
    kinds = _classify(points, walls, sides, edge_array, first)
    keep = kinds > -2
    return np.ascontiguousarray(points[keep]), kinds[keep].astype(np.int8)


def _unique_within(points: Array) -> Indices:
    """Return the indices of points no two of which are within the touching distance."""
    order = np.lexsort((points[:, 1], points[:, 0]))
    return np.sort(order[_first_of_cluster(np.ascontiguousarray(points[order]))])


@njit(cache=True, nogil=True)
def _first_of_cluster(points: Array) -> Flags:
    """Mask of points, sorted by x, that no earlier kept point lies within the touching distance of."""
    keep = np.ones(points.shape[0], np.bool_)
    for i in range(points.shape[0]):
        j = i - 1
        while j >= 0 and points[i, 0] - points[j, 0] <= _TOUCH_M:
            if keep[j] and abs(points[i, 1] - points[j, 1]) <= _TOUCH_M:
                keep[i] = False
                break
            j -= 1
    return keep


def _orient(walls: Array, is_free: Callable[[Array], Flags], resolution: float) -> tuple[Array, Indices]:
    """Turn walls so that free space is on the left; say which have it on both sides."""
    along = walls[:, 2:] - walls[:, :2]
    length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-12)[:, None]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / length
    shares = np.array([0.25, 0.5, 0.75])
    middle = walls[:, None, :2] + shares[None, :, None] * along[:, None, :]
    # 0.6 cells off the surface: surely in the next cell, and still within a wall one cell thick.
    offset = 0.6 * resolution * left[:, None, :]
    count = [is_free((middle + s * offset).reshape(-1, 2)).reshape(-1, len(shares)).sum(axis=1) for s in (1, -1)]
    flip = count[1] > count[0]
    turned = np.where(flip[:, None], walls[:, [2, 3, 0, 1]], walls)
    both = (count[0] == len(shares)) & (count[1] == len(shares))
    return np.ascontiguousarray(turned), np.where(both, _BOTH, _LEFT).astype(np.int64)


@njit(cache=True, nogil=True)
def _classify(points: Array, walls: Array, sides: Indices, edges: Array, first: Indices) -> Indices:
    """Kind of each point, or -2 where it is no corner."""
    kinds = np.full(points.shape[0], -2, np.int64)
    solid = np.zeros(_DIRECTIONS, np.bool_)
    nearest = np.zeros(_DIRECTIONS, np.float64)
    for i in range(points.shape[0]):
        solid[:] = False
        nearest[:] = 10.0
        x, y = points[i, 0], points[i, 1]
        bent = _sort_by_walls(x, y, walls, sides, solid, nearest)
        for p in range(first.shape[0] - 1):
            _sort_by_polygon(x, y, edges[first[p] : first[p + 1]], solid)
        kinds[i] = _kind(solid, bent)
    return kinds


@njit(cache=True, nogil=True)
def _sort_by_walls(x: float, y: float, walls: Array, sides: Indices, solid: Flags, nearest: Array) -> bool:
    """Mark the directions behind walls at (x, y): the angularly nearest surface decides.

    Returns whether thin walls, free on both sides, bend here.
    """
    thin_angle, bent = 10.0, False
    for w in range(walls.shape[0]):
        ax, ay, bx, by = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
        if not _near_box(x, y, ax, ay, bx, by):
            continue
        length = math.hypot(bx - ax, by - ay)
        if length < _TOUCH_M:
            continue
        ux, uy = (bx - ax) / length, (by - ay) / length
        along = (x - ax) * ux + (y - ay) * uy
        if abs((y - ay) * ux - (x - ax) * uy) > _TOUCH_M:
            continue
        for sign in (1.0, -1.0):
            # The ray from the point along the wall exists unless the wall ends here.
            if (length - along if sign > 0 else along) <= _TOUCH_M:
                continue
            angle = math.atan2(sign * uy, sign * ux)
            if sides[w] == _BOTH:
                if thin_angle < 5.0:
                    bend = abs(_turn(angle - thin_angle))
                    limit = math.radians(_STRAIGHT_DEG)
                    bent = bent or (limit < bend < math.pi - limit)
                thin_angle = angle
            for k in range(_DIRECTIONS):
                turn = _turn((k + 0.5) * 2.0 * math.pi / _DIRECTIONS - angle)
                if abs(turn) < nearest[k]:
                    nearest[k] = abs(turn)
                    # Free space is to the left of the wall's own direction.
                    solid[k] = sides[w] == _LEFT and sign * turn < 0.0
    return bent


@njit(cache=True, nogil=True)
def _sort_by_polygon(x: float, y: float, edges: Array, solid: Flags) -> None:
    """Mark the directions that lead from (x, y) into a convex polygon that the point touches."""
    touches = False
    for e in range(edges.shape[0]):
        ax, ay, bx, by = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
        length = math.hypot(bx - ax, by - ay)
        side = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / length
        if side < -_TOUCH_M:
            return
        touches = touches or side <= _TOUCH_M
    if not touches:
        return
    for k in range(_DIRECTIONS):
        angle = (k + 0.5) * 2.0 * math.pi / _DIRECTIONS
        c, s = math.cos(angle), math.sin(angle)
        inside = True
        for e in range(edges.shape[0]):
            ax, ay, bx, by = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
            length = math.hypot(bx - ax, by - ay)
            side = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / length
            if side <= _TOUCH_M and (bx - ax) * s - (by - ay) * c < 0.0:
                inside = False
                break
        if inside:
            solid[k] = True


@njit(cache=True, nogil=True)
def _kind(solid: Flags, bent: bool) -> int:
    """Kind of corner from its free directions, -2 for none."""
    count, runs = 0, 0
    for k in range(_DIRECTIONS):
        if not solid[k]:
            count += 1
            if solid[k - 1]:
                runs += 1
    if count == _DIRECTIONS:
        return 0 if bent else -2
    if runs == 0:
        return -2
    if runs > 1:
        return CONCAVE  # solids that touch in a point: a recess from every side
    free_deg = count * 360.0 / _DIRECTIONS
    if abs(free_deg - 180.0) <= _STRAIGHT_DEG:
        return 0 if bent else -2
    return CONVEX if free_deg > 180.0 else CONCAVE


@njit(cache=True, nogil=True, inline="always")
def _near_box(x: float, y: float, ax: float, ay: float, bx: float, by: float) -> bool:
    return (
        min(ax, bx) - _TOUCH_M <= x <= max(ax, bx) + _TOUCH_M
        and min(ay, by) - _TOUCH_M <= y <= max(ay, by) + _TOUCH_M
    )


@njit(cache=True, nogil=True, inline="always")
def _turn(angle: float) -> float:
    """Angle in [-π, π)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
