"""Reward: a sum of named terms, weighted by the config and handed out in ``info["reward_terms"]``."""

from __future__ import annotations

from typing import NamedTuple

from mecanum_env.config import RewardConfig

__all__ = ["StepOutcome", "reward_terms"]


class StepOutcome(NamedTuple):
    """What one step changed, as far as the reward is concerned."""

    area_m2: float  # newly mapped
    pose_entropy_loss_nat: float
    map_entropy_loss_bit_m2: float
    collisions: int  # contacts begun
    effort: float  # speed as a fraction of the robot's limits, 0 to 1
    dt: float  # [s]


def reward_terms(config: RewardConfig, outcome: StepOutcome) -> dict[str, float]:
    """Return the weighted terms; their sum is the reward."""
    return {
        "area": config.area * outcome.area_m2,
        "pose_entropy": config.pose_entropy * outcome.pose_entropy_loss_nat,
        "map_entropy": config.map_entropy * outcome.map_entropy_loss_bit_m2,
        "collision": config.collision * outcome.collisions,
        "effort": config.effort * outcome.effort * outcome.dt,
        "time": config.time * outcome.dt,
    }
