"""The end-to-end policy without PyTorch: the planning layer, the agent."""

from __future__ import annotations

import json
import math

import gymnasium
import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

import agents
import mecanum_env
from agents.learned.drive_network import DriveNetwork
from agents.learned.drive_plan import EDGES, descend, distances, gradient, node_prices
from agents.ppo import SHIPPED, Ppo
from mecanum_env.config import LidarConfig
from slam.belief import Belief
from tests.agents import grids

assert mecanum_env


def a_world(seed: int, rows: int = 13, cols: int = 17) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    prices = rng.uniform(0.2, 3.0, (4, rows, cols)).astype(np.float32)
    return prices, rng.uniform(0.0, 12.0, (rows, cols)).astype(np.float32)


def by_dijkstra(prices: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """One more node, the end of all ways, at the goals' prices."""
    rows, cols = goal.shape
    index = np.arange(rows * cols).reshape(rows, cols)
    links = {}
    for k, (dr, dc) in enumerate(EDGES):
        for r in range(rows):
            for c in range(cols):
                if 0 <= r + dr < rows and 0 <= c + dc < cols:
                    links[index[r, c], index[r + dr, c + dc]] = prices[k, r, c]
    links |= {(index[r, c], rows * cols): goal[r, c] for r in range(rows) for c in range(cols)}
    pairs = np.array(list(links))
    graph = csr_array((list(links.values()), (pairs[:, 0], pairs[:, 1])), shape=(rows * cols + 1,) * 2)
    return dijkstra(graph, directed=False, indices=rows * cols)[:-1].reshape(rows, cols)


@pytest.mark.parametrize("seed", range(4))
def test_distances_are_those_of_dijkstra(seed):
    prices, goal = a_world(seed)
    best, parent = distances(prices, goal)
    np.testing.assert_allclose(best, by_dijkstra(prices, goal), rtol=1e-5)
    for start in ((0, 0), (6, 8), (12, 3)):
        way = descend(parent, *start)
        assert tuple(way[0]) == start and parent[tuple(way[-1])] == -1
        assert (np.abs(np.diff(way, axis=0)).max(axis=1) == 1).all()
        assert best[tuple(way[-1])] == goal[tuple(way[-1])]
        assert (np.diff(best[tuple(way.T)]) < 0.0).all()


def test_the_gradient_is_that_of_finite_differences():
    """Distances are concave in prices and goals: the gradient lies between the slopes to either side."""
    prices, goal = a_world(7)
    weight = np.random.default_rng(8).uniform(size=goal.shape).astype(np.float32)
    best, parent = distances(prices, goal)
    by_price, by_goal = gradient(best, parent, weight)
    whole = float((weight * best).sum(dtype=np.float64))
    rng = np.random.default_rng(9)
    for _ in range(60):
        k, r, c = rng.integers(4), rng.integers(goal.shape[0]), rng.integers(goal.shape[1])
        for values, at, found in ((prices, (k, r, c), by_price[k, r, c]), (goal, (r, c), by_goal[r, c])):
            kept, slopes = values[at], []
            for change in (1e-2, -1e-2):
                values[at] = kept + np.float32(change)
                slopes.append(
                    (float((weight * distances(prices, goal)[0]).sum(dtype=np.float64)) - whole) / change
                )
            values[at] = kept
            assert slopes[0] - 0.01 <= found <= slopes[1] + 0.01


def test_prices_of_nodes_are_halved_between_neighbours():
    out = node_prices(np.array([[1.0, 3.0], [5.0, 7.0]], np.float32), 0.1)
    assert out[0, 0, 0] == pytest.approx(0.2)
    assert out[1, 0, 0] == pytest.approx(0.4 * math.sqrt(2.0))
    assert out[2, 0, 1] == pytest.approx(0.5) and out[3, 0, 1] == pytest.approx(0.4 * math.sqrt(2.0))


def test_the_agent_drives_and_keeps_to_the_network():
    env = gymnasium.make("mecanum_env/Explore-v0", rooms="rectangular")
    observation, info = env.reset(seed=3)
    agent = agents.make("ppo")
    agent.reset(env.unwrapped.belief)
    for _ in range(100):
        action = agent.act(observation, env.unwrapped.belief)
        observation, _, terminated, _, info = env.step(action)
        if terminated:
            break
    assert info["coverage"] > 0.6 and info["collisions"] == 0
    assert agent.goal is not None and np.hypot(*(agent.goal.path[0] - env.unwrapped.belief.pose[:2])) < 0.2


def test_a_full_circle_has_no_gap_between_its_last_beam_and_its_first():
    agent = agents.make("ppo", lidar=LidarConfig(beams=180))
    assert (agent._scan(np.full(180, 0.25, np.float32)) < 1.0).all()


def ends_after(config: dict[str, float], *beliefs: Belief) -> float:
    """Time [s] until a robot that never moves ends; each belief but the last holds for 15 s."""
    agent = Ppo(config)
    agent.reset(beliefs[0])
    for step in range(1500):
        agent.act(None, beliefs[min(step // 150, len(beliefs) - 1)])
        if agent.ended:
            return 0.1 * step
    raise AssertionError("never")


def test_a_place_without_news_is_explored_and_a_hopeful_one_later():
    known = grids.belief_of(grids.room(4.0, 3.0), (2.0, 1.5, 0.0))
    more = grids.belief_of(grids.room(4.0, 3.5), (2.0, 1.5, 0.0))
    assert ends_after({}, known) == pytest.approx(20.0)
    assert ends_after({}, known, more) == pytest.approx(35.0, abs=1.0)
    half = grids.belief_of(grids.half_known(), (1.0, 2.0, 0.0))
    assert 21.0 < ends_after({}, half) < 60.0 + 2.0 * 8.0
    assert ends_after({"hopeful_s": 24.0, "hopeful_s_per_m": 0.01}, half) == pytest.approx(25.0, abs=1.0)


def test_the_policy_says_where_it_comes_from():
    about = agents.make("ppo").about
    assert {"config", "command", "curve", "hours"} <= set(about)
    assert about["config"]["world"]["seeds"] == [0, 999]
    assert SHIPPED.stat().st_size < 2_000_000


def test_a_policys_file_is_an_agents_name(tmp_path):
    for name in ("ppo", "ppo-frontier"):
        shipped = agents.make(name).policy_path
        mine = tmp_path / shipped.name
        for suffix in (".safetensors", ".json"):
            mine.with_suffix(suffix).write_bytes(shipped.with_suffix(suffix).read_bytes())
        agent = agents.make(str(mine))
        assert type(agent) is type(agents.make(name)) and agent.policy_path == mine
    mine.with_suffix(".json").write_text('{"format": "of another"}')
    with pytest.raises(ValueError, match="'of another' is none of"):
        agents.make(str(mine))
    mine.unlink()
    with pytest.raises(ValueError, match="safetensors is missing"):
        agents.check(str(mine))
    with pytest.raises(ValueError, match="unknown agent 'pppo'"):
        agents.check("pppo", "known-map")
    agents.check("known-map", "known-map")


def test_files_that_are_no_policy_are_named(tmp_path):
    path = tmp_path / "mine.safetensors"
    with pytest.raises(ValueError, match="is missing"):
        agents.make("ppo", config={"policy": str(path)})
    path.write_bytes(b"nonsense")
    about = json.loads(SHIPPED.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match="cannot be read"):
        agents.make("ppo", config={"policy": str(path)})
    path.write_bytes(SHIPPED.read_bytes())
    path.with_suffix(".json").write_text(json.dumps(about | {"format": "another"}))
    with pytest.raises(ValueError, match="format is not"):
        agents.make("ppo", config={"policy": str(path)})
    with pytest.raises(ValueError, match=r"weight map.0.bias is missing"):
        DriveNetwork({})
