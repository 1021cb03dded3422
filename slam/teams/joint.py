"""Several accounts as one Gaussian, under the condition that landmarks which are the same are in the same place.

Errors of different robots are independent, so the accounts side by side are Gaussian with a block-diagonal
covariance P. A link says that two landmarks coincide: h(x, T) = f(T_i, x_iu) − f(T_j, x_jv) = 0, where f takes
a landmark into the common frame. Frames that are known are part of x with their covariance; of those that are not
nothing is assumed. With H and G the Jacobians of h by x and by the unknown frames, S = H P Hᵀ and
ρ = h + H (x̂ − x), one Gauss-Newton step is (generalised least squares)

    C = (Gᵀ S⁻¹ G)⁻¹,  δT = −C Gᵀ S⁻¹ ρ,  x = x̂ − K (ρ + G δT),  K = P Hᵀ S⁻¹

and at the end cov T = C, cov x = P − K S Kᵀ + K G C Gᵀ Kᵀ, cov(x, T) = −K G C. Each link counts once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve

from slam.accounts.account import Account
from slam.geometry import wrap
from slam.settings import Config, Within
from slam.teams.frames import points_into, walls_into
from slam.types import Array, Indices

__all__ = ["Frame", "Joint", "Link", "SameConfig", "joint_of", "own_cov"]

Frame = tuple[Array, Array | None]
"""Pose ``(3,)`` of a robot's frame in the common one, and its covariance ``(3, 3)``; None: nothing is known of it
but this first guess."""

Link = tuple[int, int, int, int]
"""Account and landmark that are the same as an account's landmark; landmarks are points, then walls, by row."""

_STEPS = 20
_STILL = 1e-8  # [m, rad]


@dataclass(frozen=True, kw_only=True)
class SameConfig(Config):
    """How much of what two robots find of one landmark differs beyond their filters' covariances.

    Corners are seen from other sides, walls in other pieces; an account's landmarks are each given so much of an
    error of their own. Chosen so that NEES of alignments and merged corners in apartments of the
    training seeds 0-149 is near 1.
    """

    point_sigma_m: Annotated[float, Within("[0, 10]")] = 0.0005
    wall_sigma_m: Annotated[float, Within("[0, 10]")] = 0.0005  # across it, in the middle of what was seen
    wall_sigma_rad: Annotated[float, Within("[0, 10]")] = 0.0003


@dataclass(frozen=True, kw_only=True, eq=False)
class Joint:
    """All accounts given all links: x are the accounts' states one after the other, each in its own frame."""

    x: Array  # (s,)
    frames: Array  # (N, 3) poses of the accounts' frames in the common one
    cov: Array  # (s + 3N,) squared: of x, then of the frames
    starts: Indices  # (N,) where an account's state begins in x
    chi_square: float  # of the links, χ² with dof degrees of freedom where all of them are true
    dof: int
    outlying: Array  # (links,) how far each link is from what all others say, χ² with 2 degrees of freedom


def own_cov(account: Account, same: SameConfig) -> Array:
    """Return an account's covariance with what :class:`SameConfig` adds to each landmark."""
    cov = account.cov.copy()
    n, k = len(account.points), len(account.walls)
    at = np.arange(3, 3 + 2 * n)
    cov[at, at] += same.point_sigma_m**2
    # A turn about the middle of the piece moves the wall's r by how far that is from the foot, along the wall.
    alpha = account.walls[:, 0]
    middle = account.wall_ends.reshape(-1, 2, 2).mean(axis=1)
    along = middle[:, 1] * np.cos(alpha) - middle[:, 0] * np.sin(alpha)
    a, r = 3 + 2 * n + 2 * np.arange(k), 4 + 2 * n + 2 * np.arange(k)
    turn = same.wall_sigma_rad**2
    cov[a, a] += turn
    cov[a, r] += along * turn
    cov[r, a] += along * turn
    cov[r, r] += along**2 * turn + same.wall_sigma_m**2
    return cov


