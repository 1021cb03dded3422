"""``training.explore``: the episode of ``mecanum explore``, from Python."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import training
from training.cli import main


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


@pytest.mark.parametrize(
    ("given", "words"),
    [({"rooms": "aprtment"}, "did you mean 'apartment'"), ({"floor_plan": "missing.png"}, "missing.png")],
)
def test_what_cannot_be_used_is_a_value_error(given: dict[str, str], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        training.explore(**given, out=tmp_path / "out")  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
