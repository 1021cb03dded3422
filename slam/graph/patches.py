"""What a key scan adds to the map: the surfaces that no patch in reach explains, each a patch of its own.

A patch is a rigid piece of surface in the frame of the key scan that saw it first. Where that scan's noise puts
it is an error of the patch alone: the beams that make a patch link the scan to nothing else, so that no beam's
noise counts twice, and every later scan held against the patch shares the one error.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.features.surfaces import HIDDEN, MAX_LINES
from slam.graph.surfaces import BeamEnds
from slam.types import Array, Flags, Indices

__all__ = ["ModelError", "Patch", "extended", "new_patches"]

_SAMPLES_M = 0.1  # between the points that stand for a straight surface
_FEWEST = 3  # beams that make a patch
_BENT_M = 0.003  # by which a wall may be off its line where it goes on
_LONGEST_M = 20.0  # stretch of wall that is taken for straight
_PRIOR_SIGMA = 0.02  # [m, rad] of a patch where the scan says nothing, as along a wall: nothing is held against it


@dataclass(frozen=True, eq=False)
class Patch:
    """Surface points in the frame of a key scan, and the information of where they are."""

    points: Array  # (m, 2) [m]
    normals: Array  # (m, 2) towards free space
    reach: Array  # (m,) [m] along the surface, to either side
    info: Array  # (3, 3) of the patch's pose relative to the key scan's
    common_var: float  # [m²] of what all beams of one scan on it have in common: what the model leaves out
    straight: bool

    @cached_property
    def extent(self) -> Array:
        """A disc around the points ``(3,)``: centre x, y and radius [m]."""
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        return np.append(0.5 * (low + high), 0.5 * float(np.hypot(*(high - low))))


@dataclass(frozen=True, slots=True)
class ModelError:
    """What the model of a surface leaves out, 1σ [m] across it: the same for all beams of a scan."""

    straight_m: float  # of a wall that is not quite straight
    rough_m: float  # of a contour
    ledge_m: float  # the highest ledge that the extractor does not tell from its wall

    def straight_var(self, length_m: float) -> float:
        """Return the variance [m²] of a straight surface: a ledge shifts it the more, the shorter it is."""
        hidden = HIDDEN * self.ledge_m**2 / max(length_m, self.ledge_m)
        return self.straight_m**2 + hidden * hidden


def new_patches(ends: BeamEnds, unexplained: Flags, model: ModelError) -> list[Patch]:
    """Return the patches that a scan's unexplained beams ``(n,)`` make: those that nothing known is near."""
    made: list[Patch] = []
    rest: list[tuple[Array, Array, Array, Array]] = []
    for label in np.unique(ends.surface[unexplained]):
        rows = np.flatnonzero(unexplained & (ends.surface == label))
        if len(rows) < _FEWEST:
            continue
        straight = bool(label < MAX_LINES)
        points, normals, reach = _straight(ends, rows) if straight else _contour(ends, rows)
        common = model.straight_var(float(np.hypot(*(points[-1] - points[0])))) if straight else model.rough_m**2
        info = _information(ends, rows, common)
        if straight and len(rows) >= 6:
            made.append(Patch(points, normals, reach, info + np.eye(3) / _PRIOR_SIGMA**2, common, True))
        else:
            rest.append((points, normals, reach, info))
    if rest:
        points, normals, reach = (np.concatenate([piece[k] for piece in rest]) for k in range(3))
        info = np.sum([piece[3] for piece in rest], axis=0)
        made.append(Patch(points, normals, reach, info + np.eye(3) / _PRIOR_SIGMA**2, model.rough_m**2, False))
    return made


def extended(patch: Patch, ends: BeamEnds, rows: Indices, relative: Array, model: ModelError) -> Patch | None:
    """Return a straight patch that reaches as far as more beams of the same surface ended, or None.

    None where they do not lie on its line. ``rows`` are the beams, ``relative`` ``(3,)`` the scan's pose as seen
    from the patch. A longer patch has no more freedom than a short one: later scans tell its direction.
    """
    c, s = np.cos(relative[2]), np.sin(relative[2])
    seen = ends.points[rows] @ np.array([[c, s], [-s, c]]) + relative[:2]
    normal, first = patch.normals[0], patch.points[0]
    off = (seen - first) @ normal
    noise = float(ends.var[rows].mean())
    if abs(float(off.mean())) > 3.0 * np.sqrt(noise / len(rows)) + _BENT_M:
        return None
    along = np.array([-normal[1], normal[0]])
    t, had = (seen - first) @ along, (patch.points - first) @ along
    low, high = float(min(t.min(), had.min())), float(max(t.max(), had.max()))
    if high - low > _LONGEST_M:
        return None
    new = np.concatenate([
        np.arange(float(had.min()) - _SAMPLES_M, low - 0.5 * _SAMPLES_M, -_SAMPLES_M),
        np.arange(float(had.max()) + _SAMPLES_M, high + 0.5 * _SAMPLES_M, _SAMPLES_M),
    ])  # fmt: skip
    if not len(new):
        return None
    points = np.concatenate([patch.points, first + new[:, None] * along])
    count = len(points)
    reach = np.full(count, 0.5 * _SAMPLES_M)
    return Patch(points, np.tile(normal, (count, 1)), reach, patch.info, model.straight_var(high - low), True)


def _information(ends: BeamEnds, rows: Indices, common: float) -> Array:
    n, p, weight = ends.normals[rows], ends.on[rows], 1.0 / ends.var[rows]
    j = np.column_stack([n, n[:, 1] * p[:, 0] - n[:, 0] * p[:, 1]])
    return np.asarray((j * weight[:, None]).T @ j / (1.0 + common * weight.sum()), np.float64)


def _straight(ends: BeamEnds, rows: Indices) -> tuple[Array, Array, Array]:
    """Return points along a line, as far as beams ended on it without a gap."""
    normal = ends.normals[rows[0]]
    along = np.array([-normal[1], normal[0]])
    first = ends.on[rows[0]]
    t = np.sort((ends.on[rows] - first) @ along)
    gap = np.maximum(0.3, 3.0 * float(ends.spacing[rows].max()))
    pieces = np.split(t, np.flatnonzero(np.diff(t) > gap) + 1)
    at = np.concatenate([
        np.linspace(piece[0], piece[-1], max(2, int(np.ceil((piece[-1] - piece[0]) / _SAMPLES_M)) + 1))
        for piece in pieces if len(piece) > 1
    ] or [t[:1]])  # fmt: skip
    points = first + at[:, None] * along
    return points, np.tile(normal, (len(at), 1)), np.full(len(at), 0.5 * _SAMPLES_M)


def _contour(ends: BeamEnds, rows: Indices) -> tuple[Array, Array, Array]:
    return ends.on[rows], ends.normals[rows], 0.6 * ends.spacing[rows]
