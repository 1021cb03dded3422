"""The pose graph: key scans and patches, what links them, and the sparse least squares solution.

Every node is a pose, every link a quadratic form in the pose of one node as seen from another. Gauss-Newton with
SciPy's sparse LU; marginal covariances by solving for the columns that are asked for. A loop closing's links are
weighted together by dynamic covariance scaling (Agarwal, Tipaldi, Spinello, Stachniss and Burgard 2013).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from slam.geometry import relative, wrap
from slam.types import Array, Indices

__all__ = ["PoseGraph", "relative_jacobians"]


def relative_jacobians(first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Return the second poses ``(n, 3)`` seen from the first, with Jacobians ``(n, 3, 3)`` by first and second."""
    d = relative(first, second)
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    by_second = np.zeros((len(d), 3, 3))
    by_second[:, 0, 0], by_second[:, 0, 1] = c, s
    by_second[:, 1, 0], by_second[:, 1, 1] = -s, c
    by_second[:, 2, 2] = 1.0
    by_first = -by_second
    by_first[:, 0, 2], by_first[:, 1, 2] = d[:, 1], -d[:, 0]
    return d, by_first, by_second


_PHI = 3.0  # of a closing's chi-square a degree of freedom, from which it counts less and less


class PoseGraph:
    """Nodes, links and their solution. Node 0 has a prior; link k says ½(d-z)ᵀH(d-z) + gᵀ(d-z), d = i⁻¹ ∘ j."""

    def __init__(self, pose: Array, pose_cov: Array) -> None:
        self._poses = np.zeros((64, 3))
        self._poses[0] = pose
        self.size = 1
        self._prior, self._prior_info = np.array(pose, np.float64), np.linalg.inv(pose_cov)
        self._ends = np.zeros((256, 2), np.int64)
        self._z, self._g, self._h = np.zeros((256, 3)), np.zeros((256, 3)), np.zeros((256, 3, 3))
        self._closing = np.full(256, -1, np.int64)
        self.links = 0
        self._factor: SuperLU | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return all that a copy needs: the factor, which SciPy cannot copy, is made again when asked for."""
        return {**self.__dict__, "_factor": None}

    @property
    def poses(self) -> Array:
        """Poses ``(n, 3)`` of the nodes; a view, to be written by who knows better."""
        return self._poses[: self.size]

    def add_node(self, pose: Array) -> int:
        """Add a node at a pose ``(3,)``; return its number."""
        if self.size == len(self._poses):
            self._poses = np.vstack([self._poses, np.zeros_like(self._poses)])
        self._poses[self.size] = pose
        self.size += 1
        self._factor = None
        return self.size - 1

    def add_link(
        self, first: int, second: int, z: Array, info: Array, gradient: Array | None = None, *, closing: int = -1
    ) -> None:
        """Add what is known of ``second`` as seen from ``first``; ``closing`` numbers the loop closing, if any."""
        k = self.links
        if k == len(self._z):
            for name in ("_ends", "_z", "_g", "_h", "_closing"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        self._ends[k] = first, second
        self._z[k], self._h[k] = z, info
        self._g[k] = 0.0 if gradient is None else gradient
        self._closing[k] = closing
        self.links += 1
        self._factor = None

    def drop_closing(self, closing: int) -> None:
        """Forget the links of a loop closing."""
        kept = np.flatnonzero(self._closing[: self.links] != closing)
        for name in ("_ends", "_z", "_g", "_h", "_closing"):
            array = getattr(self, name)
            array[: len(kept)] = array[kept]
        self.links = len(kept)
        self._factor = None

    # ---- solving -------------------------------------------------------------------------------------------

    def gradient_and_information(self) -> tuple[Array, csc_matrix]:
        """Return gradient ``(3n,)`` and Gauss-Newton information ``(3n, 3n)`` of the whole at the nodes' poses."""
        n, k = self.size, self.links
        i, j = self._ends[:k].T
        d, a, b = relative_jacobians(self._poses[i], self._poses[j])
        off = d - self._z[:k]
        off[:, 2] = wrap(off[:, 2])
        weight = self._weights(off)
        h = self._h[:k] * weight[:, None, None]
        g = np.einsum("kab,kb->ka", h, off) + weight[:, None] * self._g[:k]
        gradient = np.zeros((n, 3))
        np.add.at(gradient, i, np.einsum("kab,ka->kb", a, g))
        np.add.at(gradient, j, np.einsum("kab,ka->kb", b, g))
        prior = self._poses[0] - self._prior
        prior[2] = wrap(prior[2])
        gradient[0] += self._prior_info @ prior
        ha, hb = h @ a, h @ b
        at, bt = a.transpose(0, 2, 1), b.transpose(0, 2, 1)
        blocks = np.concatenate([at @ ha, at @ hb, bt @ ha, bt @ hb, self._prior_info[None]])
        rows = np.concatenate([i, i, j, j, [0]])
        cols = np.concatenate([i, j, i, j, [0]])
        at_row = (3 * rows)[:, None, None] + np.arange(3)[None, :, None] + np.zeros((1, 1, 3), np.int64)
        at_col = (3 * cols)[:, None, None] + np.arange(3)[None, None, :] + np.zeros((1, 3, 1), np.int64)
        matrix = csc_matrix((blocks.ravel(), (at_row.ravel(), at_col.ravel())), shape=(3 * n, 3 * n))
        return gradient.ravel(), matrix

    def _weights(self, off: Array) -> Array:
        weight = np.ones(len(off))
        closing = self._closing[: self.links]
        rows = np.flatnonzero(closing >= 0)
        if len(rows):
            excess, rank = self._loss(rows, off[rows])
            chi2 = np.bincount(closing[rows], excess) / np.maximum(np.bincount(closing[rows], rank), 1.0)
            scale = np.minimum(1.0, 2.0 * _PHI / (_PHI + chi2))
            weight[rows] = scale[closing[rows]] ** 2
        return weight

    def _loss(self, rows: Indices, off: Array) -> tuple[Array, Array]:
        """Return twice what links lose against their own best fit ``(r,)``, and of how many degrees of freedom."""
        h, g = self._h[rows] + 1e-6 * np.eye(3), self._g[rows]
        best = -np.linalg.solve(h, g[..., None])[..., 0]
        rest = off - best
        return np.einsum("ka,kab,kb->k", rest, h, rest), np.linalg.matrix_rank(h, tol=1.0, hermitian=True)

    def closing_loss(self, closing: int) -> float:
        """Return chi-square a degree of freedom of a loop closing's links at the present poses."""
        rows = np.flatnonzero(self._closing[: self.links] == closing)
        i, j = self._ends[rows].T
        off = relative(self._poses[i], self._poses[j]) - self._z[rows]
        off[:, 2] = wrap(off[:, 2])
        loss, rank = self._loss(rows, off)
        return float(loss.sum() / max(rank.sum(), 1))

    def solve(self, *, iterations: int = 6, tolerance: float = 1e-5) -> None:
        """Move the nodes to the least squares solution."""
        for _ in range(iterations):
            gradient, matrix = self.gradient_and_information()
            self._factor = _factorised(matrix)
            step = self._factor.solve(-gradient).reshape(-1, 3)
            self._poses[: self.size] += step
            self._poses[: self.size, 2] = wrap(self._poses[: self.size, 2])
            if float(np.abs(step).max()) < tolerance:
                break

    def covariance(self, nodes: Sequence[int] | Indices) -> Array:
        """Return the joint marginal covariance ``(3k, 3k)`` of ``k`` nodes: a solve a column."""
        if self._factor is None:
            self._factor = _factorised(self.gradient_and_information()[1])
        at = (3 * np.asarray(nodes, np.int64)[:, None] + np.arange(3)).ravel()
        unit = np.zeros((3 * self.size, len(at)))
        unit[at, np.arange(len(at))] = 1.0
        cov = np.asarray(self._factor.solve(unit)[at], np.float64)
        return 0.5 * (cov + cov.T)


def _factorised(matrix: csc_matrix) -> SuperLU:
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
