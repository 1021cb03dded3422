from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest

import agents
import slam
from mecanum_env.env import ExploreEnv
from mecanum_env.episode import wall_metrics
from slam.accounts.landmarks import handed_out, write_landmarks
from slam.landmarks.database import read_landmark_map
from slam.metrics.measures import MapScore, corner_deviation


def driven(backend: str, *, rooms: str = "rectangular", seed: int = 300, steps: int = 150) -> ExploreEnv:
    env = gymnasium.make("mecanum_env/Explore-v0", rooms=rooms, slam=backend).unwrapped
    assert isinstance(env, ExploreEnv)
    agent = agents.make("brisk-tour")
    observation, _ = env.reset(seed=seed)
    agent.reset(env.belief)
    for _ in range(steps):
        observation, _, terminated, truncated, _ = env.step(agent.act(observation, env.belief))
        if terminated or truncated:
            break
    return env


@pytest.mark.parametrize("backend", slam.names())
def test_what_is_handed_out_is_what_is_written_and_measured(backend, tmp_path):
    env = driven(backend, steps=60)
    found, belief = handed_out(env.backend), env.belief
    n = len(belief.landmarks)
    assert found.points.shape == (n, 2) and found.covs.shape == (n, 2, 2)
    assert np.hypot(*(found.points - belief.landmarks).T).max(initial=0.0) < 0.05  # no farther than to a wall
    assert all(np.linalg.eigvalsh(cov)[0] > 0.0 for cov in found.covs)
    if found.joint_cov is not None:
        for k, cov in enumerate(found.covs):
            np.testing.assert_array_equal(cov, found.joint_cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])
    metrics = env.episode_metrics()
    deviation = corner_deviation(found.points, env.truth.ground.corners)
    assert metrics["corner_mean_m"] == (deviation.mean if n else None)
    write_landmarks(tmp_path / "landmarks.db", env.backend, name=backend)
    written = read_landmark_map(tmp_path / "landmarks.db").landmarks
    order = np.argsort(belief.landmark_ids)
    np.testing.assert_allclose(np.column_stack([written["x"], written["y"]]), found.points[order], atol=1e-12)


def test_corners_handed_out_lie_nearer_the_true_ones():
    believed, handed, nees = [], [], []
    for rooms in ("rectangular", "corridors", "maze"):
        env = driven("invariant-ekf", rooms=rooms, steps=300)
        true, found = env.truth.ground.corners, handed_out(env.backend)
        believed.extend(corner_deviation(env.belief.landmarks, true).each)
        handed.extend(corner_deviation(found.points, true).each)
        off = found.points - true[np.linalg.norm(found.points[:, None] - true[None], axis=2).argmin(axis=1)]
        nees.extend(np.einsum("ki,kij,kj->k", off, np.linalg.inv(found.covs), off)[np.hypot(*off.T) < 0.1])
    assert np.mean(handed) < 0.8 * np.mean(believed)
    assert (
        0.5 < np.median(nees) / 1.39 < 3.0
    )  # of χ² with two degrees of freedom; errors of a room have much in common


@pytest.mark.parametrize("cell_m", [0.05, 0.2, 0.5])
def test_the_walls_of_a_map_that_is_right_match_in_cells_of_any_size(cell_m):
    noise = {"range_sigma_m": 0.0, "dropout": 0.0}
    config = {"grid_resolution_m": cell_m, "coverage_target": 1.0}  # one that has ended is summed up at each step
    where = {"rooms": "rectangular", "slam": "truth", "noise": noise, "config": config}
    env = gymnasium.make("mecanum_env/Explore-v0", **where).unwrapped
    observation, _ = env.reset(seed=3)
    agent = agents.make("nearest-frontier")
    agent.reset(env.belief)
    for _ in range(150):
        observation, *_ = env.step(agent.act(observation, env.belief))
    assert env.episode_metrics()["map_iou"] > 0.9


def test_what_is_not_defined_is_none():
    nothing = wall_metrics(MapScore(math.nan, math.nan, 0.5))
    assert nothing == {"map_iou": None, "map_precision": None, "map_recall": 0.5}


def test_an_error_that_the_covariance_rules_out_is_in_the_mean():
    env = driven("odometry", steps=5)
    last = tuple(env.truth.record._rows[-1])
    for nees, mean in ((math.nan, env.episode_metrics()["anees"]), (math.inf, math.inf)):
        env.truth.record.append((*last[:8], nees, *last[9:]))
        assert env.episode_metrics()["anees"] == mean
    assert math.isfinite(driven("truth", steps=5).episode_metrics()["anees"])
