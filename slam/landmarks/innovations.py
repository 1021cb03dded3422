"""What single observations say against the belief, before it is corrected by them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam.landmarks.association import gated_distance, predicted
from slam.types import CONCAVE, CONVEX, LINE, Array, Indices

__all__ = ["Innovation", "innovations"]

_KINDS = {LINE: "wall", CONVEX: "convex corner", CONCAVE: "concave corner"}


class Innovation(NamedTuple):
    """An observation that was taken for a landmark, beside what was expected of that."""

    landmark: int  # its id
    kind: str  # "wall", "wall end", "convex corner", "concave corner" or "landmark"
    nis: float  # squared Mahalanobis distance, two degrees of freedom
    seen: tuple[float, float]  # range [m] and bearing [rad] in the sensor frame; of a wall, of its foot
    expected: tuple[float, float]
    extent: tuple[float, float]  # from where to where a wall was seen, along it from its foot [m]


def innovations(x: Array, p: Array, offset: float, z: Array, match: Indices, ids: Indices) -> list[Innovation]:
    """Return the innovations of the observations that were matched, each on its own (docs/reference/ekf.md).

    Parameters
    ----------
    x, p, offset, z, match
        As in :func:`slam.landmarks.association.nearest_neighbour`.
    ids
        ``(n,)`` of the landmarks.
    """
    h = np.empty((2, 5))
    found = []
    for k in np.flatnonzero(match >= 0).tolist():
        row = int(match[k])
        kind = "wall end" if z[k, 7] != 0.0 else _KINDS.get(int(z[k, 5]), "landmark")
        expected = predicted(x, row, z[k, 5], offset, h)
        nis = gated_distance(x, p, row, offset, z[k], h)
        extent = (float(z[k, 8]), float(z[k, 9])) if z[k, 5] == LINE else (0.0, 0.0)
        seen = (float(z[k, 0]), float(z[k, 1]))
        found.append(Innovation(int(ids[row]), kind, float(nis), seen, expected, extent))
    return found
