"""A team run: every robot watched, the others' bodies among what it may touch."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
from gymnasium import spaces

import agents
from mecanum_env.team.team import Team
from slam.types import Array
from training.episodes.explore import make_agent
from training.episodes.team import tell_goal
from training.studies.reliability.steps.actions import Policy, policy
from training.studies.reliability.steps.items import TEAMS, Item
from training.studies.reliability.steps.nonsense import NONSENSE_EVERY, no_actions, refuse
from training.studies.reliability.steps.watch import Findings, Watch, check_metrics

__all__ = ["run"]


def run(item: Item, given: dict[str, Any], found: Findings, nonsense: bool) -> None:
    """Run a team of two or three; a step of each robot counts."""
    team = Team(2 + item.seed % 2, team=TEAMS[item.team], max_steps=item.limit, **given)
    robots = len(team.members)
    explorers, policies = [], []
    for k, member in enumerate(team.members):
        if item.driver in agents.names():
            explorers.append(make_agent(item.driver, member))
        else:
            policies.append(policy(item.driver, 3, np.random.default_rng([item.seed, 2, k]), member))
    while found.steps < item.steps:
        seen = team.reset(seed=item.seed + found.episodes)
        found.episodes += 1
        watches = []
        for k, (member, (observation, info)) in enumerate(zip(team.members, seen, strict=True)):
            space = cast(spaces.Dict, member.observation_space)
            watches.append(Watch(member, found, space, _others(team, k)))
            watches[k].first(observation, info)
        for k, explorer in enumerate(explorers):
            explorer.reset(team.members[k].belief, seed=item.seed + k)
        observations = [observation for observation, _ in seen]
        while team.active and found.steps < item.steps:
            actions = {}
            for k in team.active:
                actions[k] = _act(explorers, policies, team, k, observations[k])
            if nonsense and found.steps // robots % NONSENSE_EVERY == 0:
                act_badly = partial(_act_badly, team, actions)
                refuse(act_badly, no_actions(3), found.steps // robots // NONSENSE_EVERY, found)
            for k, outcome in team.step(actions).items():
                observations[k] = outcome.observation
                watches[k].step(outcome.observation, outcome.reward, outcome.info)
                if outcome.terminated or outcome.truncated:
                    check_metrics(outcome.info, found)


def _others(team: Team, number: int) -> Callable[[], Array]:
    rest = [k for k in range(len(team.members)) if k != number]
    return lambda: team.fleet.outlines()[rest].reshape(-1, 4)


def _act_badly(team: Team, actions: dict[int, Any], bad: Any) -> None:
    team.step(actions | {team.active[-1]: bad})


def _act(explorers: list[agents.Agent], policies: list[Policy], team: Team, k: int, observation: Any) -> Any:
    if not explorers:
        return policies[k](len(team.members[k].truth.record))
    action = explorers[k].act(observation, team.members[k].belief)
    tell_goal(team, k, explorers[k].goal)
    return action
