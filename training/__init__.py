"""The command line, benchmarks and training; from Python, :func:`explore` is ``mecanum explore``."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from training.learning.vec_env import ExploreVecEnv
    from training.notebook import Explored, explore

__all__ = ["ExploreVecEnv", "Explored", "explore"]


def __getattr__(name: str) -> Any:
    """Load what is public here when it is first asked for: the command line needs none of it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "training.learning.vec_env" if name == "ExploreVecEnv" else "training.notebook"
    return getattr(import_module(module), name)
