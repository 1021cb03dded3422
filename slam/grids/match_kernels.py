"""The kernels of :mod:`slam.grids.scan_matching`: drawing a field, searching it, climbing it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.types import Array, Floats

__all__ = ["BLOCK", "climb", "correlate", "field_sum", "prior_loss", "slope", "splat"]

BLOCK = 4
"""Shifts a side that one bound of the search stands for."""


@njit(cache=True, nogil=True, error_model="numpy")
def splat(values: Floats, x0: float, y0: float, cell: float, stamps: Floats, points: Array) -> None:
    """Raise the cells around each point ``(n, 2)`` to what a surface there gives them."""
    phases, half = stamps.shape[0], stamps.shape[2] // 2
    rows, cols = values.shape
    for k in range(points.shape[0]):
        u, v = (points[k, 0] - x0) / cell + 0.5, (points[k, 1] - y0) / cell + 0.5
        col, row = math.floor(u), math.floor(v)
        if not (-half <= col < cols + half and -half <= row < rows + half):
            continue
        stamp = stamps[int((v - row) * phases), int((u - col) * phases)]
        for i in range(max(row - half, 0), min(row + half + 1, rows)):
            line, out = stamp[i - row + half], values[i]
            for j in range(max(col - half, 0), min(col + half + 1, cols)):
                out[j] = max(out[j], line[j - col + half])


@njit(cache=True, nogil=True, error_model="numpy")
def correlate(
    values: Floats, bounds: Floats, x0: float, y0: float, cell: float, points: Array, guess: Array, shifts: int,
    turns: int, step: float, gain: float, info: Array,
) -> Array:  # fmt: skip
    """Return the pose with the highest sum of field values (times ``gain``, less the prior's loss)."""
    n, rows, cols = points.shape[0], values.shape[0], values.shape[1]
    angles, blocks = 2 * turns + 1, (2 * shifts + 1 + BLOCK - 1) // BLOCK
    row, col = np.empty((angles, n), np.int64), np.empty((angles, n), np.int64)
    upper = np.empty(angles * blocks * blocks)
    for a in range(angles):
        theta = guess[2] + (a - turns) * step
        c, s = math.cos(theta), math.sin(theta)
        for k in range(n):
            x = guess[0] + c * points[k, 0] - s * points[k, 1]
            y = guess[1] + s * points[k, 0] + c * points[k, 1]
            col[a, k] = math.floor((x - x0) / cell + 0.5) - shifts
            row[a, k] = math.floor((y - y0) / cell + 0.5) - shifts
        for i in range(blocks):
            for j in range(blocks):
                total = 0.0
                for k in range(n):
                    r, q = row[a, k] + i * BLOCK, col[a, k] + j * BLOCK
                    if 0 <= r < rows and 0 <= q < cols:
                        total += bounds[r, q]
                    elif -BLOCK < r < rows and -BLOCK < q < cols:  # the block reaches into the field
                        total += bounds[max(r, 0), max(q, 0)]
                upper[(a * blocks + i) * blocks + j] = gain * total
    best, found = 0.0, guess.copy()  # the guess itself, which no tie shall beat
    for k in range(n):
        r, q = row[turns, k] + shifts, col[turns, k] + shifts
        if 0 <= r < rows and 0 <= q < cols:
            best += gain * values[r, q]
    for index in np.argsort(-upper, kind="mergesort"):
        if upper[index] <= best:
            break  # every other block's bound is lower still; a prior only lowers
        a, i, j = index // (blocks * blocks), (index // blocks) % blocks, index % blocks
        for di in range(i * BLOCK, min((i + 1) * BLOCK, 2 * shifts + 1)):
            for dj in range(j * BLOCK, min((j + 1) * BLOCK, 2 * shifts + 1)):
                total = 0.0
                for k in range(n):
                    r, q = row[a, k] + di, col[a, k] + dj
                    if 0 <= r < rows and 0 <= q < cols:
                        total += values[r, q]
                dx, dy, dt = (dj - shifts) * cell, (di - shifts) * cell, (a - turns) * step
                value = gain * total - prior_loss(info, dx, dy, dt)
                if value > best:
                    best = value
                    found[0], found[1], found[2] = guess[0] + dx, guess[1] + dy, wrap_scalar(guess[2] + dt)
    return found


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def prior_loss(info: Array, dx: float, dy: float, dt: float) -> float:
    """Return what a prior of information ``(3, 3)`` loses [nat] at a distance from its mean."""
    loss: float = 0.5 * (
        info[0, 0] * dx * dx + info[1, 1] * dy * dy + info[2, 2] * dt * dt
        + 2.0 * (info[0, 1] * dx * dy + info[0, 2] * dx * dt + info[1, 2] * dy * dt)
    )  # fmt: skip
    return loss


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _weights(t: float) -> tuple[float, float, float]:
    """Return the quadratic B-spline's weights of three cells, ``t`` in [-½, ½] off the middle one."""
    return 0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)


