"""Observations: pure functions of the belief, in new arrays unless ``out`` gives those to be filled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numba import njit
from numpy.typing import NDArray

from mecanum_env.config import EnvConfig
from slam.backend import Backend
from slam.gaussian.joint_gaussian import OBSERVED_LIMIT
from slam.grids.occupancy import PROBABILITY_BYTE, OccupancyGrid
from slam.types import Array, Bytes, Floats, Scan

__all__ = ["LOCAL_CELL_M", "MAP_SIZE", "draw_maps", "map_frame", "observation_space", "observe"]

Observation = dict[str, Bytes | Floats]

MAP_SIZE = 64
"""Pixels a side of either map channel."""
LOCAL_CELL_M = 0.1
"""Side of a pixel of ``map_local`` [m]."""
UNKNOWN_BYTE = 128
# For each byte of a cell its probability × 255, by which the more occupied is found; zero where never observed,
# which gives way to what was.
_RANK = np.maximum(PROBABILITY_BYTE, 1)
_RANK[0] = 0
_ALL_BUT_ROUNDING = np.float32(1.0 - 2.0**-21)
_TWIST_LIMIT = 2.0
_COV_LIMIT = 1e6  # m², m·rad, rad²: Gymnasium asks for finite bounds


def observation_space(config: EnvConfig) -> spaces.Dict:
    """Return the space that :func:`observe` fills."""
    return spaces.Dict(
        {
            "map_local": spaces.Box(0, 255, (3, MAP_SIZE, MAP_SIZE), np.uint8),
            "map_global": spaces.Box(0, 255, (3, MAP_SIZE, MAP_SIZE), np.uint8),
            "scan": spaces.Box(0.0, 1.0, (config.lidar.beams,), np.float32),
            "pose": spaces.Box(-1.0, 1.0, (4,), np.float32),
            "pose_cov": spaces.Box(-_COV_LIMIT, _COV_LIMIT, (6,), np.float32),
            "landmarks": spaces.Box(
                -OBSERVED_LIMIT, OBSERVED_LIMIT, (config.max_landmarks_observed, 6), np.float32
            ),
            "twist": spaces.Box(-_TWIST_LIMIT, _TWIST_LIMIT, (3,), np.float32),
            "progress": spaces.Box(0.0, 1.0, (2,), np.float32),
            "health": spaces.Box(0.0, 1.0, (1,), np.float32),
        }
    )


def map_frame(grid: OccupancyGrid) -> tuple[float, float, float]:
    """Return the centre (x, y) [m] of ``map_global`` in the belief's frame, and its half extent [m]."""
    _, rows, cols = grid.overview_sums.shape
    row0, col0 = grid.lattice_origin
    return _map_frame(row0, col0, rows, cols, grid.overview_block, grid.resolution)


@njit(cache=True, nogil=True, error_model="numpy")
def _map_frame(
    row0: int, col0: int, rows: int, cols: int, block: int, resolution: float
) -> tuple[float, float, float]:
    pixel = block * resolution
    top, left = (MAP_SIZE - rows) // 2, (MAP_SIZE - cols) // 2
    half_size = MAP_SIZE // 2
    return (
        col0 * resolution + (half_size - left) * pixel, row0 * resolution + (half_size - top) * pixel,
        half_size * pixel,
    )  # fmt: skip


def observe(
    config: EnvConfig,
    backend: Backend,
    grid: OccupancyGrid,
    scan: Scan,
    *,
    pose: Array,
    pose_cov: Array,
    twist: tuple[float, float, float],
    time_used: float,
    out: Observation | None = None,
) -> Observation:
    """Return what the agent sees, all of it from sensors and belief.

    Parameters
    ----------
    grid : OccupancyGrid
        The map that is shown: the backend's, or a team's.
    pose, pose_cov : Array
        The backend's mean ``(3,)`` and covariance ``(3, 3)``.
    twist : tuple
        Of the odometry: vx, vy [m/s], ω [rad/s].
    time_used : float
        Fraction of the episode's time used.
    out : dict, optional
        Contiguous arrays of :func:`observation_space` to fill and return; new ones if left out.
    """
    robot = config.robot
    row0, col0 = grid.lattice_origin
    vx, vy, omega = twist
    seen: dict[str, Any] = _blank(len(scan.ranges), config.max_landmarks_observed) if out is None else out
    _fill(
        seen["map_local"], seen["map_global"], seen["scan"], seen["pose"], seen["pose_cov"], seen["twist"],
        seen["progress"], seen["health"], grid.cells, grid.trail, *grid.log_odds.shape, row0, col0,
        grid.resolution, grid.overview_sums, grid.overview_block, scan.ranges, scan.range_max, pose, pose_cov,
        vx / robot.max_speed_m_s, vy / robot.max_speed_m_s, omega / robot.max_turn_rate_rad_s, time_used,
        grid.known_area_m2, backend.health,
    )  # fmt: skip
    backend.near_landmarks(seen["landmarks"])
    return seen


