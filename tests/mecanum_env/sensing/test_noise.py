"""The sensors' random numbers against NumPy's own."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from mecanum_env.sensing.noise import NoiseStream, fill_normal, fill_uniform, noise_stream


@pytest.mark.parametrize("seed", range(4))
def test_every_number_is_the_one_numpy_draws(seed: int) -> None:
    ours = noise_stream(np.random.SeedSequence(seed))
    assert isinstance(ours, NoiseStream)
    theirs = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    sizes = np.random.default_rng(seed).integers(0, 400, 4000).tolist()
    beyond = 0
    for n in sizes:
        got, expected = np.empty((2, n)), np.empty((2, n))
        fill_normal(ours.words, got[0])
        fill_uniform(ours.words, got[1])
        theirs.standard_normal(out=expected[0])
        theirs.random(out=expected[1])
        np.testing.assert_array_equal(got, expected)
        beyond += np.count_nonzero(np.abs(got[0]) > 3.6541528853610088)
    assert beyond > 50  # the ziggurat's tail, where a normal number takes logarithms, was among them


def test_a_copy_draws_the_same_numbers_and_takes_none_away() -> None:
    stream = NoiseStream(np.random.PCG64(np.random.SeedSequence(1)))
    twin = copy.deepcopy(stream)
    ours, its = np.empty(100), np.empty(100)
    fill_normal(stream.words, ours)
    fill_normal(twin.words, its)
    np.testing.assert_array_equal(ours, its)