@njit(cache=True, nogil=True, error_model="numpy")
def field_sum(values: Floats, x0: float, y0: float, cell: float, points: Array, pose: Array) -> float:
    """Return the sum of the interpolated field under the points ``(n, 2)`` seen from a pose; 0 outside."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    rows, cols = values.shape
    total = 0.0
    for k in range(points.shape[0]):
        u = (pose[0] + c * points[k, 0] - s * points[k, 1] - x0) / cell
        v = (pose[1] + s * points[k, 0] + c * points[k, 1] - y0) / cell
        j, i = math.floor(u + 0.5), math.floor(v + 0.5)
        if 1 <= i < rows - 1 and 1 <= j < cols - 1:
            p0, p1, p2 = _weights(u - j)
            q0, q1, q2 = _weights(v - i)
            total += q0 * (p0 * values[i - 1, j - 1] + p1 * values[i - 1, j] + p2 * values[i - 1, j + 1])
            total += q1 * (p0 * values[i, j - 1] + p1 * values[i, j] + p2 * values[i, j + 1])
            total += q2 * (p0 * values[i + 1, j - 1] + p1 * values[i + 1, j] + p2 * values[i + 1, j + 1])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def slope(
    values: Floats,
    x0: float,
    y0: float,
    cell: float,
    points: Array,
    pose: Array,
    gradient: Array,
    curvature: Array,
) -> float:
    """Return :func:`field_sum`; write its exact gradient ``(3,)`` and the curvature ``(3, 3)`` for Gauss-Newton.

    Of a ridge L = exp(-d²/2s²) the curvature is L n nᵀ/s², n its normal: L times minus the second derivative of
    log L, which stays positive where that of L itself does not.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    rows, cols = values.shape
    total = 0.0
    gradient[:] = 0.0
    curvature[:] = 0.0
    for k in range(points.shape[0]):
        rx, ry = c * points[k, 0] - s * points[k, 1], s * points[k, 0] + c * points[k, 1]
        u, v = (pose[0] + rx - x0) / cell, (pose[1] + ry - y0) / cell
        j, i = math.floor(u + 0.5), math.floor(v + 0.5)
        if not (1 <= i < rows - 1 and 1 <= j < cols - 1):
            continue
        t, w = u - j, v - i
        p0, p1, p2 = _weights(t)
        a0, a1, a2 = values[i - 1, j - 1], values[i - 1, j], values[i - 1, j + 1]
        b0, b1, b2 = values[i, j - 1], values[i, j], values[i, j + 1]
        c0, c1, c2 = values[i + 1, j - 1], values[i + 1, j], values[i + 1, j + 1]
        a, b, d = p0 * a0 + p1 * a1 + p2 * a2, p0 * b0 + p1 * b1 + p2 * b2, p0 * c0 + p1 * c1 + p2 * c2
        ax = (t - 0.5) * a0 - 2.0 * t * a1 + (t + 0.5) * a2
        bx = (t - 0.5) * b0 - 2.0 * t * b1 + (t + 0.5) * b2
        dx = (t - 0.5) * c0 - 2.0 * t * c1 + (t + 0.5) * c2
        q0, q1, q2 = _weights(w)
        m = q0 * a + q1 * b + q2 * d
        gx = q0 * ax + q1 * bx + q2 * dx
        gy = (w - 0.5) * a - 2.0 * w * b + (w + 0.5) * d
        total += m
        gradient[0] += gx / cell
        gradient[1] += gy / cell
        gradient[2] += (gy * rx - gx * ry) / cell
        if m < 0.02:
            continue
        xx = gx * gx / m - (q0 * (a0 - 2.0 * a1 + a2) + q1 * (b0 - 2.0 * b1 + b2) + q2 * (c0 - 2.0 * c1 + c2))
        yy = gy * gy / m - (a - 2.0 * b + d)
        xy = gx * gy / m - ((w - 0.5) * ax - 2.0 * w * bx + (w + 0.5) * dx)
        # Between two surfaces the field has a valley, where a direction may curve the other way: left out.
        mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
        root = math.sqrt(half * half + xy * xy)
        if mean + root <= 0.0:
            continue
        if mean - root < 0.0 < root:
            part = 0.5 * (mean + root) / root
            xx, yy, xy = part * (root + half), part * (root - half), part * xy
        xx, yy, xy = xx / (cell * cell), yy / (cell * cell), xy / (cell * cell)
        tx, ty = xy * rx - xx * ry, yy * rx - xy * ry
        curvature[0, 0] += xx
        curvature[0, 1] += xy
        curvature[1, 1] += yy
        curvature[0, 2] += tx
        curvature[1, 2] += ty
        curvature[2, 2] += ty * rx - tx * ry
    curvature[1, 0], curvature[2, 0], curvature[2, 1] = curvature[0, 1], curvature[0, 2], curvature[1, 2]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def climb(
    values: Floats, x0: float, y0: float, cell: float, points: Array, pose: Array, prior: Array, info: Array,
    gain: float, iterations: int, curvature: Array,
) -> float:  # fmt: skip
    """Move ``pose`` ``(3,)`` to the top of gain × field sum - prior's loss; return the field sum there.

    ``curvature`` ``(3, 3)`` becomes the information at the top, prior included. Steps that lead down are halved.
    """
    gradient, hessian, trial, step = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    total = 0.0
    for iteration in range(iterations + 1):
        total = slope(values, x0, y0, cell, points, pose, gradient, hessian)
        dx, dy, dt = pose[0] - prior[0], pose[1] - prior[1], wrap_scalar(pose[2] - prior[2])
        height = gain * total - prior_loss(info, dx, dy, dt)
        for a in range(3):
            gradient[a] = gain * gradient[a] - (info[a, 0] * dx + info[a, 1] * dy + info[a, 2] * dt)
            for b in range(3):
                curvature[a, b] = gain * hessian[a, b] + info[a, b]
        if iteration == iterations or not _solve(curvature, gradient, step):
            break
        reach = max(abs(step[0]), abs(step[1])) / (2.0 * cell) + abs(step[2]) / 0.1
        scale = 1.0 / max(reach, 1.0)
        better = False
        for _ in range(5):
            for a in range(3):
                trial[a] = pose[a] + scale * step[a]
            tx, ty, tt = trial[0] - prior[0], trial[1] - prior[1], wrap_scalar(trial[2] - prior[2])
            reached = gain * field_sum(values, x0, y0, cell, points, trial) - prior_loss(info, tx, ty, tt)
            if reached > height:
                better = True
                break
            scale *= 0.5
        if not better:
            break
        pose[0], pose[1], pose[2] = trial[0], trial[1], wrap_scalar(trial[2])
        if scale * (abs(step[0]) + abs(step[1]) + abs(step[2])) < 1e-4:
            total = slope(values, x0, y0, cell, points, pose, gradient, hessian)
            break
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(a: Array, b: Array, x: Array) -> bool:
    """Solve the damped symmetric 3 × 3 system by Cholesky; ``False`` where it is not positive."""
    d0 = a[0, 0] * 1.001 + 1e-3
    l10, l20 = a[1, 0] / d0, a[2, 0] / d0
    d1 = a[1, 1] * 1.001 + 1e-3 - l10 * l10 * d0
    if not (d0 > 0.0 and d1 > 0.0):
        return False
    l21 = (a[2, 1] - l20 * l10 * d0) / d1
    d2 = a[2, 2] * 1.001 + 1e-3 - l20 * l20 * d0 - l21 * l21 * d1
    if not d2 > 0.0:
        return False
    y0 = b[0]
    y1 = b[1] - l10 * y0
    y2 = b[2] - l20 * y0 - l21 * y1
    x[2] = y2 / d2
    x[1] = y1 / d1 - l21 * x[2]
    x[0] = y0 / d0 - l10 * x[1] - l20 * x[2]
    return True
