"""The book of landmarks: tentative → confirmed → dropped.

A corner seen once may be noise or a passing shape; only one that was seen again at the same place, of the same
kind, enters the estimator's state. One that the scan keeps looking *through* was never there, or is gone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.landmarks.association import UNMATCHED, beside, nearest_neighbour
from slam.landmarks.wall_evidence import DOUBT
from slam.settings import Config, Count, Gap, NotNegative
from slam.types import LINE, VIRTUAL, Array, Indices, Scan

__all__ = [
    "FROM_MARK", "KIND", "LAST_SEEN", "MARKS", "RECENT", "LandmarkBook", "LandmarkPolicy", "count_recent",
    "match_and_recall",
]  # fmt: skip

KIND, DIRECTION, EDGE, FROM, TO = 5, 6, 7, 8, 9  # columns of an observation row, see FeatureExtractor.extract
FROM_MARK = 6  # column of ``marks``: where a wall begins, a point's end of a surface, a virtual point's place

MARKS = 14  # columns of ``marks``, one row a landmark; the last six are of walls: see curved_walls and on
_KIND, _DIRECTION, _SEEN, _MISSED, _UNSEEN, LAST_SEEN, _FROM, _TO = range(8)
RECENT = 3  # updates, of which a landmark was in one: it is missed where it is not seen again
_SAME_TURN = 0.6  # [rad] between two sightings of one landmark
_WALL_REACH_M = 3.0  # between the middles of two pieces of a wall that may become one landmark
# Columns of the tentative ones.
_X, _Y, _T_KIND, _T_DIRECTION, _COUNT, _AGE, _FROM_X, _FROM_Y, _END = range(9)
_TENTATIVE = 64
_NO_SCAN = Scan(np.zeros(0), 0.0, 1.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class LandmarkPolicy(Config):
    """When a corner becomes a landmark, and when it ceases to be one."""

    confirm_after: Count = 2  # sightings …
    edge_confirm_after: Count = 8  # … of a surface's visible end, which a round table can feign, more of them …
    edge_baseline_m: Gap = 0.2  # … and from two places this far apart
    forget_after: Count = 20  # updates without a sighting, while tentative
    tentative_gate_m: Gap = 0.1  # two sightings farther apart are two corners
    new_distance_m: Gap = 0.2  # a new corner is at least this far from a landmark of its kind
    drop_after: Count = 15  # contradictions more than sightings
    overlook_after: Count = 25  # dropped when overlooked, in plain view, more often than this …
    overlook_ratio: NotNegative = 5.0  # … and this many times the sightings
    contradicted_after: NotNegative = 14.0  # of a wall: see slam.landmarks.wall_evidence
    clear_margin_m: Gap = 0.3  # a beam that goes this far beyond a landmark contradicts it


class LandmarkBook:
    """What is known of each landmark beside its position, which the estimator keeps."""

    def __init__(self, policy: LandmarkPolicy) -> None:
        self.policy = p = policy
        self.count = 0
        self.row_of_id = np.full(64, -1, np.int64)  # id → row, -1 where there is none (any more)
        self.next_id = 0  # of the next landmark that gets its own
        self._own: set[int] = set()  # ids given here
        self.label_ids: dict[int, int] = {}  # by label
        self.now = 0  # updates reviewed
        self._ids = np.zeros(32, np.int64)
        self._marks = np.zeros((32, MARKS))
        self._tentative = np.zeros((_TENTATIVE, 9))
        self._tentative_count = 0
        self._new = np.zeros(256, np.int64)
        self._limits = np.array([
            p.tentative_gate_m, p.confirm_after, p.edge_confirm_after, p.edge_baseline_m, p.forget_after,
            p.clear_margin_m, p.drop_after, p.overlook_after, p.overlook_ratio, p.new_distance_m,
            p.contradicted_after,
        ])  # fmt: skip

    @property
    def marks(self) -> Array:
        """Kind, direction, sightings, contradictions, times overlooked, last sighting, from, to … ``(n, 14)``.

        A wall goes from one to the other [m], along it from its foot; of a point, "from" says which end of a
        surface it is, as the observation does. Then, of a wall's curvature, the information of its measurements,
        the same times what they measured, and where along the wall it is tangent to its line; how far its
        sightings contradict it; how it was held against the building's direction; and the mean of its last
        innovations of direction. A view.
        """
        return self._marks[: self.count]

    @property
    def ids(self) -> Indices:
        """Ids ``(n,)``; an id is never used twice. A view."""
        return self._ids[: self.count]

    def of_labels(self, labels: Sequence[int]) -> list[int]:
        """Return the ids of landmarks that are told apart by labels: the labels, but where one is another's id."""
        for label in labels:
            if label not in self.label_ids:
                new_id = label
                if label in self._own:
                    new_id = self.next_id
                    self._own.add(new_id)
                self.label_ids[label], self.next_id = new_id, max(self.next_id, new_id + 1)
        return [self.label_ids[label] for label in labels]

    def row(self, landmark_id: int) -> int:
        """Return the row of a landmark, or -1."""
        return int(self.row_of_id[landmark_id]) if 0 <= landmark_id < len(self.row_of_id) else -1

    def add(
        self,
        kind: float,
        direction: float,
        known_id: int | None,
        *,
        extent: tuple[float, float] = (0.0, 0.0),
        bend: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Append a landmark; without a known id it gets the next one. ``extent`` and ``bend``: see ``marks``."""
        new_id = self.next_id if known_id is None else known_id
        if known_id is None:
            self._own.add(new_id)
        self._make_room(self.count + 1)
        while new_id >= len(self.row_of_id):
            self.row_of_id = np.concatenate([self.row_of_id, np.full_like(self.row_of_id, -1)])
        self._ids[self.count] = new_id
        seen = -math.inf if kind == VIRTUAL else self.now
        first = kind, wrap_scalar(direction), 1.0, 0.0, 0.0, seen
        self._marks[self.count] = (*first, *extent, *bend, 0.0, 0.0, 0.0)
        self.row_of_id[new_id] = self.count
        self.next_id = max(self.next_id, new_id + 1)
        self.count += 1

    def drop(self, row: int) -> None:
        """Take a landmark out; those after it move up."""
        n = self.count
        self.row_of_id[self._ids[row]] = -1
        self._ids[row : n - 1] = self._ids[row + 1 : n]
        self._marks[row : n - 1] = self._marks[row + 1 : n]
        self.count = n - 1
        self.row_of_id[self.ids[row:]] = np.arange(row, n - 1)

    def replace(self, ids: Indices, marks: Array) -> None:
        """Have these landmarks ``(n,)``, with these marks ``(n, 14)``, instead of those it has."""
        self.row_of_id[self.ids] = -1
        count = len(ids)
        self._make_room(count)
        self._ids[:count], self._marks[:count] = ids, marks
        self.row_of_id[ids] = np.arange(count)
        self.count = count

    def just_seen(self, points: Array) -> tuple[Indices, Indices, Array]:
        """Return rows and ids ``(k,)`` of what the last update showed, marks ``(k, 3)`` as key scans take them.

        ``points`` ``(n, 2)`` are the estimates: x, y, or of a wall α, r.
        """
        return _seen_at(self.now, self._marks, self._ids, points)

    def _make_room(self, count: int) -> None:
        while count > len(self._ids):
            self._ids = np.concatenate([self._ids, np.zeros_like(self._ids)])
            self._marks = np.vstack([self._marks, np.zeros_like(self._marks)])

    def count_sightings(self, match: Indices) -> None:
        """Count an update in which these rows (negative: none) were seen, all of them known from outside."""
        self.now += 1
        seen = match[match >= 0]
        self._marks[seen, _SEEN] += 1.0
        self._marks[seen, LAST_SEEN] = self.now

    def review(
        self, x: Array, offset: float, z: Array, match: Indices, scan: Scan | None = None, *, at_once: bool = False
    ) -> tuple[list[int], list[int]]:
        """Count sightings; return the observations that are new landmarks by now, and rows to drop, highest first.

        Dropped are, where there is a scan, points that its beams keep passing through, or never show; and walls
        that their sightings contradict. Add what is new first or last: it was just seen. With ``at_once``, what is
        seen where features meet is a landmark at its first sighting. ``x`` is the state (robot pose first), ``z``
        the observation rows and ``match`` their landmarks.
        """
        self.now += 1
        if len(self._new) < len(z):
            self._new = np.zeros(len(z), np.int64)
        seen = scan or _NO_SCAN
        count, self._tentative_count, doubtful = _review(
            x, offset, z, match, seen.ranges, seen.angle_min, seen.angle_increment, seen.range_max, self.now,
            self._marks[: self.count], self._tentative, self._tentative_count, self._limits, at_once, self._new,
        )  # fmt: skip
        return self._new[:count].tolist() if count else [], self._to_drop() if doubtful else []

    def _to_drop(self) -> list[int]:
        p, marks = self.policy, self.marks
        passed = marks[:, _MISSED] - marks[:, _SEEN] > p.drop_after
        overlooked = marks[:, _UNSEEN] > p.overlook_after + p.overlook_ratio * marks[:, _SEEN]
        contradicted = marks[:, DOUBT] > p.contradicted_after
        return [int(i) for i in np.flatnonzero(passed | overlooked | contradicted)[::-1]]


@njit(cache=True, nogil=True)
def _seen_at(now: int, marks: Array, ids: Indices, points: Array) -> tuple[Indices, Indices, Array]:
    """Do what :meth:`LandmarkBook.just_seen` does, in two thirds of the time that indexing by arrays took."""
    n = points.shape[0]
    rows, seen_ids, seen = np.empty(n, np.int64), np.empty(n, np.int64), np.empty((n, 3))
    count = 0
    for row in range(n):
        if marks[row, LAST_SEEN] == now:
            rows[count], seen_ids[count] = row, ids[row]
            seen[count, 0], seen[count, 1] = points[row, 0], points[row, 1]
            seen[count, 2] = marks[row, _KIND] == LINE
            count += 1
    return rows[:count], seen_ids[:count], seen[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def _lengthen(x: Array, offset: float, z: Array, row: int, mark: Array) -> None:
    """Stretch wall ``row`` to the piece of it that is seen, and take over its direction from the state."""
    alpha = x[3 + 2 * row]
    nx, ny = math.cos(alpha), math.sin(alpha)
    sx, sy = x[0] + offset * math.cos(x[2]), x[1] + offset * math.sin(x[2])
    c, s = math.cos(x[2] + z[1]), math.sin(x[2] + z[1])
    for e in range(8, 10):
        t = nx * (sy + z[0] * s + z[e] * c) - ny * (sx + z[0] * c - z[e] * s)
        mark[_FROM], mark[_TO] = min(mark[_FROM], t), max(mark[_TO], t)
    mark[_DIRECTION] = alpha


@njit(cache=True, nogil=True, error_model="numpy")
def _goes_on(x: Array, offset: float, z: Array, marks: Array, near: float) -> bool:
    """Tell whether a piece of wall is one of a landmark after all, which has been seen as far as this by now."""
    for i in range(marks.shape[0]):
        along = marks[i, _KIND] == LINE and abs(wrap_scalar(marks[i, _DIRECTION] - x[2] - z[1])) < _SAME_TURN
        if along and beside(x, i, offset, z, marks[i], near):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def count_recent(marks: Array, match: Indices, now: int) -> tuple[int, int]:
    """Return how many landmarks the last three updates showed, and how many of those ``match`` has again."""
    recent = still = 0
    for i in range(marks.shape[0]):
        if marks[i, LAST_SEEN] > now - RECENT:
            recent += 1
    for k in range(match.shape[0]):
        if match[k] >= 0 and marks[match[k], LAST_SEEN] > now - RECENT:
            still += 1
    return recent, still


@njit(cache=True, nogil=True, error_model="numpy")
def _sightings(
    x: Array, offset: float, z: Array, match: Indices, now: int, marks: Array, tentative: Array,
    n: int, limits: Array, at_once: bool, new: Indices,
) -> tuple[int, int]:  # fmt: skip
    """Count sightings; return how many observations are new landmarks, and how many tentative ones there are."""
    gate, confirm_after, edge_confirm_after, baseline = limits[0], limits[1], limits[2], limits[3]
    forget_after, near = limits[4], limits[9]
    c, s = math.cos(x[2]), math.sin(x[2])
    found = 0
    for i in range(n):
        tentative[i, _AGE] += 1.0
    for k in range(z.shape[0]):
        if match[k] >= 0:
            marks[match[k], _SEEN] += 1.0
            marks[match[k], LAST_SEEN] = now
            if z[k, KIND] == LINE:
                _lengthen(x, offset, z[k], match[k], marks[match[k]])
    for k in range(z.shape[0]):
        if match[k] != UNMATCHED:
            continue
        bearing = x[2] + z[k, 1]
        px = x[0] + offset * c + z[k, 0] * math.cos(bearing)
        py = x[1] + offset * s + z[k, 0] * math.sin(bearing)
        turn = wrap_scalar(x[2] + z[k, 6])
        if z[k, KIND] == LINE:
            # The middle of the piece that is seen stands for it; another piece of the same wall counts, too.
            middle = 0.5 * (z[k, 8] + z[k, 9])
            px, py = px - middle * math.sin(bearing), py + middle * math.cos(bearing)
        nearest, best = -1, gate * gate
        for i in range(n):
            dx, dy = tentative[i, _X] - px, tentative[i, _Y] - py
            if z[k, KIND] == LINE:
                d2 = (dx * math.cos(turn) + dy * math.sin(turn)) ** 2
                if tentative[i, _T_KIND] != LINE or dx * dx + dy * dy > _WALL_REACH_M**2:
                    continue
            else:
                d2 = dx * dx + dy * dy
            same = tentative[i, _T_KIND] == z[k, 5] and (
                z[k, 5] == 0.0
                or (
                    tentative[i, _END] == z[k, EDGE]
                    and abs(wrap_scalar(tentative[i, _T_DIRECTION] - turn)) < _SAME_TURN
                )
            )
            if same and d2 < best:
                nearest, best = i, d2
        if nearest < 0:
            if n == tentative.shape[0]:
                continue
            nearest = n
            n += 1
            t = tentative[nearest]
            t[_COUNT] = t[_AGE] = 0.0  # the row may be one that became a landmark
            t[_T_KIND], t[_X], t[_Y], t[_FROM_X], t[_FROM_Y], t[_END] = z[k, 5], px, py, x[0], x[1], z[k, EDGE]
        # Compared with where it was first seen: what wanders with the robot never settles.
        t = tentative[nearest]
        # This very scan has made it a landmark already. Another piece of a wall is the same wall; another corner,
        # seen at once with the first, is another one.
        if t[_AGE] == np.inf and z[k, KIND] == LINE:
            continue
        t[_T_DIRECTION] = turn
        t[_COUNT] += 1.0
        t[_AGE] = 0.0
        moved = (x[0] - t[_FROM_X]) ** 2 + (x[1] - t[_FROM_Y]) ** 2
        settled = t[_COUNT] >= edge_confirm_after and moved >= baseline * baseline
        if settled or (z[k, EDGE] == 0.0 and (at_once or t[_COUNT] >= confirm_after)):
            if z[k, KIND] == LINE and _goes_on(x, offset, z[k], marks, near):
                continue
            new[found] = k
            found += 1
            t[_AGE] = np.inf
    kept = 0
    for i in range(n):
        if tentative[i, _AGE] <= forget_after:
            if kept != i:
                for j in range(tentative.shape[1]):
                    tentative[kept, j] = tentative[i, j]
            kept += 1
    return found, kept


@njit(cache=True, nogil=True, error_model="numpy")
def _look_through(
    x: Array, offset: float, ranges: Array, angle_min: float, increment: float, range_max: float, now: int,
    marks: Array, limits: Array,
) -> bool:  # fmt: skip
    """Count, for points near by that scans found, whether beams pass it or one ends there; tell of any doubt."""
    margin, drop_after, overlook_after, overlook_ratio = limits[5], limits[6], limits[7], limits[8]
    c, s = math.cos(x[2]), math.sin(x[2])
    sx, sy = x[0] + offset * c, x[1] + offset * s
    beams, increment = ranges.shape[0], max(increment, 1e-9)  # that of one beam may be 0
    circle = round(2.0 * math.pi / increment)
    full = beams >= circle >= 3  # a beam or two do not look all round, whatever they are said to be apart
    doubtful = False
    for i in range(marks.shape[0]):
        doubtful |= marks[i, DOUBT] > limits[10]
        if marks[i, LAST_SEEN] == now or marks[i, _KIND] >= LINE or marks[i, _KIND] == 0.0:
            continue
        dx, dy = x[3 + 2 * i] - sx, x[4 + 2 * i] - sy
        d2 = dx * dx + dy * dy
        # Farther away, an uncertain heading moves the beams past a corner that is there.
        rho = math.sqrt(d2)
        if rho > min(range_max, 5.0):
            continue
        b = round(wrap_scalar(math.atan2(dy, dx) - x[2] - angle_min) / increment)
        if b < 0:
            b += circle
        passed, ended = 0, 0
        for q in range(b - 1, b + 2):
            j = q % beams if full else q
            if 0 <= j < beams:
                if ranges[j] > rho + margin:
                    passed += 1
                elif abs(ranges[j] - rho) < 0.5 * margin:
                    ended += 1
        if passed == 3:
            marks[i, _MISSED] += 1.0
        elif ended > 0:
            marks[i, _UNSEEN] += 1.0
        if (
            marks[i, _MISSED] - marks[i, _SEEN] > drop_after
            or marks[i, _UNSEEN] > overlook_after + overlook_ratio * marks[i, _SEEN]
        ):
            doubtful = True
    return doubtful


@njit(cache=True, nogil=True, error_model="numpy")
def _review(
    x: Array, offset: float, z: Array, match: Indices, ranges: Array, angle_min: float, increment: float,
    range_max: float, now: int, marks: Array, tentative: Array, n: int, limits: Array, at_once: bool, new: Indices,
) -> tuple[int, int, bool]:  # fmt: skip
    """Do what :meth:`LandmarkBook.review` does; return the numbers of new and of tentative ones, and of doubts."""
    found, kept = _sightings(x, offset, z, match, now, marks, tentative, n, limits, at_once, new)
    return found, kept, _look_through(x, offset, ranges, angle_min, increment, range_max, now, marks, limits)


@njit(cache=True, nogil=True, error_model="numpy")
def match_and_recall(
    x: Array, p: Array, offset: float, z: Array, marks: Array, now: int, gates: Array, only_sure: bool,
    match: Indices, distance: Array,
) -> tuple[int, int]:  # fmt: skip
    """Match by nearest neighbour; return what :func:`count_recent` does of it."""
    gate, near, max_turn = gates[0], gates[1], gates[2]
    nearest_neighbour(x, p, offset, z, marks, gate, near, max_turn, only_sure, match, distance)
    return count_recent(marks, match, now)
