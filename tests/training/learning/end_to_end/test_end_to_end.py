"""The end-to-end policy's training: the same without PyTorch, mirrored rightly, and exactly resumed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gymnasium
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from safetensors.numpy import load_file  # noqa: E402

import agents  # noqa: E402
import mecanum_env  # noqa: E402
from agents.learned.drive_memory import CELL_M, LOG_PRICES  # noqa: E402
from agents.learned.drive_network import NUMBERS, SECTORS, DriveNetwork, Inputs, sectors  # noqa: E402
from agents.learned.drive_plan import node_prices  # noqa: E402
from agents.ppo import load_drive_policy  # noqa: E402
from slam.settings import from_mapping  # noqa: E402
from training.learning.end_to_end.config import DriveConfig  # noqa: E402
from training.learning.end_to_end.lessons import FollowingTeacher, map_lessons  # noqa: E402
from training.learning.end_to_end.networks import ControlNetwork, PlanNetwork, shortest, step_prices  # noqa: E402
from training.learning.end_to_end.run import DriveRun  # noqa: E402
from training.learning.policies import export_run  # noqa: E402

assert mecanum_env

SMALL = {
    "policy": "drive",
    "world": {"rooms": ["rectangular"], "time_limit_s": 3.0},
    "lessons": {"guided_episodes": 2, "teacher_shares": [1.0, 0.0], "episodes": 1, "time_limit_s": 4.0},
    "learning": {"map_steps": 2, "map_steps_a_round": 1, "map_batch": 4, "control_steps": 3, "control_batch": 8},
    "ppo": {"steps": 32, "environments": 1, "n_steps": 16, "chunk": 1, "batch_size": 8},
    "evaluation": {"episodes": 1, "every": 2},
}


def arrays(network) -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in network.state_dict().items()}


def test_numpy_and_torch_agree():
    torch.manual_seed(0)
    plan, steer = PlanNetwork(), ControlNetwork()
    rng = np.random.default_rng(0)
    maps = rng.integers(0, 256, (4, 50, 70)).astype(np.uint8)
    with torch.no_grad():
        price, goal = plan(torch.from_numpy(maps[None]))
    light = DriveNetwork(arrays(plan) | arrays(steer))
    np.testing.assert_allclose(light.of_map(maps), torch.cat([price, goal]).numpy(), atol=1e-4)
    logs = torch.from_numpy(rng.normal(size=(1, 7, 9)).astype(np.float32))
    steps = node_prices(np.exp(logs[0].clamp(*LOG_PRICES).numpy()), CELL_M)
    inside = steps < 1e3
    np.testing.assert_allclose(step_prices(logs)[0].numpy()[inside], steps[inside], rtol=1e-5)
    assert (step_prices(logs)[0].numpy()[~inside] > 1e3).all()
    scan = sectors(rng.uniform(size=360).astype(np.float32))
    rows = rng.normal(size=(32, 5)).astype(np.float32)
    rows[:, 4] = np.arange(32) < 9
    rows *= rows[:, 4:]
    for landmarks in (rows, 0.0 * rows):
        rest = rng.normal(size=NUMBERS).astype(np.float32)
        with torch.no_grad():
            wanted = steer(*(torch.from_numpy(v)[None] for v in (scan, landmarks, rest)))[0].numpy()
        np.testing.assert_allclose(light.control(Inputs(scan, landmarks, rest)), wanted, atol=1e-4)
    assert scan.shape == (SECTORS,)


def test_the_gradient_reaches_the_prices():
    torch.manual_seed(1)
    logs, goal = torch.randn(2, 4, 6, 5, requires_grad=True), torch.rand(2, 6, 5) * 9.0
    shortest(logs.exp(), goal).sum().backward()
    assert logs.grad is not None and float(logs.grad.abs().sum()) > 0.0


def test_lessons_on_maps_lie_where_the_maps_are():
    env = gymnasium.make("mecanum_env/Explore-v0", rooms="apartment").unwrapped
    observation, _ = env.reset(seed=5)
    guide = agents.make("nearest-frontier")
    guide.reset(env.belief)
    for _ in range(30):
        observation, *_ = env.step(guide.act(observation, env.belief))
    for lesson in map_lessons(guide, env, np.random.default_rng(0)):
        price = np.exp(lesson["price"] / 70.0)
        seen, goals = lesson["map"], np.unpackbits(lesson["goal"], axis=-1).astype(bool)
        assert (price[(seen[0] > 200) & (seen[1] > 0)] > 20.0).mean() > 0.95
        # Frontier has what is known on one side of it.
        assert goals.any() and (seen[1][goals] > 0).mean() > 0.5
        start = tuple(lesson["start"])
        assert lesson["travel"][start] == 0.0 and price[start] < 3.0
        # A step to the side costs what lies between.
        beside = start[0], start[1] + 1
        assert lesson["travel"][beside] <= 0.1 * max(price[start], price[beside]) + 0.01


def test_the_teacher_goes_on_from_what_was_sent():
    env = gymnasium.make("mecanum_env/Explore-v0", rooms="apartment").unwrapped
    observation, _ = env.reset(seed=5)
    path = np.stack([np.linspace(0.0, 1.5, 16), np.zeros(16)], axis=1)
    teacher = FollowingTeacher(env)
    still = teacher(path, np.zeros(3), observation, env.belief)
    moving = teacher(path, np.array([0.5, 0.0, 0.0]), observation, env.belief)
    assert 0.0 <= still[0] < 0.2 and moving[0] > 0.25


class Killed(Exception):
    pass


class InThisProcess:
    """A pool that takes no time to start."""

    map = staticmethod(map)


@contextmanager
def no_workers(count: int) -> Iterator[InThisProcess]:
    yield InThisProcess()


def run(out: Path, *, kill_at: str = "", die_before: dict | None = None, **changes) -> None:
    class Dies(DriveRun):
        def _keep(self, **progress):
            if die_before and die_before.items() <= progress.items():
                raise Killed
            super()._keep(**progress)

    def log(text: str) -> None:
        if kill_at and text.startswith(kill_at):
            raise Killed

    Dies(from_mapping(DriveConfig, SMALL | changes), out, workers=1, log=log).train()


def same_checkpoint(one: Path, other: Path) -> None:
    first, second = (load_file(out / "checkpoint.safetensors") for out in (one, other))
    assert first.keys() == second.keys()
    for name, weights in first.items():
        np.testing.assert_array_equal(weights, second[name])


def test_a_run_that_was_killed_and_resumed_is_the_one_that_was_not(tmp_path, monkeypatch):
    monkeypatch.setattr("training.learning.folder.worker_pool", no_workers)
    run(tmp_path / "whole")
    for at in ({"round": 1}, {"round": 2}, {"chunk": 1}):  # after a checkpoint, before the note of it
        with pytest.raises(Killed):
            run(tmp_path / "between", die_before=at)
    run(tmp_path / "between")
    same_checkpoint(tmp_path / "whole", tmp_path / "between")
    for moment in ("round 1: lessons", "round 1 of 2 done", "ppo, chunk 1 of 2"):
        with pytest.raises(Killed):
            run(tmp_path / "parts", kill_at=moment)
    run(tmp_path / "parts")
    same_checkpoint(tmp_path / "whole", tmp_path / "parts")
    lines = [json.loads(line) for line in (tmp_path / "whole" / "curve.jsonl").read_text().splitlines()]
    assert [line.get("round", line.get("steps")) for line in lines] == [1, 2, 32]
    with pytest.raises(ValueError, match="another configuration"):
        run(tmp_path / "parts", seed=2)
    for name in ("maps-0.npz", "maps-1.npz", "control-1.npz"):  # which nothing that is left asks for
        (tmp_path / "parts" / name).unlink()
    run(tmp_path / "parts")
    target = tmp_path / "mine.safetensors"
    export_run(tmp_path / "whole", target)
    network, about = load_drive_policy(target)
    assert isinstance(network, DriveNetwork) and len(about["curve"]) == 3
    agents.make("ppo", config={"policy": str(target)})


def test_a_run_whose_files_are_damaged_or_not_all_there_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("training.learning.folder.worker_pool", no_workers)
    with pytest.raises(Killed):
        run(tmp_path, kill_at="round 1 of 2 done")
    for name in ("checkpoint.safetensors", "maps-0.npz", "control-1.npz"):
        path = tmp_path / name
        whole = path.read_bytes()
        path.write_bytes(whole[:200])
        with pytest.raises(ValueError, match=rf"{name} is .*; choose another --out$"):
            run(tmp_path)
        path.unlink()
        with pytest.raises(ValueError, match=rf"{name} is missing, .*; choose another --out$"):
            run(tmp_path)
        path.write_bytes(whole)
