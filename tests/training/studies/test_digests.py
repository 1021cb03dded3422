"""Digests of episodes: the same for the same seed, others for another; a comparison names what differs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from training.cli import main
from training.studies import digests

SHORT: digests.Episode = ("Explore", "nearest-frontier", "rectangular", "ekf", 3, 5)


def test_a_digest_follows_the_seed() -> None:
    assert digests.digest(SHORT) == digests.digest(SHORT)
    assert digests.digest(SHORT) != digests.digest((*SHORT[:4], 4, 5))


def test_every_backend_agent_and_room_has_an_episode() -> None:
    import agents
    import slam
    from mecanum_env import rooms

    run = list(digests.episodes())
    assert {episode[2] for episode in run} >= set(rooms.names())
    assert {episode[3] for episode in run} >= set(slam.names())
    assert {episode[1] for episode in run} >= set(agents.names())


def test_the_command_compares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wheels: digests.Episode = ("ExploreWheels", None, "rectangular", "odometry", 8, 3)
    choices: digests.Episode = ("ExploreFrontier", None, "rectangular", "ekf", 9, 1)
    monkeypatch.setattr(digests, "episodes", lambda: iter([SHORT, wheels, choices]))
    before = tmp_path / "before.json"
    assert main(["study", "digests", "--out", str(before)]) == 0
    assert main(["study", "digests", "--out", str(tmp_path / "now.json"), "--against", str(before)]) == 0
    assert "3 of 3 episodes are the same" in capsys.readouterr().out
    found = json.loads(before.read_text())
    changed = " ".join(map(str, wheels))
    before.write_text(json.dumps(found | {changed: "0"}))
    assert main(["study", "digests", "--out", str(tmp_path / "now.json"), "--against", str(before)]) == 1
    assert changed in capsys.readouterr().out
    before.write_text(json.dumps(found | {"an agent that was there": "0"}))
    assert main(["study", "digests", "--out", str(tmp_path / "now.json"), "--against", str(before)]) == 1
    told = capsys.readouterr().out
    assert "3 of 3 episodes are the same" in told and "an agent that was there" in told


def test_what_cannot_be_used_is_told_before_any_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def never() -> None:
        raise AssertionError("an episode was begun")

    monkeypatch.setattr(digests, "episodes", never)
    file, good = tmp_path / "file", tmp_path / "good.json"
    file.write_text("[1")
    good.write_text("{}")
    out = str(tmp_path / "now.json")
    assert main(["study", "digests", "--out", out, "--against", str(file)]) == 2
    assert "holds no digests" in capsys.readouterr().err
    assert main(["study", "digests", "--out", str(file / "now.json"), "--against", str(good)]) == 2
    assert "--out" in capsys.readouterr().err
    assert main(["study", "digests", "--out", str(tmp_path)]) == 2
