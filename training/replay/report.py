"""What ``mecanum replay`` leaves behind: its metrics, files and the summary that is printed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

from slam.accounts.landmarks import handed_out, write_landmarks
from slam.backend import Backend
from slam.files import plain_name
from slam.formats import atomic_write, write_map_server, write_tum
from slam.logs import ScanLog
from slam.metrics.measures import anees, ate, ate_aligned, heading_errors
from slam.settings import to_mapping
from slam.types import Array
from training.figures.charts import png
from training.figures.tables import csv_table
from training.replay.picture import draw_belief, draw_replay
from training.replay.run import Replay
from training.replay.scans import scan_metrics
from training.runs.running import plain, versions, write_json, written_together

__all__ = ["metrics", "summary", "surveyed_places", "write"]


_MAP = ("map.pgm", "map.yaml", "map.png")


def metrics(replay: Replay) -> dict[str, Any]:
    """Return the contents of ``metrics.json``."""
    times, true, est = replay.trajectories()
    found: dict[str, Any] = {
        "ate_rmse_m": None, "ate_aligned_m": None, "final_position_error_m": None,
        "final_heading_error_rad": None, "anees": None, "dead_reckoning_ate_m": None,
        "dead_reckoning_ate_aligned_m": None, "landmark_rmse_m": None, "landmark_rmse_aligned_m": None,
    }  # fmt: skip
    if len(true):
        reckoned = _at(times, replay.log.odometry_times, replay.log.dead_reckoning())
        found |= {
            "ate_rmse_m": ate(true, est), "ate_aligned_m": ate_aligned(true, est),
            "final_position_error_m": ate(true[-1:], est[-1:]),
            "dead_reckoning_ate_m": ate(true, reckoned),
            "dead_reckoning_ate_aligned_m": ate_aligned(true, reckoned),
        }  # fmt: skip
        if replay.log.has_heading:
            found["final_heading_error_rad"] = float(heading_errors(true[-1:], est[-1:])[0])
            found["anees"] = float(anees(replay.nees)) if np.isfinite(replay.nees).any() else None
    belief = replay.backend.belief
    surveyed = surveyed_places(replay, belief.landmark_ids)
    mapped = np.isfinite(surveyed[:, 0])
    if mapped.any():
        found["landmark_rmse_m"] = ate(surveyed[mapped], belief.landmarks[mapped])
        if np.count_nonzero(mapped) > 1:
            found["landmark_rmse_aligned_m"] = ate_aligned(surveyed[mapped], belief.landmarks[mapped])
    recovery = replay.backend.recovery
    found |= {
        "health_mean": float(np.mean(replay.health)) if replay.health else None,
        "times_lost": recovery.times_lost, "relocalisations": recovery.relocalisations,
        "landmarks": len(belief.landmarks), "samples": len(true), "steps": replay.steps,
        "observations": replay.observations, "duration_s": replay.time_s, "wall_s": round(replay.wall_time_s, 3),
        "realtime_factor": round(replay.time_s / max(replay.wall_time_s, 1e-9), 1),
        "slam": replay.config.slam, "association": replay.run["association"], "log": replay.log.name,
        "seed": replay.run["seed"], "end": replay.end, "interrupted": replay.interrupted, "note": replay.log.note,
    }  # fmt: skip
    if isinstance(replay.log, ScanLog):
        found |= scan_metrics(replay, replay.log)
    return {key: plain(value) for key, value in found.items()}


def surveyed_places(replay: Replay, ids: NDArray[np.int64]) -> Array:
    """Return the surveyed positions ``(n, 2)`` [m] of landmarks; nan where there is none, or none is known."""
    out = np.full((len(ids), 2), np.nan)
    if replay.log.landmark_ids is None or replay.log.landmarks is None or replay.run["association"] != "known":
        return out
    row = {int(i): k for k, i in enumerate(replay.log.landmark_ids)}
    for k, landmark_id in enumerate(ids.tolist()):
        if landmark_id in row:
            out[k] = replay.log.landmarks[row[landmark_id]]
    return out


def write(replay: Replay) -> dict[str, Any]:
    """Write every file of a replay and return its metrics. The map of an earlier one there is taken away."""
    earlier = (replay.out / "metrics.json").is_file()  # else it is somebody's own
    with written_together(replay.out, without=_MAP if earlier else ()) as folder:
        return _write_into(folder, replay)


def _write_into(folder: Path, replay: Replay) -> dict[str, Any]:
    log, belief, done = replay.log, replay.backend.belief, len(replay.estimates)
    estimates = np.array(replay.estimates, np.float64).reshape(-1, 3)
    times, true, _ = replay.trajectories()
    write_tum(folder / "trajectory_estimate.tum", replay.sample_times[:done], estimates)
    write_tum(folder / "trajectory_true.tum", times, np.nan_to_num(true, nan=0.0))  # a heading not known is 0
    write_landmarks(folder / "landmarks.db", replay.backend, name=replay.config.slam, frame="reference")
    surveyed = surveyed_places(replay, belief.landmark_ids)
    atomic_write(folder / "landmarks.csv", _landmarks_csv(replay.backend, surveyed))
    reckoned = log.dead_reckoning()[log.odometry_times <= replay.time_s]
    figure = draw_replay(
        reference=_broken_at_gaps(times, true, log.reference_gap_s), reckoned=reckoned, estimate=estimates,
        landmarks=belief.landmarks,
        surveyed=surveyed if log.landmarks is None else log.landmarks,
        title=f"{log.name}   {replay.config.slam}, {replay.run['association']} association",
    )  # fmt: skip
    if isinstance(log, ScanLog):
        write_map_server(folder / "map", belief.grid)
        title = f"{log.name}   {replay.config.slam}"
        atomic_write(folder / "map.png", cv2.imencode(".png", draw_belief(belief, estimates, title))[1].tobytes())
    atomic_write(folder / "trajectory.png", png(figure))
    told = {key: v for key, v in replay.run.items() if v is not None} | {"versions": versions()}
    atomic_write(folder / "config.toml", tomli_w.dumps(to_mapping(replay.config) | {"run": told}))
    found = metrics(replay)
    write_json(folder / "metrics.json", found)
    return found


def _landmarks_csv(backend: Backend, surveyed: Array) -> str:
    """Return a line a landmark: estimate, covariance, sightings and, where it was surveyed, its true place."""
    found, ids, (seen, _) = handed_out(backend), backend.belief.landmark_ids, backend.landmark_details()
    columns = ("id", "x_m", "y_m", "var_x", "var_y", "cov_xy", "times_seen", "true_x_m", "true_y_m")
    rows = []
    for i in np.argsort(ids, kind="stable"):
        cov, true = found.covs[i], map(plain, surveyed[i])  # null where it was not surveyed
        values = ids[i], *found.points[i], cov[0, 0], cov[1, 1], cov[0, 1], seen[i], *true
        rows.append(dict(zip(columns, values, strict=True)))
    return csv_table(rows, columns, digits=9)


def _broken_at_gaps(times: Array, poses: Array, longest_s: float) -> Array:
    """Return poses ``(n, 3)`` with a row of nan wherever the time leaps by more than ``longest_s``."""
    return np.insert(poses, np.flatnonzero(np.diff(times) > longest_s) + 1, math.nan, axis=0)


def _at(times: Array, stamps: Array, poses: Array) -> Array:
    """Return poses ``(n, 3)`` between stamped ones ``(k, 3)``."""
    columns = poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2])
    return np.column_stack([np.interp(times, stamps, column) for column in columns])


def summary(found: Mapping[str, Any], out: Path, files: Sequence[str]) -> str:
    """Return what is printed at the end, where no JSON is wanted; what is not known is left out."""

    def shown(key: str, unit: str, digits: int = 2) -> str:
        return "-" if found[key] is None else f"{found[key]:.{digits}f} {unit}".rstrip()

    speed = f"{found['wall_s']:.1f} s, {found['realtime_factor']:.0f} times real time"
    sensed = f"{found['observations']} observations"
    if "scans" in found:
        sensed = f"{found['scans']} scans, {shown('ms_per_scan', 'ms each')} in the median"
    known: list[tuple[str, str]] = [("trajectory", "no reference")]
    if found["ate_rmse_m"] is not None:
        known = [
            ("trajectory", f"{shown('ate_rmse_m', 'm')} off, {shown('ate_aligned_m', 'm')} aligned"),
            ("odometry", f"{shown('dead_reckoning_ate_m', 'm')} off by dead reckoning alone"),
        ]
    surveyed = "" if found["landmark_rmse_m"] is None else f", {shown('landmark_rmse_m', 'm')} off"
    nees = [] if found["anees"] is None else [("NEES / 3", shown("anees", ""))]
    if found.get("anees_reference") is not None:
        own, other = shown("anees_reference", ""), shown("anees_reference_matched", "")
        nees.append(("", f"{own} with the reference's own error; {other} from the start that scans have"))
    rows = (
        ("replayed", f"{found['log']} with {found['slam']}, {found['association']} association"),
        ("ended", f"{found['end']} after {found['duration_s']:.1f} s, {sensed}"),
        *known,
        ("landmarks", f"{found['landmarks']}{surveyed}"),
        *nees,
        *_of_relations(found, shown),
        ("took", speed),
        ("files", f"{out}/: {', '.join(files)}"),
    )
    return "\n".join(f"{name:<12} {plain_name(text, 1000)}" for name, text in rows)


def _of_relations(found: Mapping[str, Any], shown: Callable[..., str]) -> list[tuple[str, str]]:
    if not found.get("relations_count"):
        return []
    error = f"{shown('relations_trans_m', 'm', 3)} ± {shown('relations_trans_std_m', 'm', 3)} off"
    local = shown("relations_local_trans_m", "m", 3)
    online = shown("online_relations_trans_m", "m", 3)
    rows = [
        ("relations", f"{found['relations_of']}: {error}, {local} along the way"),
        ("", f"online: {online}, of the poses believed at the time"),
    ]
    if count := found["matched_relations_count"]:
        own, other = (shown(f"matched_relations{kind}_trans_m", "m", 3) for kind in ("", "_reference"))
        rows.append(("matched", f"{own} off the {count} that scans bear witness to; the reference {other}"))
    return rows
