"""``render_mode="human"``: what the window shows, when, and how it ends; SDL's dummy driver is the screen."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled

from mecanum_env.views.render import FRAME_SHAPE, render_frame
from mecanum_env.views.window import NoDisplay, Window, _fitted

ROOT = Path(__file__).resolve().parents[3]
IDS = ("mecanum_env/Explore-v0", "mecanum_env/ExploreWheels-v0", "mecanum_env/ExploreFrontier-v0")
FAST = 10_000  # frames a second: tests do not watch


def make(env_id: str = IDS[0], *, fps: float = FAST, **kwargs: Any) -> Any:
    env = gym.make(f"mecanum_env:{env_id}", rooms="rectangular", render_mode="human", **kwargs)
    inner = env.unwrapped
    inner = getattr(inner, "base", inner)
    inner.metadata = inner.metadata | {"render_fps": fps}
    return env


def on_screen(pygame: Any) -> np.ndarray:
    """Return what the window shows as an image ``(h, w, 3)``."""
    return np.ascontiguousarray(pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1))


@pytest.mark.parametrize("env_id", IDS)
def test_reset_and_step_show_the_frame_and_render_returns_none(env_id: str, pygame: Any) -> None:
    env = make(env_id)
    assert "human" in env.metadata["render_modes"]
    assert not pygame.display.get_init()
    env.reset(seed=0)
    inner = getattr(env.unwrapped, "base", env.unwrapped)
    first = on_screen(pygame)
    assert np.array_equal(first, render_frame(inner))
    env.step(env.action_space.sample() if env_id != IDS[2] else 0)
    then = on_screen(pygame)
    assert np.array_equal(then, render_frame(inner)) and not np.array_equal(first, then)
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_a_copy_shows_itself(pygame: Any) -> None:
    env = make()
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    twin.step(np.array([0.5, 0.0, 0.0], np.float32))
    assert np.array_equal(on_screen(pygame), render_frame(twin.unwrapped))
    twin.close()
    env.close()


def test_frames_a_second_are_steps_a_second() -> None:
    env = gym.make("mecanum_env:mecanum_env/Explore-v0", config={"step_s": 0.04})
    assert env.metadata["render_fps"] == 25 and type(env.unwrapped).metadata["render_fps"] == 10


def test_the_pace_is_that_of_the_metadata(pygame: Any) -> None:
    env = gym.make("mecanum_env:mecanum_env/Explore-v0", rooms="rectangular", render_mode="human")
    assert env.metadata["render_fps"] == 10
    env.reset(seed=0)
    env.step(np.zeros(3, np.float32))
    began = time.perf_counter()
    for _ in range(3):
        env.step(np.zeros(3, np.float32))
    assert time.perf_counter() - began > 0.25
    env.close()


def test_being_watched_changes_nothing(pygame: Any) -> None:
    watched = make()
    alone = gym.make("mecanum_env:mecanum_env/Explore-v0", rooms="rectangular")
    action = np.array([0.4, 0.2, -0.1], np.float32)
    for env in (watched, alone):
        env.reset(seed=5)
    for _ in range(3):
        one, two = watched.step(action), alone.step(action)
        assert np.array_equal(one[0]["map_local"], two[0]["map_local"]) and one[1] == two[1]
    watched.close()


def test_the_picture_keeps_its_proportions_in_a_window_of_any_shape(pygame: Any) -> None:
    image = np.full((*FRAME_SHAPE, 3), 90, np.uint8)
    image[:, :640] = (200, 30, 60)
    window = Window("a test", (1280, 720))
    for size, place in (
        ((640, 360), (0, 0, 640, 360)),
        ((640, 480), (0, 60, 640, 360)),
        ((2000, 720), (360, 0, 1280, 720)),
    ):
        pygame.display.set_mode(size, pygame.RESIZABLE)
        window.show(image)
        shown, (x, y, width, height) = on_screen(pygame), place
        assert shown.shape == (size[1], size[0], 3)
        inside = shown[y : y + height, x : x + width]
        assert np.array_equal(inside, cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
        outside = np.ones(shown.shape[:2], bool)
        outside[y : y + height, x : x + width] = False
        assert np.all(shown[outside] == shown[0, 0]) or not outside.any()
    window.close()


@pytest.mark.parametrize("room", [(1, 1), (1280, 1), (333, 777)])
def test_a_picture_fits_into_any_room(room: tuple[int, int]) -> None:
    x, y, width, height = _fitted(1280, 720, *room)
    assert 1 <= width <= room[0] and 1 <= height <= room[1] and x >= 0 and y >= 0


def test_closed_by_hand_it_stays_closed_and_the_steps_go_on(pygame: Any) -> None:
    env = make()
    env.reset(seed=0)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    with pytest.warns(UserWarning, match="the window was closed"):
        env.step(np.zeros(3, np.float32))
    assert not pygame.display.get_init()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        env.step(np.zeros(3, np.float32))
        env.reset(seed=1)
    assert not pygame.display.get_init()
    env.close()
    env.reset(seed=1)
    assert pygame.display.get_init()
    env.close()


def test_keys_are_left_for_the_program_to_read(pygame: Any) -> None:
    env = make()
    env.reset(seed=0)
    pygame.event.get()
    for kind in (pygame.KEYDOWN, pygame.MOUSEMOTION):
        pygame.event.post(pygame.event.Event(kind, {"key": pygame.K_w} if kind == pygame.KEYDOWN else {}))
    env.step(np.zeros(3, np.float32))
    assert [event.type for event in pygame.event.get()] == [pygame.KEYDOWN]
    env.close()


def test_one_environment_closes_and_another_goes_on(pygame: Any) -> None:
    one, other = make(), make()
    for env in (one, other):
        env.reset(seed=0)
    one.close()
    other.step(np.zeros(3, np.float32))
    assert np.array_equal(on_screen(pygame), render_frame(other.unwrapped))
    other.close()


def test_where_no_window_can_be_opened_the_remedy_is_said(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "none-such")
    env = make()
    with pytest.raises(NoDisplay, match="SDL_VIDEODRIVER=dummy"):
        env.reset(seed=0)
    env.close()


def test_a_window_that_nobody_sees_is_warned_of(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # Where there is no desktop, SDL takes a driver that draws to memory by itself.
    pygame.display.init()
    monkeypatch.delenv("SDL_VIDEODRIVER")
    env = make()
    with pytest.warns(UserWarning, match="nobody sees this window.*SDL_VIDEODRIVER=dummy"):
        env.reset(seed=0)
    env.step(np.zeros(3, np.float32))
    env.close()


def test_without_pygame_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(DependencyNotInstalled, match=r"pip install 'mecanum-slam\[human\]'"):
        make()
    gym.make("mecanum_env:mecanum_env/Explore-v0", render_mode="rgb_array").close()


def test_pygame_is_loaded_for_people_alone() -> None:
    code = (
        "import sys, gymnasium, mecanum_env\n"
        "for mode in (None, 'rgb_array'):\n"
        "    env = gymnasium.make('mecanum_env/Explore-v0', rooms='rectangular', render_mode=mode)\n"
        "    env.reset(seed=0); env.render() if mode else None; env.close()\n"
        "print('pygame' in sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    assert result.stdout == "False\n", result.stderr
