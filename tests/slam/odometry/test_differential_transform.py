"""Taylor spectra, and paper C's filter that is solved by them: against calculus, and against stiff solvers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

from slam.odometry.differential_transform import MODELS, PowerModel, fill_model, fit_pade, make_model
from slam.odometry.riccati import RECOVERIES, Tolerances
from slam.odometry.transform_filter import KalmanBucyFilter

ORDER = 8
spectra = st.lists(st.floats(-3, 3), min_size=ORDER + 1, max_size=ORDER + 1).map(np.array)
R, Q = 1e-3, 1e-2
SPAN = (1.0, 6.0)


def exponential(rate: float, h: float, order: int) -> np.ndarray:
    return np.array([(rate * h) ** k / math.factorial(k) for k in range(order + 1)])


def matrix(model: PowerModel, t: float) -> np.ndarray:
    """F(t) written out, not taken from its spectrum."""
    if model.name == "uniform_acceleration":
        return np.array([[0, 1], [-2 / t**2, 2 / t]])
    if model.name == "as_printed":
        return np.array([[0, 1], [2 / t**2, -2 / t]])
    return np.diag(np.ones(model.size - 1), 1)


def stiff(model: PowerModel, cov: np.ndarray, times: np.ndarray) -> np.ndarray:
    n, noise = model.size, Q * np.outer(model.drive, model.drive)

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        p = y.reshape(n, n)
        f = matrix(model, t)
        return (f @ p + p @ f.T - np.outer(p[:, 0], p[0]) / R + noise).ravel()

    solved = solve_ivp(
        slope, (times[0], times[-1]), cov.ravel(), method="Radau", t_eval=times, rtol=1e-10, atol=1e-14
    )
    return solved.y.T.reshape(-1, n, n)


def spectrum(model: PowerModel, t0: float, h: float, order: int) -> np.ndarray:
    """The spectra ``(order + 1, n, n)`` of F about t₀ with scale h."""
    f = np.zeros((order + 1, model.size, model.size))
    fill_model(model.powers, model.matrices, t0, h, np.zeros(order + 1), f)
    return f


def power(exponent: float, t0: float, h: float, order: int) -> np.ndarray:
    """The spectrum of tᵖ: that of a model with a single state."""
    return spectrum(PowerModel("power", powers=[exponent], matrices=[[[1.0]]], drive=[1.0]), t0, h, order)[:, 0, 0]


def product(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The spectrum of a product: a convolution."""
    return np.convolve(x, y)[: min(len(x), len(y))]


def evaluate(x: np.ndarray, share: float) -> float:
    return float(np.polyval(x[::-1], share))


