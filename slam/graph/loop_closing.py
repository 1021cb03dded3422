"""Old places seen again from a place that is not well known: believed only when several scans say the same.

A candidate is a scan aligned with patches that left the window, found by exhaustive search of all that the belief
allows. It counts where most of the scan agrees with what was there, where the surfaces fix the pose in every
direction, and where no other place within reach fits nearly as well. It is taken only with others, from places
apart, whose corrections agree pair by pair (the consistency of Mangelson, Dominic, Eustice and Vasudevan 2018, at
the size of the few scans that are in question).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from slam.geometry import about_z, compose, inverse, wrap
from slam.graph.matching import Alignment, Links, SurfaceMap, align, links
from slam.graph.surfaces import BeamEnds
from slam.grids.match_kernels import field_sum
from slam.grids.scan_matching import LikelihoodField, MatchConfig, search
from slam.settings import Angle, Config, Count, Gap, Length, Positive, PositiveShare, Sigma, Within
from slam.types import Array, Indices

__all__ = ["Candidate", "ClosingConfig", "agreeing", "find_candidate"]

_RIVAL_APART_M, _RIVAL_STEP_M = 0.25, 0.1


@dataclass(frozen=True, kw_only=True)
class ClosingConfig(Config):
    """When an old place is believed to be seen again."""

    # Patches known this well as seen from the robot need no loop closing: nothing else is as near to them.
    sigma_m: Sigma = 0.02
    every_m: Length = 0.8  # way between two looks back
    farthest_m: Annotated[float, Within("[0.01, 10]")] = 1.5  # searched at most, to either side …
    farthest_rad: Angle = 0.4
    share: PositiveShare = 0.4  # of a scan's beams that must end on old patches …
    in_sight: PositiveShare = 0.75  # … and of those near one that must agree with it
    determined_m: Sigma = 0.04  # 1σ of the alignment, in the direction that is known least
    rival: PositiveShare = 0.85  # of the best place's score, that no place apart may reach
    together: Count = 3  # scans that must agree …
    apart_m: Gap = 1.0  # … from places at least so far apart …
    recent_m: Gap = 12.0  # … on the last so many metres
    agree_m: Gap = 0.06  # how far two corrections may be from each other
    agree_rad: Gap = 0.015
    loss: Positive = 4.0  # chi-square a degree of freedom from which a closing is given up again


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A key scan that may show an old place again."""

    node: int  # of the key scan
    way_m: float  # driven until then
    place: Array  # (2,) where it was believed to be
    correction: Array  # (3,) transform of the world that would make it fit
    links: Links  # to patches of ``nodes``
    nodes: Indices


def find_candidate(
    surfaces: SurfaceMap, frames: Array, common_var: Array, nodes: Indices, ends: BeamEnds, pose: Array,
    pose_cov: Array, config: ClosingConfig, matching: MatchConfig, *, node: int, way_m: float,
) -> Candidate | None:  # fmt: skip
    """Return how a scan from ``pose`` ``(3,)`` fits old patches, or None where it does not, or not beyond doubt.

    ``pose_cov`` ``(3, 3)`` is of the pose as seen from the old patches; ``frames`` ``(p, 3)``, ``common_var``
    ``(p,)`` and ``nodes`` ``(p,)`` are theirs.
    """
    found, rival = _search(surfaces, ends, pose, pose_cov, config, matching)
    if found.share < config.share or found.in_sight < config.in_sight or rival > config.rival:
        return None
    seen = links(surfaces, ends, found, frames, common_var)
    info = np.zeros((3, 3))
    for k, p in enumerate(seen.patches.tolist()):
        turn = about_z(-frames[p, 2])
        info += turn.T @ seen.info[k] @ turn
    if float(np.linalg.eigvalsh(np.linalg.inv(info + 1e-3 * np.eye(3))[:2, :2])[-1]) > config.determined_m**2:
        return None
    off = found.pose - pose
    off[2] = float(wrap(off[2]))
    if float(off @ np.linalg.solve(pose_cov + 1e-5 * np.eye(3), off)) > 16.0:
        return None
    return Candidate(node, way_m, pose[:2].copy(), compose(found.pose, inverse(pose)), seen, nodes)


def _search(
    surfaces: SurfaceMap, ends: BeamEnds, pose: Array, pose_cov: Array, config: ClosingConfig,
    matching: MatchConfig,
) -> tuple[Alignment, float]:  # fmt: skip
    """Return the best alignment within 3σ, and what the best place apart from it scores beside it."""
    sigma = np.sqrt(np.diag(pose_cov))
    reach = min(3.0 * float(sigma[:2].max()) + 0.1, config.farthest_m)
    turn = min(3.0 * float(sigma[2]) + 0.02, config.farthest_rad)
    window = replace(matching, window_m=reach, window_rad=turn)
    field = LikelihoodField(window, surfaces.points)
    points = ends.points[:: max(1, len(ends) // matching.beams)]
    info = np.asarray(np.linalg.inv(pose_cov + 1e-6 * np.eye(3)), np.float64)
    start = search(field, points, pose, window, prior_info=info)
    found = align(surfaces, ends, start, prior=start, prior_info=np.eye(3), gate_m=0.15)
    best = field_sum(field.values, field.x0, field.y0, field.cell_m, points, found.pose)
    rival = 0.0
    steps = np.arange(-reach, reach + 1e-9, _RIVAL_STEP_M)
    for dx in steps:
        for dy in steps:
            x, y = pose[0] + dx, pose[1] + dy
            if math.hypot(x - found.pose[0], y - found.pose[1]) < _RIVAL_APART_M:
                continue
            at = np.array([x, y, found.pose[2]])
            rival = max(rival, field_sum(field.values, field.x0, field.y0, field.cell_m, points, at))
    return found, rival / max(best, 1e-9)


def agreeing(candidates: Sequence[Candidate], config: ClosingConfig) -> list[Candidate]:
    """Return the newest candidate with all that agree with it and with each other; empty where too few do."""
    newest = candidates[-1]
    group = [newest]
    for other in reversed(candidates[:-1]):
        if newest.way_m - other.way_m > config.recent_m:
            break
        if all(_agree(other, member, config) for member in group):
            group.append(other)
    spread = max(float(np.hypot(*(a.place - newest.place))) for a in group)
    return group if len(group) >= config.together and spread >= config.apart_m else []


def _agree(a: Candidate, b: Candidate, config: ClosingConfig) -> bool:
    """Tell whether two corrections send the place between the two scans to the same place."""
    middle = np.array([*(0.5 * (a.place + b.place)), 0.0])
    off = compose(a.correction, middle) - compose(b.correction, middle)
    return math.hypot(off[0], off[1]) <= config.agree_m and abs(float(wrap(off[2]))) <= config.agree_rad
