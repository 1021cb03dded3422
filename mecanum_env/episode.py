"""One episode: what is really so, what happened, and what it amounts to."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass

import numpy as np

from mecanum_env.ground_truth import GroundTruth, on_lattice
from mecanum_env.physics.world import World
from mecanum_env.rooms.floor_plan import FloorPlan
from slam.accounts.landmarks import handed_out
from slam.backend import Backend
from slam.belief import Belief
from slam.grids.occupancy import OCCUPIED
from slam.metrics import measures as metrics
from slam.types import Array, Scan

__all__ = ["EpisodeRecord", "Truth"]

WALL_TOLERANCE_M = 0.1
"""A mapped wall stands rightly where a true one is no farther than this."""

# Columns of the record.
_TRUE, _ESTIMATE, _TIME, _COVERAGE, _NEES, _HEALTH, _LOST = slice(0, 3), slice(3, 6), 6, 7, 8, 9, 10
_COLUMNS = 11


class EpisodeRecord:
    """Poses (true and believed, in the start frame), coverage, NEES and health of every step."""

    def __init__(self) -> None:
        self._numbers = array("d")  # rows one after the other; a row of a NumPy array takes 1 µs longer to write
        self._count = 0
        self._last = (0.0, 0.0)
        self.path_length_m = 0.0
        self.collisions = 0
        self.relocalisations = 0

    def append(self, row: tuple[float, ...]) -> None:
        """Add one step: true and believed pose (x, y, θ), time [s], coverage, NEES, health, 1 if lost.

        The first is the start itself.
        """
        self._numbers.extend(row)
        x, y = row[0], row[1]
        if self._count:
            last_x, last_y = self._last
            self.path_length_m += math.hypot(x - last_x, y - last_y)
        self._last = x, y
        self._count += 1

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._count

    @property
    def _rows(self) -> Array:
        return np.array(self._numbers).reshape(-1, _COLUMNS)

    @property
    def times(self) -> Array:
        """Simulated time of each row ``(n,)`` [s]."""
        return self._rows[:, _TIME]

    @property
    def true_poses(self) -> Array:
        """True poses ``(n, 3)`` in the start frame."""
        return self._rows[:, _TRUE]

    @property
    def estimates(self) -> Array:
        """Believed poses ``(n, 3)`` in the start frame."""
        return self._rows[:, _ESTIMATE]

    @property
    def coverage(self) -> Array:
        """Coverage after each row ``(n,)``."""
        return self._rows[:, _COVERAGE]

    @property
    def nees(self) -> Array:
        """Pose NEES of each row ``(n,)``, ideally 3 on average."""
        return self._rows[:, _NEES]

    @property
    def health(self) -> Array:
        """Health of the belief after each row ``(n,)``."""
        return self._rows[:, _HEALTH]

    def metrics(self, truth: GroundTruth, backend: Backend) -> dict[str, float | int | None]:
        """Return ``episode_metrics``: plain numbers, deterministic, ``None`` where not reached or not defined.

        NEES is infinite where an error was ruled out.
        """
        rows = self._rows
        times, coverage = rows[:, _TIME], rows[:, _COVERAGE]
        belief = backend.belief
        corners = metrics.corner_deviation(handed_out(backend).points, truth.corners)
        end = rows[-1]
        heading = metrics.heading_errors(end[None, _TRUE], end[None, _ESTIMATE])
        # The start is known by definition: NEES counts from the first step on.
        anees = float(metrics.anees(rows[1:, _NEES]))
        return {
            "coverage": float(coverage[-1]),
            "time_s": round(float(times[-1]), 6),
            "steps": self._count - 1,
            "path_length_m": self.path_length_m,
            "collisions": self.collisions,
            "time_to_50_s": metrics.time_to(coverage, times, level=0.5),
            "time_to_90_s": metrics.time_to(coverage, times, level=0.9),
            "time_to_95_s": metrics.time_to(coverage, times, level=0.95),
            "time_to_99_s": metrics.time_to(coverage, times, level=0.99),
            **wall_metrics(score_map(truth, belief)),
            "corner_mean_m": _number(corners.mean),
            "corner_max_m": _number(corners.max),
            "ate_rmse_m": metrics.ate(rows[:, _TRUE], rows[:, _ESTIMATE]),
            "final_position_error_m": float(np.hypot(end[0] - end[3], end[1] - end[4])),
            "final_heading_error_rad": abs(float(heading[0])),
            "anees": None if math.isnan(anees) else anees,
            "health_mean": float(rows[:, _HEALTH].mean()),
            "lost_s": round(float(rows[:, _LOST] @ np.diff(times, prepend=times[0])), 6),
            "relocalisations": self.relocalisations,
            "landmarks": len(belief.landmarks),
        }


@dataclass
class Truth:
    """What is really so: for metrics and drawing only."""

    ground: GroundTruth
    world: World
    record: EpisodeRecord
    scan: Scan

    @property
    def plan(self) -> FloorPlan:
        """The floor plan, in the world frame."""
        return self.ground.plan

    @property
    def pose(self) -> Array:
        """True pose ``(3,)`` in the start frame, which is the belief's."""
        return self.ground.in_start_frame(self.world.pose)


def score_map(truth: GroundTruth, belief: Belief) -> metrics.MapScore:
    """Compare the belief's walls with the true ones, within :data:`WALL_TOLERANCE_M`, or the nearest eight cells.

    Two rasters of one wall at an angle differ by a cell, diagonally, too. What the belief has beyond the true
    plan's extent counts as wrong as far as ten metres out.
    """
    margin = round(10.0 / truth.resolution)
    true_walls = on_lattice(truth.walls, truth.lattice_origin, truth, margin)
    walls = on_lattice(belief.grid.classes() == OCCUPIED, belief.grid.lattice_origin, truth, margin)
    tolerance = max(WALL_TOLERANCE_M / truth.resolution, math.sqrt(2.0))
    return metrics.compare_walls(walls, true_walls, tolerance_cells=tolerance)


def wall_metrics(score: metrics.MapScore) -> dict[str, float | None]:
    """Return the score of a map as ``episode_metrics`` has it."""
    return {f"map_{name}": _number(value) for name, value in score._asdict().items()}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
