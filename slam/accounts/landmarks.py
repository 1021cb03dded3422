"""The landmarks that a robot hands out: on their walls, where it has any; and the file they are written to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.accounts.account import Account
from slam.accounts.corners import settled
from slam.backend import Backend
from slam.landmarks.database import write_landmark_map
from slam.types import Array

__all__ = ["HandedOut", "handed_out", "write_landmarks"]


@dataclass(frozen=True, kw_only=True, eq=False)
class HandedOut:
    """Landmarks in the belief's order."""

    points: Array  # (n, 2) [m]
    covs: Array  # (n, 2, 2) [m²]
    joint_cov: Array | None  # (2n, 2n) [m²], where the backend keeps one


def handed_out(backend: Backend) -> HandedOut:
    """Return a backend's landmarks, settled on its walls (:func:`slam.accounts.corners.settled`).

    As it believes them where it keeps no joint covariance of pose and map.
    """
    belief = backend.belief
    if not belief.has_whole_cov and belief.joint_cov is None:
        return HandedOut(points=belief.landmarks, covs=belief.landmark_cov, joint_cov=None)
    account = settled(Account.of(0, 0.0, backend))
    n = len(account.points)
    joint = account.cov[3 : 3 + 2 * n, 3 : 3 + 2 * n]
    of = np.arange(n)
    return HandedOut(points=account.points, covs=joint.reshape(n, 2, n, 2)[of, :, of, :], joint_cov=joint)


def write_landmarks(path: str | Path, backend: Backend, *, name: str, frame: str = "start") -> None:
    """Write :func:`handed_out` as ``landmarks.db`` (docs/reference/landmark_map.md).

    Parameters
    ----------
    path : path
        The file, replaced whole.
    backend : Backend
        Whose landmarks.
    name, frame : str
        What the backend is called, and in which frame its belief is.
    """
    found, belief = handed_out(backend), backend.belief
    times_seen, directions = backend.landmark_details()
    write_landmark_map(
        path, found.points, cov=found.covs, joint_cov=found.joint_cov, ids=belief.landmark_ids,
        kinds=belief.landmark_kinds, angles=directions, times_seen=times_seen, backend=name, frame=frame,
    )  # fmt: skip
