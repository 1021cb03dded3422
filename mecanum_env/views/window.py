"""A window for the frames: ``render_mode="human"``, and what ``mecanum play`` is shown in.

Pygame is loaded when a window is asked for, never by importing this module.
"""

from __future__ import annotations

import os
from types import ModuleType
from typing import Any

import cv2
import gymnasium
import numpy as np
from gymnasium.error import DependencyNotInstalled

from mecanum_env.views.canvas import PAGE
from mecanum_env.views.render import FRAME_SHAPE, Shown, render_frame
from slam.types import Bytes

__all__ = ["NoDisplay", "NoViewer", "Viewer", "Window", "load_pygame", "make_viewer"]

Image = Bytes

NO_DISPLAY_REMEDY = "run it on a desktop, or set SDL_VIDEODRIVER=dummy to run without a screen"
_NOWHERE = ("dummy", "offscreen", "evdev")  # SDL's drivers that show nothing to anybody
_OF_DESKTOP = 0.9  # a window's share of the desktop at most, when it opens


class NoDisplay(RuntimeError):
    """No window can be opened here; the message is one line with the remedy."""


def load_pygame() -> ModuleType:
    """Import pygame, without its greeting on standard output.

    Raises
    ------
    gymnasium.error.DependencyNotInstalled
        With the remedy, where it is not installed.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise DependencyNotInstalled(
            "a window needs pygame-ce; install it with pip install 'mecanum-slam[human]'"
        ) from error
    return pygame


class Window:
    """A resizable window that shows pictures as large as they fit, in their own proportions.

    Like every environment's of Gymnasium it is pygame's one display: two of them in one process share it.

    Parameters
    ----------
    title : str
        Written on its frame.
    size : (int, int)
        Width and height of the pictures, which it opens with where the desktop is large enough.

    Raises
    ------
    NoDisplay
        Where SDL finds nothing to open a window on.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        self._pygame = load_pygame()
        self._title, self._size = title, size
        self.closed = False
        self._surface()

    @property
    def unseen(self) -> bool:
        """Whether nobody can see it, though nobody asked for that: SDL found no desktop and draws to memory."""
        asked = os.environ.get("SDL_VIDEODRIVER")
        return not asked and not self.closed and self._pygame.display.get_driver() in _NOWHERE

    def show(self, image: Image) -> None:
        """Show an RGB image ``(h, w, 3)`` uint8; in a window that is closed, do nothing."""
        if self.closed:
            return
        pygame, surface = self._pygame, self._surface()
        x, y, width, height = _fitted(image.shape[1], image.shape[0], *surface.get_size())
        if (height, width) != image.shape[:2]:
            # Averaging keeps thin lines when it shrinks; when it grows there is nothing to average.
            how = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, (width, height), interpolation=how), np.uint8)
        surface.fill(PAGE[::-1])
        surface.blit(pygame.image.frombuffer(np.ascontiguousarray(image).data, (width, height), "RGB"), (x, y))
        pygame.display.flip()

    def take_events(self, *, leave: tuple[int, ...] = ()) -> list[Any]:
        """Return pygame's events since the last call, but for the types to ``leave`` in its queue for others.

        Where one of them closes the window, it is closed when this returns.
        """
        if self.closed:
            return []
        pygame = self._pygame
        self._surface()  # somebody else's close() shuts pygame's display, and with it the queue
        events = list(pygame.event.get(exclude=leave) if leave else pygame.event.get())
        if any(event.type == pygame.QUIT for event in events):
            self.close()
        return events

    def close(self) -> None:
        """Close it; a second time nothing happens."""
        if not self.closed:
            self.closed = True
            self._pygame.display.quit()

    def _surface(self) -> Any:
        """Return what is drawn on, opened where it is not: at first, and when somebody else closed the display."""
        pygame = self._pygame
        try:
            if not pygame.display.get_init():
                pygame.display.init()
            surface = pygame.display.get_surface()
            if surface is None:
                surface = pygame.display.set_mode(self._opening_size(), pygame.RESIZABLE)
                pygame.display.set_caption(self._title)
        except pygame.error as error:
            pygame.display.quit()
            raise NoDisplay(f"no window can be opened ({error}); {NO_DISPLAY_REMEDY}") from error
        return surface

    def _opening_size(self) -> tuple[int, int]:
        width, height = self._size
        display = self._pygame.display
        if display.get_driver() in _NOWHERE:
            return width, height
        desk_width, desk_height = (_OF_DESKTOP * side for side in display.get_desktop_sizes()[0])
        scale = min(1.0, desk_width / width, desk_height / height)
        return round(scale * width), round(scale * height)


def _fitted(width: int, height: int, room_x: int, room_y: int) -> tuple[int, int, int, int]:
    """Return x, y, width and height of a picture that fills its room as far as its proportions let it."""
    scale = min(room_x / width, room_y / height)
    fit_x, fit_y = max(round(scale * width), 1), max(round(scale * height), 1)
    return (room_x - fit_x) // 2, (room_y - fit_y) // 2, fit_x, fit_y


class NoViewer:
    """Shows nothing: every render mode but ``human``."""

    def show(self, env: Shown) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class Viewer:
    """Shows an environment's frames in a window, so many a second.

    The window opens with the first frame. When it is closed by hand, that is said in a warning and the
    environment goes on without it, at full speed; after ``close()`` the next frame opens another.
    """

    def __init__(self, fps: float) -> None:
        self._pygame = load_pygame()
        self._fps = fps
        self._clock = self._pygame.time.Clock()
        self._window: Window | None = None

    def __reduce__(self) -> tuple[type[Viewer], tuple[float]]:
        return Viewer, (self._fps,)  # a copy opens a window of its own

    def show(self, env: Shown) -> None:
        """Show the environment as it is now, and wait until the frame is due."""
        if self._window is None:
            self._window = Window("mecanum-slam", (FRAME_SHAPE[1], FRAME_SHAPE[0]))
            if self._window.unseen:
                gymnasium.logger.warn(f"no display: nobody sees this window; {NO_DISPLAY_REMEDY}")
        window = self._window
        if window.closed:
            return
        # Keys are left for a program that reads them itself; all else would fill the queue up in time.
        window.take_events(leave=(self._pygame.KEYDOWN, self._pygame.KEYUP))
        if window.closed:
            gymnasium.logger.warn("the window was closed; the environment goes on without it")
            return
        window.show(render_frame(env))
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window; a second time nothing happens."""
        if self._window is not None:
            self._window.close()
            self._window = None


def make_viewer(render_mode: str | None, *, fps: float) -> Viewer | NoViewer:
    """Return what shows an environment of a render mode to a person."""
    return Viewer(fps) if render_mode == "human" else NoViewer()
