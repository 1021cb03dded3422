"""What every estimator is to the outside: ``predict`` → ``update`` → ``belief``, and a grid drawn on the way."""

from __future__ import annotations

import abc
import copy
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np

from slam.belief import Belief
from slam.features.extraction import FeatureConfig, FeatureExtractor
from slam.geometry import wrap_scalar
from slam.grids.key_scans import KeyScanConfig, KeyScans
from slam.grids.occupancy import OccupancyGrid
from slam.health.monitor import HealthConfig
from slam.health.recovery import Recovery
from slam.health.relocalisation import RelocalisationConfig
from slam.metrics.measures import nees_pose
from slam.motion import OdometryNoise
from slam.settings import Config, Within
from slam.types import Array, Floats, Indices, Observations, Odometry, Scan

__all__ = ["Backend", "BackendConfig", "SurfaceBackend", "found_cov"]


@dataclass(frozen=True, kw_only=True)
class BackendConfig(Config):
    """What every backend needs to know of the robot, and of the map it shall draw."""

    # L: how far ahead of the body's centre the sensor sits
    lidar_offset_m: Annotated[float, Within("[-10, 10]")] = 0.2
    body_radius_m: Annotated[float, Within("[0.01, 10]")] = 0.25  # of the disc that is marked as visited
    # Of the body, its middle at the pose: whether it touches something. 0: not known, and not asked.
    body_length_m: Annotated[float, Within("[0, 10]")] = 0.0
    body_width_m: Annotated[float, Within("[0, 10]")] = 0.0
    grid_resolution_m: Annotated[float, Within("[0.01, 1]")] = 0.05
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    key_scans: KeyScanConfig = field(default_factory=KeyScanConfig)
    health: HealthConfig = field(default_factory=HealthConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    # Of the start pose where none is given: never exactly zero.
    start_sigma_m: Annotated[float, Within("[1e-9, 10]")] = 1e-6  # a map begins where its robot does
    start_sigma_rad: Annotated[float, Within("[1e-9, 10]")] = 1e-6


class Backend(abc.ABC):
    """An estimator: feed it odometry and scans (or landmark observations), read its belief.

    Subclasses estimate; this class draws the grid from the estimated poses, and watches whether scans agree with
    it (:mod:`slam.health.recovery`).
    """

    observes_landmarks: ClassVar[bool] = True
    """Whether ``observe`` has a use for landmark observations; where not, it raises ``ValueError``."""

    relocalises: ClassVar[bool] = False
    """Whether the pose is found anew where the belief is lost, which takes ``_place``; else health just tells."""

    def __init__(self, config: BackendConfig) -> None:
        self.config = config
        self.extractor = FeatureExtractor(config.features)
        self.grid = OccupancyGrid(config.grid_resolution_m)
        self.key_scans = KeyScans(config.key_scans)
        self.recovery = Recovery(config.health, config.relocalisation, config.lidar_offset_m)
        self._doubtful = False  # whether the scan at hand spoke against the predicted pose
        self._recovers = self.relocalises and config.health.recover
        self._checked: tuple[object, ...] = ()  # what was a scan at last, but for the ranges themselves
        self._first: tuple[Array, Array] | None = None  # pose and covariance at the first scan

    def reset(
        self, pose: Array | tuple[float, float, float] = (0.0, 0.0, 0.0), *,
        pose_cov: Array | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        """Start over at ``pose`` ``(3,)`` with covariance ``(3, 3)``, map and landmarks empty.

        ``seed`` matters to backends that draw samples.
        """
        start = np.array(pose, dtype=np.float64)
        if start.shape != (3,) or not np.all(np.isfinite(start)):
            raise ValueError(f"a pose is three finite numbers x, y, θ; got {pose!r}")
        start[2] = wrap_scalar(float(start[2]))
        if pose_cov is None:
            c = self.config
            pose_cov = np.diag([c.start_sigma_m**2, c.start_sigma_m**2, c.start_sigma_rad**2])
        cov = np.array(pose_cov, dtype=np.float64)
        if cov.shape != (3, 3) or not np.all(np.isfinite(cov)):
            raise ValueError("a pose covariance is a finite (3, 3) matrix")
        least = float(np.linalg.eigvalsh(cov)[0])
        if not np.allclose(cov, cov.T) or least < -1e-9 * max(np.trace(cov), 0.0):
            raise ValueError(f"a pose covariance is symmetric and has no negative eigenvalue, got {cov.tolist()}")
        if least < _SURE:
            cov += _SURE * np.eye(3)  # known exactly: but its inverse is asked for
        self.grid = OccupancyGrid(self.config.grid_resolution_m)
        self.key_scans = KeyScans(self.config.key_scans)
        self.recovery.reset()
        self._doubtful, self._first = False, None
        self._start(start, cov, seed)

    @abc.abstractmethod
    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        """Set the estimator to its initial state."""

    @abc.abstractmethod
    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured."""

    def update(self, scan: Scan) -> None:
        """Correct by a scan, and draw it into the grid; while the belief is lost, look for where it was taken.

        Raises ``ValueError`` where it is no scan; nothing has changed then.
        """
        ranges = scan.ranges
        form = getattr(ranges, "shape", None), getattr(ranges, "dtype", None), *scan[1:]
        if form != self._checked:
            scan.check()
            self._checked = form
        scan = scan.by_rep_117()
        if self._first is None:
            self._first = self.pose, self._drawing_cov()
        recovery = self.recovery
        if recovery.lost:
            place = recovery.search(self.grid, scan, self._foreseen(scan)[:3].copy(), self.pose_cov)
            if place is not None:
                self._relocate(place.pose, place.cov, scan)
            elif not recovery.lost:
                self._update(scan)
            return
        foreseen = self._foreseen(scan)
        if recovery.calm(self.grid, foreseen, scan):
            recovery.kept, self._doubtful = None, False
            self._update(scan)
            return
        x, y, theta = foreseen[:3].tolist()
        seen = recovery.look(self.grid, (x, y, theta), scan)
        self._doubtful = recovery.monitor.doubtful(seen)
        # After a loop has closed, the map is another one than what is drawn: it may be that which disagrees.
        if self._doubtful and recovery.kept is None and self._redraw_if_moved():
            seen = recovery.look(self.grid, (x, y, theta), scan)
            self._doubtful = recovery.monitor.doubtful(seen)
        if self._doubtful and self._drawing_gives_way(x, y, scan):
            recovery.kept, self._doubtful = None, False
            self._update(scan)
            return
        if not self._doubtful:
            recovery.kept = None
            recovery.monitor.take(seen, self._end_variance())
            self._update(scan)
        elif not self._recovers:
            recovery.monitor.take(seen, self._end_variance())
            self._update(scan)
        else:
            if recovery.kept is None:
                recovery.kept, recovery.waited = self._copy(), 0
                recovery.unsure = self._end_variance() > recovery.config.blur_m**2
            self._update(scan)
            if recovery.kept is not None and recovery.gone(self.grid, self.pose, scan):
                self._put_back(recovery.kept)
                recovery.give_up()

    def _foreseen(self, scan: Scan) -> Array:
        """Return the pose of the body ``(≥ 3,)`` that a scan is first held against the map from; maybe a view."""
        return self.pose

    def _update(self, scan: Scan) -> None:
        """Correct by a scan, and draw it into the grid. One that overrides ``update`` instead is not watched."""
        raise NotImplementedError(f"{type(self).__name__} has neither update nor _update")

    @abc.abstractmethod
    def observe(self, observations: Observations) -> None:
        """Correct by landmark observations without a scan."""

    @property
    @abc.abstractmethod
    def pose(self) -> Array:
        """Pose mean ``(3,)``: x [m], y [m], θ [rad]. A copy."""

    @property
    @abc.abstractmethod
    def pose_cov(self) -> Array:
        """Pose covariance ``(3, 3)``. A copy."""

    def pose_nees(self, true_pose: Array) -> float:
        """Return the NEES of the pose against the truth ``(3,)``, in the error that the covariance speaks of."""
        return float(nees_pose(self.pose, self.pose_cov, np.asarray(true_pose, dtype=np.float64)))

    @property
    @abc.abstractmethod
    def belief(self) -> Belief:
        """Everything believed now."""

    # A map may well have no landmarks: what follows is then as it should be.

    @property
    def landmark_count(self) -> int:
        """Number of landmarks in the map."""
        return 0

    def landmark_details(self) -> tuple[Indices, Array]:
        """Return per landmark how often it was seen ``(n,)`` and its direction [rad] (nan: unknown)."""
        return np.zeros(0, np.int64), np.zeros(0)

    def near_landmarks(self, out: Floats) -> None:
        """Write the nearest landmarks in the robot frame, nearest first.

        Rows of ``(k, 6)``: x, y [m], σxx, σxy, σyy [m²] of the landmark's own covariance, 1; zeros where
        there are fewer. Nothing exceeds :data:`slam.gaussian.joint_gaussian.OBSERVED_LIMIT`.
        """
        out[:] = 0.0

    def sensor_pose(self, body: Array | None = None) -> Array:
        """Return where the sensor is ``(3,)`` with the body at a pose ``(3,)``, the believed one if left out."""
        x, y, theta = (self.pose if body is None else body).tolist()
        offset = self.config.lidar_offset_m
        return np.array([x + offset * math.cos(theta), y + offset * math.sin(theta), theta])

    def _draw(self, scan: Scan) -> None:
        """Draw a scan from the believed pose, and keep it where the sensor has moved on.

        Not one that contradicts the map from there.
        """
        config, grid, surface = self.config, self.grid, self.extractor.surface
        body_x, body_y, theta = self.pose.tolist()
        if self._doubtful and self._recovers and self._contradicts((body_x, body_y, theta), scan):
            return
        offset = config.lidar_offset_m
        x, y = body_x + offset * math.cos(theta), body_y + offset * math.sin(theta)
        grid.integrate((x, y, theta), scan, surface, body=(body_x, body_y, config.body_radius_m))
        if self.key_scans.wants(x, y, theta):
            self._keep(np.array([x, y, theta]), scan)

    def _keep(self, sensor_pose: Array, scan: Scan) -> None:
        """Keep a scan that was drawn, for redrawing."""
        none = np.zeros(0, np.int64), np.zeros((0, 3)), self.pose_cov
        self.key_scans.keep(sensor_pose, scan, self.extractor.surface, *none, variance=self._end_variance())

    # ---- health ------------------------------------------------------------------------------------------------

    @property
    def health(self) -> float:
        """Probability that the true pose lies within the belief's 99.7 % region (NEES ≤ 14.16)."""
        return self.recovery.health

    def _end_variance(self) -> float:
        """Return the variance [m²] of a beam's end three metres off, by what the pose has become unsure of.

        What it was unsure of at the first scan is in all that was drawn since, and has no scan disagree with that.
        """
        cov, (x, y, _) = self._drawing_cov(), self.pose.tolist()
        first, at_first = self._first or ((x, y, 0.0), np.zeros((3, 3)))
        dx, dy = x - float(first[0]), y - float(first[1])
        along = cov[0, 0] - (at_first[0, 0] - 2.0 * dy * at_first[0, 2] + dy * dy * at_first[2, 2])
        across = cov[1, 1] - (at_first[1, 1] + 2.0 * dx * at_first[1, 2] + dx * dx * at_first[2, 2])
        turned = cov[2, 2] - at_first[2, 2]
        return float(max(along, 0.0) + max(across, 0.0) + 9.0 * max(turned, 0.0))

    def _drawing_cov(self) -> Array:
        """Return the covariance ``(3, 3)`` of the pose in the frame in which it draws."""
        return self.pose_cov

    def _drawing_gives_way(self, x: float, y: float, scan: Scan) -> bool:
        """Tell whether the map around a pose at (x, y) is old, and it or the pose so unsure that both must differ.

        Where they contradict each other, that says nothing of the pose, and the scan is drawn over the map.
        """
        drawn = self.key_scans.old_variance(x, y, scan.range_max)
        return drawn > 0.0 and max(drawn, self._end_variance()) > self.recovery.config.unsure_m**2

    def _contradicts(self, body: tuple[float, float, float], scan: Scan) -> bool:
        """Take in what a doubtful scan says of the corrected pose of the body; tell whether it still disagrees."""
        recovery = self.recovery
        seen = recovery.look(self.grid, body, scan)
        recovery.monitor.take(seen, self._end_variance())
        if recovery.monitor.doubtful(seen):
            return True
        recovery.kept = None
        return False

    def _copy(self) -> dict[str, Any]:
        """Return a copy of all that estimates; not of the map that is shown, which is redrawn instead."""
        kept: dict[str, Any] = {}
        for name, value in self.__dict__.items():
            if name not in _NOT_COPIED:  # what is in lists does not change
                kept[name] = list(value) if isinstance(value, list) else copy.deepcopy(value)
        kept["key_scan_poses"] = self.key_scans.poses
        return kept

    def _put_back(self, kept: dict[str, Any]) -> None:
        """Become again what was copied, except for the pose: that the wheels have carried on."""
        pose, pose_cov = self.pose, self.pose_cov
        poses = kept.pop("key_scan_poses")
        self.__dict__.update(kept)
        self._carry_on(pose, pose_cov)
        self._redraw_kept(poses)

    def _carry_on(self, pose: Array, pose_cov: Array) -> None:
        """Go on from what was copied at the pose ``(3,)`` that the wheels have reached by now."""
        self._place(pose, pose_cov)

    def _redraw_kept(self, poses: Array) -> None:
        """Redraw the map from the key scans that there were when their poses ``(n, 3)`` were kept."""
        self.key_scans.put_back(self.grid, poses)

    def _redraw_if_moved(self) -> bool:
        """Redraw the map where the estimates have left what is drawn by more than half a cell; tell whether."""
        return False

    def _place(self, pose: Array, pose_cov: Array) -> None:
        """Set the robot's pose ``(3,)``, unsure by a covariance ``(3, 3)`` that is correlated with nothing.

        To be overridden where ``relocalises``. In the EKF family it stays off by what the whole map is off by.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot be placed elsewhere")

    def _relocate(self, pose: Array, cov: Array, scan: Scan) -> None:
        """Go on from a pose ``(3,)`` that a scan was found to be taken from."""
        self._place(pose, cov + found_cov())
        self._update(scan)


class SurfaceBackend(Backend):
    """A backend without landmarks: ``landmarks`` of its belief are empty, and ``observe`` refuses."""

    observes_landmarks = False
    maps: ClassVar[str] = "this backend maps surfaces"
    """Its name and what it maps instead, in words."""

    def observe(self, observations: Observations) -> None:
        """Refuse: its maps have no use for landmark observations."""
        raise ValueError(
            f"{self.maps}, not landmarks: it takes scans (`update`), not landmark observations; "
            "use ekf or fastslam2 for those"
        )

    @property
    def belief(self) -> Belief:
        """Pose and grid; landmarks are empty, and there is no joint covariance."""
        return Belief.without_landmarks(self.pose, self.pose_cov, self.grid, self.health)


_SURE = 1e-12  # variance [m², rad²] of a start that is said to have none


def found_cov() -> Array:
    """Return the covariance ``(3, 3)`` of a place on a map of cells, besides what the match says."""
    return np.diag(np.square([0.03, 0.03, 0.01]))


_NOT_COPIED = {
    "config", "extractor", "grid", "key_scans", "recovery", "witness", "_given", "_doubtful", "_recovers",
}  # fmt: skip
