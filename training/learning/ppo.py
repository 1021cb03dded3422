"""Training of ``ppo-frontier``: rehearsals, then PPO in the whole environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from training.learning.choice_world import Families, make_rehearsal, make_world, world_of_worker
from training.learning.config import PpoConfig, TrainConfig
from training.learning.folder import FolderRun, save_model
from training.learning.networks import ChoicePolicy, read_zip
from training.learning.semi_markov import Durations, SemiMarkovBuffer
from training.learning.trials import Trial, evaluate, trials_in_full, trials_of
from training.runs.campaign import Pool
from training.runs.processes import one_thread_each

__all__ = ["Run", "make_model"]


class Run(FolderRun):
    """A run of one network: chunks of rollouts, those of the rehearsal first; the folder gets ``best.zip``, too.

    With one worker the rollouts are made in this process; with more, or on a cluster, each of several environments
    has a process of its own on this machine: they step in turn with the network. What is learned is the same.
    """

    config: TrainConfig

    def _train(self, pool: Pool) -> None:
        for stage in _stages(self.config):
            if self._progress["chunk"] <= stage.first + stage.ppo.chunks:
                self._enact(stage, pool)

    def _enact(self, stage: _Stage, pool: Pool) -> None:
        # Where nothing is to be learned, the model only has to see what an environment is like.
        env = VecMonitor(self._environments(stage.makers if stage.ppo.steps > 0 else stage.makers[:1]))
        try:
            model = make_model(self.config, env, stage.ppo, device=self._device)
            network = cast("ChoicePolicy", model.policy).network
            if stage.first > 0:
                found = read_zip(self.out / "checkpoint.zip")
                network.load_state_dict({name: torch.as_tensor(value) for name, value in found.items()})
            self._learn(
                model, env, stage.ppo, stage=stage.name, first=stage.first, every=stage.every,
                try_out=partial(self._try_out, stage, model, network, pool), prepare=lambda _: Durations(),
            )  # fmt: skip
        finally:
            env.close()

    def _environments(self, makers: Sequence[Callable[[], Families]]) -> VecEnv:
        if self._workers == 1 or len(makers) == 1:
            return DummyVecEnv(list(makers))
        with one_thread_each():
            apart: Any = [partial(world_of_worker, maker) for maker in makers]
            return SubprocVecEnv(apart, start_method="spawn")

    def _try_out(self, stage: _Stage, model: MaskablePPO, network: torch.nn.Module, pool: Pool) -> None:
        weights = {name: value.detach().cpu().numpy().copy() for name, value in network.state_dict().items()}
        result = evaluate(weights, self.config.heads, stage.trials, pool)
        at = {"stage": stage.name, "steps": self._progress["steps"]}
        self._note_trial(at, result, result["time_to_95_s"], partial(save_model, model, self.out / "best.zip"))


def make_model(config: TrainConfig, env: VecEnv, ppo: PpoConfig, *, device: str = "cpu") -> MaskablePPO:
    """Return an untrained model for an environment with the configuration's choices."""
    network = {"width": config.width, "heads": config.heads, "layers": config.layers}
    model = MaskablePPO(
        ChoicePolicy, env, **ppo.settings, rollout_buffer_class=SemiMarkovBuffer, device=device, seed=config.seed,
        policy_kwargs={"features_extractor_kwargs": network},
    )  # fmt: skip
    if config.rehearsal.steps > 0:
        cast("ChoicePolicy", model.policy).network.ignore_uncertainty()
    return model


@dataclass(frozen=True)
class _Stage:
    """A part of a run, in one kind of world."""

    name: str
    ppo: PpoConfig
    first: int  # number of its first chunk
    every: int  # chunks, between two evaluations
    makers: Sequence[Callable[[], Families]]
    trials: list[Trial]


def _stages(config: TrainConfig) -> list[_Stage]:
    world, rehearsal, ppo = config.world, config.rehearsal, config.ppo
    stages = []
    if rehearsal.steps > 0:
        # Trials ask for the time alone.
        unshaped = partial(make_rehearsal, world, replace(rehearsal, shaping_s_m=0.0))
        makers = [partial(make_rehearsal, world, rehearsal)] * rehearsal.environments
        trials = trials_of(world, unshaped, rehearsal.episodes, {"anywhere": False})
        stages.append(_Stage("rehearsal", rehearsal, 0, rehearsal.every, makers, trials))
    in_full = [partial(make_world, world, k, gamma=ppo.gamma) for k in range(ppo.environments)]
    every = config.evaluation.every
    return [*stages, _Stage("ppo", ppo, rehearsal.chunks, every, in_full, trials_in_full(config))]
