"""Compressed EKF-SLAM: an ordinary filter over the landmarks near by; the rest of the map is updated later.

After Guivant and Nebot 2001, in a form of its own (docs/reference/compressed.md). While the robot stays in one
region only the state's part *a*, robot and landmarks near by, is filtered. What that does to the rest *b* goes by
way of their covariance, whose rank is low (:mod:`slam.gaussian.low_rank`): P_ab = U V. So a few numbers y, whose
covariance with a is U, stand for all of b, as states beside the map that no scan shows
(:mod:`slam.gaussian.companions`). When the robot leaves the region,

    x_b += Vᵀ y,   P_bb += Vᵀ P_yy V,   P_ab = P_ay V,

y and P_yy having begun at zero. The result is that of the full filter. Every landmark has a fixed place in the
map's own state and covariance, so that taking another region moves the rows of its landmarks only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from numba import njit

from slam.ekf import EkfSlam
from slam.gaussian.joint_gaussian import read_block, state_rows
from slam.gaussian.lanes import aligned_zeros
from slam.gaussian.low_rank import FEWEST_SAMPLES, factor, root_of_loss
from slam.gaussian.settings import EkfConfig
from slam.gaussian.tiles import add_combination, downdate, product
from slam.landmark_backend import observation_rows
from slam.landmarks.book import MARKS
from slam.settings import Gap, Within
from slam.types import LINE, Array, Indices, Observations, Scan

__all__ = ["Change", "CompressedEkfConfig", "CompressedEkfSlam"]


@dataclass(frozen=True, kw_only=True)
class CompressedEkfConfig(EkfConfig):
    """EKF-SLAM with postponed updates."""

    # Of the sensor's reach: having moved so far, the robot takes another region.
    leave_share: Annotated[float, Within("[0.001, 10]")] = 0.5
    crowd: Annotated[int, Within("[0, 10000]")] = 100  # landmarks: a region of more is smaller, and sooner left
    crowd_share: Annotated[float, Within("[0.001, 10]")] = 0.5  # ``leave_share`` of such a region, at least
    margin_m: Gap = 1.0  # beyond what the sensor can reach before that: landmarks so near are filtered, too
    # Landmarks: so many are one region, wherever they are.
    whole_up_to: Annotated[int, Within("[0, 1000000000]")] = 0
    # What is left out of all correlations with what is far: root of the squares' sum.
    rank_tolerance: Annotated[float, Within("(0, 1)")] = 1e-10


class Change(NamedTuple):
    """What a region's corrections make of the rest's covariance. The first columns are the map's own."""

    left: Array  # (k, ≥ n) L and …
    right: Array  # (k, ≥ n) … R: the covariance of what is far gains Lᵀ R
    own: Array  # (own, ≥ n) covariance of the states beside the map with what is far


