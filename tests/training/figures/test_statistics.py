"""Averages, intervals and comparisons against sums by hand, brute force, SciPy and known distributions."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from scipy import stats

from training.figures.statistics import (
    CONFIDENCE,
    RESAMPLES,
    compare,
    estimate,
    interval,
    iqm,
    mean_interval,
    median,
    ratio_of_sums,
    resampled_indices,
    share_interval,
)


@pytest.mark.parametrize("n", range(1, 14))
def test_iqm_is_the_mean_of_the_middle(n: int) -> None:
    values = np.random.default_rng(n).normal(size=n)
    cut = n // 4
    expected = np.sort(values)[cut : n - cut].mean()
    np.testing.assert_allclose(stats.trim_mean(values, 0.25), expected)
    np.testing.assert_allclose(median(np.stack([values, -values])), [np.median(values), -np.median(values)])
    np.testing.assert_allclose(iqm(values), expected)
    np.testing.assert_allclose(iqm(np.stack([values, 2 * values])), [expected, 2 * expected])


def test_an_iqm_is_not_moved_by_a_few_outliers() -> None:
    values = np.concatenate([np.full(38, 5.0), np.full(6, 1e6), np.full(6, -1e6)])
    assert iqm(values) == 5.0


def test_resamples_keep_each_stratum_s_share() -> None:
    strata = ["a", "b", "a", "c", "b", "a"]
    at = resampled_indices(strata)
    assert at.shape == (RESAMPLES, 6)
    for k, name in enumerate(strata):
        assert {strata[j] for j in at[:, k].tolist()} == {name}
    # Each member of a stratum is drawn as often as the others.
    counts = np.bincount(at[:, [0, 2, 5]].ravel(), minlength=6)[[0, 2, 5]]
    assert stats.chisquare(counts).pvalue > 0.01
    np.testing.assert_array_equal(at, resampled_indices(["x", "y", "x", "z", "y", "x"]))


def test_the_interval_is_the_bootstrap_s_of_every_resample() -> None:
    """With three values, all 27 resamples can be listed; 2000 drawn ones have nearly their distribution."""
    values = np.array([1.0, 2.0, 7.0])
    means = sorted(np.mean(v) for v in product(values, repeat=3))
    found = mean_interval(values, ["a"] * 3)
    assert found.value == pytest.approx(10 / 3)
    assert (found.low, found.high) == pytest.approx((means[0], means[-1]))  # 1/27 > 2.5 %


def test_the_interval_is_scipy_s() -> None:
    values = np.random.default_rng(3).gamma(2.0, size=60)
    theirs = stats.bootstrap(
        (values,), lambda x, axis: stats.trim_mean(x, 0.25, axis=axis), n_resamples=20_000, method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    ours = estimate(values, ["a"] * 60).iqm
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=0.03)


def test_intervals_hold_the_true_value_about_as_often_as_they_say() -> None:
    """Of 200 samples of 50 from a symmetric distribution about 95 % of the intervals hold its centre.

    The percentile bootstrap is a little too sure at that size.
    """
    rng = np.random.default_rng(11)
    held = np.zeros(3)
    for _ in range(200):
        found = estimate(rng.logistic(4.0, size=50), ["a"] * 50)
        held += [v.low <= 4.0 <= v.high for v in (found.iqm, found.median, found.mean)]
    assert np.all((held / 200 >= 0.90) & (held / 200 <= 0.985)), held


def test_strata_make_the_interval_narrower_where_they_differ() -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(0, 1, 25), rng.normal(100, 1, 25)])
    within, without = mean_interval(values, ["a"] * 25 + ["b"] * 25), mean_interval(values, ["a"] * 50)
    assert within.high - within.low < 0.1 * (without.high - without.low)


def test_what_was_never_reached_is_infinite_in_the_median() -> None:
    limit, never = [10.0, 20.0, 300.0, 300.0], [10.0, 20.0, math.inf, math.inf]
    found = estimate(limit, ["a"] * 4, for_median=never)
    assert found.median.value == math.inf and found.median.high == math.inf and found.median.low == 10.0
    assert found.iqm.value == 160.0 and found.n == 4


def test_nothing_has_no_average() -> None:
    found = estimate([], [])
    assert found.n == 0 and math.isnan(found.iqm.value) and math.isnan(found.median.low)


def test_the_ratio_of_sums_weighs_by_way() -> None:
    found = ratio_of_sums([0, 2, 0], [10.0, 20.0, 70.0], ["a"] * 3)
    assert found.value == pytest.approx(0.02)
    assert found.low == 0.0 and found.high >= 0.05
    by_hundred = ratio_of_sums([0, 2, 0], [10.0, 20.0, 70.0], ["a"] * 3, per=100.0)
    assert (by_hundred.value, by_hundred.high) == pytest.approx((2.0, 100 * found.high))


def test_no_contact_at_all_leaves_a_rate_that_may_have_been() -> None:
    found = ratio_of_sums([0, 0, 0], [10.0, 20.0, 70.0], ["a"] * 3, per=100.0)
    assert (found.value, found.low) == (0.0, 0.0)
    assert found.high == pytest.approx(stats.chi2.ppf(0.975, 2) / 2), "Poisson's exact upper limit, of 100 m"
    assert stats.poisson.cdf(0, found.high) == pytest.approx(0.025)
    assert math.isnan(ratio_of_sums([0, 0], [10.0, 10.0], ["a", "b"]).high)
    assert math.isnan(ratio_of_sums([0, 0], [0.0, 0.0], ["a"] * 2).value), "nor has who stood still one"


# ---- shares ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("of", "n"), [(0, 4), (4, 4), (1, 10), (33, 50), (50, 50)])
def test_the_interval_of_a_share_is_scipy_s_and_never_without_width(of: int, n: int) -> None:
    found = share_interval([1.0] * of + [0.0] * (n - of), ["a"] * n)
    theirs = stats.binomtest(of, n).proportion_ci(method="wilson")
    assert found.value == of / n and (found.low, found.high) == pytest.approx((theirs.low, theirs.high))
    assert 0.0 <= found.low < found.high <= 1.0


def test_a_share_of_nothing_or_of_one_episode_has_no_interval() -> None:
    assert math.isnan(share_interval([], []).value)
    lone = share_interval([1.0, 1.0, 0.0], ["a", "a", "b"])
    assert lone.value == pytest.approx(2 / 3) and math.isnan(lone.low) and math.isnan(lone.high)


def test_the_interval_of_a_share_holds_the_true_one_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    for share in (0.5, 0.9, 0.98):
        found = [share_interval(rng.random(50) < share, ["a"] * 50) for _ in range(400)]
        assert np.mean([one.low <= share <= one.high for one in found]) > 0.9


# ---- in pairs --------------------------------------------------------------------------------------------------


def test_a_comparison_by_hand() -> None:
    ours, theirs = [1.0, 2.0, 3.0, 4.0], [2.0, 2.0, 6.0, 3.0]
    found = compare(ours, theirs, ["a"] * 4, lower_is_better=True)
    assert found.difference.value == pytest.approx(2.5 - 2.5)
    assert found.ratio.value == pytest.approx(1.0)
    assert found.probability.value == pytest.approx((1 + 0.5 + 1 + 0) / 4)
    other_way = compare(theirs, ours, ["a"] * 4, lower_is_better=True)
    assert other_way.probability.value == pytest.approx(1 - found.probability.value)
    assert compare(ours, theirs, ["a"] * 4, lower_is_better=False).probability.value == pytest.approx(0.375)


def test_two_infinite_ones_tie_and_one_loses() -> None:
    never = math.inf
    found = compare(
        [300.0, 300.0, 50.0], [300.0, 60.0, 300.0], ["a"] * 3, lower_is_better=True,
        for_rank=([never, never, 50.0], [never, 60.0, never]),
    )  # fmt: skip
    assert found.probability.value == pytest.approx((0.5 + 0 + 1) / 3)


def test_pairs_are_resampled_together() -> None:
    """Rooms differ much, agents by a constant factor: in pairs that is seen exactly."""
    theirs = np.random.default_rng(1).uniform(20.0, 200.0, 40)
    found = compare(0.8 * theirs, theirs, ["a"] * 40, lower_is_better=True)
    assert (found.ratio.low, found.ratio.value, found.ratio.high) == pytest.approx((0.8, 0.8, 0.8))
    sure = stats.binomtest(40, 40).proportion_ci(method="wilson")
    assert (found.probability.low, found.probability.high) == pytest.approx((sure.low, sure.high))


def test_every_stratum_counts_the_same() -> None:
    ours, theirs = [1.0] * 10 + [8.0] * 2, [2.0] * 10 + [1.0] * 2
    found = compare(ours, theirs, ["a"] * 10 + ["b"] * 2, lower_is_better=True)
    assert found.ratio.value == pytest.approx(math.sqrt(0.5 * 8.0))
    assert found.difference.value == pytest.approx((-1.0 + 7.0) / 2)
    assert found.probability.value == pytest.approx(0.5)
    # The two episodes of the one place leave more open than twelve would.
    twelve = stats.binomtest(6, 12).proportion_ci(method="wilson")
    assert found.probability.low < twelve.low and twelve.high < found.probability.high


def test_brute_force_of_a_stratified_comparison() -> None:
    rng = np.random.default_rng(5)
    ours, theirs, strata = rng.uniform(1, 2, 30), rng.uniform(1, 2, 30), ["a", "b", "b"] * 10
    found = compare(ours, theirs, strata, lower_is_better=True)
    ratios = []
    for at in resampled_indices(strata):
        logs = []
        for name in ("a", "b"):
            picked = [j for k, j in enumerate(at.tolist()) if strata[k] == name]
            logs.append(math.log(float(iqm(ours[picked])) / float(iqm(theirs[picked]))))
        ratios.append(math.exp(sum(logs) / 2))
    low, high = np.quantile(ratios, (0.5 * (1 - CONFIDENCE), 0.975), method="inverted_cdf")
    assert (found.ratio.low, found.ratio.high) == pytest.approx((low, high))


def test_one_episode_of_a_place_has_no_interval() -> None:
    found = estimate([1.0, 2.0, 3.0], ["a", "a", "b"])
    assert found.iqm.value == 2.0 and math.isnan(found.iqm.low) and math.isnan(found.mean.high)
    against = compare([1.0, 2.0], [2.0, 4.0], ["a", "b"], lower_is_better=True)
    assert against.ratio.value == pytest.approx(0.5) and math.isnan(against.ratio.high)


def test_no_pairs_and_no_ratio() -> None:
    assert math.isnan(compare([], [], [], lower_is_better=True).ratio.value)
    zero = compare([0.0, 0.0], [0.0, 0.0], ["a", "a"], lower_is_better=True)
    assert math.isnan(zero.ratio.value) and zero.difference.value == 0.0
    beside = compare([0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 2.0, 2.0], ["a", "a", "b", "b"], lower_is_better=True)
    assert beside.ratio.value == pytest.approx(0.5)


def test_the_same_values_give_the_same_interval() -> None:
    values = np.arange(20.0)
    assert interval(lambda at: values[at].max(axis=-1), ["a"] * 20) == interval(
        lambda at: values[at].max(axis=-1), ["b"] * 20
    )
