"""``mecanum_env/ExploreFrontier-v0``: one decision a step, which of the view points to drive to."""

from __future__ import annotations

import math
import operator
from collections import defaultdict
from collections.abc import Mapping
from typing import Annotated, Any, SupportsIndex, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from agents.learned.choice import CANDIDATE, STATE, Choice
from agents.learned.chooser import Chooser, ChooserConfig
from mecanum_env.arguments import check_arguments
from mecanum_env.env import ExploreEnv
from mecanum_env.step_clock import StepClock
from slam.belief import Belief
from slam.files import quoted
from slam.settings import Within, argument, checked, from_mapping
from slam.types import Flags

__all__ = ["ChoiceEnv", "ExploreFrontierEnv", "as_observation", "choice_space"]

Observation = dict[str, NDArray[Any]]

Discount = Annotated[float, Within("(0, 1]")]

_DONE_AFTER_S = 2.0  # with nothing to choose from: what is seen a moment later may change that


def choice_space(config: ChooserConfig) -> spaces.Dict:
    """Return the space of :func:`as_observation`."""
    k, side = config.choice.most, config.choice.patch_cells

    def floats(*shape: int) -> spaces.Box:
        return spaces.Box(-10.0, 10.0, shape, np.float32)

    return spaces.Dict({
        "candidates": floats(k, len(CANDIDATE)),
        "distances": floats(k, k),
        "patches": spaces.Box(0, 255, (k, 4, side, side), np.uint8),
        "present": spaces.Box(0.0, 1.0, (k,), np.float32),
        "state": floats(len(STATE)),
    })  # fmt: skip


def as_observation(choice: Choice | None, space: spaces.Dict) -> Observation:
    """Return a choice with as many rows as the space has: those that stand for nothing are zero."""
    padded: Observation = {key: np.zeros(part.shape or (), part.dtype) for key, part in space.items()}
    if choice is not None:
        m = len(choice.index)
        padded["candidates"][:m] = choice.candidates
        padded["distances"][:m, :m] = choice.distances
        padded["patches"][:m] = choice.patches
        padded["present"][:m] = 1.0
        padded["state"][:] = choice.state
    return padded


class ChoiceEnv(gymnasium.Env[Observation, SupportsIndex]):
    """What ``ExploreFrontier-v0`` and its rehearsal share: their spaces, and the choice that is due.

    Attributes
    ----------
    driver : ChooserConfig
        How frontiers are found, driven to and described.
    agent : Chooser
        The driver.
    """

    agent: Chooser

    def __init__(self, driver: ChooserConfig) -> None:
        self.driver = driver
        self.action_space = spaces.Discrete(driver.choice.most)
        self.observation_space = cast("spaces.Space[Observation]", choice_space(driver))
        self._choice: Choice | None = None

    def action_masks(self) -> Flags:
        """Return which actions stand for a candidate ``(K,)``; the first always counts as one."""
        masks = np.arange(self.driver.choice.most) < (0 if self._choice is None else len(self._choice.index))
        masks[0] = True
        return masks

    def _take(self, k: int) -> None:
        """Choose, if there was a choice; what stands for no candidate is the first."""
        if self._choice is not None:
            self.agent.take(self._choice, k if k < len(self._choice.index) else 0)

    def _observed(self) -> Observation:
        return as_observation(self._choice, cast("spaces.Dict", self.observation_space))


class _Beneath(ExploreEnv):
    """The environment that the driver drives in: it looks at the scan, and at what the wheels tell."""

    planned_path: NDArray[np.float64] | None = None  # the driver's, for the frames

    def observe(self) -> Any:
        share = self.scan.ranges / self.scan.range_max
        robot = self.config.robot
        limits = np.array([robot.max_speed_m_s, robot.max_speed_m_s, robot.max_turn_rate_rad_s])
        return {
            "scan": np.where(share < 1.0, share, 1.0).astype(np.float32),
            "twist": (np.asarray(self._odometry.twist) / limits).astype(np.float32),
        }

    @property
    def outline(self) -> Belief:
        """The belief without its landmarks: all that choosing and driving ask for, every step."""
        backend = self.backend
        return Belief.without_landmarks(backend.pose, backend.pose_cov, backend.grid, backend.health)


