"""Where one robot's frame lies in another's, found by what both have mapped: never a guess.

Candidates come from corners (``constellation``). Each is fitted to all landmarks of both accounts together
(``joint``), and one is taken only if it explains much, contradicts nothing, and has no rival that explains nearly
as much: rooms repeat, and a corridor looks the same from both ends. Else the answer is None.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from slam.accounts.account import Account
from slam.geometry import compose, inverse, wrap
from slam.grids.occupancy import OccupancyGrid
from slam.metrics.chi_square import chi2_quantile
from slam.settings import Config, Gap, NotNegative, Share, Within
from slam.teams.constellation import ConstellationConfig, candidates, rigid_fit, same_landmarks
from slam.teams.contradiction import contradiction
from slam.teams.joint import Joint, Link, SameConfig, joint_of
from slam.types import Array, Flags, Indices

__all__ = ["Alignment", "AlignmentConfig", "align", "same_place"]

Pairs = Indices

_IDENTITY = (np.zeros(3), np.zeros((3, 3)))


@dataclass(frozen=True, kw_only=True)
class AlignmentConfig(Config):
    """What an alignment takes to be believed."""

    constellation: ConstellationConfig = field(default_factory=ConstellationConfig)
    same: SameConfig = field(default_factory=SameConfig)
    # Matched corners, and corners and walls together. In apartments of the training seeds 50-249 up to 7 and 15 of
    # them agreed on a wrong place, and never without a quarter of one map's walls in the other's free space.
    fewest: Annotated[tuple[int, int], Within("[1, 1000]")] = (2, 8)
    fewest_without_grids: Annotated[tuple[int, int], Within("[1, 1000]")] = (9, 22)
    # Where to look is known, and walls alone fix a frame: in bare rooms and round ones few corners are matched.
    fewest_with_prior: Annotated[tuple[int, int], Within("[0, 1000]")] = (0, 4)
    rival_share: NotNegative = 0.6  # of the best one's matches that any other may explain
    rival_m: Gap = 0.5  # farther off than this, or turned by more, it is another one
    rival_rad: Gap = 0.15
    # Probability of χ² of all matches together, and that none of them …
    gate: Annotated[float, Within("(0, 1)")] = 0.999
    outlier_gate: Annotated[float, Within("(0, 1)")] = 0.9999  # … has of being farther from what the others say
    most_refused: Share = 0.25  # share of the matches that may fail there
    most_contradicted: Share = 0.05  # share of one map's walls that may stand in the other's free space
    sigma_m: NotNegative = 0.1  # an alignment not known to within this is none
    sigma_rad: NotNegative = 0.03
    prior_gate: Annotated[float, Within("(0, 1)")] = 0.9999  # probability of χ² with 3 degrees of freedom


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """The frame of account b in that of account a, and what says so."""

    a: int  # the accounts' robots
    b: int
    pose: Array  # (3,) x [m], y [m], θ [rad] of b's frame in a's
    cov: Array  # (3, 3) in ordinary coordinates
    points: Pairs  # (k, 2) rows of the corners in a and b that are the same
    walls: Pairs  # (m, 2) the same of walls
    rival: float  # matches that the next best explains, as a share
    contradicted: float  # share of walls in the other's free space; nan without grids

    @property
    def matches(self) -> int:
        """How many landmarks are the same."""
        return len(self.points) + len(self.walls)


def align(
    a: Account, b: Account, config: AlignmentConfig | None = None, *,
    grids: tuple[OccupancyGrid, OccupancyGrid] | None = None, prior: tuple[Array, Array] | None = None,
) -> Alignment | None:  # fmt: skip
    """Return where b's frame lies in a's, or None where that cannot be told for sure.

    Parameters
    ----------
    a, b
        Accounts of two robots.
    config
        What it takes.
    grids
        The maps of a and b, each in its own frame; walls of one must not stand in free space of the other.
    prior
        Pose ``(3,)`` and covariance ``(3, 3)`` of b's frame in a's from elsewhere (known starts, a sighting):
        where to look. It only gates: the alignment speaks of the landmarks alone, and nothing counts twice.
    """
    config = config or AlignmentConfig()
    guesses = list(candidates(a, b, config.constellation))
    if prior is not None:
        guesses = [prior[0], *(guess for guess in guesses if _near_prior(guess, np.zeros((3, 3)), prior, config))]
    found: list[_Fit] = []
    for guess in guesses:
        fit = _fit(a, b, guess, config, grids)
        if fit is None or (
            prior is not None and not _near_prior(fit.pose, fit.joint.cov[-3:, -3:], prior, config)
        ):
            continue
        if not any(same_place(fit.pose, other.pose, config) for other in found):
            found.append(fit)
    found.sort(key=lambda fit: -fit.matches)
    if not found:
        return None
    rival = found[1].matches / found[0].matches if len(found) > 1 else 0.0
    fewest = config.fewest if grids is not None else config.fewest_without_grids
    fewest = config.fewest_with_prior if prior is not None else fewest
    if rival > config.rival_share or not _believable(found[0], fewest, config):
        return None
    fit = found[0]
    return Alignment(
        a=a.robot, b=b.robot, pose=fit.pose, cov=fit.joint.cov[-3:, -3:], points=fit.points, walls=fit.walls,
        rival=rival, contradicted=fit.contradicted,
    )  # fmt: skip


class _Fit(NamedTuple):
    """A candidate, fitted to all landmarks that it says are the same."""

    joint: Joint
    points: Pairs
    walls: Pairs
    refused: float  # share of the matches that did not agree
    contradicted: float

    @property
    def pose(self) -> Array:
        return np.asarray(self.joint.frames[1], np.float64)

    @property
    def matches(self) -> int:
        return len(self.points) + len(self.walls)


def _fit(
    a: Account, b: Account, guess: Array, config: AlignmentConfig,
    grids: tuple[OccupancyGrid, OccupancyGrid] | None,
) -> _Fit | None:  # fmt: skip
    """Fit a candidate; None where there is nothing to fit, or one map's walls stand in the other's free space."""
    pose = guess
    for tolerance in config.constellation.tolerances_m:
        points, walls = same_landmarks(a, b, pose, tolerance, config.constellation)
        if len(points) + len(walls) < 2:
            return None
        pose = rigid_fit(a, b, pose, points, walls)
    if not same_place(guess, pose, config):
        return None
    contradicted = math.nan if grids is None else contradiction(*grids, pose)
    if contradicted > config.most_contradicted:
        return None
    matched = len(points) + len(walls)
    while True:
        try:
            joint = joint_of((a, b), [_IDENTITY, (pose, None)], _links(a, b, points, walls), config.same)
        except ValueError:  # parallel walls alone
            return None
        kept = _agreeing(joint, config)
        refused = 1.0 - kept.sum() / matched
        if kept.all() or refused > config.most_refused or kept.sum() < 2:
            return _Fit(joint, points, walls, refused, contradicted)
        points, walls = points[kept[: len(points)]], walls[kept[len(points) :]]


def _agreeing(joint: Joint, config: AlignmentConfig) -> Flags:
    """Return which links may stay: the one that is farthest off goes, while any is, or all together are, too far.

    Joint compatibility (Neira and Tardós 2001), by Baarda's test of one observation against the rest.
    """
    kept = np.ones(len(joint.outlying), bool)
    worst = int(np.argmax(joint.outlying))
    alone = joint.outlying[worst] > chi2_quantile(config.outlier_gate, 2)
    if alone or (joint.dof > 0 and joint.chi_square > chi2_quantile(config.gate, joint.dof)):
        kept[worst] = False
    return kept


def _believable(fit: _Fit, fewest: tuple[int, int], config: AlignmentConfig) -> bool:
    variances = np.diag(fit.joint.cov[-3:, -3:])  # of landmarks without noise one may round to below zero
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    return bool(
        len(fit.points) >= fewest[0] and fit.matches >= fewest[1] and fit.refused <= config.most_refused
        and variances.min() > 0.0 and sigmas[:2].max() <= config.sigma_m and sigmas[2] <= config.sigma_rad
    )  # fmt: skip


def _links(a: Account, b: Account, points: Pairs, walls: Pairs) -> list[Link]:
    n, m = len(a.points), len(b.points)
    return [(0, int(u), 1, int(v)) for u, v in points] + [(0, n + int(u), 1, m + int(v)) for u, v in walls]


def same_place(one: Array, other: Array, config: AlignmentConfig) -> bool:
    """Tell whether two poses ``(3,)`` of a frame are one place but for errors."""
    apart = compose(inverse(one), other)
    return bool(np.hypot(*apart[:2]) < config.rival_m and abs(apart[2]) < config.rival_rad)


def _near_prior(pose: Array, cov: Array, prior: tuple[Array, Array], config: AlignmentConfig) -> bool:
    error = pose - prior[0]
    error[2] = wrap(error[2])
    return bool(error @ np.linalg.solve(prior[1] + cov, error) < chi2_quantile(config.prior_gate, 3))