def pade(x: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Numerator and denominator of the [m/m] fraction of 2m + 1 discretes; None where there is none."""
    m = len(x) // 2
    below = np.zeros(m)
    if not fit_pade(np.asarray(x, np.float64), np.empty((m, m + 1)), below):
        return None
    denominator = np.concatenate([[1.0], below])
    return product(x[: m + 1], denominator), denominator


# ---- spectra ---------------------------------------------------------------------------------------------------


@given(st.sampled_from([-2.0, -1.0, 0.0, 0.5, 1.0, 2.0, 3.0]), st.floats(0.5, 5), st.floats(-0.3, 0.3))
def test_powers_of_t(exponent: float, t0: float, share: float) -> None:
    h = t0
    value = evaluate(power(exponent, t0, h, 30), share)
    assert value == pytest.approx((t0 + share * h) ** exponent, rel=1e-9)
    by_product = product(power(exponent, t0, h, ORDER), power(-1.0, t0, h, ORDER))
    np.testing.assert_allclose(by_product, power(exponent - 1.0, t0, h, ORDER), rtol=1e-9, atol=1e-12)


def test_powers_about_zero_and_where_there_are_none() -> None:
    np.testing.assert_array_equal(power(2, 0.0, 0.5, 3), [0, 0, 0.25, 0])
    np.testing.assert_allclose(evaluate(power(-1, -2.0, 1.0, 30), 0.5), 1 / -1.5)


# ---- Padé ------------------------------------------------------------------------------------------------------


@given(spectra)
def test_a_fraction_agrees_with_its_series(x: np.ndarray) -> None:
    found = pade(x[:7])
    if found is None:
        return
    above, below = found
    if np.abs(below).max() > 1e3:
        return
    np.testing.assert_allclose(product(np.pad(below, (0, 3)), x[:7])[:4], above[:4], atol=1e-6)
    rest = product(np.pad(below, (0, 3)), x[:7])[4:]
    np.testing.assert_allclose(rest, 0, atol=1e-6 * max(1.0, np.abs(below).max()))


def test_a_fraction_reaches_beyond_the_radius() -> None:
    """1/(1 + θ) has a pole at -1: its series diverges from θ = 1 on, the fraction of it is itself."""
    x = power(-1.0, 1.0, 1.0, 6)
    found = pade(2 * x + 0.5 * exponential(-1.0, 1.0, 6))
    assert found is not None
    share = 2.0
    value = evaluate(found[0], share) / evaluate(found[1], share)
    truth = 2 / 3 + 0.5 * math.exp(-2)
    assert abs(value - truth) < 2e-3
    assert abs(evaluate(2 * x + 0.5 * exponential(-1.0, 1.0, 6), share) - truth) > 10


@pytest.mark.parametrize("x", [[1, 0, 0, 0, 0, 0, 0], [1, 2, 3, 0, 0, 0, 0], [0] * 7, [1, -1, 1, -1, 1, -1, 1]])
def test_singular_systems_fall_back(x: list[float]) -> None:
    assert pade(np.array(x, float)) is None


# ---- models ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "exponents"), [("uniform_acceleration", (1, 2)), ("as_printed", (1, -2))]
)  # fmt: skip
@given(t=st.floats(0.3, 20))
def test_what_solves_the_models(name: str, exponents: tuple[int, int], t: float) -> None:
    """Of uniform acceleration t and t², of the print t and t⁻²: x'' = F₂₁ x + F₂₂ x'."""
    f = spectrum(make_model(name), t, 1.0, 0)[0]
    np.testing.assert_allclose(f, matrix(make_model(name), t), rtol=1e-12)
    for p in exponents:
        x, rate, second = t**p, p * t ** (p - 1), p * (p - 1) * t ** (p - 2)
        assert f[1] @ [x, rate] == pytest.approx(second, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_models_are_their_spectra(name: str) -> None:
    model, t0, h = make_model(name), 2.0, 0.5
    f = spectrum(model, t0, h, 40)
    there = np.einsum("kab,k->ab", f, 0.8 ** np.arange(41))
    np.testing.assert_allclose(there, matrix(model, t0 + 0.8 * h), atol=1e-12)


def test_unknown_models_are_named() -> None:
    with pytest.raises(ValueError, match=r"unknown motion model 'uniform'.*valid: as_printed, constant_velocity"):
        make_model("uniform")
    with pytest.raises(ValueError, match="no meaning at t = 0"):
        KalmanBucyFilter("uniform_acceleration", measurement=R, process=Q).reset(time=0.0)
    with pytest.raises(ValueError, match=r"recovery must be one of pade, series, got 'pad'.*did you mean 'pade'"):
        Tolerances(recovery="pad")
    with pytest.raises(ValueError, match="takes a state of 2 numbers"):
        KalmanBucyFilter("constant_velocity", measurement=R, process=Q).reset(state=np.zeros(3))


# ---- the covariance --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recovery", RECOVERIES)
@pytest.mark.parametrize("name", MODELS)
def test_the_covariance_is_that_of_a_stiff_solver(name: str, recovery: str) -> None:
    model = make_model(name)
    times = np.linspace(*SPAN, 41)
    cov = np.diag([1.0, 0.5, 0.2][: model.size])  # η/R = 1000: a stiff start
    true = stiff(model, cov, times)
    kalman = KalmanBucyFilter(model, measurement=R, process=Q, tolerances=Tolerances(recovery=recovery))
    kalman.reset(time=times[0], cov=cov)
    for k, span in enumerate(np.diff(times), start=1):
        kalman.advance(float(span))
        scale = np.sqrt(np.outer(np.diag(true[k]), np.diag(true[k])))
        assert np.max(np.abs(kalman.cov - true[k]) / scale) < 1e-6
        assert np.max(np.abs(kalman.cov - true[k])) < 1e-6
        assert np.linalg.eigvalsh(kalman.cov).min() > 0


@pytest.mark.parametrize("name", ["constant_velocity", "wiener_acceleration"])
def test_it_settles_at_the_algebraic_riccati_equation(name: str) -> None:
    model = make_model(name)
    h = np.eye(model.size)[:1]
    steady = solve_continuous_are(
        matrix(model, 1.0).T, h.T, Q * np.outer(model.drive, model.drive), np.array([[R]])
    )
    kalman = KalmanBucyFilter(model, measurement=R, process=Q)
    kalman.reset(time=0.0, cov=np.eye(model.size))
    kalman.advance(40.0)
    np.testing.assert_allclose(kalman.cov, steady, rtol=1e-6)


def test_one_long_step_is_many_short_ones_beyond_the_pole() -> None:
    """From t₀ = 0.05 on, 400 times the distance of F's pole at 0, in one go: it is expanded anew on the way."""
    ends = []
    for steps in (1, 200):
        kalman = KalmanBucyFilter("uniform_acceleration", measurement=R, process=Q)
        kalman.reset(time=0.05, cov=np.diag([0.01, 0.04]))
        for _ in range(steps):
            kalman.advance(20.0 / steps)
        ends.append(kalman.cov)
        assert kalman.expansions > 10
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_a_fraction_takes_no_more_expansions_than_the_series(name: str) -> None:
    taken = {}
    for recovery in RECOVERIES:
        kalman = KalmanBucyFilter(name, measurement=R, process=Q, tolerances=Tolerances(recovery=recovery))
        kalman.reset(time=1.0, cov=np.eye(make_model(name).size))
        kalman.advance(5.0)
        taken[recovery] = kalman.expansions
    assert taken["pade"] < taken["series"]


@pytest.mark.parametrize("order", [2, 4, 12, 20])
def test_other_orders_agree(order: int) -> None:
    covs = []
    for tolerances in (Tolerances(), Tolerances(order=order, relative=1e-8)):
        kalman = KalmanBucyFilter("as_printed", measurement=R, process=Q, tolerances=tolerances)
        kalman.reset(time=1.0, cov=np.eye(2))
        kalman.advance(1.0)
        covs.append(kalman.cov)
    np.testing.assert_allclose(covs[1], covs[0], rtol=1e-5)


def test_nothing_known_wrong_and_nothing_known_at_all() -> None:
    kalman = KalmanBucyFilter("constant_velocity", measurement=R, process=0.0)
    kalman.reset(time=0.0, state=[1.0, 2.0])
    kalman.advance(0.5, 99.0)  # without uncertainty no measurement counts
    np.testing.assert_allclose(kalman.state, [2.0, 2.0], rtol=1e-9)
    np.testing.assert_array_equal(kalman.cov, np.zeros((2, 2)))
    kalman = KalmanBucyFilter("constant_velocity", measurement=R, process=Q)
    kalman.reset(time=0.0)
    kalman.advance(1e-3)
    expected = Q * np.array([[1e-9 / 3, 1e-6 / 2], [1e-6 / 2, 1e-3]])
    np.testing.assert_allclose(kalman.cov, expected, rtol=1e-4)


def test_a_model_that_starts_at_time_zero() -> None:
    """F₂₂ = -t, whose spectrum about 0 is one discrete; against a stiff solver."""
    model = PowerModel("slowing", powers=[0, 1], matrices=[[[0, 1], [0, 0]], [[0, 0], [0, -1]]], drive=[0.0, 1.0])

    def slope(t: float, y: np.ndarray) -> Any:
        p, f = y.reshape(2, 2), np.array([[0, 1], [0, -t]])
        return (f @ p + p @ f.T - np.outer(p[:, 0], p[0]) / R + np.diag([0, Q])).ravel()

    true = solve_ivp(slope, (0, 2), np.eye(2).ravel(), method="Radau", rtol=1e-10, atol=1e-13).y[:, -1]
    kalman = KalmanBucyFilter(model, measurement=R, process=Q)
    kalman.reset(time=0, cov=np.eye(2))
    kalman.advance(2.0)
    np.testing.assert_allclose(kalman.cov.ravel(), true, rtol=1e-6)


# ---- the estimate ----------------------------------------------------------------------------------------------


def test_the_estimate_is_that_of_a_stiff_solver() -> None:
    model = make_model("uniform_acceleration")
    start, cov = np.array([1.0, 0.5]), np.diag([0.04, 0.09])

    def slope(t: float, y: np.ndarray) -> Any:
        x, p = y[:2], y[2:].reshape(2, 2)
        f, z = matrix(model, t), 1.1 + 2.0 * (t - 1.0)
        rate = f @ p + p @ f.T - np.outer(p[:, 0], p[0]) / R + np.diag([0, Q])
        return np.concatenate([f @ x + p[:, 0] / R * (z - x[0]), rate.ravel()])

    true = solve_ivp(
        slope, (1.0, 2.5), np.concatenate([start, cov.ravel()]), method="Radau", rtol=1e-10, atol=1e-13
    ).y[:, -1]
    kalman = KalmanBucyFilter(model, measurement=R, process=Q)
    kalman.reset(time=1.0, state=start, cov=cov, measurement=1.1)
    for k in range(1, 6):
        kalman.advance(0.3, 1.1 + 0.6 * k)
    np.testing.assert_allclose(kalman.state, true[:2], rtol=1e-6)


def test_a_perfect_start_stays_perfect_and_a_wrong_one_is_forgotten() -> None:
    for off in (0.0, 0.1):
        kalman = KalmanBucyFilter("uniform_acceleration", measurement=1e-4, process=1e-2)
        t, errors = 1.0, []
        kalman.reset(
            time=t, state=(1 + off) * np.array([1.25, 1.5]), cov=np.diag([0.125**2, 0.15**2]), measurement=1.25
        )
        for _ in range(500):
            t += 0.01
            kalman.advance(0.01, t + 0.25 * t**2)
            errors.append(abs(kalman.state[0] - t - 0.25 * t**2))
        # Between samples z is not quite straight: a Δt²/12 above its chord on average.
        assert max(errors[-100:]) < 1.1 * 0.5 * 0.01**2 / 12
        assert off or max(errors) < 1e-5
    with pytest.raises(ValueError, match="a measurement must be finite"):
        kalman.advance(0.1, math.nan)
    with pytest.raises(ValueError, match="a step must be above 0 s"):
        kalman.advance(0.0)


def test_errors_are_as_large_as_the_filter_says() -> None:
    """Sampled measurements of σ² = R/Δt: NEES of a simulated constant-velocity walk, 300 runs."""
    rng = np.random.Generator(np.random.PCG64(5))
    dt, r, q = 0.01, 1e-4, 1e-1
    kalman = KalmanBucyFilter("constant_velocity", measurement=r, process=q)
    chol = np.linalg.cholesky(q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    nees = []
    for _ in range(300):
        start = np.diag([0.02, 0.1]) @ rng.standard_normal(2)
        x = start.copy()
        noisy = x[0] + math.sqrt(r / dt) * rng.standard_normal()
        kalman.reset(time=0.0, cov=np.diag([0.02**2, 0.1**2]), measurement=noisy)
        for _ in range(80):
            x = np.array([x[0] + dt * x[1], x[1]]) + chol @ rng.standard_normal(2)
            kalman.advance(dt, x[0] + math.sqrt(r / dt) * rng.standard_normal())
        e = kalman.state - x
        nees.append(e @ np.linalg.solve(kalman.cov, e) / 2)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.2)


def test_what_is_not_finite_or_not_a_covariance_is_refused() -> None:
    kalman = KalmanBucyFilter("constant_velocity", measurement=R, process=Q)
    for wrong, message in (
        ({"measurement": math.nan}, "a measurement must be finite"),
        ({"measurement": math.inf}, "a measurement must be finite"),
        ({"time": math.nan}, "time must be finite"),
        ({"state": [math.nan, 0.0]}, "a start must be finite"),
        ({"cov": [[1.0, math.nan], [math.nan, 1.0]]}, "a start must be finite"),
        ({"cov": [[1.0, 0.5], [0.0, 1.0]]}, "must be symmetric"),
    ):
        with pytest.raises(ValueError, match=message):
            kalman.reset(**wrong)
    kalman.reset(cov=np.eye(2))
    with pytest.raises(ValueError, match="a measurement must be finite"):
        kalman.advance(0.1, math.nan)
    np.testing.assert_array_equal(kalman.cov, np.eye(2))
