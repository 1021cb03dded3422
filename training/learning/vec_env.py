"""Many environments at once for stable-baselines3: ``mecanum_env.vector`` in its dress."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

import mecanum_env
from mecanum_env.vector.vector_env import ExploreVectorEnv

__all__ = ["ExploreVecEnv"]


class ExploreVecEnv(VecEnv):
    """:class:`mecanum_env.vector.vector_env.ExploreVectorEnv` as stable-baselines3 wants it.

    An episode that ends is followed by the next in the same step; its last observation is
    ``infos[k]["terminal_observation"]``, and ``infos[k]`` is its last info. The same bits as with ``DummyVecEnv``.

    Parameters
    ----------
    n_envs : int
        How many environments.
    seed : int, optional
        Of the first one's first episode; the others follow.
    max_episode_steps : int, optional
        Steps after which an episode is truncated; None where environments see to that themselves.
    **settings
        Those of ``ExploreVectorEnv``, but ``copy``.
    """

    def __init__(
        self, n_envs: int, *, seed: int | None = None,
        max_episode_steps: int | None = mecanum_env.MAX_EPISODE_STEPS, **settings: Any,
    ) -> None:  # fmt: skip
        if not settings.get("copy", True):
            raise ValueError(
                "ExploreVecEnv: stable-baselines3 keeps observations for longer than a step; leave out copy=False"
            )
        self.envs = ExploreVectorEnv(
            n_envs, autoreset_mode=AutoresetMode.SAME_STEP, max_episode_steps=max_episode_steps, **settings
        )
        self._actions: NDArray[Any] = np.zeros(self.envs.action_space.shape or (), self.envs.action_space.dtype)
        super().__init__(n_envs, self.envs.single_observation_space, self.envs.single_action_space)
        if seed is not None:
            self.seed(seed)

    def reset(self) -> VecEnvObs:
        """Start an episode in every environment, with the seeds that :meth:`seed` was given, once."""
        options = [given or None for given in self._options]
        self._reset_options()  # where they are refused, too: else every later reset would be
        if any(given != options[0] for given in options):
            raise ValueError("ExploreVecEnv: reset options must be the same for every environment")
        observations, infos = self.envs.reset(seed=self._seeds, options=options[0])
        self.reset_infos = self._of_each(infos)
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step, ``(n_envs, a)`` or ``(n_envs,)``."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step every environment."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        final = self._of_each(infos.pop("final_info", {}))
        last = infos.pop("final_obs", None)
        each, done = self._of_each(infos), terminated | truncated
        for k in np.flatnonzero(done).tolist():
            self.reset_infos[k] = each[k]
            each[k] = final[k] | {"terminal_observation": last[k]}
            if "episode_metrics" in each[k]:  # what one did not reach is NaN in an array of those that others did
                metrics = each[k]["episode_metrics"]
                each[k]["episode_metrics"] = {m: None if v != v else v for m, v in metrics.items()}
        for info, over, cut in zip(each, terminated.tolist(), truncated.tolist(), strict=True):
            info["TimeLimit.truncated"] = cut and not over
        return observations, rewards.astype(np.float32), done, each

    def _of_each(self, infos: dict[str, Any]) -> list[dict[str, Any]]:
        """Return every environment's own info of those that Gymnasium keeps as arrays with masks."""
        each: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        rows: dict[int, list[int]] = {}  # of each mask: most keys have the same one
        for key, values in infos.items():
            mask = infos.get(f"_{key}")
            if mask is None or key.startswith("_"):
                continue
            if id(mask) not in rows:
                rows[id(mask)] = np.flatnonzero(mask).tolist()
            if isinstance(values, dict):
                parts = self._of_each(values)
            else:
                parts = values.tolist() if values.ndim == 1 else [*values.copy()]
            for k in rows[id(mask)]:
                each[k][key] = parts[k]
        return each

    def close(self) -> None:
        """Have the workers quit."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of some environments, and call nothing."""
        values = self.envs.call("get_wrapper_attr", attr_name)
        return [values[k] for k in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """Tell whether every environment has an attribute, and call nothing."""
        return all(self.envs.call("has_wrapper_attr", attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of every environment to the same value."""
        self._check_all("set_attr", indices)
        self.envs.set_attr(attr_name, [value] * self.num_envs)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of every environment; return the results."""
        self._check_all("env_method", indices)
        values = self.envs.call(method_name, *method_args, **method_kwargs)
        return [values[k] for k in self._get_indices(indices)]

    def _check_all(self, method: str, indices: VecEnvIndices) -> None:
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ValueError(f"ExploreVecEnv: {method} is for every environment: leave out indices")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Tell of some environments whether they are in a wrapper of a class; all are made alike."""
        wrapped = any(issubclass(wrapper, wrapper_class) for wrapper in self.envs.wrappers)
        return [wrapped for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a frame of each environment."""
        return list(self.envs.render() or [])
