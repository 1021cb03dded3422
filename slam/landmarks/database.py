"""The cartographic database: landmarks, what distinguishes them and how they relate.

An SQLite file (docs/reference/landmark_map.md), readable with any SQLite tool, of these tables:

``landmarks(id, kind, x, y, var_x, var_y, cov_xy, angle, times_seen)``
    One row a landmark: position [m] and covariance [m²] in the map's frame; ``kind`` is ``convex``,
    ``concave`` or ``unknown``; ``angle`` [rad] the direction of the corner's bisector into free space (NULL:
    not known).
``relations(a, b, distance, distance_sigma, correlation)``
    One row a pair a < b of near neighbours; see :func:`relate`. Relative positions are known far better than
    absolute ones: here that can be read off.
``sightings(landmark, robot)``
    Which robots have a landmark in their maps; empty where one robot alone made the map.
``meta(key, value)``
    ``schema_version``, ``frame``, ``units``, ``backend``.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.files import check_tables, open_database, plain_name, quoted
from slam.formats import replacing
from slam.types import CONCAVE, CONVEX, Array, Indices

__all__ = ["SCHEMA_VERSION", "LandmarkMap", "read_landmark_map", "relate", "write_landmark_map"]

SCHEMA_VERSION = 2
"""That of what is written. Version 1 had no ``sightings``, and is read as if there were none."""

_KIND_NAMES = {CONVEX: "convex", CONCAVE: "concave", 0: "unknown"}

_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE landmarks (
    id INTEGER PRIMARY KEY,
    kind TEXT NOT NULL CHECK (kind IN ('convex', 'concave', 'unknown')),
    x REAL NOT NULL, y REAL NOT NULL,
    var_x REAL NOT NULL, var_y REAL NOT NULL, cov_xy REAL NOT NULL,
    angle REAL,
    times_seen INTEGER NOT NULL
);
CREATE TABLE relations (
    a INTEGER NOT NULL REFERENCES landmarks (id),
    b INTEGER NOT NULL REFERENCES landmarks (id),
    distance REAL NOT NULL, distance_sigma REAL NOT NULL,
    correlation REAL,
    PRIMARY KEY (a, b), CHECK (a < b)
) WITHOUT ROWID;
CREATE TABLE sightings (
    landmark INTEGER NOT NULL REFERENCES landmarks (id),
    robot INTEGER NOT NULL,
    PRIMARY KEY (landmark, robot)
) WITHOUT ROWID;
"""


_LANDMARKS = [
    ("id", "i8"), ("kind", "U8"), *((name, "f8") for name in ("x", "y", "var_x", "var_y", "cov_xy", "angle")),
    ("times_seen", "i8"),
]  # fmt: skip
_RELATIONS = [("a", "i8"), ("b", "i8"), ("distance", "f8"), ("distance_sigma", "f8"), ("correlation", "f8")]
_SIGHTINGS = [("landmark", "i8"), ("robot", "i8")]


class LandmarkMap(NamedTuple):
    """A cartographic database in memory: arrays whose fields are the columns of the tables, nan where NULL."""

    landmarks: NDArray[np.void]  # (n,) by rising id
    relations: NDArray[np.void]  # (r,) by rising pair
    meta: dict[str, str]
    sightings: NDArray[np.void]  # (s,) by rising landmark, then robot


