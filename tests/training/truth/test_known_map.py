"""The bound that is driven: below every agent, above the lower bound, and as it was tried."""

from __future__ import annotations

import pytest

import agents
from training.episodes.explore import prepare, run
from training.truth import known_map
from training.truth.known_map import KNOWN_MAPS


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    monkeypatch.setattr(known_map, "_STARTS", 2)
    monkeypatch.setattr(known_map, "_TRIES", 3000)
    monkeypatch.setattr(known_map, "_TIMED", 20)
    monkeypatch.setattr(known_map, "_MARGINS", (0.001, 0.01))


def episode(tmp_path, agent, rooms, seed):
    it = prepare(out=tmp_path, agent=agent, rooms=rooms, seed=seed)
    run(it, lambda **_: None)
    return it.metrics()


def test_it_is_no_agent():
    assert not set(KNOWN_MAPS) & set(agents.names())


def test_it_is_between_the_lower_bound_and_every_agent(tmp_path):
    rooms, seed = "rectangular", 5
    known = episode(tmp_path, "known-map", rooms, seed)
    assert known["end"] == "covered" and known["collisions"] == 0
    # It stops where it has reached what it was to reach: 2 s later the episode is over.
    assert known["time_s"] == pytest.approx(known["time_to_95_s"] + 2.0, abs=0.11)
    assert known["lower_bound_s"] <= known["time_to_95_s"]
    for agent in ("nearest-frontier", "brisk-tour"):
        assert known["time_to_95_s"] < episode(tmp_path, agent, rooms, seed)["time_to_95_s"]


def test_it_drives_as_it_tried(tmp_path):
    it = prepare(out=tmp_path, agent="known-map", rooms="rectangular", seed=2)
    steps = it.agent._steps_left
    run(it, lambda **_: None)
    assert it.metrics()["time_to_95_s"] == pytest.approx(steps * it.config.step_s)