class CompressedEkfSlam(EkfSlam):
    """The compressed EKF-SLAM backend, ``compressed-ekf``.

    ``_x``, ``_p`` and ``_book`` of the base class are those of the region: an ordinary filter over a small map.
    """

    config: CompressedEkfConfig

    def __init__(self, config: CompressedEkfConfig | None = None) -> None:
        super().__init__(config or CompressedEkfConfig())

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        super()._start(pose, pose_cov, seed)
        # The whole map: what belongs to the region is out of date here until it is left.
        self._map_x = np.zeros(len(self._x))
        self._map_p = aligned_zeros(len(self._x), len(self._x))  # upper triangle
        self._map_own = np.zeros((self._beside.own, len(self._x)))  # cross-covariance of the states beside the map
        self._map_ids = np.zeros(len(self._x) // 2, np.int64)
        self._map_marks = np.zeros((len(self._map_ids), MARKS))
        self._near = np.zeros(0, np.int64)  # the places of the region's landmarks, in its order
        self._far = np.zeros(0, np.int64)  # those of all the others
        self._free: list[int] = []  # those of landmarks that were dropped
        self._centre = (float(pose[0]), float(pose[1]))
        self._reach = 0.0  # how far the sensor sees [m]: lately, or as it says itself
        self._rank = 0  # of the covariance of near and far, lately
        self._made_for = 0.0  # that, when the region was chosen
        self._leave_at = self.config.leave_share * self.config.margin_m  # [m] having moved so far
        self._v = aligned_zeros(0, len(self._x))  # V, its columns the map's own: zero where they are not far
        self._weights = np.zeros(0)  # squared norms of V's rows, in σ's of what is far

    # ---- the filter ----------------------------------------------------------------------------------------

    def _update(self, scan: Scan) -> None:
        """Correct by the corners of a scan, in the region of what it can show."""
        self._settle(scan.range_max)
        super()._update(scan)

    def observe(self, observations: Observations) -> None:
        """Correct by landmark observations, in the region that holds them."""
        z = observation_rows(observations)
        self._settle(float(z[:, 0].max(initial=0.0)))
        ids = self._ids_told(observations)
        if ids is not None:
            strangers = [i for i in ids if self._book.row(i) < 0]  # mostly none, which is soon seen
            if strangers and np.isin(strangers, self._map_ids[self._far]).any():
                self._choose_region(np.array(ids))
        super().observe(observations)

    def _find(self, pose: Array, pose_cov: Array) -> None:
        super()._find(pose, pose_cov)
        self._choose_region(np.zeros(0, np.int64))

    def _add(self, z: Array, known_id: int | None) -> None:
        super()._add(z, known_id)
        if not self._free:
            self._free.append(len(self._near) + len(self._far))  # every place before it is taken
        self._near = np.append(self._near, self._free.pop())

    def _drop(self, row: int) -> None:
        self._free.append(int(self._near[row]))
        self._near = np.delete(self._near, row)
        super()._drop(row)

    def _place(self, pose: Array, pose_cov: Array) -> None:
        if len(self._far):
            self._leave()  # what is far learns of the pose before it is another one
            self._enter()
        super()._place(pose, pose_cov)

    def _copy(self) -> dict[str, Any]:
        whole, self._map_p = self._map_p, np.zeros((0, 0))  # large, and changed by nothing but _leave
        kept = super()._copy()
        kept["_map_p"] = self._map_p = whole
        return kept

    # ---- regions -------------------------------------------------------------------------------------------

    def _settle(self, reach: float) -> None:
        """Take another region where the robot has left this one, or sees farther than it was made for."""
        margin = self.config.margin_m
        self._reach = max(reach, 0.95 * self._reach)
        if self._book.count <= self.config.whole_up_to and not len(self._far):
            return
        beyond = reach > self._made_for + margin and len(self._far) > 0
        moved = math.hypot(self._x[0] - self._centre[0], self._x[1] - self._centre[1])
        if beyond or moved > self._leave_at or self._reach < 0.5 * self._made_for:
            self._choose_region(np.zeros(0, np.int64))

    def _choose_region(self, also: Indices) -> None:
        """Filter from now on what is near the robot, and the landmarks with these ids."""
        self._settle_beliefs()
        self._leave()
        places = np.sort(np.concatenate([self._near, self._far]))
        marks = self._map_marks[places]
        self._centre, self._made_for = (float(self._x[0]), float(self._x[1])), self._reach
        distance = _distance(self._map_x[3:].reshape(-1, 2)[places], marks, *self._centre)
        radius = self._radius(distance)
        near = distance < radius
        near |= np.isin(self._map_ids[places], also) | (len(places) <= self.config.whole_up_to)
        self._near, self._far = places[near], places[~near]
        self._book.replace(self._map_ids[self._near], marks[near])
        self._enter()

    def _radius(self, distance: Array) -> float:
        """Return the next region's radius [m], landmarks being so far from its centre; note when to leave it."""
        config, seen = self.config, self._reach + self.config.margin_m
        share = config.leave_share
        if len(distance) > config.crowd:
            within = float(np.partition(distance, config.crowd)[config.crowd])
            share = min(share, max(config.crowd_share, (within - seen) / max(self._reach, config.margin_m)))
        self._leave_at = share * max(self._reach, config.margin_m)
        return seen + share * self._reach

    def _leave(self) -> None:
        """Bring the whole map up to date."""
        a, b = state_rows(self._near, robot=True), state_rows(self._far, robot=False)
        needed = int(max(a.max(), b.max(initial=0))) + 1
        if needed > len(self._map_x):
            self._enlarge_map(1 + 2 * (3 * needed // 4))  # odd: three of the robot, two a landmark
        if self.recovery.kept is not None and self.recovery.kept["_map_p"] is self._map_p:
            self._map_p = _enlarged(self._map_p, len(self._map_p))
        change = self._change()
        self._write(self._map_p, change)
        self._map_x[b], self._map_own[:, b] = self._rest()[b], change.own[:, b]
        self._map_x[a], self._map_own[:, a] = self._x[: self._n], self._beside.cross[: self._beside.own, : self._n]
        self._map_ids[self._near], self._map_marks[self._near] = self._book.ids, self._book.marks

    def _rest(self) -> Array:
        """Return the map's state ``(n,)``, in which what is far is up to date."""
        x = self._map_x.copy()
        if len(self._v):
            end = int(state_rows(self._far, robot=True).max()) + 1
            add_combination(x, end, self._beside.mean[self._of_far], self._v)
        return x

    @property
    def _of_far(self) -> slice:
        """Which of the states beside the map stand for what is far."""
        return slice(self._beside.own, self._beside.own + len(self._v))

    def _change(self) -> Change:
        """Return what the region's corrections make of the rest's covariance."""
        y, v, k, far = self._beside, self._v, self._beside.own, self._of_far
        end = int(state_rows(self._far, robot=True).max()) + 1
        size = max(end, int(state_rows(self._near, robot=True).max()) + 1)
        own, loss = np.zeros((k, max(size, len(self._map_x)))), aligned_zeros(0, size)
        if len(v):
            root = root_of_loss(y.cov[far, far], self._weights, self.config.rank_tolerance)
            loss = aligned_zeros(len(root), size)
            loss[:, :end] = product(root, v, end)[:, :end]
            own[:, :end] = product(y.cov[:k, far], v, end)[:, :end]
        return Change(loss, -loss, own)

    def _cross(self, rows: int) -> Array:
        """Return the covariance ``(rows, n)`` of the region's first states with what is far; 0 with the others."""
        return product(self._beside.cross[self._of_far, :rows].T, self._v, self._v.shape[1])

    def _write(self, p: Array, change: Change) -> None:
        """Write what region and rest have become into the map's covariance."""
        a, b = state_rows(self._near, robot=True), state_rows(self._far, robot=False)
        _write_rows(p, a, b, self._p, self._cross(self._n))
        if len(b):
            size = max(int(a.max()), int(b.max())) + 1
            downdate(p, size, change.left, -change.right, len(change.left), 0)

    def _enter(self) -> None:
        """Begin to filter the region, a few numbers standing for what is far."""
        self._held = None  # other states beside the map
        a, b = state_rows(self._near, robot=True), state_rows(self._far, robot=False)
        while len(a) + 2 > len(self._x):
            self._enlarge()
        n = self._n = len(a)
        self._x[:n] = self._map_x[a]
        rows = np.empty((n, int(max(a.max(), b.max(initial=0))) + 1))
        _read_rows(self._map_p, a, rows)
        self._p[:n, :n] = rows[:, a]
        beside = self._beside
        beside.part()
        beside.cross[:, :n] = self._map_own[:, a]
        self._v = aligned_zeros(0, rows.shape[1])
        if len(b):
            sigma = np.sqrt(np.diag(self._map_p)[b])
            own = np.sqrt(np.diag(beside.cov))
            row_sigma = np.concatenate([np.sqrt(np.diag(rows[:, a])), np.where(own > 0.0, own, 1.0)])
            samples = max(FEWEST_SAMPLES, self._rank + self._rank // 4)
            cross = np.vstack([rows[:, b], self._map_own[:, b]])
            u, v = factor(cross, row_sigma, sigma, self.config.rank_tolerance, samples)
            # Where it is high it stays so for a while: another look at one region in three.
            self._rank = len(v) if 2 * samples <= len(cross) else self._rank // 2
            self._weights = np.einsum("ij,ij,j->i", v[:, : len(b)], v[:, : len(b)], sigma**-2)
            self._v = aligned_zeros(len(v), rows.shape[1])
            self._v[:, b] = v[:, : len(b)]
            beside.join(u[:n].T, u[n:])

    def _enlarge_map(self, size: int) -> None:
        old = len(self._map_x)
        x, own, ids, marks = self._map_x, self._map_own, self._map_ids, self._map_marks
        self._map_x, self._map_p = np.zeros(size), _enlarged(self._map_p, size)
        self._map_own = np.zeros((len(own), size))
        self._map_ids, self._map_marks = np.zeros(size // 2, np.int64), np.zeros((size // 2, MARKS))
        self._map_x[:old], self._map_own[:, :old] = x, own
        self._map_ids[: len(ids)], self._map_marks[: len(ids)] = ids, marks

    # ---- the belief ----------------------------------------------------------------------------------------

    def _covariance(self, landmarks: Indices) -> Array:
        if not len(self._far):
            return super()._covariance(landmarks)
        places = np.concatenate([self._near, self._far])
        rows = state_rows(places[landmarks], robot=True)
        # Room for all that is written, which may be more than what is asked for.
        p = _enlarged(self._map_p, max(int(state_rows(places, robot=True).max()) + 1, len(self._map_p)))
        self._write(p, self._change())
        out = np.empty((len(rows), len(rows)))
        read_block(p, rows, out)
        return out

    def _own_covariances(self, landmarks: Indices) -> Array:
        near = landmarks[landmarks < self._book.count]
        far = self._far[landmarks[len(near) :] - self._book.count]
        covs = super()._own_covariances(near)
        if not len(far):
            return covs
        change, others = self._change(), np.empty((len(far), 2, 2))
        _far_blocks(self._map_p, change.left, change.right, far, others)
        return np.concatenate([covs, others])

    @property
    def _marks(self) -> Array:
        return np.vstack([self._book.marks, self._map_marks[self._far]]) if len(self._far) else self._book.marks

    @property
    def _ids(self) -> Indices:
        return np.concatenate([self._book.ids, self._map_ids[self._far]]) if len(self._far) else self._book.ids

    def _map_points(self) -> tuple[Array, Indices]:
        """Return every landmark's estimate ``(n, 2)``, the region's first, and which row an id has."""
        if not len(self._far):
            return super()._map_points()
        ids = self._ids
        row_of_id = np.full(max(len(self._book.row_of_id), int(ids.max(initial=0)) + 1), -1, np.int64)
        row_of_id[ids] = np.arange(len(ids))
        far = self._rest()[state_rows(self._far, robot=False)].reshape(-1, 2)
        return np.concatenate([self._points, far]), row_of_id


def _distance(x: Array, marks: Array, px: float, py: float) -> Array:
    """Return how far each landmark ``(n, 2)`` is from a point: of a wall its nearest end or piece."""
    out = np.hypot(x[:, 0] - px, x[:, 1] - py)
    walls = marks[:, 0] == LINE
    alpha, r = x[walls].T
    c, s = np.cos(alpha), np.sin(alpha)
    along = c * py - s * px
    beyond = np.maximum(np.maximum(marks[walls, 6] - along, along - marks[walls, 7]), 0.0)
    out[walls] = np.hypot(c * px + s * py - r, beyond)
    return np.asarray(out)


def _enlarged(p: Array, size: int) -> Array:
    """Return a larger matrix with p's upper triangle; the lower, which nobody reads, takes no memory."""
    out = aligned_zeros(size, size)
    _copy_upper(p, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _copy_upper(p: Array, out: Array) -> None:
    for i in range(p.shape[0]):
        for j in range(i, p.shape[0]):
            out[i, j] = p[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _read_rows(p: Array, rows: Indices, out: Array) -> None:
    """Write rows of the symmetric matrix whose upper triangle is p, as many columns as ``out`` has."""
    for k in range(rows.shape[0]):
        i = rows[k]
        for j in range(min(i, out.shape[1])):
            out[k, j] = p[j, i]
        for j in range(i, out.shape[1]):
            out[k, j] = p[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _write_rows(p: Array, a: Indices, b: Indices, block: Array, cross: Array) -> None:
    """Write P_aa, an upper triangle, and P_ab, whose columns are the map's own, into p's upper triangle."""
    for k in range(a.shape[0]):
        i = a[k]
        for e in range(k, a.shape[0]):
            p[min(i, a[e]), max(i, a[e])] = block[k, e]
        for j in b:
            p[min(i, j), max(i, j)] = cross[k, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _far_blocks(p: Array, left: Array, right: Array, places: Indices, out: Array) -> None:
    """Write the covariances ``(m, 2, 2)`` of landmarks by themselves: P's, and what Lᵀ R adds."""
    for k in range(places.shape[0]):
        i = 3 + 2 * places[k]
        for e in range(2):
            for f in range(e, 2):
                total = p[i + e, i + f]
                for q in range(left.shape[0]):
                    total += left[q, i + e] * right[q, i + f]
                out[k, e, f] = out[k, f, e] = total