def relate(
    positions: Array, cov: Array, *, joint_cov: Array | None = None, neighbours: int = 8
) -> tuple[Indices, Array, Array, Array]:
    r"""Relate each landmark to its nearest neighbours.

    For a pair with unit vector u from a to b, and covariance blocks Paa, Pbb, Pab, to first order

    - distance σ = √(uᵀ (Paa + Pbb − Pab − Pabᵀ) u),
    - correlation = uᵀ Pab u / √(uᵀ Paa u · uᵀ Pbb u), the correlation coefficient of the two position errors
      along the line that joins them: near 1 the two move together, and their distance is well known.

    Parameters
    ----------
    positions, cov : (n, 2), (n, 2, 2)
        Estimates [m] and their covariances [m²].
    joint_cov : (2n, 2n), optional
        Joint covariance [m²]. Without it Pab counts as zero in σ, and the correlation is nan.
    neighbours : int
        A pair is kept where either is among the other's so many nearest.

    Returns
    -------
    pairs (r, 2) of indices a < b in lexical order, distances (r,), distance sigmas (r,), correlations (r,).
    """
    n = len(positions)
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, : max(0, min(neighbours, n - 1))]
    chosen = np.zeros((n, n), np.bool_)
    np.put_along_axis(chosen, nearest, True, axis=1)
    pairs = np.argwhere(np.triu(chosen | chosen.T)).astype(np.int64)
    a, b = pairs.T
    distances = apart[a, b]
    # Two estimates at one point have no line between them; x serves as well as any direction.
    along = np.where(distances[:, None] > 0, positions[b] - positions[a], (1.0, 0.0))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    variance_a, variance_b = (np.einsum("ri,rij,rj->r", along, cov[i], along) for i in (a, b))
    if joint_cov is None:
        shared, correlations = np.zeros(len(pairs)), np.full(len(pairs), np.nan)
    else:
        cross = joint_cov.reshape(n, 2, n, 2)[a, :, b, :]
        shared = np.einsum("ri,rij,rj->r", along, cross, along)
        with np.errstate(divide="ignore", invalid="ignore"):
            correlations = np.clip(shared / np.sqrt(variance_a * variance_b), -1.0, 1.0)
    # Nearly rigid pairs leave a difference of large numbers, which rounding can turn negative.
    sigmas = np.sqrt(np.maximum(variance_a + variance_b - 2.0 * shared, 0.0))
    return pairs, distances, sigmas, correlations


