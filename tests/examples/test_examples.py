"""The examples run as they stand, for a few steps each."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mecanum_env.rooms.files.importers import load

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
NEEDS = {
    "sb3_ppo.py": ("torch", "stable_baselines3"),
    "sb3_maskable_ppo.py": ("torch", "sb3_contrib"),
    "cleanrl_loop.py": ("torch",),
    "rllib_ppo.py": ("torch", "ray.rllib"),
    "draw_floors.py": (),
}
# What is asked for, and what is said once it is done: of those that train, a rollout of 256 to 1024 steps.
RUNS = {
    "sb3_ppo.py": (["1"], r"total_timesteps \| 1024"),
    "sb3_maskable_ppo.py": (["1"], r"total_timesteps \| 256"),
    "cleanrl_loop.py": (["1"], r"256 steps, \d+ episodes"),
    "rllib_ppo.py": (["1", "0"], r"1: 5\d\d steps, \d+ episodes"),
    "draw_floors.py": (["floors"], r"9 plans in floors"),
}


def test_every_example_is_run() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(RUNS)


@pytest.mark.parametrize("name", sorted(RUNS))
def test_it_runs(name: str, tmp_path: Path) -> None:
    for module in NEEDS[name]:
        extra = "rllib" if module.startswith("ray") else "train"
        pytest.importorskip(module, reason=f"{name} needs the extra `{extra}`: {module} is not installed")
    arguments, said = RUNS[name]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    result = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments],
        env=os.environ | {"PYTHONPATH": path, "HOME": str(tmp_path)},  # RLlib keeps its results in the home folder
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr
    assert re.search(said, " ".join(result.stdout.split())), result.stdout


def test_every_floor_that_is_drawn_can_be_explored(tmp_path: Path) -> None:
    subprocess.run([sys.executable, str(EXAMPLES / "draw_floors.py"), str(tmp_path)], check=True, timeout=600)
    areas = {path.stem: load(path, seed=10000).area_m2 for path in tmp_path.glob("*.yaml")}
    assert len(areas) == 9
    assert all(350 < area < 2000 for area in areas.values()), areas