def _blank(beams: int, landmarks: int) -> dict[str, Any]:
    return {
        "map_local": np.empty((3, MAP_SIZE, MAP_SIZE), np.uint8),
        "map_global": np.empty((3, MAP_SIZE, MAP_SIZE), np.uint8),
        "scan": np.empty(beams, np.float32),
        "pose": np.empty(4, np.float32),
        "pose_cov": np.empty(6, np.float32),
        "landmarks": np.empty((landmarks, 6), np.float32),
        "twist": np.empty(3, np.float32),
        "progress": np.empty(2, np.float32),
        "health": np.empty(1, np.float32),
    }


def draw_maps(grid: OccupancyGrid, pose: Array) -> Observation:
    """Return an observation's ``map_local``, ``map_global`` and ``pose``, of a map and a pose ``(3,)`` alone."""
    out = _blank(0, 0)
    row0, col0 = grid.lattice_origin
    _fill(
        out["map_local"], out["map_global"], out["scan"], out["pose"], out["pose_cov"], out["twist"],
        out["progress"], out["health"], grid.cells, grid.trail, *grid.log_odds.shape, row0, col0, grid.resolution,
        grid.overview_sums, grid.overview_block, np.empty(0), 1.0, np.asarray(pose, dtype=np.float64),
        np.zeros((3, 3)), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
    )  # fmt: skip
    return {key: out[key] for key in ("map_local", "map_global", "pose")}


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(
    map_local: Bytes, map_global: Bytes, scan_out: Floats, pose_out: Floats, cov_out: Floats, twist_out: Floats,
    progress_out: Floats, health_out: Floats, cells: Bytes, trail: Bytes, rows: int, cols: int, row0: int,
    col0: int, resolution: float, overview: NDArray[np.int32], block: int, ranges: Array, range_max: float,
    pose: Array, cov: Array, vx: float, vy: float, omega: float, time_used: float, known_area_m2: float,
    health: float,
) -> None:  # fmt: skip
    """Fill everything but the landmarks, in one call."""
    centre_x, centre_y, half = _map_frame(row0, col0, overview.shape[1], overview.shape[2], block, resolution)
    x, y = (pose[0] - centre_x) / half, (pose[1] - centre_y) / half
    _fill_local(map_local, cells, trail, rows, cols, row0, col0, resolution, pose[0], pose[1], pose[2])
    _fill_global(map_global, overview, block, x, y)
    for i in range(ranges.shape[0]):
        # A lost beam says as little as one that nothing returned: 1.
        r = ranges[i] / range_max
        scan_out[i] = r if r < 1.0 else 1.0
    pose_out[0], pose_out[1] = _within(x, 1.0), _within(y, 1.0)
    pose_out[2], pose_out[3] = math.cos(pose[2]), math.sin(pose[2])
    k = 0
    for i in range(3):
        for j in range(i, 3):
            cov_out[k] = _within(cov[i, j], _COV_LIMIT)
            k += 1
    twist_out[0], twist_out[1] = _within(vx, _TWIST_LIMIT), _within(vy, _TWIST_LIMIT)
    twist_out[2] = _within(omega, _TWIST_LIMIT)
    progress_out[0] = min(max(time_used, 0.0), 1.0)
    progress_out[1] = min(max(known_area_m2 / (4.0 * half * half), 0.0), 1.0)
    health_out[0] = health


@njit(nogil=True, error_model="numpy", inline="always")
def _within(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_local(
    out: Bytes, cells: Bytes, trail: Bytes, rows: int, cols: int, row0: int,
    col0: int, resolution: float, x: float, y: float, theta: float,
) -> None:  # fmt: skip
    """Fill the robot-centred map: row 0 is farthest ahead, column 0 farthest to the left.

    A pixel takes the more occupied of two points in it, a quarter pixel from its middle on one diagonal, and its
    neighbours on the other: so a wall one cell thick does not slip through, whichever way it runs.

    ``cells`` and ``trail`` are a grid's, of so many rows and columns: behind the last is another that is zero.
    """
    size = out.shape[1]
    step = LOCAL_CELL_M / resolution
    c, s = np.float32(math.cos(theta) * step), np.float32(math.sin(theta) * step)
    half = 0.5 * size - 0.5
    quarter = np.float32(0.25)
    ax, ay = quarter * (c - s), quarter * (s + c)  # from the middle to the points, in cells
    bx, by = quarter * (c + s), quarter * (s - c)
    along, offset = np.empty((2, size), np.float32), np.empty((2, 2, size), np.float32)  # in even and odd rows
    for j in range(size):
        along[0, j], along[1, j] = np.float32(j) * s, np.float32(j) * c
        for odd in range(2):
            one_way = (odd + j) & 1 == 1
            offset[odd, 0, j], offset[odd, 1, j] = ax if one_way else bx, ay if one_way else by
    first, second, middle = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int32)
    probability_out, observed_out, trail_out = out[0].ravel(), out[1].ravel(), out[2].ravel()
    for i in range(size):
        x0 = np.float32(x / resolution - col0 + c * (half - i) - s * half)
        y0 = np.float32(y / resolution - row0 + s * (half - i) + c * half)
        # A row's indices first, in a loop that vectorises, then the look-ups, which cannot.
        find_row_cells(x0, y0, along, offset[i & 1], rows, cols, first, second, middle)
        # Unsigned indices: others are tested for being negative.
        for j in range(np.uint64(size)):
            pixel = np.uint64(i * size) + j
            probability_out[pixel] = max(_RANK[cells[np.uint32(first[j])]], _RANK[cells[np.uint32(second[j])]])
            trail_out[pixel] = trail[np.uint32(middle[j])]
    # One loop for each channel: these vectorise.
    for k in range(size * size):
        observed_out[k] = 255 if probability_out[k] != 0 else 0
    for k in range(size * size):
        trail_out[k] = observed_out[k] * (trail_out[k] != 0)
    for k in range(size * size):
        probability_out[k] |= UNKNOWN_BYTE * (probability_out[k] == 0)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)  # else it does not vectorise
