from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.particles.resampling import ResamplingPolicy, effective_particles, normalise, systematic

weights_lists = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40).filter(lambda w: sum(w) > 1e-3)


def resample(weights: np.ndarray, uniform: float) -> np.ndarray:
    ancestors = np.full(len(weights), -1)
    systematic(weights, uniform, ancestors)
    return ancestors


@given(weights_lists, st.floats(0.0, 1.0, exclude_max=True))
def test_a_particle_has_its_share_of_descendants_up_to_rounding(values: list[float], uniform: float) -> None:
    weights = np.array(values) / np.sum(values)
    n = len(weights)
    ancestors = resample(weights, uniform)
    copies = np.bincount(ancestors, minlength=n)
    assert copies.sum() == n
    assert np.all(copies >= np.floor(n * weights - 1e-9))
    assert np.all(copies <= np.ceil(n * weights + 1e-9))


@given(weights_lists, st.floats(0.0, 1.0, exclude_max=True))
def test_who_survives_keeps_its_place(values: list[float], uniform: float) -> None:
    ancestors = resample(np.array(values) / np.sum(values), uniform)
    survivors = np.unique(ancestors)
    np.testing.assert_array_equal(ancestors[survivors], survivors)


@settings(max_examples=15)
@given(weights_lists)
def test_resampling_is_unbiased(values: list[float]) -> None:
    """Averaged over the uniform number, a particle has n w descendants: the midpoints of 200 equal strips."""
    weights = np.array(values) / np.sum(values)
    n, strips = len(weights), 200
    total = np.zeros(n)
    for k in range(strips):
        total += np.bincount(resample(weights, (k + 0.5) / strips), minlength=n)
    np.testing.assert_allclose(total / strips, n * weights, atol=2.0 / strips)


def test_even_weights_change_nothing_and_one_takes_all() -> None:
    np.testing.assert_array_equal(resample(np.full(7, 1 / 7), 0.5), np.arange(7))
    np.testing.assert_array_equal(resample(np.eye(7)[4], 0.0), np.full(7, 4))


@given(st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=30))
def test_weights_are_normalised_wherever_the_log_weights_stand(values: list[float]) -> None:
    log_weights, weights = np.array(values), np.zeros(len(values))
    want = np.exp(log_weights - log_weights.max())
    want /= want.sum()
    normalise(log_weights, weights)
    np.testing.assert_allclose(weights, want, atol=1e-12)
    np.testing.assert_allclose(np.exp(log_weights), want, atol=1e-12)
    assert effective_particles(weights) == pytest.approx(1 / np.sum(want**2))


@pytest.mark.parametrize("value", [-math.inf, math.nan, math.inf])
def test_without_any_likelihood_left_all_weigh_the_same(value: float) -> None:
    log_weights, weights = np.full(4, value), np.zeros(4)
    normalise(log_weights, weights)
    np.testing.assert_array_equal(weights, np.full(4, 0.25))
    np.testing.assert_allclose(log_weights, math.log(0.25))
    log_weights = np.array([value, -1e300, -math.inf])
    normalise(log_weights, weights[:3])
    np.testing.assert_array_equal(weights[:3], [0, 1, 0])


def test_effective_particles_lie_between_one_and_all() -> None:
    assert effective_particles(np.full(50, 0.02)) == pytest.approx(50)
    assert effective_particles(np.eye(50)[3]) == 1.0


def test_policies() -> None:
    assert ResamplingPolicy(when="every_step").due(100.0, 100, 1)
    every_third = ResamplingPolicy(when="every_k", every=3)
    assert [every_third.due(1.0, 100, k) for k in (1, 2, 3)] == [False, False, True]
    half = ResamplingPolicy(when="n_eff", share=0.5)
    assert half.due(49.9, 100, 1) and not half.due(50.0, 100, 9)
    with pytest.raises(ValueError, match=r"Policy.when must be .*, got 'n_ef' \(did you mean 'n_eff'\?\)"):
        ResamplingPolicy(when="n_ef")
    with pytest.raises(ValueError, match=r"share must be in \[1e-6, 1\], got 0.0"):
        ResamplingPolicy(share=0.0)
    with pytest.raises(ValueError, match=r"every must be a whole number in \[1, 10000\], got 0"):
        ResamplingPolicy(every=0)
