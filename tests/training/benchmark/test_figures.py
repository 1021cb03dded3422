"""Figures of rows: what was not reached, what is not defined, contacts, regret."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.training.benchmark.small import made_up_group
from training.benchmark.figures import comparisons, figures, with_regrets
from training.benchmark.tables import AGAINST, BY_KEY, against_table, figure, shown
from training.benchmark.team_figures import _nees_each


def test_regret_is_over_the_least_time_in_the_same_room_whoever_had_it() -> None:
    agent = made_up_group("a", time_to_95_s=[40.0, 18.0, None, 50.0])
    known = made_up_group("known-map", time_to_95_s=[20.0, 20.0, 30.0, 40.0])
    ours, theirs = with_regrets([agent, known])
    assert [row.metrics["regret_95"] for row in ours.rows] == pytest.approx([1.0, 0.0, 9.0, 0.25])
    assert [row.metrics["regret_95"] for row in theirs.rows] == pytest.approx([0.0, 20.0 / 18.0 - 1.0, 0.0, 0.0])
    found = figures(ours)["regret_95"]
    assert found.averages.median.value == pytest.approx(0.625)
    assert found.centre.value == pytest.approx((1.0 + 0.25) / 2) and found.averages.n == 4
    # Without the planner that knows the map there is no bound: none of 99 % here, none at all there.
    assert np.isnan(figures(ours)["regret_99"].centre.value)
    assert np.isnan(figures(with_regrets([agent])[0])["regret_95"].centre.value)


def test_the_median_of_a_regret_is_infinite_where_that_of_the_time_is() -> None:
    agent = made_up_group("a", time_to_95_s=[None, None, 18.0])
    known = made_up_group("known-map", time_to_95_s=[20.0, 20.0, 20.0])
    found = figures(with_regrets([agent, known])[0])
    assert found["time_to_95_s"].averages.median.value == found["regret_95"].averages.median.value == math.inf
    assert found["regret_95"].averages.mean.value == pytest.approx((14.0 + 14.0 + 0.0) / 3), "the limit, 300 s"


def test_what_was_never_reached_counts_as_the_limit_and_loses() -> None:
    group = made_up_group(time_to_95_s=[40.0, 50.0, None, None], coverage=[1.0, 1.0, 0.9, 0.8])
    found = figures(group)
    assert found["time_to_95_s"].centre.value == pytest.approx((50 + 300) / 2)
    assert found["time_to_95_s"].averages.median.value == math.inf and found["time_to_95_s"].averages.n == 4
    assert found["reached_95"].centre.value == 0.5
    other = made_up_group("b", time_to_95_s=[45.0, 45.0, 290.0, None])
    against = comparisons(group, other)["time_to_95_s"]
    assert against.probability.value == pytest.approx((1 + 0 + 0 + 0.5) / 4) and against.n == 4


def test_the_way_of_one_that_has_not_explored_is_compared_with_none() -> None:
    group = made_up_group(time_to_95_s=[40.0, None], path_length_m=[20.0, 1.0])
    other = made_up_group("b", time_to_95_s=[40.0, 40.0], path_length_m=[10.0, 10.0])
    against = comparisons(group, other)
    assert against["path_length_m"].n == 1 and against["path_length_m"].probability.value == 0.0
    cells = dict(zip(AGAINST, against_table({"a": against}, "b").rows[0][1], strict=False))
    assert cells["path_length_m"].note == "0 %, n 1" and ", n" not in cells["time_to_90_s"].note


@pytest.mark.parametrize(("episodes", "tone"), [(9, ""), (10, "better")])
def test_what_few_episodes_say_has_no_colour(episodes: int, tone: str) -> None:
    pair = [made_up_group(time_to_95_s=[time_s] * episodes) for time_s in (20.0, 40.0)]
    table = against_table({"a": comparisons(*pair)}, "b")
    assert table.rows[0][1][AGAINST.index("time_to_95_s")].tone == tone


def test_what_is_not_defined_is_left_out_and_counted() -> None:
    found = figures(made_up_group(map_iou=[0.5, None, 0.7]))["map_iou"]
    assert found.averages.n == 2 and found.centre.value == pytest.approx(0.6)
    nothing = figures(made_up_group(map_iou=[None, None]))["map_iou"]
    assert nothing.averages.n == 0 and math.isnan(nothing.centre.value)
    pairs = comparisons(made_up_group(map_iou=[0.5, None, 0.7]), made_up_group("b", map_iou=[0.4, 0.4, None]))
    assert pairs["map_iou"].n == 1 and pairs["map_iou"].probability.value == 1.0


def test_collisions_are_all_contacts_over_all_the_way() -> None:
    found = figures(made_up_group(collisions=[0, 3, 0], path_length_m=[10.0, 20.0, 70.0]))
    assert found["collisions_per_100_m"].centre.value == pytest.approx(3.0)
    assert found["collided"].centre.value == pytest.approx(1 / 3)


def test_episodes_that_all_agree_leave_something_open() -> None:
    found = figures(made_up_group(time_to_95_s=[50.0] * 4))
    reached, collided, rate = (found[key].centre for key in ("reached_95", "collided", "collisions_per_100_m"))
    assert reached.value == 1.0 and 0.4 < reached.low < 0.6 and reached.high == 1.0
    assert collided.value == 0.0 and collided.low == 0.0 and 0.4 < collided.high < 0.6
    assert rate.value == rate.low == 0.0 and rate.high == pytest.approx(100 * 3.689 / (4 * 30.0), rel=1e-3)


def test_nees_is_the_mean_which_a_few_beliefs_that_are_wrong_move() -> None:
    rng = np.random.default_rng(0)
    true = [float(rng.chisquare(3) / 3) for _ in range(2000)]
    found = figures(made_up_group(anees=true))["anees"]
    assert found.centre.value == pytest.approx(1.0, abs=0.05) and found.averages.iqm.value < 0.9
    assert found.centre.low < 1.0 < found.centre.high
    wrong = figures(made_up_group(anees=[1.0] * 9 + [171.0]))["anees"]
    assert wrong.centre.value == pytest.approx(18.0) and wrong.averages.iqm.value == 1.0


def test_a_covariance_that_rules_errors_out_is_no_rosy_figure() -> None:
    group = made_up_group(anees=[1.0, 1.0, None, None])
    nees = [np.ones(3), np.ones(3), np.array([1.0, np.inf, 1.0]), np.full(3, np.nan)]
    group = replace(group, rows=tuple(replace(row, nees=n) for row, n in zip(group.rows, nees, strict=True)))
    found = figures(group)["anees"]
    assert found.averages.mean.value == math.inf and found.averages.n == 3, "JSON has null for both"
    cell = figure(BY_KEY["anees"], found.centre)
    assert (cell.text, cell.high) == ("∞", "∞"), "what is not defined is left out, what is ruled out is not"
    assert shown(BY_KEY["anees"], group.consistency()["nees_over_3_mean"]) == "∞"
    assert _nees_each(group) == (math.inf,)
