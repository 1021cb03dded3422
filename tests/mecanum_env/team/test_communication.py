"""Who hears whom."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.team.communication import groups, walls_between
from mecanum_env.team.config import CommunicationConfig

WALL = np.array([(5.0, -10.0, 5.0, 10.0), (5.1, -10.0, 5.1, 10.0)])  # both surfaces of one
NO_WALL = np.zeros((0, 4))


def _plan(walls: np.ndarray, **more: Any) -> FloorPlan:
    free = np.ones((2, 2), np.bool_)
    return FloorPlan(name="open", walls=walls, free=free, resolution=1.0, start=(1.0, 1.0, 0.0), **more)


def _heard(
    model: str, places: list[tuple[float, float]], plan: FloorPlan | None = None, **more: float
) -> list[int]:
    config = CommunicationConfig(model=model, **more)  # type: ignore[arg-type]
    return groups(config, np.array(places), plan or _plan(WALL)).tolist()


def test_models() -> None:
    near, behind, far = (0.0, 0.0), (6.0, 0.0), (30.0, 0.0)
    assert _heard("unlimited", [near, behind, far]) == [0, 0, 0]
    assert len(set(_heard("none", [near, behind, far]))) == 3
    assert _heard("range", [near, behind, far]) == [0, 0, 1]
    assert _heard("line-of-sight", [near, behind]) == [0, 1]
    assert _heard("line-of-sight", [near, (4.0, 0.0)]) == [0, 0]
    # 6 m of 10 leave 4.4 dB: less than a wall of 5 dB takes, more than one of 4.
    assert _heard("walls", [near, behind]) == [0, 1]
    assert _heard("walls", [near, behind], wall_loss_db=4.0) == [0, 0]


def test_who_is_heard_by_one_that_is_heard_is_heard() -> None:
    assert _heard("range", [(0, 0), (8, 0), (16, 0)], _plan(NO_WALL)) == [0, 0, 0]
    assert _heard("range", [(0, 0), (16, 0), (8, 0), (50, 0)], _plan(NO_WALL)) == [0, 0, 0, 1]


def test_furniture_is_in_the_way_of_sight_and_no_wall() -> None:
    box = np.array([(4.0, -1.0), (6.0, -1.0), (6.0, 1.0), (4.0, 1.0)])
    for plan in (_plan(NO_WALL, polygons=(box,)), _plan(NO_WALL, circles=np.array([(5.0, 0.0, 1.0)]))):
        for y, past in ((0.0, False), (0.9, False), (1.1, True)):
            places = [(0.0, y), (9.0, y)]
            assert _heard("line-of-sight", places, plan) == ([0, 0] if past else [0, 1])
            assert _heard("walls", places, plan) == [0, 0]
        for beside in ([(0.0, 0.0), (3.9, 0.0)], [(6.1, 0.0), (9.0, 0.0)], [(9.0, 0.0), (9.0, 0.0)]):
            assert _heard("line-of-sight", beside, plan) == [0, 0]


@given(st.tuples(*[st.floats(-9, 9)] * 4), st.floats(-3, 3))
def test_walls_between_are_the_same_from_either_side_and_in_any_frame(
    ends: tuple[float, float, float, float], turn: float
) -> None:
    a, b = np.array(ends[:2]), np.array(ends[2:])
    count = walls_between(a, b, WALL)
    assert count == walls_between(b, a, WALL)
    if min(abs(a[0] - 5), abs(b[0] - 5), abs(a[0] - 5.1), abs(b[0] - 5.1)) > 1e-6:
        assert count == int((a[0] < 5) != (b[0] < 5) or (a[0] < 5.1) != (b[0] < 5.1))
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([(c, -s), (s, c)])
        turned = (WALL.reshape(-1, 2) @ rotation.T).reshape(-1, 4)
        assert count == walls_between(rotation @ a, rotation @ b, turned)
