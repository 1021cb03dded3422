"""``mecanum play`` at work: pygame's events to the session, steps at their pace, pictures to the window."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from gymnasium.error import DependencyNotInstalled

from mecanum_env.views.window import NO_DISPLAY_REMEDY, NoDisplay, Window, load_pygame
from training.play.controls import Command, Controls, Twist, stick_twist
from training.play.picture import PICTURE_SHAPE, play_picture
from training.play.session import Session
from training.runs.errors import BadInput, Interrupted
from training.runs.signals import interrupt_flag

__all__ = ["Game", "open_window"]

_POLL_S = 1 / 30  # how long a key waits at most
_BUSY_S = 0.05  # for stepping on end, at paces where a picture a step would be too slow
_LAG_S = 0.1  # that is caught up with; a computer that is too slow for the pace slows it down instead
_AXIS = 32768.0  # of a game controller: its axes are 16 bit


def open_window() -> Window:
    """Open the window.

    Raises
    ------
    BadInput
        Without pygame, or a display to open it on.
    """
    try:
        window = Window("mecanum play", (PICTURE_SHAPE[1], PICTURE_SHAPE[0]))
    except (DependencyNotInstalled, NoDisplay) as error:
        raise BadInput(str(error)) from error
    if window.unseen:
        window.close()
        raise BadInput(f"no display to open a window on; {NO_DISPLAY_REMEDY}")
    return window


class Game:
    """A session in a window, from which the keys come, too; ``speed`` is times true speed."""

    def __init__(self, session: Session, window: Window, *, speed: float) -> None:
        self._pygame = load_pygame()
        self._session, self._window = session, window
        self._controls, self._gamepad = Controls(), _Gamepad()
        self._pace = _Pace(speed / session.config.step_s)
        self._help = self._over = False
        self.steps = 0

    def run(self, frames: int | None = None) -> None:
        """Play until it is quit, or for so many steps.

        Raises
        ------
        Interrupted
            By Ctrl-C.
        """
        with interrupt_flag() as interrupted:
            self._show()
            while self.steps != frames:
                if interrupted.is_set():
                    raise Interrupted(f"interrupted; {self._session.summary()}")
                events = self._window.take_events()
                for event in events:
                    self._handle(event)
                if self._over or self._window.closed:
                    break
                if self._step_what_is_due(frames) or events:
                    self._show()
                time.sleep(self._pace.wait_s(_POLL_S))

    def _step_what_is_due(self, frames: int | None) -> bool:
        """Step until no step is due, or the window has waited long enough; return whether there was one."""
        before, until = self.steps, time.perf_counter() + _BUSY_S
        while self.steps != frames and time.perf_counter() < until and self._pace.due():
            self._controls.sticks = self._gamepad.twist()
            self._session.step(self._controls.action())
            self.steps += 1
        return self.steps > before

    def _handle(self, event: Any) -> None:
        pygame = self._pygame
        if event.type == pygame.KEYDOWN:
            # With these it is meant for the desktop: Alt and Tab changes windows.
            if not getattr(event, "mod", 0) & (pygame.KMOD_ALT | pygame.KMOD_CTRL | pygame.KMOD_META):
                command = self._controls.press(pygame.key.name(event.key))
                if command is not None:
                    self._obey(command)
        elif event.type == pygame.KEYUP:
            self._controls.release(pygame.key.name(event.key))
        elif event.type == pygame.WINDOWFOCUSLOST:
            self._controls.release_all()
        elif event.type in (pygame.JOYDEVICEADDED, pygame.JOYDEVICEREMOVED):
            self._gamepad.find()

    def _obey(self, command: Command) -> None:
        if command is Command.QUIT:
            self._over = True
        elif command is Command.HELP:
            self._help = not self._help
        else:
            notice = self._session.preview(command)
            if notice:  # drawing rooms takes a moment, and a backend's first use of compiled code seconds
                self._show(f"{notice} …")
            self._session.obey(command)
            self._pace.restart()

    def _show(self, notice: str = "") -> None:
        picture = play_picture(
            self._session, steps_per_s=self._pace.measured, show_help=self._help and not notice, notice=notice
        )
        self._window.show(picture)


class _Pace:
    """Says when a step is due, so many a second, and counts how many a second there are."""

    def __init__(self, per_s: float) -> None:
        self._gap_s = 1.0 / per_s
        self.restart()

    def restart(self) -> None:
        """Begin now: the next step is due at once."""
        self._next = time.perf_counter()
        self._times: deque[float] = deque()

    def due(self) -> bool:
        """Return whether a step is due; then it counts as made."""
        now = time.perf_counter()
        if now < self._next:
            return False
        self._next = max(self._next + self._gap_s, now - _LAG_S)
        self._times.append(now)
        while len(self._times) > 20 and self._times[0] < now - 1.0:
            self._times.popleft()
        return True

    def wait_s(self, most_s: float) -> float:
        """Return how long it is until the next step is due, at most so long [s]."""
        return min(max(self._next - time.perf_counter(), 0.0), most_s)

    @property
    def measured(self) -> float | None:
        """Steps a second over the last second or 20 steps, or None before the second step."""
        if len(self._times) < 2:
            return None
        return (len(self._times) - 1) / (self._times[-1] - self._times[0])


class _Gamepad:
    """The first gamepad that is plugged in; none is as good as one at rest."""

    def __init__(self) -> None:
        self._pygame = load_pygame()
        # SDL knows which axis is which stick of most gamepads; its joysticks alone have them in any order.
        from pygame._sdl2 import controller

        self._controller = controller
        self._pygame.joystick.init()
        controller.init()
        self.find()

    def find(self) -> None:
        """Look for it again: one was plugged in or out."""
        joystick, controller = self._pygame.joystick, self._controller
        known = [i for i in range(joystick.get_count()) if controller.is_controller(i)]
        self._pad = controller.Controller(known[0]) if known else None
        self._joystick = joystick.Joystick(0) if not known and joystick.get_count() else None

    def twist(self) -> Twist:
        """Return what its sticks ask for."""
        pygame = self._pygame
        if self._pad is not None:
            sticks = (pygame.CONTROLLER_AXIS_LEFTX, pygame.CONTROLLER_AXIS_LEFTY, pygame.CONTROLLER_AXIS_RIGHTX)
            left_x, left_y, right_x = (self._pad.get_axis(axis) / _AXIS for axis in sticks)
        elif self._joystick is not None and self._joystick.get_numaxes() >= 3:
            # Of five axes or more the third is a trigger most often, of fewer the right stick.
            right = 3 if self._joystick.get_numaxes() >= 5 else 2
            left_x, left_y, right_x = (self._joystick.get_axis(axis) for axis in (0, 1, right))
        else:
            return 0.0, 0.0, 0.0
        return stick_twist(left_x, left_y, right_x)
