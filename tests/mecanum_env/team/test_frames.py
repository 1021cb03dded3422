"""When a frame that maps have told is used, and when it is given up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from mecanum_env.team.frames import Frames
from mecanum_env.team.reports import Report
from slam.accounts.account import Account
from slam.geometry import compose, inverse
from slam.types import Array
from tests.slam.teams.worlds import World

HERE = np.zeros(3)
THERE, ELSEWHERE = np.array([3.0, -2.0, 2.0]), np.array([-4.0, 1.0, 0.5])


def _told(account: Account | None, **frames: Array) -> Report:
    known = {int(name[1:]): pose for name, pose in frames.items()}
    return Report(0.0, HERE, np.eye(3), None, 0.0, None, account, None, known, ended=False)


def _frames(robot: int = 0, *, known: bool = False) -> Frames:
    return Frames(robot, cast(Any, SimpleNamespace(grid=None)), known=known)


def _maps(seen: int, frame: Array) -> tuple[Account, Account]:
    """What two robots have mapped of one world when both have seen so many corners."""
    world, rng = World(np.random.default_rng(0), points=60), np.random.default_rng(1)
    a, b = (
        world.account(k, origin, HERE, rng, sees=np.arange(seen), sigma=0.001)
        for k, origin in ((0, HERE), (1, frame))
    )
    return a, b


def _look(frames: Frames, time_s: float, seen: int, frame: Array = THERE) -> set[int]:
    own, other = _maps(seen, frame)
    frames.take_reports(time_s, {1: _told(other)}, own)
    return set(frames.found)


def test_a_first_match_is_not_used_before_a_larger_map_confirms_it() -> None:
    frames = _frames()
    assert _look(frames, 0.0, 30) == set()
    assert _look(frames, 10.0, 30) == set()  # nothing new has been seen
    assert _look(frames, 20.0, 40) == {1}
    off = compose(inverse(THERE), frames.found[1])
    assert np.hypot(*off[:2]) < 0.05


def test_a_first_match_that_the_next_look_contradicts_is_not_used() -> None:
    frames = _frames()
    assert _look(frames, 0.0, 30, ELSEWHERE) == set()
    assert _look(frames, 10.0, 40) == set()
    assert _look(frames, 20.0, 50) == {1}


def test_a_frame_that_a_later_look_contradicts_is_given_up() -> None:
    frames = _frames()
    _look(frames, 0.0, 30)
    assert _look(frames, 10.0, 40) == {1}
    assert _look(frames, 80.0, 50, ELSEWHERE) == set() == set(frames.told)


def test_what_one_has_given_up_nobody_goes_on_to_tell() -> None:
    """The first robot tells the third where the second's frame lies, and then no more."""
    frames = _frames(2)
    heard = {0: _told(None, r1=THERE, r2=ELSEWHERE), 1: _told(None)}
    frames.take_reports(0.0, heard, None)
    assert set(frames.found) == {0, 1} and not frames.told
    np.testing.assert_allclose(frames.found[1], compose(inverse(ELSEWHERE), THERE), atol=1e-12)
    frames.take_reports(1.0, heard | {0: _told(None, r2=ELSEWHERE)}, None)
    assert set(frames.found) == {0}
