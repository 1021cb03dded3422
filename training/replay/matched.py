"""How exact a reference is that is an estimate itself: by the scans of its relations, matched with each other.

Kümmerle et al. (2009) make their relations so: two scans of one place are matched, and a person looks whether the
match is right. Here it is taken for right where matching either scan to the other says the same. Neither the
backend nor its estimate has a part in it; the search begins at the reference's relation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.features.extraction import FeatureConfig, FeatureExtractor
from slam.geometry import about_z, compose, inverse, relative, wrap
from slam.graph.matching import SurfaceMap, align
from slam.graph.surfaces import BeamEnds, beam_ends
from slam.logs import ScanLog
from slam.metrics.measures import nees_pose
from slam.settings import from_mapping
from slam.types import Array

__all__ = [
    "MatchedRelations", "error_of_reference", "errors", "matched_relations", "nees_with_reference",
    "start_as_matched",
]  # fmt: skip

_REACH_M, _ROUGH_M = 20.0, 0.02  # as of the logs' graph-slam
_GATE_M = 0.3  # farthest that a beam may end from its surface, from where the reference has it
_SHARE = 0.5  # of a scan's beams that must end on the other's surfaces
_AGREE_M, _AGREE_RAD = 0.01, 0.004  # by which the two matches of a pair may differ
_FAR = np.array([0.3, 0.3, 0.15])  # [m, rad] from the reference's relation, beyond which a match is not believed
_MEDIAN = 1.4826  # of the absolute deviation, from median to 1σ
_MEDIAN_NORM = 1.1774  # of the length of a vector of two normal numbers, in 1σ of either


@dataclass(frozen=True, slots=True)
class MatchedRelations:
    """Relations as scans have them."""

    pairs: NDArray[np.int64]  # (m, 2) rows of the reference
    seen: Array  # (m, 3) the second's pose as seen from the first [m, rad]


def matched_relations(
    log: ScanLog, scans: NDArray[np.int64], reference: Array, pairs: NDArray[np.int64]
) -> MatchedRelations:
    """Match scans with each other.

    Parameters
    ----------
    scans, reference
        Numbers ``(n,)`` of scans and their reference poses ``(n, 3)``, where each match begins.
    pairs
        ``(k, 2)`` rows of them. Kept are those that are matched beyond doubt.
    """
    config = from_mapping(FeatureConfig, log.settings["features"])
    extractor, offset_m = FeatureExtractor(config), float(log.settings.get("lidar_offset_m", 0.0))
    ends: list[BeamEnds] = []
    maps: list[SurfaceMap] = []
    for k in scans.tolist():
        scan = log.scan(k)
        extractor.extract(scan)
        seen = beam_ends(
            scan, extractor, offset_m=offset_m, reach_m=_REACH_M, sigma_m=config.range_sigma_m, rough_m=_ROUGH_M
        )
        ends.append(seen)
        maps.append(SurfaceMap(seen.on, seen.normals, 0.6 * seen.spacing, np.zeros(len(seen), np.int64)))
    kept, found = [], []
    for i, j in pairs.tolist():
        start = relative(reference[i][None], reference[j][None])[0]
        there, back = _match(maps[i], ends[j], start), _match(maps[j], ends[i], inverse(start))
        if there is None or back is None:
            continue
        differ = _off(there, inverse(back))
        if math.hypot(differ[0], differ[1]) > _AGREE_M or abs(differ[2]) > _AGREE_RAD:
            continue
        middle = there - 0.5 * differ
        if np.all(np.abs(_off(middle, start)) < _FAR):
            kept.append((i, j))
            found.append(middle)
    return MatchedRelations(np.array(kept, np.int64).reshape(-1, 2), np.array(found).reshape(-1, 3))


def _match(surfaces: SurfaceMap, ends: BeamEnds, start: Array) -> Array | None:
    if not len(ends) or not len(surfaces.points):
        return None
    found = align(surfaces, ends, start, prior=start, prior_info=np.eye(3), gate_m=_GATE_M, iterations=30)
    return found.pose if found.share >= _SHARE else None


def _off(pose: Array, other: Array) -> Array:
    off = pose - other
    off[2] = float(wrap(off[2]))
    return off


def errors(matched: MatchedRelations, poses: Array) -> Array:
    """Return by how much relations of a trajectory ``(n, 3)`` are off ``(m, 3)`` [m, rad]."""
    i, j = matched.pairs.T
    off = relative(poses[i], poses[j]) - matched.seen
    off[:, 2] = wrap(off[:, 2])
    return off


def error_of_reference(matched: MatchedRelations, reference: Array) -> tuple[float, float]:
    """Return 1σ of a reference pose, by either coordinate [m] and in heading [rad]: that of a relation over √2.

    By medians, so that a wrong match or a reference that was lost does not count.
    """
    off = errors(matched, reference)
    if not len(off):
        return math.nan, math.nan
    metres = float(np.median(np.hypot(off[:, 0], off[:, 1]))) / _MEDIAN_NORM
    return metres / math.sqrt(2.0), _MEDIAN * float(np.median(np.abs(off[:, 2]))) / math.sqrt(2.0)


def start_as_matched(matched: MatchedRelations, reference: Array) -> tuple[Array, int]:
    """Return the first pose ``(3,)`` as matched scans have it in the reference's frame, and of how many it is.

    The median of what each pose says whose scan matches the first one: a single pose may be far off.
    """
    rows = np.flatnonzero(matched.pairs[:, 0] == 0)
    if not len(rows):
        return reference[0].copy(), 1
    said = [compose(reference[matched.pairs[k, 1]], inverse(matched.seen[k])) for k in rows]
    off = np.array([_off(pose, reference[0]) for pose in said])
    pose = reference[0] + np.median(off, axis=0)
    pose[2] = float(wrap(pose[2]))
    return pose, len(rows)


def nees_with_reference(
    estimates: Array, covs: Array, reference: Array, start: Array, *, sigma: tuple[float, float], of: int,
    form: Callable[[Array, Array, Array], float] = nees_pose,
) -> Array:  # fmt: skip
    """Return the NEES ``(n,)`` of poses against a reference that errs itself.

    Parameters
    ----------
    estimates, covs : Array
        ``(n, 3)`` and ``(n, 3, 3)``, the first where the reference's first pose is.
    reference, start : Array
        ``(n, 3)``, and the first pose as it is believed to be in the reference's frame: the estimates are moved
        there, and turn about it.
    sigma, of
        1σ of a reference pose [m], [rad], and of how many such poses the start is the median.
    form
        The NEES of a pose, its covariance and the true pose, in the error that the covariances speak of. Either of
        :mod:`slam.metrics.measures` is the same wherever the estimates are moved.
    """
    move = compose(start, inverse(estimates[0]))
    own = np.diag([sigma[0] ** 2, sigma[0] ** 2, sigma[1] ** 2])
    first = own * (0.5 * math.pi / of if of > 1 else 1.0)  # the variance of a median of many
    turn = about_z(float(move[2]))
    out = np.zeros(len(estimates))
    for k, (estimate, cov) in enumerate(zip(estimates, covs, strict=True)):
        pose = compose(move, estimate)
        x, y = (pose[:2] - start[:2]).tolist()
        lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        out[k] = float(form(pose, turn @ cov @ turn.T + lever @ first @ lever.T + own, reference[k]))
    return out
