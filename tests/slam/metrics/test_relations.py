"""The relations metric: by hand, against the transforms it is defined by, and what it must not depend on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry import compose, inverse
from slam.metrics import relations as metrics
from tests.slam.metrics.test_measures import moved, trajectory, transforms


def test_by_hand() -> None:
    # One metre ahead each time; the estimate turns left by 90° at its second pose and goes on from there.
    true = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    est = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, math.pi / 2], [1.0, 1.0, math.pi / 2]])
    pairs = [(0, 1), (1, 2), (0, 2)]
    trans, rot = metrics.relation_errors(true, est, pairs)
    # The second relation is right, though in the frame of the start it points elsewhere.
    assert trans == pytest.approx([0.0, 0.0, math.sqrt(2.0)], abs=1e-15)
    assert rot == pytest.approx([math.pi / 2, 0.0, math.pi / 2])
    score = metrics.relation_score(true, est, pairs)
    assert score.trans_m == pytest.approx(math.sqrt(2) / 3)
    assert score.trans_std_m == pytest.approx(2 / 3)  # √(2/3 - 2/9)
    assert score.trans_sq_m2 == pytest.approx(2 / 3) and score.trans_sq_std_m2 == pytest.approx(math.sqrt(8) / 3)
    assert score.rot_rad == pytest.approx(math.pi / 3) and score.rot_sq_rad2 == pytest.approx(math.pi**2 / 6)
    assert score.relations == 3


@given(transforms, transforms, st.integers(0, 99))
def test_a_rigid_transform_of_all_changes_nothing(here: np.ndarray, there: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, est = trajectory(rng), trajectory(rng)
    pairs = metrics.local_relations(len(true), steps=(1, 7))
    before = metrics.relation_score(true, est, pairs)
    assert before.trans_m > 0.01
    assert metrics.relation_score(moved(here, true), moved(there, est), pairs) == pytest.approx(before, abs=1e-9)
    assert metrics.relation_score(true, moved(there, true), pairs)[:8] == pytest.approx(np.zeros(8), abs=1e-10)


@given(st.integers(0, 99), st.lists(st.tuples(st.integers(0, 39), st.integers(0, 39)), min_size=1, max_size=20))
def test_against_the_definition(seed: int, pairs: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(seed)
    true, est = trajectory(rng), trajectory(rng)
    trans, rot = metrics.relation_errors(true, est, pairs)
    for k, (i, j) in enumerate(pairs):
        between = [compose(inverse(poses[i]), poses[j]) for poses in (true, est)]
        off = compose(inverse(between[0]), between[1])
        assert trans[k] == pytest.approx(math.hypot(off[0], off[1]), abs=1e-12)
        assert rot[k] == pytest.approx(abs(off[2]), abs=1e-12)


def test_local_relations() -> None:
    assert metrics.local_relations(4, steps=(1, 3)).tolist() == [[0, 1], [1, 2], [2, 3], [0, 3]]
    assert metrics.local_relations(1).shape == metrics.local_relations(0).shape == (0, 2)
    assert len(metrics.local_relations(100)) == 99 + 95 + 80


def test_closing_relations() -> None:
    # Out along x, back, and out again, one pose a metre, with a rest of three poses at the far end.
    x = [0.0, 1, 2, 3, 4, 4, 4, 3, 2, 1, 0, 1, 2, 3, 4]
    found = metrics.closing_relations(np.column_stack([x, np.zeros(15), np.zeros(15)]), within_m=0.5, after_m=4.0)
    assert [0, 10] in found.tolist() and [4, 14] in found.tolist()  # the rest counts once
    assert [5, 14] not in found.tolist() and [9, 11] not in found.tolist()  # … and 2 m of way are too short
    assert [3, 13] in found.tolist() and [7, 13] in found.tolist()  # two visits, two relations
    assert np.all(found[:, 0] < found[:, 1])
    for poses in (np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((50, 3))):
        assert metrics.closing_relations(poses).shape == (0, 2)


def test_nothing_and_nonsense() -> None:
    score = metrics.relation_score(np.zeros((0, 3)), np.zeros((0, 3)), metrics.local_relations(0))
    assert score.relations == 0 and all(map(math.isnan, score[:8]))
    with pytest.raises(ValueError, match=r"equal arrays of poses \(n, 3\)"):
        metrics.relation_errors(np.zeros((3, 3)), np.zeros((4, 3)), [(0, 1)])
    with pytest.raises(ValueError, match="outside 0 … 2"):
        metrics.relation_errors(np.zeros((3, 3)), np.zeros((3, 3)), [(0, 3)])
