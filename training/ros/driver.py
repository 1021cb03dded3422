"""A backend and an agent on the messages of a robot: scans and odometry in; twist, map and map → odom out.

It knows nothing of ROS's libraries: whatever has the fields of a message is taken, and messages come as nested
mappings (:mod:`slam.ros`). Times of messages are the robot's; when they came is told by the caller's clock.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

import agents
from agents.base import Agent
from mecanum_env.arguments import make_backend
from mecanum_env.config import EnvConfig, LidarConfig
from mecanum_env.observation import observe
from slam.backend import Backend
from slam.belief import Belief
from slam.files import quoted
from slam.geometry import compose, inverse
from slam.motion import jacobians, move, twist_between
from slam.ros import (
    Frames,
    Message,
    Mount,
    grid_message,
    header,
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
from training.ros.odometry import OdometryTrack

__all__ = ["Driver", "lidar_of"]

_LOST = 0.1  # health of a belief below which it is no good for driving, as to the agents
_WAITING = 100  # scans that are newer than all odometry so far: of the fastest lidar, two seconds
_BESIDE_M = 0.05  # that a lidar may sit off the middle line of the body that the agents drive
_NARROWEST_RAD = math.radians(30.0)
_AGAIN_S = 5.0  # after which it says again what it waits for, and what was wrong and has been good since
_ANOTHER_CLOCK_S = 10.0  # between a message and ROS's clock at first: not late, but stamped by another clock
_STAND = (0.0, 0.0, 0.0)


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
        After so long without a scan or odometry it stands [s]; what is so old by its stamp is none.
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
        self._odometry = OdometryTrack(config.robot, late_s, complain=self._complain, set_back=self._set_back)
        # Scans that odometry has not come up to: it may be later than one by more than a sweep.
        self._waiting: deque[tuple[float, Scan]] = deque(maxlen=_WAITING)
        self._heard = {"odometry": -math.inf, "scan": -math.inf}  # when it last heard what was of use
        self._came = dict.fromkeys(("odometry", "a scan", *([] if mount else ["/tf_static"])), -math.inf)
        self._now_s = -math.inf  # when the last message came
        self._one_clock: bool | None = None  # whether ROS's clock is the robot's; None: nothing came so far
        self._backend: Backend | None = None
        self._agent: Agent
        self._layout: tuple[float, float, int]  # first bearing, step and beams of the scans that are mapped
        self._scan: Scan  # the last, by the bearings of the lidar that the agent knows of
        self._at: tuple[float, Array]  # time of the last scan, and odometry, of the point behind the lidar
        self._twist: tuple[float, float, float] = _STAND
        self._base, self._odom, self._lidar = "base_link", "odom", ""  # frames
        self._wrong: dict[str, float] = {}  # what was wrong, and when last
        self._said_s = -math.inf  # when it last said what it waits for
        self.status = "waiting for odometry and a scan"

    # ---- what it hears -------------------------------------------------------------------------------------

    def hear_transforms(self, message: Any) -> None:
        """Take a ``tf2_msgs/TFMessage`` of transforms that stand still."""
        self._came["/tf_static"] = math.inf
        for placed in transforms_of(message):
            self._frames.add(placed)

    def hear_odometry(self, message: Any, now_s: float, ros_s: float = math.nan) -> None:
        """Take a ``nav_msgs/Odometry``; when it came by the caller's clock, and by ROS's if known [s]."""
        self._now_s = self._came["odometry"] = now_s
        with self._passing_over("odometry"):
            at, pose = stamp_of(message), odometry_of(message)
            self._compare_clocks(at, ros_s)
            if self._waiting:
                self._check_age(at, self._waiting[-1][0], "the scans")
            if self._odometry.add(at, pose, now_s):
                self._base = message.child_frame_id.lstrip("/") or self._base
                self._odom = message.header.frame_id.lstrip("/") or self._odom
                self._heard["odometry"] = now_s
        self._advance()

    def hear_scan(self, message: Any, now_s: float, ros_s: float = math.nan) -> None:
        """Take a ``sensor_msgs/LaserScan``; when it came by the caller's clock, and by ROS's if known [s]."""
        self._now_s = self._came["a scan"] = now_s
        with self._passing_over("scan"):
            at, scan, frame = stamp_of(message), scan_of(message), message.header.frame_id.lstrip("/")
            self._lidar = self._lidar or frame
            if frame != self._lidar:
                both = f"{quoted(self._lidar)} and {quoted(frame)}"
                raise ValueError(f"has scans in frames {both}; give a topic for each lidar")
            if np.isnan(scan.ranges).all():
                raise ValueError("measures nothing, every beam is lost; see whether the lidar turns")
            self._compare_clocks(at, ros_s)
            self._waiting.append((at, scan))
        self._advance()

    @contextmanager
    def _passing_over(self, what: str) -> Iterator[None]:
        """Pass over a message that is of no use: where none is good, it will be late, and stand."""
        try:
            yield
        except ValueError as error:
            self._complain(f"{what} {error}")

    def _compare_clocks(self, at: float, ros_s: float) -> None:
        """Refuse what is old by ROS's clock, unless the robot has another, as in a simulation.

        The first message tells: by one clock, whatever comes later and later is no simulation's.
        """
        if self._one_clock is None:
            self._one_clock = abs(ros_s - at) < _ANOTHER_CLOCK_S
        if self._one_clock:
            self._check_age(at, ros_s, "ROS's clock")

    def _check_age(self, at: float, newest: float, whose: str) -> None:
        if newest - at > self._late_s:
            raise ValueError(f"is more than {self._late_s} s behind {whose} by its stamp; see what holds it up, "
                             "and whether all have one clock")  # fmt: skip

    def _set_back(self, back_s: float) -> None:
        """Follow odometry's clock, which was set back by so much."""
        self._complain("odometry's clock was set back")
        self._waiting.clear()
        # Else it is of the clock as it is now.
        if self._backend is not None and self._at[0] > self._odometry.newest_s:
            self._at = self._at[0] + back_s, self._at[1]

    # ---- what it believes ----------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Go on to the last scan that odometry has come up to; older ones are left out."""
        newest = self._odometry.newest_s
        due = [k for k, (at, _) in enumerate(self._waiting) if at <= newest]
        if not due:
            return
        at, scan = self._waiting[due[-1]]
        for _ in range(due[-1] + 1):
            self._waiting.popleft()
        if self._backend is not None and at <= self._at[0]:
            return
        with self._passing_over("scan"):
            self._check_age(at, newest, "the odometry")
            if (pose := self._odometry.at(at)) is not None:
                self._take(at, scan, pose)

    def _take(self, at: float, scan: Scan, odometry: Array) -> None:
        """Move the belief on to a scan, and look at it."""
        self._mount = self._mount or self._mounted()
        levelled, pose = self._mount.level(scan), compose(odometry, self._beside)
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
        self._heard["scan"] = self._now_s  # not before it was of use
        if not hasattr(self, "_agent"):
            body: dict[str, Any] = {"robot": self.config.robot, "lidar": lidar, "step_s": self.config.step_s}
            self._agent = agents.make(self._agent_name, **body)
            self._agent.reset(self._backend.belief, self._seed)

    def _mounted(self) -> Mount:
        """Return where the lidar is by the transforms."""
        matrix = self._frames.between(self._base, self._lidar)
        if matrix is None:
            raise ValueError(f"is waiting for a transform from {self._base} to the lidar {self._lidar}; publish "
                             "it on /tf_static, or give --mount")  # fmt: skip
        mount = mount_of(matrix)
        if abs(mount.y_m) > _BESIDE_M:
            raise ValueError(
                f"is of a lidar {mount.y_m:.2f} m to the left of the middle; {_BESIDE_M} m is the most"
            )
        return mount

    @property
    def _beside(self) -> Array:
        """From the base to the point straight behind the lidar ``(3,)``, whose pose the backend has."""
        return np.array([0.0, self._mount.y_m if self._mount else 0.0, 0.0])

    def _begin(self, scan: Scan) -> None:
        """Start the backend, now that the lidar is known; the map begins where the base is."""
        assert self._mount is not None
        self.config = replace(self.config, lidar=lidar_of(scan, self._mount.x_m))
        self._layout = scan.angle_min, scan.angle_increment, len(scan.ranges)
        self._backend = make_backend(self.config)
        self._backend.reset(self._beside, seed=self._seed)
        lidar = self.config.lidar
        self.log(f"begun: lidar {lidar.offset_m:.2f} m ahead, {lidar.beams} beams over "
                 f"{lidar.field_of_view_deg:.0f}°")  # fmt: skip

    def _plausible(self, twist: Array) -> tuple[float, float, float]:
        vx, vy, omega = twist.tolist()
        return (vx, vy, omega) if self._odometry.is_motion(math.hypot(vx, vy), omega, 1.0) else _STAND

    # ---- what it says --------------------------------------------------------------------------------------

    def command(self, now_s: float) -> Message | None:
        """Return the ``geometry_msgs/Twist`` to drive now; to be asked for every ``config.step_s``.

        ``None`` before it has begun: then others may drive.
        """
        if self._backend is None:
            self._wait(now_s)
            return None
        late = [name for name, at in self._heard.items() if now_s - at > self._late_s]
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

    def stamped(self, twist: Message) -> Message:
        """Return a twist as a ``geometry_msgs/TwistStamped`` of the base, by the clock that stamps odometry."""
        return {"header": header(self._odometry.newest_s, self._base), "twist": twist}

    def _wait(self, now_s: float) -> None:
        """Say what it waits for before it can begin."""
        missing = [name for name, came_s in self._came.items() if now_s - came_s > _AGAIN_S]
        wrong = [text for text, last_s in self._wrong.items() if now_s - last_s < _AGAIN_S]
        status = wrong[0] if wrong else f"waiting for {' and '.join(missing) or 'a scan and odometry of one time'}"
        if status != self.status or now_s - self._said_s > _AGAIN_S:
            self.log(status)
            self.status, self._said_s = status, now_s

    def _belief_now(self) -> Belief:
        """Return the belief of the last scan, its pose moved on by the odometry since."""
        assert self._backend is not None
        belief = self._backend.belief
        if self._odometry.newest_s == self._at[0]:
            return belief
        since = compose(inverse(self._at[1]), compose(self._odometry.newest, self._beside))
        return replace(belief, pose=compose(belief.pose, since))

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
        at = compose(compose(self._backend.pose, inverse(self._at[1])), self._odometry.since_jumps)
        return transform_message("map", self._odom, self._odometry.newest_s, at)

    def pose(self) -> Message | None:
        """Return the base's pose at the last scan, as a ``geometry_msgs/PoseWithCovarianceStamped``."""
        if self._backend is None:
            return None
        pose, back = self._backend.pose, -self._beside
        lever, _ = jacobians(pose, back, 1.0)
        cov = lever @ self._backend.pose_cov @ lever.T
        return pose_with_covariance(self._at[0], "map", move(pose, back, 1.0), cov)

    @property
    def backend(self) -> Backend | None:
        """The backend, once it has begun."""
        return self._backend

    def _complain(self, text: str) -> None:
        """Say what is wrong, once as long as it is; before it has begun that is its status, and said as such."""
        lately = {old: last_s for old, last_s in self._wrong.items() if self._now_s - last_s < _AGAIN_S}
        if text not in lately and self._backend is not None:
            self.log(text)
        self._wrong = lately | {text: self._now_s}

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
