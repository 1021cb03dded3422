"""Floor plans from files: ROS map_server maps (YAML and an image) and plain images.

Nothing in a file is trusted: no code in it is run, sizes are checked before decoding, and what is wrong is said in
one line.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mecanum_env.rooms.files.image_files import IMAGE_SUFFIXES, read_bytes, read_grey
from mecanum_env.rooms.floor_plan import FloorPlan, FloorPlanError, clearance_of
from mecanum_env.rooms.layout.assembly import DRIVE_RADIUS_M, generator
from mecanum_env.rooms.outlines.distance import largest_part
from mecanum_env.rooms.outlines.outline import outline_segments
from slam.files import parse_yaml, quoted, shown_path
from slam.types import Flags

__all__ = ["MAP_SUFFIXES", "from_raster", "image_of", "load"]

MAP_SUFFIXES = (".yaml", ".yml")
"""Suffixes of ROS maps."""

Pose = Sequence[float]
Raster = tuple[Flags, float, tuple[float, float]]  # free cells, their side [m], the lower-left corner [m]

_START_CLEARANCE_M = 0.6
_RADII_M = (DRIVE_RADIUS_M, 0.35, 0.3, 0.2, 0.1, 0.0)
_MODES = ("trinary", "scale", "raw")
_MAX_RESOLUTION_M = 10.0
_FARTHEST_M = 1e7  # of the origin: farther away, floats tell too little apart
_MOST_WALLS = 100_000  # the time that their corners take goes by the square


def load(
    path: str | Path, *, start: Pose | None = None, seed: int = 0, resolution: float | None = None,
    roomy_m: float = 0.0,
) -> FloorPlan:  # fmt: skip
    """Read a floor plan from a file; its suffix says how.

    Parameters
    ----------
    path
        A ROS map (``.yaml``, ``.yml``) or an image (``.png``, ``.pgm``, ``.jpg``, ``.jpeg``, ``.bmp``).
    start
        Start pose x, y [m], θ [rad] in the plan's frame; None chooses a roomy place by ``seed``.
    resolution
        Size of an image's pixel [m], 0.05 where None; a ROS map says its own.
    roomy_m
        How far a start that is chosen is clear of everything [m], where there is such a place; 0.6 at least.

    Raises
    ------
    FloorPlanError
        In one line: what is wrong with the file or the start, and what to do.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in IMAGE_SUFFIXES:
        what = f"image {shown_path(path)}"
        # Bright pixels are free, the lower-left one is at the origin.
        resolution = _resolution(0.05 if resolution is None else resolution, what)
        raster = read_grey(path)[::-1] > 127, resolution, (0.0, 0.0)
    elif suffix not in MAP_SUFFIXES:
        valid = ", ".join((*MAP_SUFFIXES, *IMAGE_SUFFIXES))
        raise FloorPlanError(f"floor plan {shown_path(path)} has the unknown suffix {suffix!r}; valid: {valid}")
    elif resolution is not None:
        raise FloorPlanError(
            f"map {shown_path(path)} says its own resolution; leave resolution out or give the image"
        )
    else:
        what = f"map {shown_path(path)}"
        raster = _read_ros_map(path, what)
    free, cell_m, origin = raster
    return from_raster(
        free, name=path.stem, resolution=cell_m, origin=origin, start=start, seed=seed, roomy_m=roomy_m, what=what
    )


def image_of(path: Path) -> Path:
    """Return the image that a ROS map names.

    Raises
    ------
    FloorPlanError
        Where it names none, or one that lies elsewhere.
    """
    what = f"map {shown_path(path)}"
    return _image_of(path, _read_yaml(path, what), what)


def _image_of(path: Path, values: Mapping[str, Any], what: str) -> Path:
    image = values.get("image")
    if not isinstance(image, str) or not image or "\0" in image:
        raise FloorPlanError(
            f"{what}: image must name a file, got {quoted(image)}; add a line such as image: map.pgm"
        )
    return _beside(path, image, what)


def _read_ros_map(path: Path, what: str) -> Raster:
    """Read a ROS map_server map: a cell is free where its occupancy is below ``free_thresh``, else solid.

    The occupancy of a grey value c is (255 − c) / 255, or c / 255 if ``negate``; in ``mode: raw`` it is c %.
    """
    values = _read_yaml(path, what)
    resolution = _resolution(values.get("resolution"), what)
    origin = _origin(values.get("origin"), what)
    limit = _threshold(values, "free_thresh", 0.196, what)
    _threshold(values, "occupied_thresh", 0.65, what)
    negate = values.get("negate", 0)
    if negate not in (0, 1):
        raise FloorPlanError(f"{what}: negate must be 0 or 1, got {quoted(negate)}")
    mode = values.get("mode", "trinary")
    if mode not in _MODES:
        raise FloorPlanError(f"{what}: unknown mode {quoted(mode)}; valid: {', '.join(_MODES)}")
    grey = read_grey(_image_of(path, values, what))[::-1]
    if mode == "raw":
        occupancy = grey / np.float32(100.0)
    else:
        occupancy = (grey if negate else np.float32(255.0) - grey) / np.float32(255.0)
    return occupancy < limit, resolution, origin


