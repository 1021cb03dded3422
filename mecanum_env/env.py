"""The exploration environments. ``ExploreEnv`` is only wiring: act, step the world, sense, believe, observe."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from numba import njit
from numpy.typing import NDArray

from mecanum_env.arguments import (
    check_arguments,
    make_backend,
    make_config,
    make_plan,
    reset_options,
    room_seed_of,
)
from mecanum_env.episode import EpisodeRecord, Truth
from mecanum_env.ground_truth import Coverage, GroundTruth
from mecanum_env.observation import Observation, observation_space, observe
from mecanum_env.physics.floor import Floor
from mecanum_env.physics.robot import WheelTargets
from mecanum_env.physics.world import World
from mecanum_env.reward import StepOutcome, reward_terms
from mecanum_env.rooms import FloorPlan
from mecanum_env.sensing.noise import noise_stream
from mecanum_env.sensing.sensors import FilteredEncoders, Lidar, WheelEncoders
from mecanum_env.step_clock import StepClock
from mecanum_env.views.window import make_viewer
from slam.belief import Belief
from slam.dead_reckoning import TruthSlam
from slam.geometry import wrap_scalar
from slam.grids.occupancy import OccupancyGrid
from slam.odometry.filters import make_odometry_filter
from slam.settings import check_name
from slam.types import Array, Floats, Odometry, Scan

__all__ = ["ExploreEnv"]

ACTIONS = {"twist": 3, "wheels": 4}

_NOTHING = Scan(np.zeros(0), 0.0, 0.0, 0.0)


class ExploreEnv(gymnasium.Env[Observation, Floats]):
    """A mecanum robot in rooms it has never seen; see the documentation of ``mecanum_env/Explore-v0``.

    Parameters
    ----------
    action : str
        ``"twist"``: body twist as fractions of the limits; ``"wheels"``: wheel speeds FL, FR, RL, RR.
    render_mode : str, optional
        ``"rgb_array"``: truth beside belief. ``"human"``: the same in a window, shown by ``reset`` and ``step``.
    floor_plan : FloorPlan or path, optional
        Where to explore, instead of rooms that are drawn.
    config, rooms, slam, robot, lidar, noise, reward, odometry_filter
        See :func:`mecanum_env.arguments.make_config`.

    Attributes
    ----------
    canvas : dict or None
        Arrays of the observation space that ``reset`` and ``step`` fill and return from now on; None: new ones.

    Notes
    -----
    ``reset(seed=…, options=…)`` takes the options ``floor_plan`` (a :class:`FloorPlan` or a file),
    ``start_pose`` (x, y, θ in the plan's frame) and ``room_seed`` (the room of another seed). One seed gives
    the same episode, bit for bit; its room and its noise depend on neither agent nor backend.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - declared so by gymnasium.Env
        "render_modes": ["rgb_array", "human"],
        "render_fps": 10,
    }

    def __init__(
        self,
        *,
        action: str = "twist",
        render_mode: str | None = None,
        floor_plan: str | Path | FloorPlan | None = None,
        **settings: Any,
    ) -> None:
        check_arguments(settings, ExploreEnv)
        check_name("action", action, ACTIONS)
        if render_mode is not None:
            check_name("render_mode", render_mode, self.metadata["render_modes"])
        self._plan = floor_plan if isinstance(floor_plan, FloorPlan) else None
        self.config = make_config(floor_plan=floor_plan, **settings)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.config.step_s)}
        self.render_mode = render_mode
        targets = WheelTargets(self.config.robot)
        self._to_wheels = targets.of_wheels if action == "wheels" else targets.of_twist
        self.action_space = spaces.Box(-1.0, 1.0, (ACTIONS[action],), np.float32)
        self.observation_space = cast("spaces.Space[Observation]", observation_space(self.config))
        self.backend = make_backend(self.config)
        self._knows_truth = isinstance(self.backend, TruthSlam)
        self.lidar = Lidar(self.config.lidar, self.config.noise)
        self._filter = make_odometry_filter(self.config.odometry_filter, self.config.odometry_filter_config)
        self._viewer = make_viewer(render_mode, fps=self.metadata["render_fps"])
        self._ready = False
        self.canvas: Observation | None = None

    # ---- Gymnasium -----------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode: draw the room, place the robot, take the first scan."""
        super().reset(seed=seed)
        self._ready = False
        options = reset_options(options, ("floor_plan", "start_pose", "room_seed"))
        if seed is None and not hasattr(self, "truth") and self.np_random_seed >= 0:
            seed = self.np_random_seed  # with which the first episode can be had again
        episode_seed = int(self.np_random.integers(2**31)) if seed is None else int(seed)
        plan = make_plan(
            self.config, room_seed_of(options, episode_seed, self._plan),
            given=options.get("floor_plan", self._plan), start=options.get("start_pose"),
        )  # fmt: skip
        self._clock = StepClock.of_caller(self)
        self._set_up(plan, episode_seed)
        info = self.first_look()
        self._viewer.show(self)
        return self.observe(), info

    def _set_up(self, plan: FloorPlan, episode_seed: int, floor: Floor | None = None) -> None:
        """Place the robot in the plan, on the floor of another robot if there is one; nothing is sensed yet."""
        # One generator per purpose, so that nothing an agent or a backend does changes another's draws.
        world_seed, sensor_seed = np.random.SeedSequence(episode_seed).spawn(2)
        world_rng = np.random.Generator(np.random.PCG64(world_seed))
        self._sensor_rng = noise_stream(sensor_seed)
        config = self.config
        self._encoders = WheelEncoders(config.robot, config.noise, world_rng)
        self._odometer = FilteredEncoders(self._encoders, self._filter) if self._filter else self._encoders
        world = World(
            plan, config.robot, config.noise, world_rng, floor=floor,
            true_radii=self._encoders.true_radii, true_lever=self._encoders.true_lever,
        )  # fmt: skip
        ground = self._ground_truth(plan)
        self._coverage = Coverage(ground)
        self._start_backend(ground.in_start_frame(np.array(plan.start)), episode_seed)
        self.truth = Truth(ground, world, EpisodeRecord(), _NOTHING)

    def _ground_truth(self, plan: FloorPlan) -> GroundTruth:
        config = self.config
        start = np.array(plan.start, dtype=np.float64)
        return GroundTruth(
            plan, start, robot=config.robot, lidar=config.lidar, resolution=config.grid_resolution_m
        )

    def _start_backend(self, start: Array, seed: int) -> None:
        """Have the backend start over at its start pose ``(3,)``, in its own frame."""
        self.backend.reset(start, seed=seed)

    def first_look(self) -> dict[str, Any]:
        """Take the first scan, and return the first info."""
        backend, truth = self.backend, self.truth
        true_pose = truth.ground.in_start_frame(np.array(truth.world.plan.start))
        self.scan, mapped = self._look()
        truth.scan = self.scan
        self._steps = 0
        self._odometry = Odometry((0.0, 0.0, 0.0), self.config.step_s)
        self._ready = True
        if self._knows_truth:
            cast("TruthSlam", backend).give_pose(true_pose)
        backend.update(mapped)
        self._pose, self._pose_cov = backend.pose, backend.pose_cov
        self._remember()
        return self._info(self.own_coverage.update(backend.grid), true_pose)

    def step(self, action: Floats) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for one control step; see :mod:`mecanum_env.reward` for the reward."""
        if not self._ready:
            raise RuntimeError("call reset() before step()")
        config, world = self.config, self.truth.world
        collisions = world.collisions
        world.step(self._to_wheels(action), config.step_s, config.physics_step_s)
        info = self.perceive(collisions)
        success = info["coverage"] >= config.coverage_target
        terminated = success or (config.terminate_on_collision and world.collisions > 0)
        if terminated or self._clock.used >= 1.0:
            info["is_success"] = bool(success)
            info["episode_metrics"] = self.episode_metrics()
        self._viewer.show(self)
        return self.observe(), float(sum(info["reward_terms"].values())), bool(terminated), False, info

    def perceive(self, collisions: int) -> dict[str, Any]:
        """Sense what a step brought, believe it, and return its info; there were so many collisions before."""
        coverage = self.believe()
        terms = reward_terms(self.config.reward, self._outcome(self.truth.world.collisions - collisions))
        info = self._info(coverage, self.truth.pose)
        info["reward_terms"] = terms
        return info

    def believe(self) -> float:
        """Sense what a step brought and believe it; return the coverage."""
        config, truth, backend = self.config, self.truth, self.backend
        world = truth.world
        odometry = self._odometer.odometry(world.wheel_readings, config.step_s, self._sensor_rng)
        self.scan, mapped = self._look()
        self._odometry, truth.scan = odometry, self.scan
        backend.predict(odometry)
        if self._knows_truth:
            cast("TruthSlam", backend).give_pose(truth.pose)
        backend.update(mapped)
        self._pose, self._pose_cov = backend.pose, backend.pose_cov
        self._steps += 1
        self._clock.tick()
        return self.own_coverage.update(backend.grid)

    def _look(self) -> tuple[Scan, Scan]:
        """Take a scan: as the agent sees it, and as it is mapped."""
        plan = self.truth.ground.plan
        scan = self.lidar.scan(plan.segments, plan.circles, self.truth.world.pose, self._sensor_rng)
        return scan, scan

    def render(self) -> Any:
        """Return truth beside belief as an RGB image ``(h, w, 3)``; with ``"human"`` None: it is shown already."""
        if self.render_mode is None:
            gymnasium.logger.warn('render() needs render_mode="rgb_array" or "human" in gym.make')
        if self.render_mode != "rgb_array":
            return None
        if not self._ready:
            raise RuntimeError("call reset() before render()")
        from mecanum_env.views.render import render_frame

        return render_frame(self)

    def _repr_png_(self) -> bytes | None:
        """Return the frame that a notebook shows; before the first reset there is none."""
        if not hasattr(self, "truth"):
            return None
        import cv2

        from mecanum_env.views.render import render_frame

        return bytes(cv2.imencode(".png", render_frame(self)[..., ::-1])[1])

    def close(self) -> None:
        """Close the window, if there is one."""
        self._viewer.close()

    # ---- what others may read ------------------------------------------------------------------------------

    @property
    def belief(self) -> Belief:
        """What the robot knows; agents may use it."""
        return self.backend.belief

    @property
    def grid(self) -> OccupancyGrid:
        """The map that the robot goes by."""
        return self.backend.grid

    @property
    def odometry(self) -> Odometry:
        """The wheels' account of the last step, as the backend was given it."""
        return self._odometry

    @property
    def map_changes(self) -> NDArray[np.int32] | None:
        """Cells of the belief's grid whose class the last step changed, or None where the whole map was redrawn.

        Rows of ``(n, 4)``: lattice row, lattice column, class before, class now.
        """
        return self.own_coverage.changes

    @property
    def own_coverage(self) -> Coverage:
        """What the map of its belief covers."""
        return self._coverage

    def episode_metrics(self) -> dict[str, float | int | None]:
        """Return the metrics of the episode so far (see :class:`mecanum_env.episode.EpisodeRecord`)."""
        return self.truth.record.metrics(self.truth.ground, self.backend)

    # ---- parts of a step -----------------------------------------------------------------------------------

    def _remember(self) -> None:
        """Keep what the next step's reward compares with."""
        grid = self.backend.grid
        self._before = grid.known_cells, grid.entropy_bit, _entropy(self._pose_cov)

    def _outcome(self, collisions: int) -> StepOutcome:
        known_before, map_entropy_before, pose_entropy_before = self._before
        self._remember()
        known, map_entropy, pose_entropy = self._before
        config = self.config
        cell = config.grid_resolution_m**2
        vx, vy, omega = self._odometry.numbers
        robot = config.robot
        speed = math.hypot(vx, vy) / robot.max_speed_m_s + abs(omega) / robot.max_turn_rate_rad_s
        # By position: names would take as long again.
        return StepOutcome(
            (known - known_before) * cell,
            pose_entropy_before - pose_entropy,
            (map_entropy_before - map_entropy) * cell,
            collisions,
            min(speed, 1.0),
            config.step_s,
        )

    def _info(self, coverage: float, true_pose: Array) -> dict[str, Any]:
        nees = self.backend.pose_nees(true_pose)
        x, y, theta = self._pose.tolist()
        true_x, true_y, true_theta = true_pose.tolist()
        truth = self.truth
        record, collisions = truth.record, truth.world.collisions
        time_s = self._steps * self.config.step_s
        recovery = self.backend.recovery
        health, lost = recovery.health, float(recovery.lost)
        record.append((true_x, true_y, true_theta, x, y, theta, time_s, coverage, nees, health, lost))
        record.relocalisations = recovery.relocalisations
        record.collisions = collisions
        return {
            "coverage": coverage,
            "collisions": collisions,
            "path_length_m": record.path_length_m,
            "time_s": time_s,
            "true_pose": true_pose,
            "position_error_m": math.hypot(true_x - x, true_y - y),
            "heading_error_rad": abs(wrap_scalar(true_theta - theta)),
            "nees": nees,
        }

    def observe(self) -> Observation:
        """Return the observation that the last ``reset`` or ``step`` did."""
        limit = self.config.time_limit_s / self.config.step_s
        return observe(
            self.config,
            self.backend,
            self.grid,
            self.scan,
            pose=self._pose,
            pose_cov=self._pose_cov,
            twist=self._odometry.numbers,
            time_used=self._clock.used or self._steps / limit,  # of the time, where nothing limits the steps
            out=self.canvas,
        )


@njit(cache=True, nogil=True)
def _entropy(cov: Array) -> float:
    """Return the pose's differential entropy up to a constant: ½ log |Σ| [nat]."""
    a, b, c, d, e, f = cov[0, 0], cov[0, 1], cov[0, 2], cov[1, 1], cov[1, 2], cov[2, 2]
    det = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return 0.5 * math.log(max(det, 1e-60))
