"""How likely a belief is true: a recursive Bayes filter over what scans and innovations say.

Two things can be wrong with a belief. It can be *lost*: the robot is somewhere else, and scans contradict the map.
A filter with two states, fine and lost, takes each scan's evidence in by the likelihoods of both. Or it can be
*too sure*: about right, yet by more off than the covariance says. No single scan tells of that. How often it is so
was measured; where landmarks are observed without a scan, it depends on how large the innovations are.

    health = P(fine) · P(within the 99.7 % region | fine)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from slam.health.evidence import Agreement
from slam.settings import Config, Count, Finite, Gap, Length, Share, Within, require

__all__ = ["HealthConfig", "HealthMonitor"]


@dataclass(frozen=True, kw_only=True)
class HealthConfig(Config):
    """What evidence weighs, and when a belief is given up.

    Likelihoods and weights were measured on rooms of seeds below 1000 and on two floors
    (docs/reference/health.md); they are properties of the evidence, not of a room.
    """

    recover: bool = True  # when lost, find the pose again and undo what was done meanwhile; else only tell
    glance_beams: Annotated[int, Within("[8, 10000]")] = 36  # of a scan that are looked at, at most …
    beams: Annotated[int, Within("[8, 10000]")] = 120  # … and where these do not agree
    fewest_beams: Count = 25  # that say anything, for a scan to count; fewer could not find it again, either
    # Upper edges of the bins of the share of beams in the open, and how often a scan of a robot that is fine, or
    # lost, falls into each: in logarithms, since products of them are taken.
    against_edges: Annotated[tuple[float, ...], Within("[0, 1]")] = (0.03, 0.08, 0.16, 0.3)
    against_fine: Annotated[tuple[float, ...], Within("[1e-9, 1]")] = (0.70, 0.20, 0.08, 0.015, 0.005)
    against_lost: Annotated[tuple[float, ...], Within("[1e-9, 1]")] = (0.06, 0.10, 0.15, 0.25, 0.44)
    # The same of the share of the beams on walls that end in the very cell of one.
    sharp_edges: Annotated[tuple[float, ...], Within("[0, 1]")] = (0.5, 0.65, 0.8, 0.9)
    sharp_fine: Annotated[tuple[float, ...], Within("[1e-9, 1]")] = (0.01, 0.06, 0.20, 0.30, 0.43)
    sharp_lost: Annotated[tuple[float, ...], Within("[1e-9, 1]")] = (0.35, 0.30, 0.20, 0.10, 0.05)
    # Scans one after the other err together: each counts as this part of one.
    scan_weight: Annotated[float, Within("[0, 10]")] = 0.3
    # How likely a robot gets lost from one scan to the next.
    lost_per_scan: Annotated[float, Within("[1e-9, 1)")] = 1e-5
    blur_m: Length = 0.1  # σ of the beams' ends, by the pose's covariance, at which a scan says half as much
    unsure_m: Gap = 0.3  # σ of the beams' ends, now or when they were drawn, at which an old drawing gives way
    doubt_against: Share = 0.1  # a scan with more in the open, or fewer sharp, is doubtful: it is only drawn …
    doubt_sharp: Share = 0.6  # … where it agrees from the corrected pose
    give_up: Annotated[float, Within("(0, 1)")] = 0.2  # P(fine) below which the belief is lost
    while_lost: Share = 0.02  # the health then
    found: Annotated[float, Within("(0, 1)")] = 0.9  # P(fine) right after a relocalisation
    # P(within the region | fine) = 1 / (1 + exp(-score)), score = bias less what innovations take off it: the
    # weight, times what the mean logarithm of NIS over its degrees of freedom has above where it begins to tell.
    bias: Finite = 3.5
    nis_weight: Finite = 2.9
    nis_from: Finite = 0.0
    memory: Annotated[float, Within("[1, 1e6]")] = 50.0  # updates that the mean is taken over

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("against", "sharp"):
            bins = len(getattr(self, f"{name}_edges")) + 1
            for state in ("fine", "lost"):
                values = getattr(self, f"{name}_{state}")
                require(
                    len(values) == bins,
                    f"HealthConfig.{name}_{state} must hold one more than {name}_edges, got {len(values)} values",
                )
        require(self.give_up < self.found, f"HealthConfig.give_up {self.give_up} must be below found {self.found}")


_LEAST_ODDS = 2e-5  # of being lost


class HealthMonitor:
    """Takes evidence in and says how likely the belief is true.

    Attributes
    ----------
    fine : float
        Probability that the robot is about where it is believed to be.
    sure : bool
        Whether a scan that agrees as ever would make no difference.
    health : float
        Probability that the true pose lies within the 99.7 % region of the belief.
    """

    def __init__(self, config: HealthConfig) -> None:
        self.config = config
        self._against = _log_ratios(config.against_lost, config.against_fine)
        self._sharp = _log_ratios(config.sharp_lost, config.sharp_fine)
        self.restart(1.0)

    def restart(self, fine: float) -> None:
        """Begin anew with this probability of being fine."""
        self._odds = (1.0 - fine) / max(fine, 1e-12)  # of being lost
        self._mean_nis = self.config.nis_from
        self._judge()

    @property
    def fine(self) -> float:
        """P(fine)."""
        return 1.0 / (1.0 + self._odds)

    def _judge(self) -> None:
        c = self.config
        score = c.bias - c.nis_weight * max(self._mean_nis - c.nis_from, 0.0)
        self.sure = self._odds <= _LEAST_ODDS
        self.health = 1.0 / ((1.0 + self._odds) * (1.0 + math.exp(-min(max(score, -30.0), 30.0))))

    def doubtful(self, seen: Agreement) -> bool:
        """Tell whether a scan speaks against the pose that it was looked at from."""
        if seen.beams < self.config.fewest_beams:
            return False
        return seen.against > self.config.doubt_against or seen.sharpness < self.config.doubt_sharp

    def take(self, seen: Agreement, variance: float) -> None:
        """Take in what a scan says, the ends of its beams being known to ``variance`` [m²]."""
        c = self.config
        odds = self._odds + c.lost_per_scan
        if seen.beams >= c.fewest_beams:
            ratio = self._against[_bin(seen.against, c.against_edges)]
            if seen.sharp + seen.blurred:
                ratio += self._sharp[_bin(seen.sharpness, c.sharp_edges)]
            odds *= math.exp(c.scan_weight * ratio / (1.0 + variance / c.blur_m**2))
        self._odds = min(max(odds, _LEAST_ODDS), 1e6)
        self._judge()

    def take_innovations(self, nis: float, dof: int) -> None:
        """Take in the NIS of an update with so many degrees of freedom."""
        if dof > 0 and math.isfinite(nis):
            value = math.log(max(nis / dof, 1e-3))
            self._mean_nis += (value - self._mean_nis) / self.config.memory
            self._judge()


def _log_ratios(lost: tuple[float, ...], fine: tuple[float, ...]) -> list[float]:
    return [math.log(a / b) for a, b in zip(lost, fine, strict=True)]


def _bin(value: float, edges: tuple[float, ...]) -> int:
    for k, edge in enumerate(edges):
        if value < edge:
            return k
    return len(edges)
