"""One furnished rectangular room: the simplest place to explore."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.rooms.layout.assembly import assemble, generator
from mecanum_env.rooms.layout.furniture import Furnisher, cells
from slam.settings import Config, Share, Span, require

__all__ = ["RectangularConfig", "rectangular"]

_MARGIN = 4  # solid cells around the room


@dataclass(frozen=True, kw_only=True)
class RectangularConfig(Config):
    """Limits between which a room is drawn, by seed."""

    length_m: Annotated[tuple[float, float], Span("[2, 30]")] = (5.0, 10.0)  # along x
    width_m: Annotated[tuple[float, float], Span("[2, 30]")] = (4.0, 8.0)  # along y
    furniture: Share = 0.65  # 0 an empty room, 1 as full as can be driven through
    turned: Share = 0.2  # share of the pieces that stand free at an angle
    round: Share = 0.2  # share of the pieces that are round tables and columns

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.turned + self.round <= 1,
            f"RectangularConfig needs turned + round ≤ 1, got {self.turned} + {self.round}",
        )


def rectangular(config: RectangularConfig, *, seed: int) -> FloorPlan:
    """Return the room of a seed: the same one every time."""
    rng = generator(seed)
    width, depth = (cells(float(rng.uniform(*limits))) for limits in (config.length_m, config.width_m))
    room = (_MARGIN, _MARGIN, _MARGIN + width, _MARGIN + depth)
    furnisher = Furnisher(room, rng)
    # A quarter of the floor is about as much as leaves wide ways between the pieces.
    target = 0.26 * config.furniture * float(rng.uniform(0.75, 1.25))
    # A room is filled from the largest piece to the smallest, with an end to the trying.
    for _ in range(int(40 * config.furniture)):
        if furnisher.covered >= target:
            break
        _place(furnisher, config, rng)
    size = (width + 2 * _MARGIN, depth + 2 * _MARGIN)
    return assemble(f"rectangular-{seed}", [room], furnisher.pieces, size=size, rng=rng)


def _place(furnisher: Furnisher, config: RectangularConfig, rng: np.random.Generator) -> None:
    """Try to place one random piece."""
    kind = float(rng.random())
    if kind < config.round:
        furnisher.round_table(float(rng.choice([0.15, 0.2, 0.4, 0.5, 0.6])))
    elif kind < config.round + config.turned:
        furnisher.turned_box(float(rng.uniform(0.6, 1.4)), float(rng.uniform(0.5, 0.9)))
    else:
        width = float(rng.uniform(0.6, 2.2))
        choice = int(rng.integers(8))
        if choice < 3:
            furnisher.against_wall(width, float(rng.choice([0.35, 0.45, 0.6])))
        elif choice == 3:
            furnisher.corner_sofa(float(rng.uniform(2.0, 2.8)), float(rng.uniform(0.6, 1.2)))
        elif choice == 4:
            furnisher.bed(float(rng.choice([0.9, 1.4, 1.8])), 2.0, tables=int(rng.integers(3)))
        elif choice == 5:
            furnisher.desk(float(rng.uniform(1.2, 1.8)), 0.7)
        else:
            furnisher.island(
                float(rng.uniform(1.2, 2.0)), float(rng.uniform(0.7, 1.0)), chairs=int(rng.choice([0, 2, 4]))
            )
