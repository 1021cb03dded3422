"""What a matched pose inherits from the map it is matched to: the errors of the poses that drew it.

A scan that fits a map says where the robot is in the map. In the world that is known no better than the surfaces
it was matched to, which are as far off as the poses from which they were drawn. So the map is cut into square
tiles, and each has an error of its own, that of a rigid piece: a pose's, at the tile's centre. A match is a mean
of the motion's prior and of the tiles in sight, each weighed by the information its beams gave; drawing the scan
makes each tile the mean of what it was and of the new pose. Both are linear in the errors, so the joint covariance
follows from the weights that were used, best or not, in Joseph's form (``docs/reference/dp_slam.md``).
"""

from __future__ import annotations

import numpy as np

from slam.types import Array, Indices

__all__ = ["MapError", "transport"]


class MapError:
    """Joint covariance of the errors of the pose and of the map's tiles [m, rad], in the world's axes.

    Three rows each: x, y, θ, first the pose's, then those of every tile, at its centre.
    """

    def __init__(self, pose_cov: Array, tile_m: float) -> None:
        self.tile_m = tile_m
        self._p = np.zeros((96, 96))  # room for more tiles than there are
        self._p[:3, :3] = pose_cov
        self._size = 3
        self._tile_of: dict[tuple[int, int], int] = {}  # square → tile
        self._centres, self._drawn = np.zeros((32, 2)), np.zeros(32)  # [m]; beams that ended there so far

    @property
    def cov(self) -> Array:
        """The joint covariance, a view."""
        return self._p[: self._size, : self._size]

    @property
    def pose_cov(self) -> Array:
        """Covariance ``(3, 3)`` of the pose of the last :meth:`match`."""
        return self._p[:3, :3].copy()

    def tiles(self, ends: Array) -> tuple[Indices, Indices]:
        """Return the place ``(n,)`` of each point's tile in a list of tiles ``(t,)``, and that list.

        ``ends`` ``(n, 2)`` are in the world [m]. Tiles are made where there were none.
        """
        squares, place = np.unique(np.floor(ends / self.tile_m).astype(np.int64), axis=0, return_inverse=True)
        return place.ravel(), np.array([self._tile(x, y) for x, y in squares.tolist()], np.int64)

    def _tile(self, x: int, y: int) -> int:
        tile = self._tile_of.setdefault((x, y), len(self._tile_of))
        if 3 * tile + 6 > self._size:
            self._size = 3 * tile + 6
            if self._size > len(self._p):
                wider = np.zeros((2 * len(self._p), 2 * len(self._p)))
                wider[: len(self._p), : len(self._p)] = self._p
                self._p = wider
                self._centres = np.concatenate([self._centres, np.zeros_like(self._centres)])
                self._drawn = np.concatenate([self._drawn, np.zeros_like(self._drawn)])
            self._centres[tile] = (np.array([x, y]) + 0.5) * self.tile_m
        return tile

    def match(
        self, before: Array, pose: Array, motion: Array, prior: Array, tiles: Indices, infos: Array, noise: float,
        draw: Array,
    ) -> None:  # fmt: skip
        """Go on from one matched pose ``(3,)`` to the next.

        Parameters
        ----------
        motion : Array
            Covariance ``(3, 3)`` of the motion between them, in the world's axes.
        prior : Array
            The information ``(3, 3)`` that the match gave the motion.
        tiles, infos : Array
            The tiles in sight ``(t,)``, and the information ``(t, 3, 3)`` that the match gave each of them.
        noise : float
            Variance of the beams' ends over the one that ``infos`` assume.
        draw : Array
            Covariance ``(3, 3)`` of what was added to the pose by chance.
        """
        total = infos.sum(axis=0)
        gain = np.linalg.inv(prior + total)
        by_motion, by_map = gain @ prior, gain @ infos
        # e ← A e + noise of the motion, of the scan and of the draw: A's blocks side by side.
        # Where nothing was drawn yet, beams meet surfaces across the tile's border: the last poses drew those.
        new = self._drawn[tiles] == 0
        blocks = [(by_motion + by_map[new].sum(axis=0)) @ transport(before[:2], pose[:2])]
        tiles, by_map = tiles[~new], by_map[~new]
        blocks += [k @ transport(self._centres[t], pose[:2]) for k, t in zip(by_map, tiles, strict=True)]
        rows = np.concatenate([np.arange(3), *(3 + 3 * t + np.arange(3) for t in tiles)])
        a, p = np.hstack(blocks), self.cov
        row = a @ p[rows]
        own = row[:, rows] @ a.T + by_motion @ motion @ by_motion.T + noise * gain @ total @ gain + draw
        p[:3], p[:, :3] = row, row.T
        p[:3, :3] = 0.5 * (own + own.T)

    def draw(self, pose: Array, tiles: Indices, beams: Array) -> None:
        """Draw a scan from a pose ``(3,)``: so many ``beams`` ``(t,)`` of it end in each of the ``tiles``."""
        p = self.cov
        for tile, count in zip(tiles.tolist(), beams.tolist(), strict=True):
            self._drawn[tile] += count
            share, at = count / self._drawn[tile], slice(3 + 3 * tile, 6 + 3 * tile)
            moved = transport(pose[:2], self._centres[tile])
            row = share * moved @ p[:3] + (1.0 - share) * p[at]
            own = share * row[:, :3] @ moved.T + (1.0 - share) * row[:, at]
            p[at], p[:, at] = row, row.T
            p[at, at] = 0.5 * (own + own.T)


def transport(here: Array, there: Array) -> Array:
    """Return what makes the error ``(3,)`` of a rigid piece at ``here`` ``(2,)`` [m] that of it at ``there``."""
    x, y = (there - here).tolist()
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
