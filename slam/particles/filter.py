"""FastSLAM's particles as kernels: predict, narrow by matched landmarks, draw (docs/reference/fastslam.md)."""

from __future__ import annotations

import math

from numba import njit

from slam.geometry import wrap_scalar
from slam.motion import predict_robot
from slam.particles.maps import correct_landmark, innovation, own
from slam.types import Array, Indices

__all__ = ["correct_particles", "draw", "narrow", "predict_particles"]


_LOG_2PI = math.log(2.0 * math.pi)


@njit(cache=True, nogil=True, error_model="numpy")
def predict_particles(poses: Array, covs: Array, twists: Array, dt: float, var_v: float, var_w: float) -> None:
    """Move every particle's pose Gaussian by its own twist ``(n, 3)``, with V's variances."""
    for i in range(poses.shape[0]):
        predict_robot(poses[i], covs[i], 3, twists[i, 0], twists[i, 1], twists[i, 2], dt, var_v, var_w)


@njit(cache=True, nogil=True, error_model="numpy")
def correct_particles(
    poses: Array, covs: Array, normals: Array, log_weights: Array, z: Array, match: Indices, offset: float,
    unexplained: float, table: Indices, records: Array, references: Indices, free: Indices, free_count: Indices,
) -> None:  # fmt: skip
    """Narrow each particle's pose by what it sees, weigh it, draw the pose, correct the landmarks seen.

    The weight is p(z | the path so far): of each observation the predictive likelihood, given those before.
    """
    for i in range(poses.shape[0]):
        log_weights[i] += narrow(poses[i], covs[i], records, table[i], z, match[i], offset, unexplained)
        if covs[i, 0, 0] + covs[i, 1, 1] + covs[i, 2, 2] > 0.0:
            draw(poses[i], covs[i], normals[i])
        c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        for k in range(z.shape[0]):
            if match[i, k] < 0:
                continue
            before = records[table[i, match[i, k]]]
            after = records[own(i, match[i, k], table, references, free, free_count)]
            correct_landmark(poses[i], c, s, offset, z[k], before, after)


@njit(cache=True, nogil=True, error_model="numpy")
def narrow(
    pose: Array, p: Array, records: Array, table: Indices, z: Array, match: Indices, offset: float,
    unexplained: float,
) -> float:  # fmt: skip
    """Update the Gaussian of a particle's pose by all its matches, in turn; return the log likelihood of ``z``.

    S = H_x P H_xᵀ + H_m P_m H_mᵀ + R (docs/reference/fastslam.md, Weights); ``p`` is an upper triangle.
    """
    total = 0.0
    spread = p[0, 0] + p[1, 1] + p[2, 2] > 0.0
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    for k in range(z.shape[0]):
        r00, r01, r11 = z[k, 2], z[k, 3], z[k, 4]
        if match[k] < 0:
            total -= 0.5 * (unexplained + math.log(r00 * r11 - r01 * r01)) + _LOG_2PI
            continue
        m = records[table[match[k]]]
        u, v, a, b, c, d, e, f = innovation(pose, cosine, sine, offset, m[0], m[1], z[k])
        s00 = r00 + a * a * m[2] + 2.0 * a * b * m[3] + b * b * m[4]
        s01 = r01 + a * d * m[2] + (a * e + b * d) * m[3] + b * e * m[4]
        s11 = r11 + d * d * m[2] + 2.0 * d * e * m[3] + e * e * m[4]
        gx = gy = gt = hx = hy = ht = 0.0  # P H_xᵀ, column by column
        if spread:
            gx, hx = p[0, 0] * a + p[0, 1] * b + p[0, 2] * c, p[0, 0] * d + p[0, 1] * e + p[0, 2] * f
            gy, hy = p[0, 1] * a + p[1, 1] * b + p[1, 2] * c, p[0, 1] * d + p[1, 1] * e + p[1, 2] * f
            gt, ht = p[0, 2] * a + p[1, 2] * b + p[2, 2] * c, p[0, 2] * d + p[1, 2] * e + p[2, 2] * f
            s00 += a * gx + b * gy + c * gt
            s01 += d * gx + e * gy + f * gt
            s11 += d * hx + e * hy + f * ht
        # With S = L Lᵀ: y = L⁻¹ ν, W = L⁻¹ H P, x += Wᵀ y, P ← P − Wᵀ W.
        l00 = math.sqrt(s00)
        l10 = s01 / l00
        l11 = math.sqrt(s11 - l10 * l10)
        y0 = u / l00
        y1 = (v - l10 * y0) / l11
        total -= 0.5 * (y0 * y0 + y1 * y1) + math.log(l00 * l11) + _LOG_2PI
        if not spread:
            continue
        gx, gy, gt = gx / l00, gy / l00, gt / l00
        hx, hy, ht = (hx - l10 * gx) / l11, (hy - l10 * gy) / l11, (ht - l10 * gt) / l11
        pose[0] += gx * y0 + hx * y1
        pose[1] += gy * y0 + hy * y1
        pose[2] = wrap_scalar(pose[2] + gt * y0 + ht * y1)
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        p[0, 0] -= gx * gx + hx * hx
        p[0, 1] -= gx * gy + hx * hy
        p[0, 2] -= gx * gt + hx * ht
        p[1, 1] -= gy * gy + hy * hy
        p[1, 2] -= gy * gt + hy * ht
        p[2, 2] -= gt * gt + ht * ht
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def draw(pose: Array, p: Array, normal: Array) -> None:
    """Draw the pose from its Gaussian and clear the covariance: the pose is known from here on.

    By p's Cholesky factor; where rounding has left no variance, nothing is added.
    """
    l00 = math.sqrt(max(p[0, 0], 0.0))
    l10, l20 = (p[0, 1] / l00, p[0, 2] / l00) if l00 > 0.0 else (0.0, 0.0)
    l11 = math.sqrt(max(p[1, 1] - l10 * l10, 0.0))
    l21 = (p[1, 2] - l20 * l10) / l11 if l11 > 0.0 else 0.0
    l22 = math.sqrt(max(p[2, 2] - l20 * l20 - l21 * l21, 0.0))
    pose[0] += l00 * normal[0]
    pose[1] += l10 * normal[0] + l11 * normal[1]
    pose[2] = wrap_scalar(pose[2] + l20 * normal[0] + l21 * normal[1] + l22 * normal[2])
    p[:, :] = 0.0