class ExploreFrontierEnv(ChoiceEnv):
    """Choose where to look next; the way there is planned on the belief's map and driven.

    Parameters
    ----------
    driver : ChooserConfig or mapping, optional
        How frontiers are found, driven to and described.
    discount : float
        Of the reward, per control step of the environment beneath: a step here adds up Σ discountⁿ rₙ, and
        ``info["duration_s"]`` says how long it took, so that what follows it can be discounted alike.
    render_mode, **kwargs
        As for ``mecanum_env/Explore-v0``; ``"human"`` shows every control step of the drive.

    Attributes
    ----------
    base : ExploreEnv
        The environment beneath, with all that it has for metrics and drawing.

    Notes
    -----
    A step ends when a choice is due again: the goal is reached, what was to be seen from it is seen, the way is
    blocked, or ``driver.patience.replan_s`` is over, on a large map ``driver.large_replan_s``; and there is
    something to choose, of more than one. An action that stands for no candidate (see :meth:`action_masks`)
    takes the first, the cheapest to reach.

    ``terminated``: as in the environment beneath, or the robot has found nothing left to choose for two seconds
    (``info["end"]`` says why); the observation is blank. ``truncated``: after ``time_limit_s`` of the
    configuration; the observation shows what there was to choose.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - declared so by gymnasium.Env
        "render_modes": ["rgb_array", "human"],
        "render_fps": 1,
    }

    def __init__(
        self,
        *,
        driver: ChooserConfig | Mapping[str, Any] | None = None,
        discount: float = 1.0,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> None:
        check_arguments(kwargs, ExploreFrontierEnv)
        self.discount = checked("discount", Discount, discount)
        with argument("driver"):
            super().__init__(from_mapping(ChooserConfig, driver))
        self.base = _Beneath(action="twist", render_mode=render_mode, **kwargs)
        self.config = self.base.config
        # A limit of its own, in its own steps: the one that may be around this environment counts decisions.
        limit = math.ceil(self.config.time_limit_s / self.config.step_s - 1e-9)
        self._limited = TimeLimit(self.base, max_episode_steps=limit)
        self.render_mode = render_mode
        self.agent = Chooser(
            self.driver, robot=self.config.robot, lidar=self.config.lidar, step_s=self.config.step_s
        )

    @property
    def belief(self) -> Any:
        """What the robot knows; agents may use it."""
        return self.base.belief

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode: draw the room, place the robot, take the first scan."""
        super().reset(seed=seed)
        self._decisions = StepClock.of_caller(self)
        self.base.planned_path = None
        # One generator for both: it draws the next episode, whoever sets it back.
        self.base._np_random, self.base._np_random_seed = self._np_random, self._np_random_seed
        self._seen, info = self._limited.reset(seed=seed, options=options)
        self._np_random, self._np_random_seed = self.base._np_random, self.base._np_random_seed
        self.agent.reset(self.base.outline, 0 if seed is None else int(seed))
        self._choice = self.agent.survey(self.base.belief)
        return self._observed(), info | {"duration_s": 0.0}

    def step(self, action: SupportsIndex) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive to a view point until the next choice is due; see the class."""
        if not hasattr(self, "_seen"):
            raise RuntimeError("call reset() before step()")
        most = self.driver.choice.most
        try:
            k = operator.index(action)
        except TypeError:
            k = most
        if not 0 <= k < most:
            raise ValueError(f"action must be 0 … {most - 1}, got {quoted(action)}")
        self._take(k)
        config, agent = self.config, self.agent
        patience = math.ceil(_DONE_AFTER_S / config.step_s)
        terms: defaultdict[str, float] = defaultdict(float)
        weight, steps, idle = 1.0, 0, 0
        belief = self.base.outline
        while True:
            act = agent.act(self._seen, belief)
            self.base.planned_path = None if agent.goal is None else agent.goal.path
            self._seen, _, terminated, truncated, info = self._limited.step(act)
            for name, term in info["reward_terms"].items():
                terms[name] += weight * term
            weight *= self.discount
            steps += 1
            idle = idle + 1 if agent.goal is None and agent.status != "lost" else 0
            self._choice = None
            if terminated or truncated:
                break
            if idle >= patience:
                terminated = True
                break
            belief = self.base.outline
            if agent.due(belief):
                self._choice = agent.survey(self.base.belief)
                if self._choice is not None and len(self._choice.index) > 1:
                    break
                self._take(0)
        if truncated and not terminated:
            # Whoever learns estimates from the last observation what would have followed: it shows what there is
            # to choose, though no choice is due.
            self._choice = agent.survey(self.base.belief)
        info["reward_terms"] = dict(terms)
        info["duration_s"] = steps * config.step_s
        self._decisions.tick()
        if terminated or truncated or self._decisions.used >= 1.0:
            covered = bool(info.get("is_success", False))
            given_up = agent.status if idle >= patience else "collision"
            info["end"] = "covered" if covered else "time" if truncated or not terminated else given_up
            info.setdefault("is_success", False)
            info.setdefault("episode_metrics", self.base.episode_metrics())
        return self._observed(), sum(terms.values()), bool(terminated), bool(truncated), info

    def render(self) -> Any:
        """Return truth beside belief as an RGB image ``(h, w, 3)``; with ``"human"`` None: it is shown already."""
        return self.base.render()

    def close(self) -> None:
        """Close the environment beneath."""
        self._limited.close()
