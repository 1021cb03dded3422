"""A backend and an agent on the messages of a robot: scans and odometry in; twist, map and map → odom out.

It knows nothing of ROS's libraries: whatever has the fields of a message is taken, and messages come as nested
mappings (:mod:`slam.ros`). Times of messages are the robot's; when they came is told by the caller's clock.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any, Concatenate, ParamSpec

import numpy as np

import agents
from agents.base import Agent
from mecanum_env.arguments import make_backend
from mecanum_env.config import EnvConfig, LidarConfig
from mecanum_env.observation import observe
from slam.backend import Backend
from slam.belief import Belief
from slam.geometry import compose, inverse, wrap_scalar
from slam.motion import twist_between
from slam.ros import (
    Frames,
    Message,
    Mount,
    grid_message,
    mount_of,
    odometry_of,
    pose_with_covariance,
    resampled,
    scan_of,
    stamp_of,
    transform_message,
    transforms_of,
    twist_message,
)
from slam.settings import require
from slam.types import FARTHEST_M, Array, Odometry, Scan

__all__ = ["Driver", "lidar_of"]

_LOST = 0.1  # health of a belief below which it is no good for driving, as to the agents
_KEPT = 1000  # odometry messages: seconds of the fastest
_WAITING = 100  # scans that are newer than all odometry so far: of the fastest lidar, two seconds
_TOO_FAST = 3.0  # times its limits: no robot's motion, but odometry that began anew
_LEAST_S = 0.1  # in which so much way is no jump: stamps of single messages may lie closer
_BESIDE_M = 0.05  # that a lidar may sit off the middle line of the body that the agents drive
_NARROWEST_RAD = math.radians(30.0)
_STAND = (0.0, 0.0, 0.0)

_Heard = ParamSpec("_Heard")


def _guarded(hear: Callable[Concatenate[Driver, _Heard], None]) -> Callable[Concatenate[Driver, _Heard], None]:
    """Pass over a message that says what no robot does: where none is good, it will be late, and stand."""

    @wraps(hear)
    def guarded(self: Driver, /, *heard: _Heard.args, **named: _Heard.kwargs) -> None:
        try:
            hear(self, *heard, **named)
        except ValueError as error:
            self._complain(f"{hear.__name__.removeprefix('hear_')} {error}")

    return guarded


class Driver:
    """Drives a robot by what it hears; it stands whenever what it hears is late, or its belief is lost.

    Parameters
    ----------
    config : EnvConfig
        Robot, noise and backend; what it says of the lidar gives way to what the first scan says.
    agent : str
        Name of an agent, or a policy's file.
    mount : Mount, optional
        Where the lidar is on the robot; by default as transforms say (:meth:`hear_transforms`).
    seed : int
        Of agents and backends that draw.
    late_s : float
        After so long without a scan or odometry it stands [s].
    log : callable
        Told in a line what there is to know.

    Raises
    ------
    ValueError
        For a name that is not known.
    """

    def __init__(
        self, config: EnvConfig, agent: str, *, mount: Mount | None = None, seed: int = 0, late_s: float = 0.5,
        log: Callable[[str], None] = print,
    ) -> None:  # fmt: skip
        agents.check(agent)
        require(mount is None or abs(mount.y_m) <= _BESIDE_M, f"a mount is {_BESIDE_M} m off the middle at most")
        make_backend(config)  # now, not at the first scan, it is known to fit
        self.config, self._agent_name, self._seed, self._late_s, self.log = config, agent, seed, late_s, log
        self._mount, self._frames = mount, Frames()
        self._odometry: deque[tuple[float, Array]] = deque(maxlen=_KEPT)
        self._since_jumps = np.zeros(3)  # what its poses are moved by, for jumps to be no motion
        self._older_since = math.inf  # when messages began to be older than the last one that was taken
        # Scans that odometry has not come up to: it may be later than one by more than a sweep.
        self._waiting: deque[tuple[float, str, Scan]] = deque(maxlen=_WAITING)
        self._heard = {"odometry": -math.inf, "scan": -math.inf}
        self._backend: Backend | None = None
        self._agent: Agent
        self._layout: tuple[float, float, int]  # first bearing, step and beams of the scans that are mapped
        self._scan: Scan  # the last, by the bearings of the lidar that the agent knows of
        self._at: tuple[float, Array]  # time and odometry of the last scan
        self._twist: tuple[float, float, float] = _STAND
        self._base, self._odom = "base_link", "odom"
        self._complaint = ""
        self.status = "waiting for odometry and a scan"

    # ---- what it hears -------------------------------------------------------------------------------------

    @_guarded
    def hear_transforms(self, message: Any) -> None:
        """Take a ``tf2_msgs/TFMessage`` of transforms that stand still."""
        for placed in transforms_of(message):
            self._frames.add(placed)

    @_guarded
    def hear_odometry(self, message: Any, now_s: float) -> None:
        """Take a ``nav_msgs/Odometry`` that came at a time of the caller's clock [s]."""
        at, pose = stamp_of(message), odometry_of(message)
        if self._odometry and at <= self._odometry[-1][0]:  # out of order
            self._older_since = min(self._older_since, now_s)
            if now_s - self._older_since < self._late_s:
                return
        if self._odometry and math.isfinite(self._older_since):  # the caller's clock says how old what is kept is
            back_s = at - (now_s - self._heard["odometry"]) - self._odometry[-1][0]
            if back_s < -_LEAST_S:
                self._complain("odometry's clock was set back")
                self._odometry = deque(((t + back_s, kept) for t, kept in self._odometry), maxlen=_KEPT)
                self._waiting.clear()
                if (
                    self._backend is not None and self._at[0] > self._odometry[-1][0]
                ):  # else of the clock as it is now
                    self._at = self._at[0] + back_s, self._at[1]
        self._older_since = math.inf
        self._base = message.child_frame_id.lstrip("/") or self._base
        self._odom = message.header.frame_id.lstrip("/") or self._odom
        self._odometry.append((at, self._without_jumps(at, pose)))
        self._heard["odometry"] = now_s
        self._advance(now_s)

    @_guarded
    def hear_scan(self, message: Any, now_s: float) -> None:
        """Take a ``sensor_msgs/LaserScan`` that came at a time of the caller's clock [s]."""
        self._waiting.append((stamp_of(message), message.header.frame_id.lstrip("/"), scan_of(message)))
        self._advance(now_s)

    def _without_jumps(self, at: float, pose: Array) -> Array:
        """Return where the odometry would be at a time, had it never jumped; a jump is no motion."""
        if not self._odometry:
            return pose
        (before, last), moved = self._odometry[-1], compose(self._since_jumps, pose)
        robot, most_s = self.config.robot, _TOO_FAST * max(at - before, _LEAST_S)
        far = math.hypot(moved[0] - last[0], moved[1] - last[1]) > most_s * robot.max_speed_m_s
        if far or abs(wrap_scalar(float(moved[2] - last[2]))) > most_s * robot.max_turn_rate_rad_s:
            self._complain("odometry jumped; the jump is left out")
            self._since_jumps = compose(last, inverse(pose))
            return last.copy()
        return moved

    # ---- what it believes ----------------------------------------------------------------------------------

    def _advance(self, now_s: float) -> None:
        """Go on to the last scan that odometry has come up to; older ones are left out."""
        newest = self._odometry[-1][0] if self._odometry else -math.inf
        due = [k for k, (at, _, _) in enumerate(self._waiting) if at <= newest]
        if not due:
            return
        at, frame, scan = self._waiting[due[-1]]
        for _ in range(due[-1] + 1):
            self._waiting.popleft()
        pose = self._odometry_at(at)
        if pose is None or (self._backend is not None and at <= self._at[0]):
            return
        if self._mount is None:
            matrix = self._frames.between(self._base, frame)
            if matrix is None:
                self.status = f"waiting for a transform from {self._base} to the lidar {frame}"
                return
            self._mount = mount_of(matrix)
        levelled = self._mount.level(scan)
        if self._backend is None:
            self._begin(levelled)
        else:
            dt = at - self._at[0]
            self._twist = self._plausible(twist_between(self._at[1], pose, dt))
            self._backend.predict(Odometry(self._twist, dt))
        assert self._backend is not None
        lidar, layout = self.config.lidar, self._layout
        mapped = Scan(resampled(levelled, *layout), *layout[:2], lidar.range_max_m, lidar.range_min_m)
        mapped.ranges[mapped.ranges > lidar.range_max_m] = math.inf
        ahead = resampled(mapped, lidar.angle_min, lidar.angle_increment, lidar.beams)
        self._scan = mapped._replace(
            ranges=ahead, angle_min=lidar.angle_min, angle_increment=lidar.angle_increment
        )
        self._at = at, pose
        self._backend.update(mapped)
        self._heard["scan"] = now_s  # not before it was of use
        if not hasattr(self, "_agent"):
            body: dict[str, Any] = {"robot": self.config.robot, "lidar": lidar, "step_s": self.config.step_s}
            self._agent = agents.make(self._agent_name, **body)
            self._agent.reset(self._backend.belief, self._seed)

    def _begin(self, scan: Scan) -> None:
        """Start the backend, now that the lidar is known."""
        assert self._mount is not None
        if abs(self._mount.y_m) > _BESIDE_M:
            beside, self._mount = self._mount.y_m, None
            raise ValueError(f"is of a lidar {beside:.2f} m to the left of the middle; {_BESIDE_M} m is the most")
        self.config = replace(self.config, lidar=lidar_of(scan, self._mount.x_m))
        self._layout = scan.angle_min, scan.angle_increment, len(scan.ranges)
        self._backend = make_backend(self.config)
        self._backend.reset(seed=self._seed)
        lidar = self.config.lidar
        self.log(f"begun: lidar {lidar.offset_m:.2f} m ahead, {lidar.beams} beams over "
                 f"{lidar.field_of_view_deg:.0f}°")  # fmt: skip

    def _odometry_at(self, at: float) -> Array | None:
        """Return the odometry's pose ``(3,)`` at a time, between two messages; ``None`` before the first kept."""
        after = next((k for k, (time_s, _) in enumerate(self._odometry) if time_s >= at), None)
        if after is None or (after == 0 and self._odometry[0][0] > at):
            return None
        (t1, pose), (t0, before) = self._odometry[after], self._odometry[max(after - 1, 0)]
        if t1 == at:
            return pose
        share = (at - t0) / (t1 - t0)
        x, y, theta = before + share * np.array([*(pose - before)[:2], wrap_scalar(float(pose[2] - before[2]))])
        return np.array([x, y, wrap_scalar(float(theta))])

    def _plausible(self, twist: Array) -> tuple[float, float, float]:
        vx, vy, omega = twist.tolist()
        robot = self.config.robot
        if max(math.hypot(vx, vy) / robot.max_speed_m_s, abs(omega) / robot.max_turn_rate_rad_s) > _TOO_FAST:
            self._complain("odometry jumped; the jump is left out")
            return _STAND
        return vx, vy, omega

    # ---- what it says --------------------------------------------------------------------------------------

    def command(self, now_s: float) -> Message | None:
        """Return the ``geometry_msgs/Twist`` to drive now; to be asked for every ``config.step_s``.

        ``None`` before it has begun: then others may drive.
        """
        late = [name for name, at in self._heard.items() if now_s - at > self._late_s]
        if self._backend is None:
            return None
        if late:
            self._become(f"standing: no {' and no '.join(late)} for {self._late_s} s")
        elif self._backend.recovery.lost or self._backend.health < _LOST:
            self._become("standing: the belief is lost")
        else:
            action = self._agent.act(self._observation(), self._belief_now())
            self._become(self._agent.status)
            robot = self.config.robot
            limits = np.array([robot.max_speed_m_s, robot.max_speed_m_s, robot.max_turn_rate_rad_s])
            twist = limits * action
            fastest_m_s = float(np.abs(twist) @ (1.0, 1.0, robot.lever_m))  # of the wheels, as in the environment
            return twist_message((twist / max(fastest_m_s / robot.max_speed_m_s, 1.0)).tolist())
        return twist_message(list(_STAND))

    def _belief_now(self) -> Belief:
        """Return the belief of the last scan, its pose moved on by the odometry since."""
        assert self._backend is not None
        belief, newest = self._backend.belief, self._odometry[-1][1]
        if newest is self._at[1]:
            return belief
        return replace(belief, pose=compose(belief.pose, compose(inverse(self._at[1]), newest)))

    def _observation(self) -> Any:
        backend = self._backend
        assert backend is not None
        return observe(
            self.config, backend, backend.grid, self._scan, pose=backend.pose, pose_cov=backend.pose_cov,
            twist=self._twist, time_used=0.0,
        )  # fmt: skip

    def map(self) -> Message | None:
        """Return the map as a ``nav_msgs/OccupancyGrid`` in the frame ``map``; ``None`` before the first scan."""
        if self._backend is None:
            return None
        grid = self._backend.grid
        return grid_message(self._at[0], "map", grid.classes(), grid.resolution, grid.origin)

    def map_to_odom(self) -> Message | None:
        """Return map → odom as a ``geometry_msgs/TransformStamped``, of the time of the newest odometry."""
        if self._backend is None:
            return None
        at = compose(compose(self._backend.pose, inverse(self._at[1])), self._since_jumps)
        return transform_message("map", self._odom, self._odometry[-1][0], at)

    def pose(self) -> Message | None:
        """Return where it believes to be, as a ``geometry_msgs/PoseWithCovarianceStamped`` of the last scan."""
        if self._backend is None:
            return None
        return pose_with_covariance(self._at[0], "map", self._backend.pose, self._backend.pose_cov)

    @property
    def backend(self) -> Backend | None:
        """The backend, once it has begun."""
        return self._backend

    def _complain(self, text: str) -> None:
        if text != self._complaint:
            self.log(text)
            self._complaint = text

    def _become(self, status: str) -> None:
        if status != self.status:
            self.log(status)
            self.status = status


def lidar_of(scan: Scan, offset_m: float) -> LidarConfig:
    """Return the lidar that made a level scan: a circle, or the sector around straight ahead that it sees whole.

    Raises
    ------
    ValueError
        Where that sector is too narrow, or a number is none of a lidar's.
    """
    step = scan.angle_increment
    last = scan.angle_min + (len(scan.ranges) - 1) * step
    if last - scan.angle_min + step > 2.0 * math.pi - 0.5 * step:
        beams, sweep = round(2.0 * math.pi / step), 2.0 * math.pi
    else:
        half = math.floor(min(-scan.angle_min, last) / step + 1e-3) * step
        beams, sweep = 2 * round(half / step) + 1, 2.0 * half
        if half < 0.5 * _NARROWEST_RAD:
            raise ValueError(f"sees from {math.degrees(scan.angle_min):.0f}° to {math.degrees(last):.0f}°; "
                             "15° to either side of straight ahead are the least to drive by")  # fmt: skip
    return LidarConfig(
        beams=beams, field_of_view_deg=min(math.degrees(sweep), 360.0), offset_m=offset_m,
        range_min_m=scan.range_min, range_max_m=min(scan.range_max, FARTHEST_M),
    )  # fmt: skip
