"""What is measured of a replay that has scans: time a scan, and the relations metric against a reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.dead_reckoning import OdometrySlam
from slam.invariant import InvariantEkfSlam
from slam.logs import ScanLog
from slam.metrics.measures import anees, nees_pose, nees_pose_invariant
from slam.metrics.relations import RelationScore, closing_relations, local_relations, relation_score
from slam.types import Array
from training.replay.matched import (
    MatchedRelations,
    error_of_reference,
    errors,
    matched_relations,
    nees_with_reference,
    start_as_matched,
)
from training.replay.run import Replay

__all__ = ["scan_metrics"]

_INVARIANT = InvariantEkfSlam, OdometrySlam
"""Backends whose covariance is that of the invariant error."""

_KINDS = ("", "local_", "closing_")  # all relations; those along the way; those between visits of one place


def scan_metrics(replay: Replay, log: ScanLog) -> dict[str, Any]:
    """Return the entries of ``metrics.json`` that only a log of scans has; null where nothing can be said.

    Relations are of the trajectory as the backend believes it at the end where it has ``scan_poses``, an array
    ``(scans, 3)`` of body poses, one an update so far: a trajectory SLAM's result. Else, and where that lacks a
    pose, they are of the poses it believed at the time; ``relations_of`` says which. Those of the poses at the
    time are there in any case (``online_``), and those that scans alone bear witness to (``matched_``).
    """
    each_ms = 1e3 * np.array(replay.scan_times_s)
    found: dict[str, Any] = {
        "scans": len(each_ms),
        "ms_per_scan": float(np.median(each_ms)) if len(each_ms) else None,
        "ms_per_scan_mean": float(np.mean(each_ms)) if len(each_ms) else None,
    }
    rows = replay.sample_rows[: len(replay.estimates)]
    compared = np.flatnonzero(rows >= 0)
    online = np.array(replay.estimates, np.float64).reshape(-1, 3)
    final = getattr(replay.backend, "scan_poses", None)
    is_final = final is not None and len(final) >= len(online)
    believed = np.asarray(final, np.float64) if is_final else online
    true = log.reference_poses[rows[compared]]
    relations = local_relations(len(true)), closing_relations(true)
    for start, poses in (("", believed), ("online_", online), ("dead_reckoning_", log.dead_reckoning())):
        for kind, pairs in zip(_KINDS, (np.vstack(relations), *relations), strict=True):
            score = relation_score(true, poses[compared], pairs)
            found |= _named(f"{start}relations_{kind}", score, short=bool(start))
    found["relations_of"] = "final" if is_final else "online"
    matched = matched_relations(log, compared, true, np.vstack(relations))
    found |= {"matched_relations_count": len(matched.pairs)}
    found |= _matched("matched_relations", matched, believed[compared])
    found |= _matched("matched_relations_reference", matched, true)
    return found | _with_reference(replay, matched, compared, true)


def _matched(prefix: str, matched: MatchedRelations, poses: Array) -> dict[str, float | None]:
    """Return how far a trajectory ``(n, 3)`` is off the relations that scans have."""
    if not len(matched.pairs):
        return {f"{prefix}_{name}": None for name in ("trans_m", "trans_std_m", "rot_rad")}
    off = errors(matched, poses)
    trans = np.hypot(off[:, 0], off[:, 1])
    return {
        f"{prefix}_trans_m": float(trans.mean()), f"{prefix}_trans_std_m": float(trans.std()),
        f"{prefix}_rot_rad": float(np.abs(off[:, 2]).mean()),
    }  # fmt: skip


def _with_reference(
    replay: Replay, matched: MatchedRelations, compared: NDArray[np.int64], true: Array
) -> dict[str, float | None]:
    """Return the reference's own error, and NEES / 3 that owns to it: from its first pose, and as matched."""
    names = "reference_sigma_m", "reference_sigma_rad", "anees_reference", "anees_reference_matched"
    if not len(matched.pairs):
        return dict.fromkeys(names)
    sigma = error_of_reference(matched, true)
    online, covs = np.array(replay.estimates)[compared], np.array(replay.covs)[compared]
    start, of = start_as_matched(matched, true)
    starts = ((true[0], 1), (start, of))
    # That of the backends' own ``pose_nees``.
    form = nees_pose_invariant if isinstance(replay.backend, _INVARIANT) else nees_pose
    values = [
        float(anees(nees_with_reference(online, covs, true, pose, sigma=sigma, of=count, form=form)))
        for pose, count in starts
    ]
    return dict(zip(names, (*sigma, *values), strict=True))


def _named(prefix: str, score: RelationScore, *, short: bool) -> dict[str, float]:
    fields = ("trans_m", "rot_rad") if short else score._fields  # one number tells how bad dead reckoning is
    named = {prefix + field: getattr(score, field) for field in fields if field != "relations"}
    return named if short else named | {prefix + "count": score.relations}
