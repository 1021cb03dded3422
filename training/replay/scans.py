"""What is measured of a replay that has scans: time a scan, and the relations metric against a reference."""

from __future__ import annotations

from typing import Any

import numpy as np

from slam.logs import ScanLog
from slam.metrics.relations import RelationScore, closing_relations, local_relations, relation_score
from training.replay.run import Replay

__all__ = ["scan_metrics"]

_KINDS = ("", "local_", "closing_")  # all relations; those along the way; those between visits of one place


def scan_metrics(replay: Replay, log: ScanLog) -> dict[str, Any]:
    """Return the entries of ``metrics.json`` that only a log of scans has; null where nothing can be said.

    Relations are of the trajectory as the backend believes it at the end where it has ``scan_poses``, an array
    ``(scans, 3)`` of body poses, one an update so far: a trajectory SLAM's result. Else, and where that lacks a
    pose, they are of the poses it believed at the time; ``relations_of`` says which.
    """
    each_ms = 1e3 * np.array(replay.scan_times_s)
    found: dict[str, Any] = {
        "scans": len(each_ms),
        "ms_per_scan": float(np.median(each_ms)) if len(each_ms) else None,
        "ms_per_scan_mean": float(np.mean(each_ms)) if len(each_ms) else None,
    }
    rows = replay.sample_rows[: len(replay.estimates)]
    compared = np.flatnonzero(rows >= 0)
    believed = np.array(replay.estimates, np.float64).reshape(-1, 3)
    final = getattr(replay.backend, "scan_poses", None)
    is_final = final is not None and len(final) >= len(believed)
    if is_final:
        believed = np.asarray(final, np.float64)
    true = log.reference_poses[rows[compared]]
    relations = local_relations(len(true)), closing_relations(true)
    for start, poses in (("", believed), ("dead_reckoning_", log.dead_reckoning())):
        for kind, pairs in zip(_KINDS, (np.vstack(relations), *relations), strict=True):
            score = relation_score(true, poses[compared], pairs)
            found |= _named(f"{start}relations_{kind}", score, short=bool(start))
    found["relations_of"] = "final" if is_final else "online"
    return found


def _named(prefix: str, score: RelationScore, *, short: bool) -> dict[str, float]:
    fields = ("trans_m", "rot_rad") if short else score._fields  # one number tells how bad dead reckoning is
    named = {prefix + field: getattr(score, field) for field in fields if field != "relations"}
    return named if short else named | {prefix + "count": score.relations}
