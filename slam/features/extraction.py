"""Scan → straight surfaces and the corners where they meet, each with a covariance from its fit.

Split and merge (iterative end-point fit) over the scan's points in order of bearing; every piece is fitted by
maximum likelihood, range noise acting along the beam. A corner is where two fitted surfaces meet and the scan runs
through without a break, or where one ends in front of something farther away. The rim of a shadow is neither:
it moves with the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.features.corners import all_on, edge, meet, walls_first
from slam.features.surfaces import ENDS, FIRST, LAST, MAX_LINES, MAX_STEP, fit, points_in_order, split
from slam.settings import Config, Count, Gap, Length, NotNegative, Positive, Sigma, Within
from slam.types import Array, Indices, Scan

__all__ = ["FeatureConfig", "FeatureExtractor"]


@dataclass(frozen=True, kw_only=True)
class FeatureConfig(Config):
    """What counts as a straight surface and as a corner."""

    range_sigma_m: Sigma = 0.01  # of one beam, along it
    split_sigmas: NotNegative = 4.0  # a piece is split where it departs from its chord by more than this
    split_floor_m: Gap = 0.02  # … and by more than this
    min_points: Annotated[int, Within("[4, 10000]")] = 6
    min_length_m: Gap = 0.25
    # Flattest incidence at which neighbouring points still belong together.
    grazing_deg: Annotated[float, Within("[0.1, 45)")] = 8.0
    # Between the surfaces of a corner; pieces of a round column meet at less.
    min_angle_deg: Annotated[float, Within("[5, 85]")] = 55.0
    max_gap_m: Gap = 0.12  # from the corner to the nearest point of either surface
    edge_length_m: Gap = 0.35  # of a surface whose visible end is taken for a corner
    edge_points: Count = 8  # … and the points on it: fewer would let a piece of a round column pass for straight
    edge_face_m: Gap = 0.25  # thickest wall of which the end face may show
    # 1σ of a visible end along the surface, as a share of the beams' spacing there. A uniform error has 0.29, but
    # it lasts while beams and surface move alike.
    edge_sigma: Positive = 0.6
    # … and what frames, bevels and ledges take off an end: 1 cm, which lasts for some scans.
    edge_floor_m: Gap = 0.02
    edge_jump_m: Gap = 0.15  # how far beyond the surface the next beam must go
    edge_spacing_m: Gap = 0.2  # farthest apart that two beams may meet the surface there
    # 1σ of a corner along each axis that the model of straight walls leaves out; like those of walls below, chosen
    # for an average pose NEES/3 of 0.7 to 1.2 in five kinds of rooms (training seeds 200-239) and on three floors.
    sigma_floor_m: Sigma = 0.0003
    # Of a surface that is a landmark itself, where the backend takes walls.
    wall_length_m: Length = 0.6
    # Through a door the walls beyond are seen by a few beams, and nothing else tells as much.
    wall_points: Count = 5
    # What a fit does not see of a wall (chamfers, ledges) shifts it by the same in some scans, those past a door's
    # jamb. As noise of each it counts for so much more, and adds up to no less.
    # Of a wall's curvature (slam.landmarks.curved_walls): the probability that it has one, 1σ of it where it has,
    # and the share by which it changes along the wall. Chosen in caves of the training seeds 100-115.
    wall_curved_share: Annotated[float, Within("[0, 1)")] = 0.25
    wall_curvature_sigma: Positive = 0.1  # [1/m]
    wall_shape_share: NotNegative = 0.1
    wall_sigma_m: Sigma = 0.0002  # 1σ that the model of a straight wall leaves out, across it …
    wall_sigma_rad: Sigma = 0.00005  # … and in its direction


class FeatureExtractor:
    """Extracts corners and lines from scans; holds the buffers, so that no scan allocates in the kernel.

    After :meth:`extract`, ``surface`` ``(beams,)`` holds for each beam the index of the line that it ended on,
    or -1.
    """

    def __init__(self, config: FeatureConfig | None = None) -> None:
        self.config = config or FeatureConfig()
        self.surface = np.zeros(0, np.int16)
        self._angles = np.zeros(0)
        self._scan_of: tuple[int, float, float] = (0, 0.0, 0.0)
        self._lines = np.zeros((MAX_LINES, 15))
        self._corners = np.zeros((3 * MAX_LINES, 12))
        self._walls_and_corners = np.zeros((4 * MAX_LINES, 12))
        self._line_count = 0
        self._corner_count = 0
        c = self.config
        self._limits = np.array([
            c.range_sigma_m, c.split_sigmas, c.split_floor_m, c.min_points, c.min_length_m,
            math.sin(math.radians(c.min_angle_deg)), c.max_gap_m, c.sigma_floor_m, c.edge_length_m, c.edge_jump_m,
            c.edge_spacing_m, c.edge_points, c.edge_face_m, c.edge_sigma, c.edge_floor_m,
        ])  # fmt: skip

    def extract(self, scan: Scan) -> NDArray[np.float64]:
        """Return the corners as rows of ``(m, 12)`` (a view, until the next call).

        Columns: range, bearing, then the covariance's three distinct terms, kind, direction, and for the visible
        end of a surface 1 or -1, as it is its last or first point by bearing, 0 for a meeting of two; then the
        surfaces' numbers, -1 for none, and two columns that only walls have.
        """
        n = len(scan.ranges)
        key = (n, scan.angle_min, scan.angle_increment)
        if key != self._scan_of:
            angles = scan.angle_min + scan.angle_increment * np.arange(n)
            self._angles = np.column_stack([np.cos(angles), np.sin(angles)])
            self._xy = np.zeros((n, 2))
            self._reach = np.zeros(n)
            self._places = np.zeros((7, n + 2), np.int64)
            self.surface = np.zeros(n, np.int16)
            self._gaps = self._gap_table(scan.angle_increment)
            self._scan_of = key
        self._line_count, self._corner_count = _extract(
            scan.ranges, self._angles, scan.angle_increment, scan.range_min, scan.range_max, self._limits,
            self._gaps, self._xy, self._reach, self._places, self.surface, self._lines, self._corners,
        )  # fmt: skip
        return self._corners[: self._corner_count]

    @property
    def lines(self) -> NDArray[np.float64]:
        """Straight surfaces of the last scan, in the order of ``surface``'s numbers (a view, until the next call).

        Rows of ``(l, 15)``, in the sensor frame: :mod:`slam.features.surfaces` names the columns.
        """
        return self._lines[: self._line_count]

    def with_walls(self) -> NDArray[np.float64]:
        """Return walls and corners of the last scan, as rows like :meth:`extract`'s (a view, until the next call).

        A wall is a surface long enough to be a landmark: a row of kind LINE with distance and bearing of its foot,
        then from where to where it was seen, its curvature and the variance of that. A corner says about the walls
        that make it only what they do not say themselves: nothing where two of them meet, and at a wall's end the
        place along it.
        """
        c = self.config
        count = walls_first(
            self._lines[: self._line_count], self._corners[: self._corner_count], self._limits, c.wall_length_m,
            c.wall_points, c.wall_sigma_m, c.wall_sigma_rad, self._walls_and_corners,
        )  # fmt: skip
        return self._walls_and_corners[:count]

    def _gap_table(self, increment: float) -> Array:
        """Return, for neighbours 1, 2, … beams apart: how far apart they may be, and 2 − 2 cos of the angle.

        The adaptive breakpoint of Borges and Aldon (2004): a surface at the flattest incidence that is still
        accepted would put the next point at most sin Δ / sin(λ − Δ) times the nearer range away.
        """
        angles = increment * np.arange(1, MAX_STEP + 1)
        rest = math.radians(self.config.grazing_deg) - angles
        # Neighbours as far apart as the flattest incidence never belong together: nothing is that near.
        share = np.where(rest > 0, np.sin(angles) / np.sin(np.maximum(rest, 1e-6)), -np.inf)
        return np.column_stack([share, 2.0 - 2.0 * np.cos(angles)])


@njit(cache=True, nogil=True, error_model="numpy")
def _extract(
    ranges: Array, rays: Array, increment: float, range_min: float, range_max: float, limits: Array, gaps: Array,
    xy: Array, reach: Array, places: Indices, surface: NDArray[np.int16], lines: Array, corners: Array,
) -> tuple[int, int]:  # fmt: skip
    """Fill ``surface``, ``lines`` and ``corners`` from a scan; return how many lines and corners there are.

    ``xy`` ``(n, 2)``, ``reach`` ``(n,)`` and ``places`` ``(7, n + 2)`` are work space.
    """
    beam, apart = places[0], places[1]
    stack, pieces = places[2:4].reshape(-1, 2), places[4:7].reshape(-1, 3)
    surface[:] = -1
    n = points_in_order(ranges, rays, increment, range_min, limits, gaps, xy, reach, beam, apart)
    pieces_count = split(xy, n, limits, apart, stack, pieces)
    line_count = 0
    last_line = -1  # the surface that the scan has run on from without a break, else -1
    last_end = 0  # … and its last point
    corner_count = 0
    for k in range(pieces_count):
        first, last = pieces[k, 0], pieces[k, 1]
        if pieces[k, 2] == 0:
            last_line = -1
        if line_count == MAX_LINES or not fit(xy, first, last, limits, lines[line_count]):
            continue
        line = lines[line_count]
        line[FIRST], line[LAST] = beam[first], beam[last]
        line[ENDS] = 0.0
        for i in range(first, last + 1):
            surface[beam[i]] = line_count
        # Noise near a corner may leave a sliver between its two surfaces; its points must lie on either.
        if last_line >= 0 and all_on(xy, last_end, first, lines[last_line], line, limits):
            met = meet(lines[last_line], line, increment, limits, corners[corner_count])
            corners[corner_count, 8], corners[corner_count, 9] = last_line, line_count
            corner_count += met
            lines[last_line, ENDS] += 2.0 * met
            line[ENDS] += met
        last_line, last_end = line_count, last
        line_count += 1
    for k in range(line_count):
        for side in range(2):
            # This end may already make a corner with the neighbouring surface.
            if int(lines[k, ENDS]) & (1 << side) == 0:
                corners[corner_count, 8], corners[corner_count, 9] = k, -1.0
                corner_count += edge(
                    lines[k], side, ranges, rays, increment, range_max, limits, corners[corner_count]
                )
    return line_count, corner_count
