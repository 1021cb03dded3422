"""Old landmarks seen again from an uncertain place: taken for what they are only together (kernels).

A gate says that an observation *could* be a landmark. Whether it is, is another matter where the gate is wider
than features stand apart: after a long way the one landmark inside it may be the neighbour of the one that is
seen, which is not in the map yet, and individual gating finds nothing ambiguous in that. One wall taken for the
next, half a metre beside it, bends the map for good, at a likelihood that no test notices. So such pairings are
put off until several of one scan agree: jointly compatible (Neira and Tardós 2001), and so many that some of them
are *predicted*, narrowly, by the others. The first ones only fix the pose, and any pose would do for those.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.landmarks.association import IGNORED, add_expected, gated_distance, predicted
from slam.landmarks.book import LAST_SEEN
from slam.landmarks.joint_compatibility import JOINT_GATES, extend, joint_compatibility
from slam.types import LINE, Array, Indices

__all__ = ["agreeing", "put_off"]

_OLD = 50.0  # updates without a sighting: what is followed from scan to scan needs no company
_HOLD = 3  # other landmarks seen, that old ones can wait for company
_ALONE = 2.0  # times ``sigma`` to which one must be expected to be taken without company
_LEAST = 3  # old landmarks that the others predict narrowly, for them all to be taken


@njit(cache=True, nogil=True, error_model="numpy")
def _variance(z: Array, s00: float, s01: float, s11: float) -> float:
    """Return the variance [m²] of where an observation is expected, from that of range and bearing.

    Of a wall, across it and in the middle of the piece that is seen: it turns about its foot.
    """
    if z[5] == LINE:
        t = 0.5 * (z[8] + z[9])
        return float(s00 - 2.0 * t * s01 + t * t * s11)
    across = z[0] * z[0] * s11
    half = 0.5 * (s00 - across)
    return float(0.5 * (s00 + across) + math.sqrt(half * half + z[0] * z[0] * s01 * s01))


@njit(cache=True, nogil=True, error_model="numpy")
def _expected_variance(x: Array, p: Array, i: int, offset: float, z: Array, h: Array) -> float:
    """Return the variance [m²] of where landmark ``i`` should be seen, the observation's own noise left out."""
    predicted(x, i, z[5], offset, h)
    s00, s01, s11 = add_expected(0.0, 0.0, 0.0, p, i, h)
    return _variance(z, s00, s01, s11)


@njit(cache=True, nogil=True, error_model="numpy")
def put_off(
    x: Array, p: Array, offset: float, z: Array, marks: Array, now: int, sigma: float, match: Indices
) -> int:
    """Set to IGNORED the matches with old landmarks that are not expected to within ``sigma`` [m]; count them.

    Where too little else is seen to wait for company, leaving them out would be going blind: there only those
    that are too uncertain, or too far off, to be taken alone.
    """
    h = np.empty((2, 5))
    doubtful, alone = np.zeros(z.shape[0], np.bool_), np.zeros(z.shape[0], np.bool_)
    held = 0
    for k in range(z.shape[0]):
        i = match[k]
        if i < 0:
            continue
        if now - marks[i, LAST_SEEN] > _OLD:
            sigmas2 = _expected_variance(x, p, i, offset, z[k], h) / sigma**2
            doubtful[k] = sigmas2 > 1.0
            if doubtful[k] and sigmas2 <= _ALONE**2:
                alone[k] = gated_distance(x, p, i, offset, z[k], h) < JOINT_GATES[1]
        held += not doubtful[k]
    count = 0
    for k in range(z.shape[0]):
        if doubtful[k] and (held >= _HOLD or not alone[k]):
            match[k] = IGNORED
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def agreeing(
    x: Array, p: Array, offset: float, z: Array, marks: Array, now: int, sigma: float, near: float,
    max_turn: float, match: Indices,
) -> int:  # fmt: skip
    """Match old landmarks that are not expected to within ``sigma`` [m] if enough of them agree; return how many.

    ``match`` ``(m,)`` is filled. Enough of the pairings must be expected to within ``sigma`` once those before
    them are taken for true. The other arguments are ``joint_compatibility``'s.
    """
    m = z.shape[0]
    match[:] = IGNORED
    if m <= _LEAST:  # the first is never expected any better
        return 0
    joint_compatibility(x, p, offset, z, marks, near, max_turn, match)
    h = np.zeros((m, 2, 5))
    landmark = np.zeros(m, np.int64)
    factor, y = np.zeros((2 * m, 2 * m)), np.zeros(2 * m)
    pairs = confirmed = 0
    for k in range(m):
        i = match[k]
        if i < 0:
            continue
        if now - marks[i, LAST_SEEN] <= _OLD or _expected_variance(x, p, i, offset, z[k], h[pairs]) <= sigma**2:
            match[k] = IGNORED
            continue
        landmark[pairs] = i
        extend(x, p, offset, z[k], landmark, pairs, h, factor, y)
        row = 2 * pairs
        a, b, c = factor[row, row], factor[row + 1, row], factor[row + 1, row + 1]
        narrow = _variance(z[k], a * a, a * b, b * b + c * c) <= sigma**2
        confirmed += narrow and y[row] ** 2 + y[row + 1] ** 2 < JOINT_GATES[1]
        pairs += 1
    if confirmed < _LEAST:
        match[:] = IGNORED
        return 0
    return pairs
