"""What an account leaves unsaid of its corners: on which walls they lie, and how far the end of a wall is off.

The filter takes from a corner only what the walls that make it do not say (docs/reference/features.md), so across
a wall a corner's own covariance is centimetres wide, where the wall is known to a millimetre or two. Here such a
corner is read off its wall: its foot on the wall, or where two walls cross. Both are functions of the account's
state, so the covariance goes over by their Jacobian and nothing is counted twice.

Where a surface is seen to end, a corner's error lasts along the surface. A filter cannot say that of white noise,
and takes so much of it that the sum is no less. How much of the variance is the corner's own, its covariance
tells: it is what is left where all else is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from slam.accounts.account import Account
from slam.metrics.chi_square import chi2_quantile
from slam.settings import Angle, Config, Length, Share, Within
from slam.types import CONVEX, Array

__all__ = ["CornerConfig", "settled"]

_NOTHING = 1e-12  # [m²] lets a covariance be inverted in which something is exactly known
_FACING = 0.3  # cosine; a corner's bisector makes 45° with the free side of either wall


@dataclass(frozen=True, kw_only=True)
class CornerConfig(Config):
    """Which walls a corner lies on, and how far off ends are; chosen in apartments of training seeds 0-249."""

    off_m: Length = 0.05  # from the wall …
    beyond_m: Length = 0.15  # … and past what was seen of it
    gate: Annotated[float, Within("(0, 1)")] = 0.997  # probability of χ² of the distance from the wall
    crossing_rad: Angle = 0.96  # least angle between two walls that make a corner
    # The end of a surface lies between two beams: a uniform error, of a twelfth of the squared spacing. The filter
    # takes all of that, four times (FeatureConfig.edge_sigma and wall_lasting_scans) …
    end_share: Share = 1.0 / (12.0 * 4.0)
    end_sigma_m: Length = 0.0075  # … for this, which is much the same however often the end is seen


def settled(account: Account, config: CornerConfig | None = None) -> Account:
    """Return the account with its ends' errors as they are, and its corners on the walls on which they lie."""
    config = config or CornerConfig()
    if not len(account.points):
        return account
    return _on_walls(replace(account, cov=_with_lasting_ends(account, config)), config)


def _with_lasting_ends(account: Account, config: CornerConfig) -> Array:
    """Return the covariance with v → min(v, share · v + σ²), v being a convex corner's own largest variance.

    Own is what it has where all else is known: less by no more than that, one corner after the other, a covariance
    stays one. A corner where two surfaces meet has less than σ², and keeps it.
    """
    cov = account.cov.copy()
    information = np.linalg.inv(cov + _NOTHING * np.eye(len(cov)))
    for u in np.flatnonzero(account.kinds == CONVEX):
        at = slice(3 + 2 * u, 5 + 2 * u)
        variances, axes = np.linalg.eigh(np.linalg.inv(information[at, at]))
        less = variances[1] - (config.end_share * variances[1] + config.end_sigma_m**2)
        if less > 0.0:
            axis = axes[:, 1]
            cov[at, at] -= less * np.outer(axis, axis)
            column = information[:, at] @ axis
            information += np.outer(column, column) * (less / (1.0 - less * (axis @ column[at])))
    return cov


def _on_walls(account: Account, config: CornerConfig) -> Account:
    """Return the account with corners read off their walls, x' = f(x) with the covariance J P Jᵀ."""
    n, (alpha, r) = len(account.points), account.walls.T
    normals = np.column_stack([np.cos(alpha), np.sin(alpha)])
    tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
    ends = np.einsum("kei,ki->ke", account.wall_ends.reshape(-1, 2, 2), tangents)
    off, along = account.points @ normals.T - r, account.points @ tangents.T
    bisectors = np.column_stack([np.cos(account.directions), np.sin(account.directions)])
    likely = (np.abs(off) < config.off_m) & (bisectors @ normals.T < -_FACING)  # not so where it is not known
    likely &= np.maximum(ends.min(axis=1) - along, along - ends.max(axis=1)) < config.beyond_m
    points, jacobian, gate = account.points.copy(), np.eye(len(account.cov)), chi2_quantile(config.gate, 1)
    for u in range(n):
        walls = [j for j in np.flatnonzero(likely[u]) if off[u, j] ** 2 < gate * _variance(account, u, int(j))]
        if not walls:
            continue
        walls.sort(key=lambda j: abs(off[u, j]))
        first, at = walls[0], slice(3 + 2 * u, 5 + 2 * u)
        across = [j for j in walls if abs(normals[j] @ tangents[first]) > math.sin(config.crossing_rad)]
        if across:  # N x = r
            made_by = [first, across[0]]
            gains = np.linalg.inv(normals[made_by])
            points[u], jacobian[at, at] = gains @ r[made_by], 0.0
        else:  # x − n (nᵀx − r)
            made_by, gains = [first], normals[[first]].T
            points[u] -= normals[first] * off[u, first]
            jacobian[at, at] -= np.outer(normals[first], normals[first])
            jacobian[at, 3 + 2 * (n + first)] = -tangents[first] * off[u, first]
        for j, gain in zip(made_by, gains.T, strict=True):  # a turn of the wall moves it at the corner, too
            jacobian[at, 3 + 2 * (n + j)] -= gain * (tangents[j] @ points[u])
            jacobian[at, 4 + 2 * (n + j)] = gain
    cov = jacobian @ account.cov @ jacobian.T
    return replace(account, points=points, cov=0.5 * (cov + cov.T))


def _variance(account: Account, u: int, j: int) -> float:
    """Return the variance of a corner's distance from a wall, nᵀx − r."""
    alpha, at, wall = account.walls[j, 0], 3 + 2 * u, 3 + 2 * (len(account.points) + j)
    c, s = math.cos(alpha), math.sin(alpha)
    x, y = account.points[u]
    rows = np.array([at, at + 1, wall, wall + 1])
    h = np.array([c, s, c * y - s * x, -1.0])
    return float(h @ account.cov[np.ix_(rows, rows)] @ h)
