from __future__ import annotations

import math
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.landmarks.database import read_landmark_map, relate, write_landmark_map
from slam.types import CONCAVE, CONVEX


def example(n: int = 5) -> dict[str, Any]:
    """Landmarks with a joint covariance dominated by a common shift, as EKF-SLAM leaves them."""
    rng = np.random.default_rng(3)
    factor = np.hstack([np.tile(np.eye(2), (n, 1)), 0.05 * rng.normal(size=(2 * n, 2 * n))])
    joint = 0.01 * factor @ factor.T
    joint = 0.5 * (joint + joint.T)
    return {
        "positions": rng.uniform(-4, 4, (n, 2)),
        "cov": np.array([joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(n)]),
        "joint_cov": joint,
        "ids": np.array([7, 3, 11, 0, 5][:n]),
        "kinds": np.array([CONVEX, CONCAVE, 0, CONVEX, 0][:n], np.int8),
        "angles": np.array([0.5, -2.0, np.nan, 3.0, np.nan][:n]),
        "times_seen": np.array([4, 1, 2, 9, 1][:n]),
        "backend": "ekf",
    }


def test_round_trip(tmp_path: Path) -> None:
    path, written = tmp_path / "landmarks.db", example()
    write_landmark_map(path, **written)
    read = read_landmark_map(path)
    order = np.argsort(written["ids"])
    landmarks = read.landmarks
    np.testing.assert_array_equal(landmarks["id"], written["ids"][order])
    assert landmarks["kind"].tolist() == ["convex", "concave", "unknown", "convex", "unknown"]
    np.testing.assert_array_equal(np.array([landmarks["x"], landmarks["y"]]).T, written["positions"][order])
    cov = np.array([[landmarks["var_x"], landmarks["cov_xy"]], [landmarks["cov_xy"], landmarks["var_y"]]])
    np.testing.assert_array_equal(cov.transpose(2, 0, 1), written["cov"][order])
    np.testing.assert_array_equal(landmarks["angle"], written["angles"][order])
    np.testing.assert_array_equal(landmarks["times_seen"], written["times_seen"][order])
    assert read.meta == {"schema_version": "2", "frame": "start", "units": "m, rad", "backend": "ekf"}
    assert len(read.relations) == 10 and (read.relations["a"] < read.relations["b"]).all()
    assert list(tmp_path.iterdir()) == [path]


def test_relations_are_keyed_by_id_whatever_the_order(tmp_path: Path) -> None:
    path, written = tmp_path / "landmarks.db", example()
    write_landmark_map(path, **written)
    read = read_landmark_map(path)
    place = {int(k): i for i, k in enumerate(written["ids"])}
    joint, positions = written["joint_cov"], written["positions"]
    for a, b, distance, sigma, rho in read.relations.tolist():
        i, j = place[a], place[b]
        line = positions[j] - positions[i]
        assert distance == pytest.approx(np.linalg.norm(line))
        # The distance's gradient over the joint state.
        gradient = np.zeros(len(joint))
        gradient[2 * i : 2 * i + 2], gradient[2 * j : 2 * j + 2] = -line / distance, line / distance
        assert sigma == pytest.approx(math.sqrt(gradient @ joint @ gradient))
        # The correlation of a's and b's errors along the line, from a sampled covariance's definition.
        u = line / distance
        pick = np.zeros((2, len(joint)))
        pick[0, 2 * i : 2 * i + 2] = pick[1, 2 * j : 2 * j + 2] = u
        pair = pick @ joint @ pick.T
        assert rho == pytest.approx(pair[0, 1] / math.sqrt(pair[0, 0] * pair[1, 1]))
        # Paper B, claim 2: relative positions are known better than absolute ones.
        assert rho > 0.9 and sigma < math.sqrt(pair[0, 0])


def test_relations_without_a_joint_covariance() -> None:
    positions, cov = np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([np.diag([0.09, 1.0]), np.diag([0.16, 1.0])])
    pairs, distances, sigmas, correlations = relate(positions, cov)
    np.testing.assert_array_equal(pairs, [[0, 1]])
    np.testing.assert_allclose(distances, [2.0])
    np.testing.assert_allclose(sigmas, [0.5])
    assert np.isnan(correlations).all()


def test_relations_keep_the_nearest_neighbours() -> None:
    positions = np.column_stack([[0.0, 1.0, 3.0, 7.0], np.zeros(4)])
    pairs, *_ = relate(positions, np.tile(np.eye(2), (4, 1, 1)), neighbours=1)
    np.testing.assert_array_equal(pairs, [[0, 1], [1, 2], [2, 3]])
    assert len(relate(positions, np.tile(np.eye(2), (4, 1, 1)), neighbours=0)[0]) == 0


