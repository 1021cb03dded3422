"""Weights of particles: what they sum up to, when and how they are resampled (docs/reference/fastslam.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import njit

from slam.geometry import wrap, wrap_scalar
from slam.settings import Config, Count, OneOf, PositiveShare
from slam.types import Array, Indices

__all__ = ["ResamplingPolicy", "effective_particles", "normalise", "pose_moments", "scattered", "systematic"]


@dataclass(frozen=True, kw_only=True)
class ResamplingPolicy(Config):
    """When particles are resampled: after every update, after every k-th, or once the weights are too uneven."""

    when: Annotated[str, OneOf(("n_eff", "every_step", "every_k"))] = "n_eff"  # or "every_step", "every_k"
    every: Count = 5  # k, of "every_k"
    share: PositiveShare = 0.5  # "n_eff": resampled where N_eff is below this share of the particles

    def due(self, n_eff: float, particles: int, updates: int) -> bool:
        """Tell whether to resample now, ``updates`` (≥ 1) after the last time."""
        if self.when == "n_eff":
            return n_eff < self.share * particles
        return self.when == "every_step" or updates >= self.every


def scattered(pose: Array, pose_cov: Array, particles: int, rng: np.random.Generator) -> Array:
    """Return poses ``(particles, 3)`` drawn from the Gaussian of a start pose."""
    variances, axes = np.linalg.eigh(pose_cov)
    spread = axes * np.sqrt(np.maximum(variances, 0.0))
    poses: Array = pose + rng.standard_normal((particles, 3)) @ spread.T
    poses[:, 2] = wrap(poses[:, 2])
    return poses


@njit(cache=True, nogil=True, error_model="numpy")
def normalise(log_weights: Array, weights: Array) -> None:
    """Make the weights ``(n,)`` of log weights ``(n,)`` sum to one; both are written.

    Where no particle has any likelihood left, none is preferred: they weigh the same.
    """
    n = log_weights.shape[0]
    largest = -math.inf
    for i in range(n):
        if math.isnan(log_weights[i]) or log_weights[i] == math.inf:
            log_weights[i] = -math.inf
        largest = max(largest, log_weights[i])
    total = 0.0
    for i in range(n):
        weights[i] = math.exp(log_weights[i] - largest) if largest > -math.inf else 1.0
        total += weights[i]
    shift = largest + math.log(total) if largest > -math.inf else 0.0
    for i in range(n):
        weights[i] /= total
        log_weights[i] = log_weights[i] - shift if largest > -math.inf else math.log(weights[i])


@njit(cache=True, nogil=True, error_model="numpy")
def effective_particles(weights: Array) -> float:
    """Return N_eff = 1 / Σ w² of normalised weights: from 1 (one has it all) to n (all the same)."""
    total = 0.0
    for i in range(weights.shape[0]):
        total += weights[i] * weights[i]
    return 1.0 / total


@njit(cache=True, nogil=True, error_model="numpy")
def systematic(weights: Array, uniform: float, ancestors: Indices) -> None:
    """Resample systematically: fill ``ancestors`` ``(n,)`` with the particle that each one descends from.

    The points (u + j) / n, j = 0 … n-1, on the cumulated weights: one ``uniform`` number in [0, 1) for all, and a
    particle of weight w has ⌊n w⌋ or ⌈n w⌉ descendants, n w on average. A particle that survives keeps its place,
    and the places of the others go to the copies in order: so only those need copying.
    """
    n = weights.shape[0]
    copies = np.zeros(n, np.int64)
    cumulated, taken, heaviest = 0.0, 0, 0
    for i in range(n):
        cumulated += n * weights[i]
        # The points below the cumulated weight: u + j < c. Rounding must neither make nor lose a particle.
        below = min(max(math.ceil(cumulated - uniform), taken), n)
        copies[i] = below - taken
        taken = below
        if weights[i] > weights[heaviest]:
            heaviest = i
    copies[heaviest] += n - taken
    source = 0
    for i in range(n):
        if copies[i] > 0:
            ancestors[i] = i
            continue
        while copies[source] < 2:
            source += 1
        ancestors[i] = source
        copies[source] -= 1


@njit(cache=True, nogil=True, error_model="numpy")
def pose_moments(poses: Array, covs: Array, weights: Array, floor: Array, mean: Array, cov: Array) -> None:
    """Write the mean pose and its covariance ``(3, 3)``; ``floor`` ``(3,)`` are the σ that are always added.

    The covariance is the mean of the particles' own, plus how much their poses differ.
    """
    sine = cosine = 0.0
    for i in range(poses.shape[0]):
        mean[0] += weights[i] * (poses[i, 0] - poses[0, 0])
        mean[1] += weights[i] * (poses[i, 1] - poses[0, 1])
        cosine += weights[i] * math.cos(poses[i, 2])
        sine += weights[i] * math.sin(poses[i, 2])
    mean[0] += poses[0, 0]
    mean[1] += poses[0, 1]
    mean[2] = wrap_scalar(math.atan2(sine, cosine))
    for i in range(poses.shape[0]):
        dx, dy = poses[i, 0] - mean[0], poses[i, 1] - mean[1]
        dt = wrap_scalar(poses[i, 2] - mean[2])
        w = weights[i]
        cov[0, 0] += w * (covs[i, 0, 0] + dx * dx)
        cov[0, 1] += w * (covs[i, 0, 1] + dx * dy)
        cov[0, 2] += w * (covs[i, 0, 2] + dx * dt)
        cov[1, 1] += w * (covs[i, 1, 1] + dy * dy)
        cov[1, 2] += w * (covs[i, 1, 2] + dy * dt)
        cov[2, 2] += w * (covs[i, 2, 2] + dt * dt)
    for a in range(3):
        cov[a, a] += floor[a] * floor[a]
        for b in range(a):
            cov[a, b] = cov[b, a]
