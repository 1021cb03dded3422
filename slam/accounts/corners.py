"""What an account leaves unsaid of its corners: on which walls they lie, and which no wall reaches.

The filter takes from a corner only what the walls that make it do not say (docs/reference/features.md), so across
a wall a corner's own covariance is centimetres wide, where the wall is known to a millimetre or two. Here such a
corner is read off its wall: its foot on the wall, or where two walls cross. Both are functions of the account's
state, so the covariance goes over by their Jacobian and nothing is counted twice.

A convex corner is seen together with its walls, so they reach it. Where one was seen to end before, the lines of
two surfaces only cross there, behind a jamb perhaps, and the corner is off along the wall by as much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.sparse import coo_array

from slam.accounts.account import Account
from slam.metrics.chi_square import chi2_quantile
from slam.settings import Angle, Config, Length, Within
from slam.types import CONVEX, Array

__all__ = ["CornerConfig", "settled"]

Blocks = dict[tuple[int, int], Array]
"""Blocks ``(2, 2)`` of a Jacobian, by the corner whose row they are in, and the point or wall."""

_FACING = 0.3  # cosine; a corner's bisector makes 45° with the free side of either wall


@dataclass(frozen=True, kw_only=True)
class CornerConfig(Config):
    """Which walls a corner lies on; chosen in apartments of training seeds 0-249."""

    off_m: Length = 0.05  # from the wall …
    beyond_m: Length = 0.15  # … and past what was seen of it
    gate: Annotated[float, Within("(0, 1)")] = 0.997  # probability of χ² of the distance from the wall
    jamb_m: Length = 0.4  # … or a convex corner's, where no other is: of 61,078 this takes 6 true and 5 false ones
    crossing_rad: Angle = 0.96  # least angle between two walls that make a corner
    reach_m: Length = 0.06  # from a convex corner to what was seen of its walls; 5 of 6 farther off were false


def settled(account: Account, config: CornerConfig | None = None) -> Account:
    """Return the account with its corners on the walls on which they lie."""
    config = config or CornerConfig()
    if not len(account.points):
        return account
    cov = account.cov.copy()
    points, blocks, apart = _on_walls(account, cov, config)
    if blocks:
        _go_over(cov, blocks)
    for u, gap in apart:
        at = slice(3 + 2 * u, 5 + 2 * u)
        cov[at, at] += np.outer(gap, gap)
    return replace(account, points=points, cov=cov)


def _on_walls(account: Account, cov: Array, config: CornerConfig) -> tuple[Array, Blocks, list[tuple[int, Array]]]:
    """Return points ``(n, 2)`` read off their walls, x' = f(x), rows of J that this changes, and where walls end.

    That is, corners that no wall reaches, each with the gap ``(2,)`` [m] along the wall.
    """
    n, (alpha, r) = len(account.points), account.walls.T
    normals = np.column_stack([np.cos(alpha), np.sin(alpha)])
    tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
    ends = np.einsum("kei,ki->ke", account.wall_ends.reshape(-1, 2, 2), tangents)
    off, along = account.points @ normals.T - r, account.points @ tangents.T
    bisectors = np.column_stack([np.cos(account.directions), np.sin(account.directions)])
    likely = (np.abs(off) < config.off_m) & (bisectors @ normals.T < -_FACING)  # not so where it is not known
    beyond = np.maximum(ends.min(axis=1) - along, along - ends.max(axis=1))
    likely &= beyond < max(config.beyond_m, config.jamb_m)
    points, gate = account.points.copy(), chi2_quantile(config.gate, 1)
    blocks: Blocks = {}
    apart: list[tuple[int, Array]] = []
    for u in range(n):
        every = [
            j for j in np.flatnonzero(likely[u]).tolist() if off[u, j] ** 2 < gate * _variance(account, cov, u, j)
        ]
        walls = [j for j in every if beyond[u, j] < config.beyond_m]
        if not walls:
            if account.kinds[u] == CONVEX and every:
                apart += _gaps(account.points[u], u, _nearest(every, beyond[u]), tangents, ends, config)
            continue
        walls.sort(key=lambda j: abs(off[u, j]))
        first = walls[0]
        crossing = [j for j in every if abs(normals[j] @ tangents[first]) > math.sin(config.crossing_rad)]
        across = [j for j in walls if j in crossing]
        if across:  # N x = r
            made_by = [first, across[0]]
            gains = np.linalg.inv(normals[made_by])
            points[u], blocks[u, u] = gains @ r[made_by], np.zeros((2, 2))
        else:  # x − n (nᵀx − r)
            made_by, gains = [first], normals[[first]].T
            points[u] -= normals[first] * off[u, first]
            blocks[u, u] = np.eye(2) - np.outer(normals[first], normals[first])
        for j, gain in zip(made_by, gains.T, strict=True):  # a turn of the wall moves it at the corner, too
            blocks[u, n + j] = np.column_stack([-gain * (tangents[j] @ points[u]), gain])
        if not across:
            blocks[u, n + first][:, 0] -= tangents[first] * off[u, first]
        if account.kinds[u] == CONVEX:
            # Where none of those that are across reaches it, one that ends before may have made it.
            made_by += [] if across else _nearest(crossing, beyond[u])
            apart += _gaps(points[u], u, made_by, tangents, ends, config)
    return points, blocks, apart


def _nearest(walls: list[int], beyond: Array) -> list[int]:
    return sorted(walls, key=lambda j: float(beyond[j]))[:1]


def _gaps(
    point: Array, u: int, walls: list[int], tangents: Array, ends: Array, config: CornerConfig
) -> list[tuple[int, Array]]:
    """Return by how much ``(2,)`` [m] walls end before a corner, where that is more than a trifle."""
    found = []
    for j in walls:
        at = point @ tangents[j]
        gap = np.clip(at, *np.sort(ends[j])) - at
        if abs(gap) > config.reach_m:
            found.append((u, gap * tangents[j]))
    return found


def _go_over(cov: Array, blocks: Blocks) -> None:
    """Make the covariance J P Jᵀ, in place; the rows of J that no block is in are those of 1."""
    corners = sorted({u for u, _ in blocks})
    row = np.searchsorted(corners, [u for u, _ in blocks])
    column = 3 + 2 * np.array([k for _, k in blocks])
    rows, columns = (2 * row[:, None] + [0, 0, 1, 1]).ravel(), (column[:, None] + [0, 1, 0, 1]).ravel()
    jacobian = coo_array(
        (np.array(list(blocks.values())).ravel(), (rows, columns)), shape=(2 * len(corners), len(cov))
    ).tocsr()
    at = (3 + 2 * np.array(corners)[:, None] + [0, 1]).ravel()
    new = jacobian @ cov
    among = jacobian @ new.T
    new[:, at] = 0.5 * (among + among.T)
    cov[at] = new
    cov[:, at] = new.T


def _variance(account: Account, cov: Array, u: int, j: int) -> float:
    """Return the variance of a corner's distance from a wall, nᵀx − r."""
    alpha, at, wall = account.walls[j, 0], 3 + 2 * u, 3 + 2 * (len(account.points) + j)
    c, s = math.cos(alpha), math.sin(alpha)
    x, y = account.points[u]
    rows = np.array([at, at + 1, wall, wall + 1])
    h = np.array([c, s, c * y - s * x, -1.0])
    return float(h @ cov[np.ix_(rows, rows)] @ h)
