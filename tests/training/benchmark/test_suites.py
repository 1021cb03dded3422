"""Suites: seeds of their own, all kinds of rooms, and plans from a folder."""

from __future__ import annotations

from pathlib import Path

from tests.training.plans import write_room
from training.benchmark import suites
from training.benchmark.suites import SPLITS


def test_splits_are_disjoint_and_suites_have_all_five_kinds_twice() -> None:
    seeds = [set(split) for split in SPLITS.values()]
    assert not (seeds[0] & seeds[1] or seeds[0] & seeds[2] or seeds[1] & seeds[2])
    assert SPLITS["test"] == range(10000, 10050)
    every = suites.choose("all")
    assert len(every) == 10 and {suite.noise for suite in every} == {"nominal", "slippery"}
    assert {place.rooms for suite in every for place in suite.places} == {
        "rectangular", "apartment", "corridors", "cave", "maze",
    }  # fmt: skip
    assert [s.name for s in suites.choose("mazes-slippery, rooms,mazes-slippery")] == ["mazes-slippery", "rooms"]


def test_floor_plans_are_maps_and_images_that_belong_to_none(tmp_path: Path) -> None:
    write_room(tmp_path / "a.png")
    write_room(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    (tmp_path / "notes.txt").write_text("no plan")
    (suite,) = suites.choose("floor-plans", floor_plans=tmp_path)
    assert [place.name for place in suite.places] == ["a.png", "map.yaml"]
    assert len(suite.seeds("test")) == 5
    assert len(suites.choose("all", floor_plans=tmp_path)) == 12
    before = [place.digest for place in suite.places]
    write_room(tmp_path / "map.pgm", width_m=5.0)
    (suite,) = suites.choose("floor-plans", floor_plans=tmp_path)
    assert [a == b.digest for a, b in zip(before, suite.places, strict=True)] == [True, False]
