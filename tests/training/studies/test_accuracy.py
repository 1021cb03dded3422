"""``mecanum study accuracy``: what it refuses before any episode is run, and its summary."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from training.cli import main
from training.studies import accuracy


@pytest.mark.parametrize(
    ("option", "hint"),
    [
        (("--rooms", "apartment,kave"), "did you mean 'cave'?"),
        (("--slam", "ekf,dp-slamm"), "did you mean 'dp-slam'?"),
        (("--agent", "nearest"), "valid: "),
        (("--noise", "slipery"), "did you mean 'slippery'?"),
        (("--seeds", "a"), "seeds"),
    ],
)
def test_bad_options_are_refused_in_one_line(
    option: tuple[str, str], hint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["study", "accuracy", *option, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert hint in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("study", ["accuracy", "team-filters"])
def test_a_folder_that_is_not_to_be_used_is_refused_before_any_work(
    study: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    older = tmp_path / "older"
    older.mkdir()
    (older / "settings.json").write_text('{"version": "0.0.1"}')
    (older / "episodes.jsonl").write_text("[]\n")
    for out in (tmp_path / "file", older):
        assert main(["study", study, "--out", str(out)]) == 2
        assert "choose another --out" in capsys.readouterr().err


def test_a_time_that_was_not_reached_is_later_than_any() -> None:
    row = {name: 1.0 for name in accuracy._MEDIANS} | {
        "collisions": 0, "nees_each_s": [3.0], "rooms": "cave", "slam": "ekf", "noise": "nominal", "agent": "tour",
    }  # fmt: skip
    rows = [row | {"time_to_95_s": time} for time in (20.0, None, None)]
    assert accuracy.summarise(rows, "0:2")[0]["time_to_95_s_median"] is None
    assert accuracy.summarise(rows[:2] + rows[:1], "0:2")[0]["time_to_95_s_median"] == 20.0


def test_the_summary_has_the_seeds_as_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = {name: 1.0 for name in accuracy._MEDIANS} | {"collisions": 0, "nees_each_s": [3.0, 3.0]}

    def quick(job: accuracy.Job) -> accuracy.Row:
        return row | dict(zip(("rooms", "slam", "seed", "agent", "noise"), job, strict=True))

    monkeypatch.setattr(accuracy, "run_job", quick)
    command = ["study", "accuracy", "--rooms", "cave", "--slam", "ekf", "--seeds", "1,4,7", "--workers", "1"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    (summary,) = json.loads((tmp_path / "summary.json").read_text())["summaries"]
    assert summary["seeds"] == "1,4,7" and summary["episodes"] == 3