def write_landmark_map(
    path: str | Path,
    positions: ArrayLike,
    *,
    cov: ArrayLike,
    joint_cov: ArrayLike | None = None,
    ids: ArrayLike | None = None,
    kinds: ArrayLike | None = None,
    angles: ArrayLike | None = None,
    times_seen: ArrayLike | None = None,
    seen_by: Sequence[Iterable[int]] | None = None,
    backend: str = "",
    frame: str = "start",
) -> None:
    """Write the cartographic database; the same arguments give the same content.

    Parameters
    ----------
    path : path
        The file, replaced whole.
    positions, cov : (n, 2), (n, 2, 2)
        Estimates [m] and their covariances [m²], in ``frame``.
    joint_cov : (2n, 2n), optional
        Joint covariance of the landmarks [m²] (without the robot's rows), where the backend keeps one.
    ids : (n,) int, optional
        Distinct; 0 … n-1 by default.
    kinds : (n,) int, optional
        ``slam.types.CONVEX``, ``CONCAVE`` or 0; unknown by default, or where empty.
    angles : (n,), optional
        Direction of each corner's bisector into free space [rad], nan where not known.
    times_seen : (n,) int, optional
        Number of observations; 0 where not counted.
    seen_by : (n,) of robots' ids, optional
        Which robots have each landmark in their maps, where several made the map together.
    backend, frame : str
        Who estimated this, and in which frame: by default that of the robot's start.

    Raises
    ------
    ValueError
        Where shapes disagree, ids repeat, or a position or covariance is not finite.
    """
    xy = np.asarray(positions, np.float64).reshape(-1, 2)
    n = len(xy)
    covs = _column("cov", cov, np.zeros((n, 2, 2)))
    joint = None if joint_cov is None else _column("joint_cov", joint_cov, np.zeros((2 * n, 2 * n)))
    names = _column("ids", ids, np.arange(n, dtype=np.int64))
    order = np.argsort(names, kind="stable")
    if len(np.unique(names)) != n:
        raise ValueError("landmark ids must be distinct")
    if not all(np.isfinite(v).all() for v in (xy, covs, joint if joint is not None else 0.0)):
        raise ValueError("landmark positions and covariances must be finite")
    kind = _column("kinds", kinds, np.zeros(n, np.int8))
    if not np.isin(kind, list(_KIND_NAMES)).all():
        raise ValueError(f"landmark kinds must be among {sorted(_KIND_NAMES)}")
    angle = _column("angles", angles, np.full(n, np.nan))
    seen = _column("times_seen", times_seen, np.zeros(n, np.int64))
    if joint is not None:
        joint = joint.reshape(n, 2, n, 2)[order][:, :, order].reshape(2 * n, 2 * n)
    pairs, *measures = relate(xy[order], covs[order], joint_cov=joint)
    moments = np.column_stack([xy, covs[:, 0, 0], covs[:, 1, 1], covs[:, 0, 1]]).tolist()
    rows = [
        (int(names[i]), _KIND_NAMES[int(kind[i])], *moments[i], _or_null(angle[i]), int(seen[i])) for i in order
    ]
    relations = [
        (*pair, *map(_or_null, values))
        for pair, *values in zip(names[order][pairs].tolist(), *(m.tolist() for m in measures), strict=True)
    ]
    robots = [()] * n if seen_by is None else [sorted({int(robot) for robot in seen}) for seen in seen_by]
    if len(robots) != n:
        raise ValueError(f"landmark seen_by must have length {n}, got {len(robots)}")
    sightings = [(int(names[i]), robot) for i in order for robot in robots[i]]
    meta = {"backend": backend, "frame": frame, "schema_version": str(SCHEMA_VERSION), "units": "m, rad"}
    with replacing(path) as temporary, closing(sqlite3.connect(temporary)) as database:
        # A half-written temporary file is thrown away whole: no journal is needed.
        database.executescript("PRAGMA journal_mode = OFF;" + _SCHEMA)
        database.executemany("INSERT INTO meta VALUES (?, ?)", sorted(meta.items()))
        database.executemany("INSERT INTO landmarks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
        database.executemany("INSERT INTO relations VALUES (?, ?, ?, ?, ?)", relations)
        database.executemany("INSERT INTO sightings VALUES (?, ?)", sightings)
        database.commit()


def read_landmark_map(path: str | Path) -> LandmarkMap:
    """Read a cartographic database.

    Raises
    ------
    ValueError
        One line, where the file is missing, is not such a database, or has another schema version.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"cannot read landmark map {path}: no such file")
    try:
        # Read-only, so that reading never changes or creates a file.
        with open_database(path) as database:
            check_tables(database, ("meta", "landmarks", "relations", "sightings"))
            meta = {str(key): str(value) for key, value in database.execute("SELECT key, value FROM meta")}
            version = meta.get("schema_version")
            if version not in ("1", str(SCHEMA_VERSION)):
                raise ValueError(f"schema version {quoted(version)}, this program reads 1 and {SCHEMA_VERSION}")
            names = ", ".join(f"'{name}'" for name in _KIND_NAMES.values())
            if database.execute(f"SELECT 1 FROM landmarks WHERE kind NOT IN ({names}) LIMIT 1").fetchone():
                raise ValueError(f"a landmark's kind is none of {names}")
            landmarks = _read(database, "landmarks", _LANDMARKS)
            relations = _read(database, "relations", _RELATIONS)
            sightings = np.zeros(0, _SIGHTINGS)
            if version != "1":
                sightings = _read(database, "sightings", _SIGHTINGS)
        _check_values(landmarks, relations, sightings)
        return LandmarkMap(landmarks, relations, meta, sightings)
    except (sqlite3.Error, ValueError, TypeError, KeyError, OverflowError) as error:
        raise ValueError(
            f"{path} is not a landmark map: {plain_name(' '.join(str(error).split()), 300)}"
        ) from error


def _read(database: sqlite3.Connection, table: str, columns: list[tuple[str, str]]) -> NDArray[np.void]:
    names = ", ".join(name for name, _ in columns)
    return np.array(database.execute(f"SELECT {names} FROM {table} ORDER BY 1, 2").fetchall(), columns)


def _check_values(landmarks: NDArray[np.void], relations: NDArray[np.void], sightings: NDArray[np.void]) -> None:
    """Raise ``ValueError`` for values that :func:`write_landmark_map` does not write."""
    for name in ("x", "y", "var_x", "var_y", "cov_xy"):
        if not np.isfinite(landmarks[name]).all():
            raise ValueError(f"a landmark's {name} is no finite number")
    for table, names in ((relations, ("a", "b")), (sightings, ("landmark",))):
        for name in names:
            if not np.isin(table[name], landmarks["id"]).all():
                raise ValueError(f"there is no landmark that a row names as its {name}")


def _column(name: str, values: ArrayLike | None, default: NDArray[Any]) -> NDArray[Any]:
    """Return the values in the default's shape and type, or the default where there are none."""
    array = default if values is None else np.asarray(values, default.dtype)
    if array.shape != default.shape:
        # A belief's kinds are an empty array where its backend knows none.
        if name == "kinds" and array.size == 0:
            return default
        raise ValueError(f"landmark {name} must have shape {default.shape}, got {array.shape}")
    return array


def _or_null(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