def test_coincident_landmarks_and_rigid_pairs_stay_finite() -> None:
    joint = np.tile(0.04 * np.eye(2), (2, 2))
    cov = np.array([0.04 * np.eye(2)] * 2)
    for positions in (np.zeros((2, 2)), np.array([[0.0, 0.0], [0.3, 0.4]])):
        _, distances, sigmas, correlations = relate(positions, cov, joint_cov=joint)
        np.testing.assert_allclose(sigmas, 0.0, atol=1e-8)
        np.testing.assert_allclose(correlations, 1.0)
        assert np.isfinite(distances).all()


def test_content_is_deterministic(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_landmark_map(tmp_path / name, **example())
    # Another order of the same landmarks is the same map.
    shuffled, order = example(), np.array([4, 2, 0, 1, 3])
    both = np.stack([2 * order, 2 * order + 1], axis=1).ravel()
    for key in ("positions", "cov", "ids", "kinds", "angles", "times_seen"):
        shuffled[key] = shuffled[key][order]
    shuffled["joint_cov"] = shuffled["joint_cov"][np.ix_(both, both)]
    write_landmark_map(tmp_path / "c", **shuffled)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes() == (tmp_path / "c").read_bytes()


def test_empty_single_and_defaults(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.db"
    for n in (0, 1):
        write_landmark_map(path, np.zeros((n, 2)), cov=np.zeros((n, 2, 2)), kinds=np.zeros(0, np.int8))
        read = read_landmark_map(path)
        landmarks = read.landmarks
        assert landmarks.shape == (n,) and read.relations.shape == (0,)
        assert np.isnan(landmarks["angle"]).all() and (landmarks["kind"] == "unknown").all()
        assert (landmarks["times_seen"] == 0).all()


def test_tables_are_readable_with_plain_sql(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.db"
    write_landmark_map(path, **example())
    with closing(sqlite3.connect(path)) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert database.execute("PRAGMA foreign_key_check").fetchall() == []
        rows = database.execute("SELECT id, kind, angle, times_seen FROM landmarks ORDER BY id").fetchall()
        assert rows[:3] == [(0, "convex", 3.0, 9), (3, "concave", -2.0, 1), (5, "unknown", None, 1)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cov": np.zeros((4, 2, 2))}, "cov must have shape"),
        ({"joint_cov": np.zeros((13, 13))}, "joint_cov must have shape"),
        ({"ids": np.array([1, 1, 2, 3, 4])}, "distinct"),
        ({"kinds": np.full(5, 3)}, "kinds"),
        ({"positions": np.full((5, 2), np.nan)}, "finite"),
    ],
)
def test_bad_arguments_write_nothing(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_landmark_map(tmp_path / "landmarks.db", **(example() | change))
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_a_landmark_map(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.db"

    def refused(message: str) -> None:
        with pytest.raises(ValueError, match=message) as caught:
            read_landmark_map(path)
        assert "landmarks.db" in str(caught.value) and "\n" not in str(caught.value)

    refused("no such file")
    assert not path.exists()
    path.write_bytes(b"")
    refused("no such table")
    path.write_bytes(b"not a database" * 100)
    refused("not a database")
    path.unlink()
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE meta (key, value)")
        database.commit()
    refused("schema version None")
    write_landmark_map(path, **example())
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE meta SET value = '99' WHERE key = 'schema_version'")
        database.commit()
    refused("schema version '99'")
    write_landmark_map(path, **example())
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE landmarks SET x = 'left'")
        database.commit()
    refused("not a landmark map")
    write_landmark_map(path, **example())
    path.write_bytes(path.read_bytes()[:5000])
    refused("not a landmark map")


def test_who_saw_a_landmark(tmp_path: Path) -> None:
    path, written = tmp_path / "landmarks.db", example()
    write_landmark_map(path, **written, seen_by=[(1, 0), (2,), (), (0, 0), (1,)])
    read = read_landmark_map(path)
    assert read.sightings.tolist() == [(0, 0), (3, 2), (5, 1), (7, 0), (7, 1)]
    with pytest.raises(ValueError, match="seen_by must have length 5"):
        write_landmark_map(path, **written, seen_by=[(1,)])


def test_a_file_of_version_1_is_read(tmp_path: Path) -> None:
    path, written = tmp_path / "landmarks.db", example()
    write_landmark_map(path, **written)
    now = read_landmark_map(path)
    with closing(sqlite3.connect(path)) as database:
        database.execute("DROP TABLE sightings")
        database.execute("UPDATE meta SET value = '1' WHERE key = 'schema_version'")
        database.commit()
    read = read_landmark_map(path)
    assert read.landmarks["id"].tolist() == now.landmarks["id"].tolist()
    np.testing.assert_array_equal(read.landmarks["angle"], now.landmarks["angle"])
    assert len(read.sightings) == 0 and read.sightings.dtype.names == ("landmark", "robot")