def find_row_cells(
    x0: np.float32, y0: np.float32, along: Floats, offset: Floats,
    rows: int, cols: int, first: NDArray[np.int32], second: NDArray[np.int32], middle: NDArray[np.int32],
) -> None:  # fmt: skip
    """Write which cells of a grid a row of pixels looks at; all numbers are in cells.

    Parameters
    ----------
    x0, y0
        The middle of the first pixel.
    along
        ``(2, n)``: how far to the right (x) and down (y) of it the others are; neither turns back.
    offset
        ``(2, n)``: from each pixel's middle to the first of its two points; the second lies opposite.
    rows, cols
        Of the grid.
    first, second, middle
        ``(n,)``, filled: indices of the cells under either point and the middle, counted row by row; one beyond
        the last cell for a pixel that may reach over an edge.
    """
    right, down, to_x, to_y = along[0], along[1], offset[0], offset[1]
    n = right.shape[0]
    low_x, low_y = max(abs(to_x[0]), abs(to_x[1])), max(abs(to_y[0]), abs(to_y[1]))
    # Less what the sums below may be rounded up by, which would be a row beyond the last.
    high_x, high_y = np.float32(cols) * _ALL_BUT_ROUNDING - low_x, np.float32(rows) * _ALL_BUT_ROUNDING - low_y
    x1, y1 = x0 + right[n - 1], y0 - down[n - 1]
    width, nowhere = np.int32(cols), np.int32(rows * cols)
    if min(x0, x1) >= low_x and max(x0, x1) < high_x and min(y0, y1) >= low_y and max(y0, y1) < high_y:
        for j in range(n):  # as most rows: no pixel reaches over, and none need be asked
            px, py, dx, dy = x0 + right[j], y0 - down[j], to_x[j], to_y[j]
            first[j] = np.int32(py + dy) * width + np.int32(px + dx)
            second[j] = np.int32(py - dy) * width + np.int32(px - dx)
            middle[j] = np.int32(py) * width + np.int32(px)
        return
    for j in range(n):
        px, py, dx, dy = x0 + right[j], y0 - down[j], to_x[j], to_y[j]
        inside = (px >= low_x) & (py >= low_y) & (px < high_x) & (py < high_y)
        first[j] = np.int32(py + dy) * width + np.int32(px + dx) if inside else nowhere
        second[j] = np.int32(py - dy) * width + np.int32(px - dx) if inside else nowhere
        middle[j] = np.int32(py) * width + np.int32(px) if inside else nowhere


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_global(out: Bytes, overview: NDArray[np.int32], block: int, x: float, y: float) -> None:
    """Fill the whole map in the start frame: row 0 at the highest y, the overview in the middle."""
    size = out.shape[1]
    known, probability, visited = overview[0], overview[1], overview[2]
    rows, cols = known.shape
    top, left = (size - rows) // 2, (size - cols) // 2
    area, shift = block * block, 0
    while 1 << shift < area:  # a power of two: whole blocks divide by shifting, at a twentieth of the cost
        shift += 1
    out[0] = UNKNOWN_BYTE
    out[1] = 0
    out[2] = 0
    for r in range(rows):
        i = size - 1 - (top + r)
        for c in range(cols):
            n = known[r, c]
            if n > 0:
                j = left + c
                out[0, i, j] = probability[r, c] >> shift if n == area else probability[r, c] // n
                out[1, i, j] = 255 * n >> shift
                # The trail stays below 128, above it is the robot itself.
                out[2, i, j] = 127 * visited[r, c] >> shift
    i = size - 1 - math.floor((y + 1.0) * 0.5 * size)
    j = math.floor((x + 1.0) * 0.5 * size)
    for di in range(-1, 2):
        for dj in range(-1, 2):
            if 0 <= i + di < size and 0 <= j + dj < size:
                out[2, i + di, j + dj] = 255
