"""What the keys and the sticks of ``mecanum play`` mean. Nothing here knows of a window."""

from __future__ import annotations

import enum
import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["COMMANDS", "DRIVING", "KEYS", "Command", "Controls", "stick_twist"]

Twist = tuple[float, float, float]
"""Body twist vx, vy, ω as fractions of the robot's limits: forward, left, counter-clockwise."""


class Command(enum.Enum):
    """What a key asks for once, when it goes down."""

    HAND_OVER = "hand over"
    NEXT_BACKEND = "next backend"
    NEXT_ROOM = "next room"
    PREVIOUS_ROOM = "previous room"
    NEXT_KIND = "next kind of rooms"
    RESTART = "restart"
    HELP = "help"
    QUIT = "quit"


_FORWARD, _LEFT, _TURN_LEFT = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_BACK, _RIGHT, _TURN_RIGHT = (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)

DRIVING: dict[str, Twist] = {
    "w": _FORWARD, "s": _BACK, "a": _LEFT, "d": _RIGHT, "q": _TURN_LEFT, "e": _TURN_RIGHT,
    "up": _FORWARD, "down": _BACK, "left": _TURN_LEFT, "right": _TURN_RIGHT,
}  # fmt: skip
"""The keys that drive while they are held, by pygame's names, and where to."""

COMMANDS = {
    "space": Command.HAND_OVER, "tab": Command.NEXT_BACKEND, "b": Command.NEXT_BACKEND, "n": Command.NEXT_ROOM,
    "p": Command.PREVIOUS_ROOM, "k": Command.NEXT_KIND, "r": Command.RESTART, "f1": Command.HELP,
    "h": Command.HELP, "escape": Command.QUIT,
}  # fmt: skip
"""The keys that do something once, by pygame's names."""

KEYS = (
    ("W  S  or  Up  Down", "drive forward, back"),
    ("A  D", "strafe left, right"),
    ("Q  E  or  Left  Right", "turn left, right"),
    ("Space", "let the agent drive, or take the wheel back"),
    ("Tab  or  B", "next SLAM backend, same room"),
    ("N  P", "next, previous room"),
    ("K", "next kind of rooms"),
    ("R", "restart"),
    ("F1  or  H", "show or hide these keys"),
    ("Esc", "quit"),
    ("Gamepad", "left stick drives and strafes, right stick turns"),
)
"""The same for people: keys and what they do."""

DEAD_ZONE = 0.15
"""Share of a stick's travel about its middle, where worn ones come to rest, that counts as none."""


class Controls:
    """The keys that are held and the gamepad's sticks, as one action."""

    def __init__(self) -> None:
        self._held: set[str] = set()
        self._tapped: set[str] = set()
        self.sticks: Twist = (0.0, 0.0, 0.0)

    def press(self, key: str) -> Command | None:
        """Take note of a key that went down; return what it asks for once, if anything."""
        if key in DRIVING:
            self._held.add(key)
            self._tapped.add(key)
        return COMMANDS.get(key)

    def release(self, key: str) -> None:
        """Take note of a key that went up."""
        self._held.discard(key)

    def release_all(self) -> None:
        """Let go of all keys: the window gets none while another one has the keyboard."""
        self._held.clear()
        self._tapped.clear()

    def action(self) -> NDArray[np.float32]:
        """Return the action ``(3,)`` in [-1, 1] for the next step.

        A key that was tapped since the last one counts as held, however short that was.
        """
        twists = [DRIVING[key] for key in self._held | self._tapped] + [self.sticks]
        self._tapped.clear()
        return np.asarray(np.clip(np.sum(twists, axis=0), -1.0, 1.0), np.float32)


def stick_twist(left_x: float, left_y: float, right_x: float) -> Twist:
    """Return what sticks ask for, from their axes in [-1, 1] with right and down positive, as gamepads have them.

    What lies beyond the dead zone is stretched to all of [0, 1], so that the robot can also creep.
    """
    length = math.hypot(left_x, left_y)
    share = _beyond_dead_zone(length) / length if length > 0 else 0.0
    # From zero, for a zero without a sign.
    return (
        0.0 - share * left_y,
        0.0 - share * left_x,
        0.0 - math.copysign(_beyond_dead_zone(abs(right_x)), right_x),
    )


def _beyond_dead_zone(travel: float) -> float:
    return min(max((travel - DEAD_ZONE) / (1.0 - DEAD_ZONE), 0.0), 1.0)
