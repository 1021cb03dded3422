"""A short episode, recorded, for the tests of what is made from recordings."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium

import agents
import mecanum_env  # noqa: F401 - registers the environments
from mecanum_env.env import ExploreEnv
from training.episodes.explore import Witness
from training.episodes.recording import Recorder, Recording

STEPS = 60


@dataclass(frozen=True)
class Recorded:
    env: ExploreEnv  # as the episode left it
    recording: Recording


def explore(*witnesses: Witness, steps: int = STEPS) -> Recorded:
    """Let the nearest-frontier agent explore a rectangular room for so many steps."""
    wrapped = gymnasium.make("mecanum_env/Explore-v0", rooms="rectangular", disable_env_checker=True)
    observation, _ = wrapped.reset(seed=3)
    env = wrapped.unwrapped
    assert isinstance(env, ExploreEnv)
    agent = agents.make("nearest-frontier")
    agent.reset(env.belief, 0)
    recorder = Recorder()
    for witness in (recorder, *witnesses):
        witness.take(env, None)
    for _ in range(steps):
        observation, *_ = wrapped.step(agent.act(observation, env.belief))
        for witness in (recorder, *witnesses):
            witness.take(env, agent.goal)
    return Recorded(env, recorder.recording())
