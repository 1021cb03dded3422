"""What the keys and sticks of ``mecanum play`` mean; no window is needed for it."""

from __future__ import annotations

import numpy as np
import pytest

from training.play.controls import COMMANDS, DEAD_ZONE, DRIVING, KEYS, Command, Controls, stick_twist


@pytest.mark.parametrize(
    ("keys", "action"),
    [
        (["w"], (1, 0, 0)), (["s"], (-1, 0, 0)), (["a"], (0, 1, 0)), (["d"], (0, -1, 0)), (["q"], (0, 0, 1)),
        (["e"], (0, 0, -1)), (["up"], (1, 0, 0)), (["down"], (-1, 0, 0)), (["left"], (0, 0, 1)),
        (["right"], (0, 0, -1)), (["w", "a", "e"], (1, 1, -1)), (["w", "s"], (0, 0, 0)), (["w", "up"], (1, 0, 0)),
        ([], (0, 0, 0)), (["x"], (0, 0, 0)),
    ],
)  # fmt: skip
def test_held_keys_are_a_twist(keys: list[str], action: tuple[int, int, int]) -> None:
    controls = Controls()
    for key in keys:
        assert controls.press(key) is None
    for _ in range(2):
        held = controls.action()
        assert held.dtype == np.float32 and held.tolist() == list(action)
    for key in keys:
        controls.release(key)
    assert not controls.action().any()


def test_a_tap_between_two_steps_counts_for_one() -> None:
    controls = Controls()
    controls.press("w")
    controls.release("w")
    assert controls.action().tolist() == [1, 0, 0] and not controls.action().any()
    controls.press("w")
    controls.release_all()
    assert not controls.action().any()


def test_sticks_drive_and_keys_go_with_them() -> None:
    controls = Controls()
    controls.sticks = (0.5, -0.25, 0.0)
    controls.press("w")
    controls.press("q")
    assert controls.action().tolist() == [1.0, -0.25, 1.0]


def test_sticks_have_a_dead_zone_and_their_full_range() -> None:
    assert stick_twist(0.0, 0.0, 0.0) == (0.0, 0.0, 0.0)
    assert stick_twist(0.1, -0.1, -0.14) == (0.0, 0.0, 0.0)
    assert stick_twist(0.0, -1.0, 0.0) == (1.0, 0.0, 0.0)  # pushed away: forward
    assert stick_twist(1.0, 0.0, 1.0) == (0.0, -1.0, -1.0)  # to the right: strafe and turn right
    creep, _, turn = stick_twist(0.0, -(DEAD_ZONE + 0.01), -(DEAD_ZONE + 0.01))
    assert creep == pytest.approx(0.01 / (1 - DEAD_ZONE)) == turn
    # Diagonally, the direction is the stick's.
    vx, vy, _ = stick_twist(-0.3, -0.6, 0.0)
    assert vy / vx == pytest.approx(0.5)
    assert np.hypot(*stick_twist(-1.0, -1.0, 0.0)[:2]) == pytest.approx(1.0)


def test_every_key_is_listed_and_none_means_two_things() -> None:
    listed = {word.lower() for keys, _ in KEYS for word in keys.split()} - {"or", "gamepad"}
    assert listed == {{"escape": "esc"}.get(key, key) for key in (*DRIVING, *COMMANDS)}
    assert not set(DRIVING) & set(COMMANDS)
    assert set(COMMANDS.values()) == set(Command)
