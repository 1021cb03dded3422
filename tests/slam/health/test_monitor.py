"""The Bayes filter of the health: its recursion, its limits, and which way evidence turns it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.health.evidence import Agreement
from slam.health.monitor import HealthConfig, HealthMonitor

CONFIG = HealthConfig()
agreements = st.builds(
    lambda sharp, blurred, unseen, free: Agreement(sharp + blurred + unseen, sharp, blurred, free),
    st.integers(0, 50), st.integers(0, 50), st.integers(0, 50), st.integers(0, 100),
)  # fmt: skip


@given(st.lists(st.tuples(agreements, st.floats(0.0, 1.0)), max_size=60))
def test_health_is_a_probability_and_no_larger_than_that_of_being_fine(
    scans: list[tuple[Agreement, float]],
) -> None:
    monitor = HealthMonitor(CONFIG)
    for seen, variance in scans:
        monitor.take(seen, variance)
        assert 0.0 <= monitor.health <= monitor.fine <= 1.0


def test_one_step_is_bayes_rule() -> None:
    monitor = HealthMonitor(CONFIG)
    monitor.restart(0.5)
    monitor.take(Agreement(50, 20, 30, 50), 0.0)  # half in the open, two fifths sharp: the last and the first bin
    lost = CONFIG.against_lost[-1] * CONFIG.sharp_lost[0]
    fine = CONFIG.against_fine[-1] * CONFIG.sharp_fine[0]
    prior = 1.0 + CONFIG.lost_per_scan  # odds, with what may have happened since the last scan
    odds = prior * (lost / fine) ** CONFIG.scan_weight
    assert monitor.fine == pytest.approx(1.0 / (1.0 + odds), rel=1e-12)
    assert monitor.health == pytest.approx(monitor.fine / (1.0 + math.exp(-CONFIG.bias)), rel=1e-12)


def test_a_wide_covariance_excuses_what_a_scan_says() -> None:
    sure, unsure = HealthMonitor(CONFIG), HealthMonitor(CONFIG)
    for _ in range(8):
        sure.take(Agreement(50, 20, 30, 50), 1e-6)
        unsure.take(Agreement(50, 20, 30, 50), 1.0)
    assert sure.fine < 0.5 * unsure.fine


def test_few_beams_say_nothing() -> None:
    monitor = HealthMonitor(CONFIG)
    before = monitor.fine
    monitor.take(Agreement(0, 0, 0, CONFIG.fewest_beams - 1), 0.0)
    assert monitor.fine == pytest.approx(before, abs=2e-5)
    assert not monitor.doubtful(Agreement(0, 0, 0, CONFIG.fewest_beams - 1))
    assert monitor.doubtful(Agreement(0, 0, 0, CONFIG.fewest_beams))


def test_large_innovations_lower_it() -> None:
    monitor = HealthMonitor(CONFIG)
    values = [monitor.health]
    for _ in range(40):
        monitor.take_innovations(8.0, 4)
        values.append(monitor.health)
    assert values[-1] < 0.5 < values[0]
    assert values == sorted(values, reverse=True)
    monitor.take_innovations(math.nan, 4)
    monitor.take_innovations(1.0, 0)
    assert monitor.health == values[-1]


@pytest.mark.parametrize(
    "wrong",
    [{"against_fine": (0.5, 0.5)}, {"sharp_lost": (0.0, 1.0, 1.0, 1.0, 1.0)}, {"give_up": 0.95}, {"blur_m": 0.0}],
)
def test_settings_are_checked(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="HealthConfig"):
        HealthConfig(**wrong)  # type: ignore[arg-type]
