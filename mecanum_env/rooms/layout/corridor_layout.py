"""Where corridors run: a connected network of straight ones, whose lengths add up to what was asked for.

All in cells, whose side the lengths decide (:func:`sizes_of`). A corridor is its centre line widened by half a
width all round: at a crossing the line ends in the other corridor's middle, at a dead end half a width before the
end wall. So lengths are the same by the centre lines whatever a corridor's ends look like, and a crossing counts
once for each corridor through it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated

import numpy as np

from mecanum_env.rooms.layout.furniture import CELL_M, Box
from slam.settings import Config, Share, Within, require

__all__ = ["PAPER_D", "Corridor", "CorridorsConfig", "Sizes", "draw_layout", "sizes_of"]

PAPER_D: Mapping[int, tuple[float, float]] = MappingProxyType(
    {1: (19.46, 3.67), 2: (31.11, 1.80), 3: (33.83, 2.61)}
)
"""Total and longest corridor length [m] of the three maps of paper D."""

# The paper gives none: its robot, 0.29 m across the corners, turns in it with room to spare.
_PAPER_D_WIDTH_M = 0.6
_DEFAULT_LENGTHS_M, _DEFAULT_WIDTH_M = (60.0, 12.0), 1.4  # for the youBot, 0.69 m across the corners
_FINE_M = 0.01  # paper D's maps have pixels of 1 cm

_NETWORKS = 40  # begun before giving up
_TRIES = 400  # for each further corridor of one
_AT_END = 0.3  # share of the new corridors that meet the old one at its end: a bend, not a junction


@dataclass(frozen=True, kw_only=True)
class CorridorsConfig(Config):
    """Lengths to lay out. What is left out is that of ``map``, or else fits a youBot: 60 m, 12 m, 1.4 m wide."""

    map: Annotated[int | None, Within("[1, 3]")] = None  # 1, 2 or 3: one of paper D's, of its lengths, 0.6 m wide
    total_length_m: Annotated[float | None, Within("[0.5, 300]")] = None  # of all corridors together
    longest_m: Annotated[float | None, Within("[0.5, 50]")] = None  # length of the longest one
    width_m: Annotated[float | None, Within("[0.2, 5]")] = None
    wall_m: Annotated[float, Within("[0.05, 2]")] = 0.2  # least thickness between two corridors
    loops: Share = 0.7  # probability that a new corridor may end on further old ones; 0 gives a tree

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.map is not None:
            for name in ("total_length_m", "longest_m"):
                value = getattr(self, name)
                require(
                    value is None, f"CorridorsConfig.map={self.map} sets {name} already: leave out one of the two"
                )
        sizes_of(self)


@dataclass(frozen=True, slots=True)
class Sizes:
    """A config in whole cells."""

    cell_m: float  # side of a cell [m]
    total: int
    longest: int
    half: int  # of the width
    pitch: int  # least distance between parallel centre lines, between crossings, and beyond one


@dataclass(frozen=True, slots=True)
class Corridor:
    """A straight corridor by its centre line [cells]."""

    upright: bool  # along y, not along x
    line: int  # the coordinate that does not change
    low: int
    high: int

    @property
    def length(self) -> int:
        """Length of the centre line [cells]."""
        return self.high - self.low

    def box(self, half: int) -> Box:
        """Return its free rectangle."""
        across, along = (self.line - half, self.line + half), (self.low - half, self.high + half)
        (x0, x1), (y0, y1) = (across, along) if self.upright else (along, across)
        return x0, y0, x1, y1


def sizes_of(config: CorridorsConfig) -> Sizes:
    """Return the sizes in cells: of 0.05 m where total, longest and half the width allow, else of 0.01 m.

    Raises
    ------
    ValueError
        If corridors of this width cannot have these lengths.
    """
    total_m, longest_m = _DEFAULT_LENGTHS_M if config.map is None else PAPER_D[config.map]
    total_m = total_m if config.total_length_m is None else config.total_length_m
    longest_m = longest_m if config.longest_m is None else config.longest_m
    default_width_m = _DEFAULT_WIDTH_M if config.map is None else _PAPER_D_WIDTH_M
    width_m = default_width_m if config.width_m is None else config.width_m
    coarse = all(abs(v / CELL_M - round(v / CELL_M)) < 1e-6 for v in (total_m, longest_m, 0.5 * width_m))
    cell_m = CELL_M if coarse else _FINE_M
    half = round(0.5 * width_m / cell_m)
    pitch = 2 * half + math.ceil(config.wall_m / cell_m - 1e-6)
    sizes = Sizes(cell_m, round(total_m / cell_m), round(longest_m / cell_m), half, pitch)
    least = pitch * cell_m
    require(
        sizes.longest <= sizes.total,
        f"CorridorsConfig.longest_m is {longest_m:g} but total_length_m only {total_m:g}: raise the total to at "
        f"least {longest_m:g}",
    )
    require(
        sizes.longest >= 2 * pitch,
        f"CorridorsConfig.longest_m {longest_m:g} is too short for corridors {width_m:g} m wide: raise it to "
        f"2 (width_m + wall_m) = {2 * least:g} or make width_m smaller",
    )
    rest = sizes.total - sizes.longest
    require(
        rest == 0 or rest >= pitch,
        f"CorridorsConfig.total_length_m {total_m:g} leaves {rest * cell_m:g} m beside the longest corridor, too "
        f"short for another: make it {longest_m:g}, or at least {longest_m + least:g}",
    )
    return sizes


def draw_layout(config: CorridorsConfig, rng: np.random.Generator) -> list[Corridor]:
    """Return a random network of the config's lengths, the longest corridor first.

    Raises
    ------
    ValueError
        If 40 beginnings led to no network: what is asked for is too dense.
    """
    sizes = sizes_of(config)
    for _ in range(_NETWORKS):
        upright = bool(rng.random() < 0.5)
        network = [Corridor(upright, 0, 0, sizes.longest)]
        rest = sizes.total - sizes.longest
        while rest > 0:
            corridor = _further(network, rest, sizes, config.loops, rng)
            if corridor is None:
                break
            network.append(corridor)
            rest -= corridor.length
        if rest == 0:
            return network
    raise ValueError(
        f"no corridors of {sizes.total * sizes.cell_m:g} m with a longest of {sizes.longest * sizes.cell_m:g} m "
        "found; make width_m or wall_m smaller, or longest_m larger"
    )


def _further(
    network: list[Corridor], rest: int, sizes: Sizes, loops: float, rng: np.random.Generator
) -> Corridor | None:
    """Return one more corridor that meets those there are, or None where none was found."""
    shares = np.cumsum([c.length for c in network])
    for _ in range(_TRIES):
        host = network[int(np.searchsorted(shares, rng.integers(int(shares[-1])), side="right"))]
        line = _place_on(host, sizes.pitch, rng)
        # What is then left must be nothing, or enough for a corridor.
        most = min(sizes.longest, rest)
        length = int(rng.integers(sizes.pitch, most + 1))
        if rest - length < sizes.pitch:
            length = most if most == rest else min(length, rest - sizes.pitch)
        if length < sizes.pitch:
            continue
        may_loop = bool(rng.random() < loops)
        low, high = _ends(host, line, length, sizes.pitch, rng)
        if may_loop:
            low, high = _onto_another(network, host, line, (low, high), most, sizes.pitch, rng)
        left = rest - (high - low)
        if left < 0 or 0 < left < sizes.pitch:
            continue
        corridor = Corridor(not host.upright, line, low, high)
        met = _meetings(corridor, network, sizes.pitch)
        if met == 1 or (met > 1 and may_loop):
            return corridor
    return None


def _place_on(host: Corridor, pitch: int, rng: np.random.Generator) -> int:
    """Return where along a corridor another one meets it: at an end, or well between the ends."""
    if rng.random() < _AT_END or host.length < 2 * pitch:
        return host.low if rng.random() < 0.5 else host.high
    return int(rng.integers(host.low + pitch, host.high - pitch + 1))


def _ends(host: Corridor, line: int, length: int, pitch: int, rng: np.random.Generator) -> tuple[int, int]:
    """Return the ends of a corridor of this length that begins at, or crosses, the host."""
    kind = float(rng.random())
    if kind < 0.3 and length >= 2 * pitch and host.low < line < host.high:
        before = int(rng.integers(pitch, length - pitch + 1))
    else:
        before = length if kind < 0.65 else 0
    return host.line - before, host.line - before + length


def _onto_another(
    network: list[Corridor],
    host: Corridor,
    line: int,
    ends: tuple[int, int],
    most: int,
    pitch: int,
    rng: np.random.Generator,
) -> tuple[int, int]:
    """Move an end of a new corridor, where possible, onto the middle of a third one beside the host."""
    low, high = ends
    choices: list[tuple[int, int]] = []
    for other in network:
        if other.upright != host.upright or other is host or not _at_good_place(line, other, pitch):
            continue
        if other.line > host.line and other.line - low <= most:
            choices.append((low, other.line))
        elif other.line < host.line and high - other.line <= most:
            choices.append((other.line, high))
    return choices[int(rng.integers(len(choices)))] if choices else ends


def _at_good_place(position: int, corridor: Corridor, pitch: int) -> bool:
    """Whether a crossing at this place leaves no stump: at an end, or a pitch and more from both."""
    low, high = corridor.low, corridor.high
    return position in (low, high) or low + pitch <= position <= high - pitch


def _meetings(new: Corridor, network: list[Corridor], pitch: int) -> int:
    """Return how many corridors a new one meets, or -1 where it comes too near to one without meeting it."""
    met = 0
    for old in network:
        if old.upright == new.upright:
            along = max(old.low, new.low) - min(old.high, new.high)
            if abs(old.line - new.line) < pitch and along < pitch:
                return -1
            continue
        apart_along = max(new.low - old.line, old.line - new.high)
        apart_across = max(old.low - new.line, new.line - old.high)
        if max(apart_along, apart_across) >= pitch:
            continue
        if not (_at_good_place(old.line, new, pitch) and _at_good_place(new.line, old, pitch)):
            return -1
        met += 1
    return met
