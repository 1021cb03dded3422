"""What a folder of runs is held to, and runs whose process dies or leaves."""

from __future__ import annotations

import json
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest

from tests.training.cli.test_bad_input import refused
from training.runs import campaign
from training.runs.campaign import keep_settings, made_by, run_all
from training.runs.errors import BadInput


def test_own_agents_and_backends_are_added_to_a_folder_and_not_mixed_with_other_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own: dict[str, str] = {}
    monkeypatch.setattr(campaign, "own_code", lambda agents, backends: dict(own))

    def keep() -> None:
        keep_settings(tmp_path, made_by(agents=["mine"], backends=["ekf"]), [])

    keep()
    (tmp_path / "runs.jsonl").write_text("a row")
    own["agent mine"] = "1"
    keep()
    own.clear()
    own["backend mine"] = "1"
    keep()
    own["agent mine"] = "2"
    with pytest.raises(BadInput, match="holds runs of other code"):
        keep()
    own["agent mine"] = "1"
    keep()


def test_a_folder_with_no_run_yet_takes_other_settings(tmp_path: Path) -> None:
    store = tmp_path / "runs.jsonl"
    keep_settings(tmp_path, {"steps": 3000}, [])
    store.touch()
    keep_settings(tmp_path, {"steps": 20}, [])
    assert json.loads((tmp_path / "settings.json").read_text("utf-8")) == {"steps": 20}
    store.write_text("a row")
    with pytest.raises(BadInput, match="holds runs with steps = 20, not 3000"):
        keep_settings(tmp_path, {"steps": 3000}, [])
    assert json.loads((tmp_path / "settings.json").read_text("utf-8")) == {"steps": 20}


@pytest.mark.parametrize(
    ("command", "agent"),
    [
        ("consistency", ""), ("complexity", ""), ("study paper-d", ""), ("study worlds", ""),
        ("study accuracy --agent random", "random"), ("study recovery --agent random", "random"),
    ],
)  # fmt: skip
def test_every_study_notes_whose_code_it_runs(
    command: str, agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(agents: list[str], backends: list[str]) -> Any:
        raise BadInput(f"asked for {' '.join([*agents, *backends])}")

    monkeypatch.setattr(campaign, "own_code", asked)
    line = refused([*command.split(), "--slam", "ekf,invariant-ekf", "--out", str(tmp_path)], capsys)
    assert f"asked for {agent} ekf invariant-ekf".replace("  ", " ") in line


def test_a_worker_that_dies_is_told_with_what_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def results(*_: Any) -> Any:
        yield 1, 1
        raise BrokenProcessPool("abruptly")

    monkeypatch.setattr(campaign, "_results", results)
    kept: list[int] = []
    with pytest.raises(
        RuntimeError, match=r"worker process died .* after 1 of 2 runs, which are kept; run the same"
    ):
        run_all([1, 2], int, workers=2, keep=lambda job, result: kept.append(result))
    assert kept == [1]