def _beside(path: Path, image: str, what: str) -> Path:
    """Return the image that a map names; a map from elsewhere shall not have other folders' files read."""
    target = path.parent / image
    try:
        leads_to, within = target.resolve(), {path.parent.resolve(), path.resolve().parent}
        if any(leads_to.is_relative_to(folder) for folder in within):
            return target
    except (OSError, RuntimeError) as error:  # links in a circle, a name too long
        raise FloorPlanError(f"{what}: image {quoted(image)} leads nowhere; name a file beside it") from error
    raise FloorPlanError(
        f"{what}: image {quoted(image)} lies outside of its folder; put it beside the map, and name it there by "
        f"image: {quoted(Path(image).name)}"
    )


def from_raster(
    free: Flags,
    *,
    name: str,
    resolution: float,
    origin: tuple[float, float] = (0.0, 0.0),
    start: Pose | None = None,
    seed: int = 0,
    roomy_m: float = 0.0,
    what: str | None = None,
) -> FloorPlan:
    """Return the plan of a raster of free cells ``(rows, cols)``, row 0 at the lowest y.

    Its walls lie within half a cell of the edges between free and other cells; see :mod:`.outline`. The start is
    given, or chosen by ``seed`` in the largest area that a disc of 0.40 m can drive in (or a smaller one, where
    that fits nowhere), 0.6 m or ``roomy_m`` clear of everything if possible, heading 0.

    Raises
    ------
    FloorPlanError
        If no cell is free, or the start is not in free space.
    """
    what = what or f"plan {name}"
    free = np.ascontiguousarray(free, dtype=np.bool_)
    if free.ndim != 2 or not free.any():
        raise FloorPlanError(
            f"{what} has no free space: bright cells are free; check negate and free_thresh, or invert the image"
        )
    rng = generator(seed)
    walls = outline_segments(free) * resolution
    if len(walls) > _MOST_WALLS:
        raise FloorPlanError(
            f"{what} has {len(walls)} walls, more than {_MOST_WALLS}: it is no plan, or noisy; smooth the image"
        )
    walls += np.tile(np.asarray(origin, np.float64), 2)
    return FloorPlan(
        name=name,
        walls=walls,
        free=free,
        resolution=resolution,
        origin=origin,
        start=_start(free, resolution, origin, rng, roomy_m) if start is None else _given(start, what),
    )


def _start(
    free: Flags, resolution: float, origin: tuple[float, float], rng: np.random.Generator, roomy_m: float
) -> tuple[float, float, float]:
    clearance = clearance_of(free, resolution)
    # Of a free cell's centre at the least, so that some radius fits.
    radius = next((r for r in _RADII_M if np.any(clearance >= r)), 0.0)
    area = largest_part((clearance >= radius) & free)
    assert area is not None
    # Surfaces may lie half a cell before the cells' edges.
    wanted = min(max(roomy_m, _START_CLEARANCE_M) + 0.5 * resolution, float(clearance[area].max()))
    places = np.flatnonzero(area & (clearance >= wanted))
    row, col = divmod(int(places[int(rng.integers(places.size))]), free.shape[1])
    return origin[0] + (col + 0.5) * resolution, origin[1] + (row + 0.5) * resolution, 0.0


def _given(start: Pose, what: str) -> tuple[float, float, float]:
    try:
        x, y, theta = (float(v) for v in start)
    except (TypeError, ValueError) as error:
        raise FloorPlanError(f"{what}: start must be three numbers x, y, θ, got {start!r}") from error
    return x, y, theta


def _read_yaml(path: Path, what: str) -> Mapping[str, Any]:
    data = read_bytes(path, what="map", limit=2**20)
    try:
        values = parse_yaml(data, what=what)
    except ValueError as error:
        raise FloorPlanError(f"{error}; compare it with ROS's map_server") from error
    if not isinstance(values, Mapping):
        raise FloorPlanError(f"{what} is damaged: it must hold keys such as image, resolution and origin")
    return values


def _number(value: object) -> float:
    """Return a finite number, or NaN for anything else."""
    if isinstance(value, str):  # 1e-05, as ROS's map_saver writes it: to PyYAML a number has a point
        try:
            value = float(value)
        except ValueError:
            return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value) if math.isfinite(value) else math.nan
    except OverflowError:
        return math.nan


def _resolution(value: object, what: str) -> float:
    resolution = _number(value)
    if not 0 < resolution <= _MAX_RESOLUTION_M:
        raise FloorPlanError(
            f"{what}: resolution must be above 0 and at most {_MAX_RESOLUTION_M:g} m, got {quoted(value)}; "
            "correct it"
        )
    return resolution


def _origin(value: object, what: str) -> tuple[float, float]:
    numbers = [_number(v) for v in value] if isinstance(value, (list, tuple)) else []
    if len(numbers) not in (2, 3) or not all(abs(v) <= _FARTHEST_M for v in numbers):
        raise FloorPlanError(
            f"{what}: origin must be [x, y, yaw] in m and rad, up to {_FARTHEST_M:g} m away, got {quoted(value)}"
        )
    if len(numbers) == 3 and abs(numbers[2]) > 1e-9:
        raise FloorPlanError(f"{what}: origin's yaw must be 0, got {numbers[2]:g}; turn the image instead")
    return numbers[0], numbers[1]


def _threshold(values: Mapping[str, Any], key: str, default: float, what: str) -> float:
    threshold = _number(values.get(key, default))
    if not 0 <= threshold <= 1:
        raise FloorPlanError(f"{what}: {key} must be between 0 and 1, got {quoted(values.get(key))}")
    return threshold
