"""The environments as Gymnasium users meet them; run on every supported Gymnasium version."""

from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mecanum_env
import slam
from mecanum_env import rooms
from mecanum_env.config import EnvConfig, to_toml
from mecanum_env.env import ExploreEnv
from mecanum_env.ground_truth import Coverage

IDS = ["mecanum_env/Explore-v0", "mecanum_env/ExploreWheels-v0"]
ROOT = Path(__file__).parents[2]
NO_WINDOWS = find_spec("pygame") is None  # check_env opens one


def make(env_id: str = IDS[0], **kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make(f"mecanum_env:{env_id}", **{"rooms": "rectangular", **kwargs})


def episode_bytes(seed: int, steps: int = 25, **kwargs: Any) -> bytes:
    """Everything that an episode returns, as bytes."""
    env = make(**kwargs)
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    out = []
    for _ in range(steps):
        out += [observation[key].tobytes() for key in sorted(observation)]
        out += [np.asarray(info[key], np.float64).tobytes() for key in sorted(info) if key != "reward_terms"]
        observation, reward, *_, info = env.step(env.action_space.sample())
        out.append(np.float64(reward).tobytes())
    return b"".join(out)


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_finds_nothing_to_complain_of(env_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(env_id, render_mode="rgb_array").unwrapped, skip_render_check=NO_WINDOWS)


def test_before_the_first_reset_it_says_what_to_do() -> None:
    env = ExploreEnv(rooms="rectangular", render_mode="rgb_array")
    with pytest.raises(RuntimeError, match=r"call reset\(\) before step\(\)"):
        env.step(np.zeros(3, np.float32))
    with pytest.raises(RuntimeError, match=r"call reset\(\) before render\(\)"):
        env.render()


@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines3_finds_nothing_to_complain_of(env_id: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra `train`")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The contract has landmarks as rows; stable-baselines3 flattens them and advises to do so beforehand.
        warnings.filterwarnings("ignore", "Your observation landmarks has an unconventional shape")
        sb3.check_env(make(env_id).unwrapped, warn=True)


@pytest.mark.parametrize("name", rooms.names())
@pytest.mark.parametrize("backend", slam.names())
def test_every_room_with_every_backend(name: str, backend: str) -> None:
    env = make(rooms=name, slam=backend)
    observation, info = env.reset(seed=5)
    env.action_space.seed(5)
    for _ in range(30):
        assert env.observation_space.contains(observation)
        assert 0 <= info["coverage"] <= 1
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert math.isfinite(reward)
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert not truncated
        if terminated:
            break
    if backend == "truth":
        assert info["position_error_m"] < 1e-9
    assert info["true_pose"] == pytest.approx(np.asarray(env.unwrapped.truth.pose))
    belief = env.unwrapped.belief
    assert belief.pose == pytest.approx(observation_pose(env, observation), abs=1e-5)


def observation_pose(env: gym.Env[Any, Any], observation: dict[str, Any]) -> np.ndarray:
    """Undo what the observation does to the pose."""
    from mecanum_env.observation import map_frame

    x, y, half = map_frame(env.unwrapped.backend.grid)
    p = observation["pose"].astype(float)
    return np.array([x + half * p[0], y + half * p[1], math.atan2(p[3], p[2])])


def test_one_seed_is_one_episode_bit_for_bit() -> None:
    first = episode_bytes(7)
    assert episode_bytes(7) == first
    assert episode_bytes(8) != first


def test_one_seed_is_one_episode_in_a_spawned_process_too() -> None:
    code = (
        "import hashlib; from tests.mecanum_env.test_env import episode_bytes; "
        "print(hashlib.sha256(episode_bytes(7)).hexdigest())"
    )
    import hashlib

    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == hashlib.sha256(episode_bytes(7)).hexdigest()


def test_room_and_noise_of_a_seed_depend_on_neither_agent_nor_backend() -> None:
    plans, scans, encoders = [], [], []
    for backend, action in (("ekf", 0.0), ("odometry", 0.5), ("truth", -1.0)):
        env = make(rooms="apartment", slam=backend)
        env.reset(seed=3)
        for _ in range(5):
            env.step(np.array([action, 0.0, 0.0], np.float32))
        u = env.unwrapped
        plans.append(u.truth.plan)
        true = u.lidar.true_ranges(u.truth.plan.segments, u.truth.plan.circles, u.truth.world.pose)
        noise = u.scan.ranges - true
        scans.append(noise)
        encoders.append(u._encoders.true_radii)
    for plan, noise, radii in zip(plans[1:], scans[1:], encoders[1:], strict=True):
        np.testing.assert_array_equal(plan.walls, plans[0].walls)
        both = np.isfinite(noise) & np.isfinite(scans[0])
        assert both.sum() > 100
        np.testing.assert_allclose(noise[both], scans[0][both], atol=1e-12)
        np.testing.assert_array_equal(radii, encoders[0])


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_async_vector_env(context: str) -> None:
    vector = gym.vector.AsyncVectorEnv(
        [lambda: gym.make("mecanum_env:mecanum_env/Explore-v0", rooms="rectangular")] * 2, context=context
    )
    try:
        observations, _ = vector.reset(seed=[7, 8])
        single, _ = make().reset(seed=7)
        for key, value in single.items():
            np.testing.assert_array_equal(observations[key][0], value)
        vector.step(vector.action_space.sample())
    finally:
        vector.close()


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_subproc_vec_env(method: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3.common.vec_env", reason="needs the extra `train`")
    vector = sb3.SubprocVecEnv([_make_rectangular] * 2, start_method=method)
    try:
        vector.seed(7)
        observations = vector.reset()
        single, _ = make().reset(seed=7)
        np.testing.assert_array_equal(observations["map_local"][0], single["map_local"])
        vector.step([vector.action_space.sample()] * 2)
    finally:
        vector.close()


def _make_rectangular() -> gym.Env[Any, Any]:
    return gym.make("mecanum_env:mecanum_env/Explore-v0", rooms="rectangular")


def test_flatten_observation_works_and_registration_is_idempotent() -> None:
    mecanum_env.register_envs()
    env = gym.wrappers.FlattenObservation(make())
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)


def test_the_last_step_carries_the_metrics() -> None:
    env = make(max_episode_steps=4, config={"coverage_target": 1.0})
    env.reset(seed=0)
    for k in range(4):
        *_, terminated, truncated, info = env.step(np.array([0.3, 0.0, 0.0], np.float32))
        assert ("episode_metrics" in info) == (k == 3)
    assert truncated
    assert not terminated
    assert info["is_success"] is False
    metrics = info["episode_metrics"]
    assert metrics["steps"] == 4
    assert metrics["coverage"] == pytest.approx(info["coverage"])
    assert metrics["path_length_m"] == pytest.approx(info["path_length_m"])
    assert metrics["collisions"] == 0
    assert metrics["time_to_95_s"] is None or metrics["time_to_95_s"] <= 0.4


def test_the_least_of_several_step_limits_is_the_last_step() -> None:
    env = gym.wrappers.TimeLimit(make(config={"coverage_target": 1.0}), 2)  # beside one of 3000
    env.reset(seed=0)
    env.step(np.zeros(3, np.float32))
    observation, _, _, truncated, info = env.step(np.zeros(3, np.float32))
    assert truncated
    assert observation["progress"][0] == 1.0
    assert info["is_success"] is False and info["episode_metrics"]["steps"] == 2


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_as_the_original_does(duplicate: Any) -> None:
    """Into walls, too: pymunk's own copies report contacts to the original."""
    env = make(slam="ekf", render_mode="rgb_array")
    env.reset(seed=1)
    env.step(np.zeros(3, np.float32))
    env.render()  # which reads the belief
    twin = duplicate(env)
    for k in range(60):
        action = np.array([1.0, -0.2, 0.1 if k % 2 else -0.1], np.float32)
        (observation, *rest, info), (other, *other_rest, other_info) = env.step(action), twin.step(action)
        assert rest == other_rest and all(np.array_equal(observation[key], other[key]) for key in other)
        assert np.array_equal(info["true_pose"], other_info["true_pose"])
    assert info["collisions"] == other_info["collisions"] > 0
    again, other_again = env.reset()[0], twin.reset()[0]  # the next episode is the same, too
    assert all(np.array_equal(again[key], other_again[key]) for key in again)


def test_reaching_the_target_terminates_with_success() -> None:
    env = make(config={"coverage_target": 0.05})
    env.reset(seed=0)
    *_, terminated, _, info = env.step(np.zeros(3, np.float32))
    assert terminated
    assert info["is_success"] is True


def test_a_collision_counts_and_ends_where_the_config_says_so() -> None:
    env = make(config={"terminate_on_collision": True, "coverage_target": 1.0})
    env.reset(seed=1)
    for _ in range(300):
        *_, terminated, _, info = env.step(np.array([1.0, 0.0, 0.0], np.float32))
        if terminated:
            break
    assert info["collisions"] == 1
    assert info["reward_terms"]["collision"] == -1.0
    assert info["is_success"] is False


def test_options_place_the_robot_and_choose_the_room() -> None:
    env = make()
    plan = rooms.make("rectangular", seed=11)
    env.reset(seed=0, options={"floor_plan": plan})
    np.testing.assert_array_equal(env.unwrapped.truth.plan.walls, plan.walls)
    env.reset(seed=0, options={"room_seed": 11})
    np.testing.assert_array_equal(env.unwrapped.truth.plan.walls, plan.walls)
    start = (plan.start[0], plan.start[1], 0.7)
    env.reset(seed=0, options={"floor_plan": plan, "start_pose": start})
    np.testing.assert_allclose(env.unwrapped.truth.world.pose, start)
    np.testing.assert_allclose(env.unwrapped.truth.pose, 0, atol=1e-12)
    with pytest.raises(ValueError, match="start"):
        env.reset(seed=0, options={"floor_plan": plan, "start_pose": (-50.0, 0.0, 0.0)})
    for wrong, message in (({"room": 3}, "unknown reset option 'room'"), (5, "options must be a mapping, got 5")):
        with pytest.raises(ValueError, match=message):
            env.reset(seed=0, options=wrong)
    env = make(floor_plan=plan, rooms=None)
    env.reset(seed=0, options={"floor_plan": None, "room_seed": None})  # as left out
    assert env.unwrapped.truth.plan is plan


def test_a_turned_start_gives_the_same_coverage_accounts() -> None:
    """Truth rasters lie on the belief's lattice at any heading."""
    plan = rooms.make("rectangular", seed=2)
    areas = []
    for heading in (plan.start[2], plan.start[2] + 0.6):
        env = make(slam="truth", config={"coverage_target": 1.0})
        env.reset(seed=0, options={"floor_plan": plan, "start_pose": (*plan.start[:2], heading)})
        for k in range(40):
            *_, info = env.step(np.array([0.0, 0.0, 1.0 if k < 20 else -1.0], np.float32))
        areas.append(env.unwrapped.truth.ground.mappable_cells * 0.05**2)
        assert info["coverage"] > 0.5
        fresh = Coverage(env.unwrapped.truth.ground).update(env.unwrapped.backend.grid)
        assert info["coverage"] == pytest.approx(fresh)
    assert areas[0] == pytest.approx(areas[1], rel=0.02)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"rooms": "flat"}, "unknown rooms 'flat'.*valid: apartment, cave, corridors, maze, rectangular"),
        ({"slam": "ekff"}, "unknown SLAM backend 'ekff'"),
        ({"robot": "youbt"}, "unknown robot 'youbt'.*valid: cavity, youbot"),
        ({"lidar": {"beam": 3}}, "unknown key of LidarConfig 'beam'.*did you mean 'beams'"),
        ({"lidar": {"beams": 3}}, r"lidar.beams must be a whole number in \[8, 10000\], got 3"),
        ({"reward": {"arae": 1.0}}, "unknown key of RewardConfig"),
        ({"config": {"coverage_target": 1.5}}, "coverage_target"),
        ({"config": "no/such.toml"}, "cannot read config no/such.toml"),
        ({"slam": {"name": "ekf", "gates": 3}}, "unknown key of EkfConfig 'gates'"),
        ({"render_mode": "ansi"}, "render_mode"),
    ],
)
def test_wrong_settings_are_named(kwargs: dict[str, Any], message: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium's own about the render mode
        with pytest.raises(ValueError, match=message):
            make(**kwargs)


@pytest.mark.parametrize(
    "action",
    [
        [math.nan, 0, 0], [0, 0], [0, 0, 0, 0], [math.inf, 0, 0], [[0.0], [0.0], [0.0]], [1j, 0, 0], [10**400] * 3,
        ["a", "b", "c"], None,
    ],
)  # fmt: skip
def test_wrong_actions_are_refused(action: Any) -> None:
    env = make().unwrapped
    env.reset(seed=0)
    for given in (action, np.array(action)):
        with pytest.raises(ValueError, match=r"^an action must be 3 finite numbers in \[-1, 1\], got .{1,60}$"):
            env.step(given)


def test_actions_beyond_the_limits_are_the_limits() -> None:
    ends = []
    for size in (1.0, 3e38):
        env = make().unwrapped
        env.reset(seed=0)
        for _ in range(3):
            env.step(np.full(3, size, np.float32))
        ends.append(env.truth.world.pose)
    assert np.array_equal(*ends)


@pytest.mark.parametrize("backend", slam.names())
def test_every_backend_works_with_sensors_that_have_no_noise(backend: str) -> None:
    noise = dict.fromkeys(("range_sigma_m", "dropout", "encoder", "radius_error", "base_error"), 0.0)
    env = make(slam=backend, noise=noise)
    env.reset(seed=1)
    for k in range(12):
        observation, reward, *_ = env.step(np.array([0.5, 0.2 * (-1) ** k, 0.5], np.float32))
    assert env.observation_space.contains(observation) and math.isfinite(reward)
    belief = env.unwrapped.belief
    assert np.isfinite(belief.landmarks).all() and np.linalg.eigvalsh(belief.pose_cov)[0] > 0.0
    assert np.hypot(*(belief.pose - env.unwrapped.truth.pose)[:2]) < 0.05


def test_mappings_presets_and_files_configure(tmp_path: Path) -> None:
    env = make(lidar={"preset": "youbot", "beams": 180}, noise="slippery", slam={"name": "ekf", "gate": 9.0})
    config = env.unwrapped.config
    assert (config.lidar.beams, config.noise.slip, config.slam_config["gate"]) == (180, 0.1, 9.0)
    assert env.observation_space["scan"].shape == (180,)
    cavity = make(robot="cavity").unwrapped.config
    assert (cavity.lidar.field_of_view_deg, cavity.robot.max_speed_m_s, cavity.noise.slip) == (120.0, 0.5, 0.1)
    path = tmp_path / "config.toml"
    path.write_text(to_toml(config))
    assert make(config=str(path), rooms=None).unwrapped.config == config
    assert EnvConfig() == make(config={}, rooms=None).unwrapped.config


def test_the_belief_follows_the_cavity_robot_too() -> None:
    env = make(robot="cavity", config={"coverage_target": 1.0})
    env.reset(seed=4)
    for k in range(150):
        *_, info = env.step(np.array([0.3 * math.cos(k / 15), 0.2, 0.4 * math.sin(k / 20)], np.float32))
    assert info["path_length_m"] > 1.0
    assert info["position_error_m"] < 0.15


def test_observations_are_fresh_arrays() -> None:
    env = make().unwrapped
    first, info = env.reset(seed=0)
    kept = {key: value.copy() for key, value in first.items()}
    true_pose = info["true_pose"].copy()
    for _ in range(5):
        env.step(np.array([0.5, 0.2, 0.5], np.float32))
    for key, value in kept.items():
        np.testing.assert_array_equal(first[key], value)
    np.testing.assert_array_equal(info["true_pose"], true_pose)


def test_observations_are_filled_into_the_canvas_and_are_the_same() -> None:
    env = gym.make(IDS[0], rooms="rectangular", slam="ekf")
    env.reset(seed=4)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 3)).astype(np.float32)
    expected = [env.step(action)[0] for action in actions]
    inner = env.unwrapped
    assert isinstance(inner, ExploreEnv)
    space = inner.observation_space
    assert isinstance(space, gym.spaces.Dict)
    canvas = {key: np.full(box.shape or (), 9, box.dtype) for key, box in space.items()}
    inner.canvas = canvas
    assert env.reset(seed=4)[0] is canvas
    for action, want in zip(actions, expected, strict=True):
        got = env.step(action)[0]
        assert got is canvas and got.keys() == want.keys()
        for key, value in want.items():
            np.testing.assert_array_equal(got[key], value)
        assert inner.observe() is canvas
    inner.canvas = None
    assert not np.shares_memory(inner.observe()["scan"], canvas["scan"])
