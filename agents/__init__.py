"""Agents: who decides, on the belief alone, where the robot goes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.base import Agent, Goal
from slam.files import quoted
from slam.settings import check_name

if TYPE_CHECKING:
    from mecanum_env.config import LidarConfig, RobotConfig

__all__ = ["Agent", "Goal", "check", "entry_point", "is_policy", "make", "names"]

# Entry points as text: naming an agent loads nothing, making one loads only what that agent needs.
_REGISTRY = {
    "active": "agents.active:ActiveSlam",
    "assigned": "agents.teams.assigned:Assigned",
    "brisk-tour": "agents.brisk_tour:BriskTour",
    "coordinated": "agents.teams.coordinated:Coordinated",
    "cost-utility": "agents.cost_utility:CostUtility",
    "explore-and-return": "agents.explore_and_return:ExploreAndReturn",
    "learned-tour": "agents.learned_tour:LearnedTour",
    "nearest-frontier": "agents.nearest_frontier:NearestFrontier",
    "next-best-view": "agents.next_best_view:NextBestView",
    "ppo": "agents.ppo:Ppo",
    "ppo-frontier": "agents.ppo_frontier:PpoFrontier",
    "random": "agents.random:RandomAgent",
    "rendezvous": "agents.teams.rendezvous:Rendezvous",
    "rrt": "agents.rrt:Rrt",
    "team-frontier": "agents.teams.team_frontier:TeamFrontier",
    "team-tour": "agents.teams.team_tour:TeamTour",
    "tour": "agents.tour:Tour",
}

GROUP = "mecanum_slam.agents"
"""Entry points of this group, ``name = "module:class"``, are agents, too: so other packages add theirs."""


_POLICIES = {
    "mecanum-slam choice policy 1": "ppo-frontier",
    "mecanum-slam drive policy 2": "ppo",
    "mecanum-slam station policy 2": "learned-tour",
}
"""The formats of trained policies, and the agents that read them."""


@cache
def _installed() -> dict[str, str]:
    """Return every agent's entry point: other packages' ones, then ours, which none of them replaces."""
    return {point.name: point.value for point in entry_points(group=GROUP)} | _REGISTRY


def names() -> tuple[str, ...]:
    """Return the names that :func:`make` takes, sorted."""
    return tuple(sorted(_installed()))


def check(name: str, *others: str) -> None:
    """Raise ``ValueError`` in one line unless :func:`make` takes the name, or it is one of the others."""
    if isinstance(name, str) and is_policy(name):
        _reader(_file_of(name))
    else:
        check_name("agent", name, (*names(), *others))


def entry_point(name: str) -> str:
    """Return ``module:attribute`` of what makes an agent, of a name or policy that :func:`check` takes."""
    return _installed()[_reader(_file_of(name)) if is_policy(name) else name]


def is_policy(name: str) -> bool:
    """Tell whether an agent's name means a trained policy, in a file or on a hub."""
    return name.endswith(".safetensors") or name.startswith("hf://")


def _file_of(name: str) -> str:
    """Return the file of a trained policy; one on a hub is fetched at need."""
    if not name.startswith("hf://"):
        return name
    from agents.learned.hub import fetch

    return str(fetch(name))


def _reader(policy: str) -> str:
    from agents.learned.policy_files import policy_format

    found = policy_format(Path(policy))
    if found not in _POLICIES:
        raise ValueError(f"policy {policy}: its format {quoted(found)} is none of {', '.join(_POLICIES)}")
    return _POLICIES[found]


def make(
    name: str,
    *,
    config: Any = None,
    robot: RobotConfig | Mapping[str, Any] | str | None = None,
    lidar: LidarConfig | Mapping[str, Any] | str | None = None,
    step_s: float = 0.1,
) -> Agent:
    """Return a new agent by name; call its ``reset(belief, seed)`` before its first step.

    Parameters
    ----------
    name : str
        One of :func:`names`; the path of a trained policy's ``.safetensors`` file, its ``.json`` beside it; or
        ``hf://USER/REPO[/NAME]@COMMIT``, one on a Hugging Face hub.
    config : dataclass or mapping, optional
        The agent's own configuration, ``agents.<module>.<Agent>Config``; a mapping where a policy is named.
    robot, lidar : config, mapping or preset name, optional
        The body it drives and the sensor it looks with; the youBot's by default.
    step_s : float
        Time between two calls of ``act`` [s].

    Raises
    ------
    ValueError
        For a name or key that is not known, with the valid ones; for an agent that cannot be loaded or made.
    """
    check(name)
    module, _, attribute = entry_point(name).partition(":")
    if is_policy(name):
        if not isinstance(config, Mapping | None):
            raise ValueError(f"config: with a policy's file {name} it must be a mapping, got {quoted(config)}")
        config = {**(config or {}), "policy": _file_of(name)}
    try:
        made = getattr(import_module(module), attribute)
        agent: Agent = made(config, robot=robot, lidar=lidar, step_s=step_s)
    except (ImportError, AttributeError, TypeError) as error:  # another package's, or what it needs is not there
        raise ValueError(
            f"cannot load agent {name} ({' '.join(str(error).split())}); install or mend what it needs, "
            "or leave it out"
        ) from error
    return agent
