"""Names → backends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from slam.backend import Backend, BackendConfig
from slam.compressed import CompressedEkfConfig, CompressedEkfSlam
from slam.dead_reckoning import OdometrySlam, TruthSlam
from slam.dp_slam import DpSlam, DpSlamConfig
from slam.ekf import EkfSlam
from slam.fastslam import FastSlam1, FastSlam2, FastSlamConfig
from slam.gaussian.settings import EkfConfig, EkfLinesConfig
from slam.graph.graph_slam import GraphSlam
from slam.graph.settings import GraphSlamConfig
from slam.invariant import InvariantEkfConfig, InvariantEkfSlam
from slam.settings import argument, check_name, from_mapping, require, same_definitions

__all__ = ["config_type", "make", "names", "register"]

_BACKENDS: dict[str, tuple[type[Backend], type[BackendConfig]]] = {
    "odometry": (OdometrySlam, EkfConfig),
    "truth": (TruthSlam, EkfConfig),
    "ekf": (EkfSlam, EkfConfig),
    "ekf-lines": (EkfSlam, EkfLinesConfig),
    "invariant-ekf": (InvariantEkfSlam, InvariantEkfConfig),
    "compressed-ekf": (CompressedEkfSlam, CompressedEkfConfig),
    "fastslam1": (FastSlam1, FastSlamConfig),
    "fastslam2": (FastSlam2, FastSlamConfig),
    "dp-slam": (DpSlam, DpSlamConfig),
    "graph-slam": (GraphSlam, GraphSlamConfig),
}


def register(name: str, backend: type[Backend], config_type: type[BackendConfig]) -> None:
    """Make a backend known under a name, with the frozen dataclass that configures it.

    A notebook's cell that is run again replaces what it registered.

    Raises
    ------
    ValueError
        If another backend has the name.
    """
    require(
        name not in _BACKENDS or same_definitions(_BACKENDS[name], (backend, config_type)),
        f"SLAM backend {name!r} is registered already; choose another name",
    )
    _BACKENDS[name] = (backend, config_type)


def names() -> tuple[str, ...]:
    """Return the names that :func:`make` knows."""
    return tuple(_BACKENDS)


def config_type(name: str) -> type[BackendConfig]:
    """Return the config dataclass of a backend; ``ValueError`` lists the valid names."""
    check_name("SLAM backend", name, _BACKENDS)
    return _BACKENDS[name][1]


def make(name: str, *, config: Mapping[str, Any] | BackendConfig | None = None) -> Backend:
    """Make a backend by name, with a config dataclass or a mapping laid over its defaults.

    Raises ``ValueError`` that lists what is valid where the name or a key is unknown.
    """
    cls = config_type(name)
    with argument("config"):
        settings = from_mapping(cls, config)
    return _BACKENDS[name][0](settings)
