"""``training.explore``: the episode of ``mecanum explore``, from Python."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import training
from training.cli import main
from training.notebook import Explored


def test_it_is_the_command_s_episode_and_shows_its_figures(tmp_path: Path) -> None:
    result = training.explore(rooms="rectangular", seed=4, max_steps=25, out=tmp_path / "a <b>")
    argv = ["--rooms", "rectangular", "--seed", "4", "--max-steps", "25", "--out", str(tmp_path / "b")]
    assert main(["explore", *argv]) == 0
    for name in ("trajectory_true.tum", "trajectory_estimate.tum", "map.pgm"):
        assert (result.out / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert result.metrics["steps"] == json.loads((tmp_path / "b" / "metrics.json").read_text())["steps"] == 25
    page = result._repr_html_()
    assert page.count("data:image/png;base64,") == 2
    assert "a &lt;b&gt;" in page and "a <b>" not in page
    assert f"{100 * result.metrics['coverage']:.3g} %" in page
    assert "95 % covered at</th><td>–" in page, "not reached"
    training.explore(rooms="rectangular", seed=5, max_steps=5, out=result.out)
    assert result._repr_html_() == page, "its own pictures, whatever is there by now"


def test_long_episodes_are_shown_in_seconds_and_metres(tmp_path: Path) -> None:
    metrics = {"time_s": 1234.5, "path_length_m": 999.7, "coverage": 0.5}
    page = Explored(metrics=metrics, out=tmp_path)._repr_html_()
    assert "time</th><td>1234 s" in page and "path</th><td>1000 m" in page and "coverage</th><td>50 %" in page


def test_several_robots_are_the_command_s_too(tmp_path: Path) -> None:
    result = training.explore(robots=2, rooms="rectangular", seed=4, max_steps=25, out=tmp_path / "a")
    argv = ["--robots", "2", "--rooms", "rectangular", "--seed", "4", "--max-steps", "25"]
    assert main(["explore", *argv, "--out", str(tmp_path / "b")]) == 0
    for name in ("trajectory_true_robot_1.tum", "trajectory_estimate_robot_1.tum", "map.pgm"):
        assert (result.out / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    page = result._repr_html_()
    assert page.count("data:image/png;base64,") == 1
    assert "collisions of robots</th><td>0" in page


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"rooms": "aprtment"}, "did you mean 'apartment'"),
        ({"floor_plan": "missing.png"}, "missing.png"),
        ({"floor_plan": 3}, "floor_plan must be a path, got 3"),
        ({"rooms": "cave", "floor_plan": "missing.png"}, "instead of rooms"),
        ({"max_steps": 0}, "max_steps must be a whole number"),
        ({"seed": "one"}, "seed must be a whole number"),
        ({"coverage_target": 2.0}, "coverage_target must be in"),
        ({"start": 3}, "start must be"),
        ({"robots": 0}, "robots must be a whole number in .1, 64., got 0"),
        ({"robots": 2, "starts": "apart"}, "together, scattered"),
        ({"joint_belief": "yes"}, "joint_belief must be"),
    ],
)
def test_what_cannot_be_used_is_a_value_error(given: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        training.explore(**given, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
