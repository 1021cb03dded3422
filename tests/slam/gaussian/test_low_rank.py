"""A covariance of low rank as two thin matrices: within its tolerance, and the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from slam.gaussian.low_rank import factor, root_of_loss


def blocks(rank: int, noise: float, *, m: int = 150, n: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a block of a given rank but for noise, and the σ's of its rows and columns."""
    rng = np.random.default_rng(rank)
    rows, columns = rng.uniform(1e-3, 10.0, m), rng.uniform(1e-3, 10.0, n)
    decay = 0.5 ** np.arange(rank)
    correlation = (rng.normal(size=(m, rank)) * decay) @ rng.normal(size=(rank, n)) / rank
    return (correlation + noise * rng.normal(size=(m, n))) * np.outer(rows, columns), rows, columns


@pytest.mark.parametrize(("rank", "noise"), [(5, 0.0), (30, 0.0), (70, 0.0), (12, 1e-9), (0, 0.0)])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-10])
def test_what_is_left_out_is_within_the_tolerance(rank: int, noise: float, tolerance: float) -> None:
    cov, rows, columns = blocks(max(rank, 1), noise)
    cov *= rank > 0
    u, v = factor(cov, rows, columns, tolerance)
    left = (cov - u @ v[:, : cov.shape[1]]) / np.outer(rows, columns)
    assert np.sqrt((left**2).sum()) < 3.0 * tolerance  # it is estimated from samples
    assert u.shape[1] == len(v) <= (150 if noise > 0.1 * tolerance / np.sqrt(cov.size) else max(rank, 1))
    assert not v[:, cov.shape[1] :].any()


def test_few_rows_are_taken_as_they_are() -> None:
    cov, rows, columns = blocks(40, 0.1, m=30)
    u, v = factor(cov, rows, columns, 1e-3)
    np.testing.assert_allclose(u @ v[:, : cov.shape[1]], cov, rtol=1e-14)


def test_it_is_the_same_every_time() -> None:
    one, two = factor(*blocks(20, 0.0), 1e-6), factor(*blocks(20, 0.0), 1e-6)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("size", "rank", "tolerance"), [(60, 7, 1e-6), (60, 0, 1e-6), (9, 9, 1e-10), (40, 12, 1e-2)]
)
def test_what_was_learnt_has_a_root_of_few_rows(size: int, rank: int, tolerance: float) -> None:
    """Only the upper triangle counts; what is left out of the weighted trace is within the tolerance."""
    rng = np.random.default_rng(size)
    learnt = 0.7 ** np.arange(rank)[:, None] * rng.normal(size=(rank, size))
    weights = rng.uniform(0.1, 100.0, size)
    cov = -learnt.T @ learnt
    upper = np.triu(cov) + np.tril(rng.normal(size=cov.shape), -1)
    root = root_of_loss(np.pad(upper, 1)[1:-1, 1:-1], weights, tolerance)  # a part of a larger one, as it is used
    assert len(root) <= rank
    rest = -cov - root.T @ root
    assert -1e-9 < weights @ np.diag(rest) <= tolerance + 1e-9
    assert np.linalg.eigvalsh(rest).min() > -1e-9  # no covariance gets too small by it
