"""Rooms to explore: generators by name, and plans read from files.

``make("apartment", seed=3)`` draws a plan, ``load("floor.yaml")`` reads one; both give a ``floor_plan``.
``rectangular``, ``apartment``, ``corridors``, ``cave`` and ``maze`` are the generators, ``registry`` has their
names; ``layout`` and ``outlines`` are what they share, ``files`` reads.
"""

from __future__ import annotations

from mecanum_env.rooms.apartment import ApartmentConfig, apartment
from mecanum_env.rooms.cave import CaveConfig, cave
from mecanum_env.rooms.corridors import PAPER_D, CorridorsConfig, corridors
from mecanum_env.rooms.files.importers import load
from mecanum_env.rooms.floor_plan import FloorPlan, FloorPlanError
from mecanum_env.rooms.maze import MazeConfig, maze
from mecanum_env.rooms.rectangular import RectangularConfig, rectangular
from mecanum_env.rooms.registry import make, names, register

__all__ = [
    "PAPER_D",
    "ApartmentConfig",
    "CaveConfig",
    "CorridorsConfig",
    "FloorPlan",
    "FloorPlanError",
    "MazeConfig",
    "RectangularConfig",
    "load",
    "make",
    "names",
    "register",
]

register("rectangular", rectangular, RectangularConfig)
register("apartment", apartment, ApartmentConfig)
register("corridors", corridors, CorridorsConfig)
register("cave", cave, CaveConfig)
register("maze", maze, MazeConfig)