def joint_of(
    accounts: Sequence[Account], frames: Sequence[Frame], links: Sequence[Link], same: SameConfig | None = None
) -> Joint:
    """Return the accounts as one Gaussian under all links, relinearised until nothing moves.

    Raises
    ------
    ValueError
        Where the links leave an unknown frame undetermined, or are no links of different accounts.
    """
    sizes = [len(account.cov) for account in accounts]
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    s, count = int(starts[-1]), len(accounts)
    known = [cov is not None for _, cov in frames]
    same = same or SameConfig()
    prior = block_diag(*(own_cov(a, same) for a in accounts), *(c for _, c in frames if c is not None))
    # y: x, then all frames; the columns of those that are known belong to H, the others to G.
    taken = np.repeat(known, 3)
    columns_h = np.concatenate([np.ones(s, bool), taken])
    y_hat = np.concatenate([*(a.state for a in accounts), *(np.asarray(pose) for pose, _ in frames)])
    y = y_hat.copy()
    free = int(3 * count - taken.sum())
    for _ in range(_STEPS):
        residual, jacobian = _linearised(accounts, starts[:-1], links, y)
        h, g = jacobian[:, columns_h], jacobian[:, ~columns_h]
        rho = residual + h @ (y_hat - y)[columns_h]
        crossed = prior @ h.T
        spread = h @ crossed
        try:
            factor = cho_factor(spread) if len(links) else None
            whitened_g = cho_solve(factor, g) if factor is not None else g
            cov_free = np.linalg.inv(g.T @ whitened_g) if free else np.zeros((0, 0))
        except (LinAlgError, np.linalg.LinAlgError) as error:
            raise ValueError("the links leave a frame undetermined; give more of them, or its pose") from error
        step = np.empty_like(y)
        moved = -cov_free @ (whitened_g.T @ rho)
        left = rho + g @ moved
        weighed = cho_solve(factor, left) if factor is not None else left
        step[~columns_h] = moved
        step[columns_h] = (y_hat - y)[columns_h] - crossed @ weighed
        y += step
        if np.abs(step).max() < _STILL:
            break
    gain = cho_solve(factor, crossed.T).T if factor is not None else crossed
    gain_g = gain @ g
    cov = np.empty((len(y), len(y)))
    cov[np.ix_(columns_h, columns_h)] = prior - gain @ crossed.T + gain_g @ cov_free @ gain_g.T
    cov[np.ix_(columns_h, ~columns_h)] = -gain_g @ cov_free
    cov[np.ix_(~columns_h, columns_h)] = (-gain_g @ cov_free).T
    cov[np.ix_(~columns_h, ~columns_h)] = cov_free
    cov = 0.5 * (cov + cov.T)
    outlying = np.zeros(len(links))
    if factor is not None:
        weight = cho_solve(factor, np.eye(len(left))) - whitened_g @ cov_free @ whitened_g.T
        for k in range(len(links)):
            w, block = weighed[2 * k : 2 * k + 2], weight[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
            outlying[k] = w @ np.linalg.lstsq(block, w, rcond=None)[0]
    chi_square = float(left @ weighed)
    return Joint(
        x=y[:s], frames=np.column_stack([y[s::3], y[s + 1 :: 3], wrap(y[s + 2 :: 3])]), cov=cov,
        starts=starts[:-1],
        chi_square=chi_square, dof=2 * len(links) - free, outlying=outlying,
    )  # fmt: skip


def _linearised(
    accounts: Sequence[Account], starts: Indices, links: Sequence[Link], y: Array
) -> tuple[Array, Array]:
    """Return h ``(2 links,)`` and its Jacobian by x and all frames ``(2 links, s + 3N)``."""
    count = len(accounts)
    s = len(y) - 3 * count
    residual, jacobian = np.zeros(2 * len(links)), np.zeros((2 * len(links), len(y)))
    placed = []
    for i, account in enumerate(accounts):
        n = len(account.points)
        features = y[starts[i] + 3 : starts[i] + len(account.cov)].reshape(-1, 2)
        frame = y[s + 3 * i : s + 3 * i + 3]
        points, walls = points_into(frame, features[:n]), walls_into(frame, features[n:])
        placed.append([np.concatenate(pair) for pair in zip(points, walls, strict=True)])
    for k, (i, u, j, v) in enumerate(links):
        wall = u >= len(accounts[i].points)
        if i == j or wall != (v >= len(accounts[j].points)):
            raise ValueError(f"a link joins points or walls of two accounts, not {(i, u, j, v)}")
        rows = slice(2 * k, 2 * k + 2)
        residual[rows] = placed[i][0][u] - placed[j][0][v]
        if wall:
            residual[2 * k] = wrap(residual[2 * k])
        for sign, a, row in ((1.0, i, u), (-1.0, j, v)):
            at = starts[a] + 3 + 2 * row
            jacobian[rows, at : at + 2] = sign * placed[a][1][row]
            jacobian[rows, s + 3 * a : s + 3 * a + 3] = sign * placed[a][2][row]
    return residual, jacobian
