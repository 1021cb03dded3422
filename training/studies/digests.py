"""Same seed, same bits: digests of episodes over every backend, agent and kind of room.

Only public names are used, so that the file also runs in the checkout of another commit, and what a change of the
code changed is seen: ``cd OLD && PYTHONPATH=. python …/training/studies/digests.py --out old.json``.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np
import typer

import agents
import slam
from mecanum_env import rooms
from slam.formats import atomic_write

__all__ = ["Episode", "digest", "episodes", "study"]

Episode = tuple[str, str | None, str, str, int, int]
"""Environment, agent (None: random actions), room, backend, seed, and steps at most."""


def episodes() -> Iterator[Episode]:
    """Yield what is run: rooms to their end, every backend, every agent in three rooms, the other environments."""
    for room in sorted(rooms.names()):
        yield "Explore", "nearest-frontier", room, "ekf", 3, 3000
        yield "ExploreWheels", None, room, "ekf", 8, 60
        yield "ExploreFrontier", None, room, "ekf", 9, 6
    for backend in slam.names():
        yield "Explore", "nearest-frontier", "apartment", backend, 4, 300
    for agent in agents.names():
        yield "Explore", agent, "apartment", "ekf", 5, 3000
        yield "Explore", agent, "maze", "ekf", 6, 150
        yield "Explore", agent, "corridors", "ekf", 7, 200


def digest(episode: Episode) -> str:
    """Run an episode; return a SHA-256 over each observation, reward and info, and over the last belief."""
    name, agent_name, room, backend, seed, steps = episode
    made = hashlib.sha256()
    env = gymnasium.make(f"mecanum_env/{name}-v0", rooms=room, slam=backend)
    inner: Any = env.unwrapped
    observation, info = env.reset(seed=seed)
    env.action_space.seed(seed)
    _feed(made, [observation, info])
    agent = None
    if agent_name is not None:
        agent = agents.make(agent_name)
        agent.reset(inner.belief, seed=seed)
    for k in range(steps):
        if agent is not None:
            action: Any = agent.act(observation, inner.belief)
        elif name == "ExploreFrontier":
            allowed = np.flatnonzero(inner.action_masks())
            action = int(allowed[k % len(allowed)])
        else:
            action = env.action_space.sample()
        observation, reward, terminated, truncated, info = env.step(action)
        _feed(made, [observation, float(reward), info])
        if terminated or truncated:
            break
    belief = inner.belief
    metrics: dict[str, Any] = inner.episode_metrics() if hasattr(inner, "episode_metrics") else {}
    _feed(made, [belief.pose, belief.pose_cov, belief.landmarks, belief.grid.log_odds, metrics])
    env.close()
    return made.hexdigest()


def _feed(made: Any, value: Any) -> None:
    if isinstance(value, dict):
        _feed(made, [part for key in sorted(value) for part in (key, value[key])])
    elif isinstance(value, list | tuple):
        for part in value:
            _feed(made, part)
    elif isinstance(value, np.ndarray):
        made.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    else:
        made.update(repr(value).encode())


def study(
    out: Annotated[Path, typer.Option(dir_okay=False, help="The digests, as JSON.")] = Path("out/digests.json"),
    against: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="Digests to compare with.")
    ] = None,
) -> None:
    """Digest episodes over every backend, agent and room, and compare with the digests of another commit."""
    # What cannot be used is told before the minutes that the episodes take.
    before = None if against is None else _read(against)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise typer.BadParameter(f"cannot write {out}: {error.strerror}", param_hint="--out") from error
    found: dict[str, str] = {}
    for episode in episodes():
        name = " ".join(map(str, episode))
        found[name] = digest(episode)
        print(name, found[name][:16], file=sys.stderr, flush=True)
    atomic_write(out, (json.dumps(found, indent=1) + "\n").encode())
    if before is not None:
        other = sorted(name for name in {*found, *before} if found.get(name) != before.get(name))
        same = sum(before.get(name) == told for name, told in found.items())
        print("\n".join([f"{same} of {len(found)} episodes are the same", *other]))
        if other:
            raise typer.Exit(1)


def _read(path: Path) -> dict[str, str]:
    try:
        before = json.loads(path.read_bytes())
    except ValueError:
        before = None
    if not isinstance(before, dict):
        raise typer.BadParameter(f"{path} holds no digests; give what --out wrote", param_hint="--against")
    return before


if __name__ == "__main__":
    typer.run(study)
