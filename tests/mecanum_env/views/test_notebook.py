"""What a notebook shows of an environment and of a belief."""

from __future__ import annotations

import cv2
import gymnasium as gym
import numpy as np

import mecanum_env
from mecanum_env.views.render import render_frame


def decoded(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image


def test_an_environment_is_its_frame_and_a_belief_its_map() -> None:
    env = gym.make("mecanum_env/Explore-v0", rooms="rectangular").unwrapped
    assert isinstance(env, mecanum_env.ExploreEnv)
    assert env._repr_png_() is None, "before reset there is nothing to see"
    env.reset(seed=0)
    png = env._repr_png_()
    assert png is not None
    np.testing.assert_array_equal(decoded(png)[..., ::-1], render_frame(env))
    at_first = env.belief._repr_png_()
    assert len(np.unique(decoded(at_first).reshape(-1, 3), axis=0)) > 10
    assert len(at_first) < 100_000
