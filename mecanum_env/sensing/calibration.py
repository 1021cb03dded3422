"""What the estimators are told of the simulated robot: V from its declared noise, and where its lidar sits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mecanum_env.config import EnvConfig, NoiseConfig, RobotConfig
from mecanum_env.sensing.slip import grip_m_s2, patch_friction
from slam.motion import LastingErrors, OdometryNoise
from slam.settings import overlaid, to_mapping

__all__ = ["backend_settings", "odometry_noise"]

# A wheel's radius error stays for the whole episode, while a filter without it as a state takes it for white. Over
# the most of a second that it takes landmarks to correct a drift, the steps' errors add up instead of averaging.
_PERSISTENCE_S = 0.8

# What is left of the wheels' creep when its mean is taken out (mecanum_env.sensing.sensors.creep), and some more:
# a robot that stands must not become certain of where it is.
_FLOOR_M_S = 0.0001

_LEAST_RANGE_SIGMA_M = 0.0001  # of a lidar that has no noise: no filter divides by zero


def odometry_noise(robot: RobotConfig, noise: NoiseConfig, step_s: float = 0.1) -> OdometryNoise:
    """Return V for a robot, its noise and the length of a step, from what is declared (docs/reference/motion.md).

    Each wheel's relative error has a white part (encoder, random slip) and a lasting one (radius, lever, uniform
    within their bounds); the slip's mean the odometry takes out itself. Four wheels average into vx and vy with
    weight 1/4 each, and into ω with 1/(4l). For filters that estimate the lasting part it is told apart.
    ``mecanum study calibration`` measures V on the simulated robot.
    """
    # Of the motion p u gets lost, u uniform in [0, 2]; the odometry tells the wheels' times 1 - p.
    white = noise.encoder**2 + (noise.slip / (1.0 - noise.slip)) ** 2 / 3.0
    steps = max(_PERSISTENCE_S / step_s, 1.0)
    as_white = steps * (noise.radius_error**2 / 3.0)
    per_wheel = math.sqrt((white + as_white) / 4.0)
    # A wrong lever is a bias in the turn rate, with half of the wheels' squared speed in a turn.
    base = noise.base_error * math.sqrt(steps / 6.0)
    white_share = math.sqrt(white / 4.0)
    return OdometryNoise(
        lever_m=robot.lever_m,
        speed_floor_m_s=_FLOOR_M_S,
        turn_floor_rad_s=_FLOOR_M_S / robot.lever_m,
        speed_share=per_wheel,
        turn_share_rad_m=math.hypot(per_wheel, base) / robot.lever_m,
        slide_m_s2=grip_m_s2(patch_friction(noise)),
        lasting=LastingErrors(
            radius_sigma=noise.radius_error / math.sqrt(3.0),
            lever_sigma=noise.base_error / math.sqrt(3.0),
            white_speed_share=white_share,
            white_turn_share_rad_m=white_share / robot.lever_m,
        ),
    )


def backend_settings(config: EnvConfig) -> dict[str, Any]:
    """Return a backend's settings as the environment's parts imply them, ``slam_config`` laid over them."""
    settings: dict[str, Any] = {
        "lidar_offset_m": config.lidar.offset_m,
        "body_radius_m": 0.5 * (config.robot.inscribed_radius_m + config.robot.circumscribed_radius_m),
        "body_length_m": config.robot.length_m,
        "body_width_m": config.robot.width_m,
        "grid_resolution_m": config.grid_resolution_m,
        "odometry": to_mapping(odometry_noise(config.robot, config.noise, config.step_s)),
        "features": {"range_sigma_m": max(config.noise.range_sigma_m, _LEAST_RANGE_SIGMA_M)},
    }
    given = config.slam_config.get("odometry")
    whole = {"speed_share", "turn_share_rad_m"}
    if isinstance(given, Mapping) and "lasting" not in given and given.keys() & whole:
        del settings["odometry"]["lasting"]  # these speak of V as a whole
    return overlaid(settings, config.slam_config)
