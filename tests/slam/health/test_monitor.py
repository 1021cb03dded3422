"""The Bayes filter of the health: its recursion, its limits, and which way evidence turns it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import slam
from slam import Observations, Odometry
from slam.geometry import compose, exp, rotation
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
        monitor.take_innovations(40.0, 4)
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


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf", "compressed-ekf"])
def test_a_filter_whose_noise_is_as_stated_is_healthy(name: str) -> None:
    rng = np.random.default_rng(0)
    points, cov = rng.uniform(-8.0, 8.0, (30, 2)), np.diag([0.05**2, 0.01**2])
    backend = slam.make(name, config={"odometry": {"slip_share": 0.0}})
    backend.reset(pose := np.zeros(3))
    noise = backend.config.odometry
    for k in range(150):
        twist = np.array([0.5, 0.0, 0.3 + 0.2 * math.sin(k / 20.0)])
        pose = compose(pose, exp(0.1 * twist))
        linear, turning = noise.variances(*twist)
        measured = twist + np.sqrt([linear, linear, turning]) * rng.standard_normal(3)
        backend.predict(Odometry(tuple(measured.tolist()), 0.1))
        sensor = compose(pose, np.array([0.2, 0.0, 0.0]))
        seen = (points - sensor[:2]) @ rotation(sensor[2])
        ids = np.flatnonzero(np.hypot(*seen.T) < 6.0)
        polar = np.column_stack([np.hypot(*seen[ids].T), np.arctan2(*seen[ids, ::-1].T)])
        polar += rng.standard_normal(polar.shape) @ np.sqrt(cov)
        backend.observe(Observations(polar, np.tile(cov, (len(ids), 1, 1)), ids))
    assert backend.pose_nees(pose) < 14.16 and backend.health > 0.9
