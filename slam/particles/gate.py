"""Which observations no mixture of particles can explain: the gate of an EKF, over all particles together."""

from __future__ import annotations

import numpy as np

from slam.geometry import wrap
from slam.landmarks.association import IGNORED
from slam.particles.maps import ParticleMaps
from slam.types import Array, Indices

__all__ = ["refuse_unlikely"]


def refuse_unlikely(
    poses: Array, covs: Array, weights: Array, maps: ParticleMaps, offset: float, z: Array, gate: float,
    rows: Indices,
) -> None:  # fmt: skip
    """Set to IGNORED the matches ``(m,)``, given from outside, beyond a squared Mahalanobis distance.

    All particles refuse an observation or none: a particle that refused what others explain would be weighed
    against them by something else than they are. What is expected is the mixture of what particles expect, by its
    mean and covariance: Σ w (S + ν νᵀ) − ν̄ ν̄ᵀ with each one's S = H_x P_x H_xᵀ + H_m P_m H_mᵀ + R.

    Parameters
    ----------
    poses, covs, weights
        ``(n, 3)``, ``(n, 3, 3)`` upper triangles, ``(n,)`` of sum 1.
    z
        ``(m, ≥ 5)``: range, bearing, and the three distinct terms of their covariance.
    """
    upper = np.triu(covs)
    full = upper + np.triu(covs, 1).transpose(0, 2, 1)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    for k in np.flatnonzero(rows >= 0).tolist():
        mean_x, mean_y, xx, xy, yy = maps.records[maps.table[:, rows[k]]].T
        dx, dy = poses[:, 0] + offset * c - mean_x, poses[:, 1] + offset * s - mean_y
        rho = np.maximum(np.hypot(dx, dy), 1e-6)
        nx, ny = dx / rho, dy / rho
        h = np.empty((len(poses), 2, 3))  # docs/reference/ekf.md, Observe
        h[:, 0] = np.column_stack([nx, ny, offset * (ny * c - nx * s)])
        h[:, 1] = np.column_stack([-ny / rho, nx / rho, offset * (nx * c + ny * s) / rho - 1.0])
        innovation = np.column_stack([z[k, 0] - rho, wrap(z[k, 1] - np.arctan2(-dy, -dx) + poses[:, 2])])
        landmark = np.stack([np.stack([xx, xy], 1), np.stack([xy, yy], 1)], 1)
        by_place = h[:, :, :2]  # less its sign
        spread = h @ full @ h.transpose(0, 2, 1) + by_place @ landmark @ by_place.transpose(0, 2, 1)
        mean = weights @ innovation
        off = innovation - mean
        cov = np.tensordot(weights, spread + off[:, :, None] * off[:, None, :], 1)
        cov += np.array([[z[k, 2], z[k, 3]], [z[k, 3], z[k, 4]]])
        if mean @ np.linalg.solve(cov, mean) > gate:
            rows[k] = IGNORED
