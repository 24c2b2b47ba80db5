"""Kriging of f: caps, noise, jumps."""

import numpy as np
import pytest

from samplers.methods.kriging import compress_outcomes, fit_kriging, outcome_scale


def points(n, dim, seed=0, scale=2.0):
    return scale * np.random.default_rng(seed).standard_normal((n, dim))


def misjudged(f, dim=2, n=80):
    """Share of fresh points whose more likely side is not theirs, after n points."""
    u, new = points(n, dim), points(2000, dim, seed=1)
    prediction = fit_kriging(u, f(u)).predict(new)
    return float(((prediction.mean <= 0) != (f(new) <= 0)).mean())


@pytest.mark.parametrize(
    "f",
    [
        lambda u: 2.5 - u[:, 0],
        lambda u: np.minimum(2.5 - u[:, 0], 1.0),  # a cap at most points
        lambda u: np.where(u[:, 0] > 2.5, -1.0, 2.5 - u[:, 0]),  # a floor where it fails
        lambda u: np.where(u[:, 0] > 2.5, -np.inf, np.minimum(2.5 - u[:, 0], 1.0)),
        lambda u: 3.0 - np.abs(u[:, 0] + 0.2 * u[:, 1] ** 2),
    ],
    ids=["plane", "capped", "floored", "capped and minus infinity", "two bent regions"],
)
def test_few_points_are_misjudged(f):
    assert misjudged(f) < 0.02


def test_censoring_serves_where_f_has_a_cap():
    """The cap is no outcome: a process through it bends the limit state."""
    u = points(80, 2)
    kriging = fit_kriging(u, np.minimum(2.5 - u[:, 0], 1.0))
    slope = np.diff(kriging.predict(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])).mean)
    assert (slope < -0.1).all()  # f itself is 1 at the first two of these


def test_noise_is_taken_as_noise():
    """With sd 0.5, P[fail] at a depth of one sd is Phi(1) = 0.84 however many points are there."""
    rng, u = np.random.default_rng(3), points(250, 1)
    kriging = fit_kriging(u, 2.0 - u[:, 0] + 0.5 * rng.standard_normal(250))
    p = np.exp(kriging.predict(np.array([[2.5], [2.0], [1.5]])).log_fail)
    np.testing.assert_allclose(p, [0.84, 0.5, 0.16], atol=0.12)


def test_posterior_covariance_has_the_predicted_variance_on_its_diagonal():
    u, new = points(40, 3), points(7, 3, seed=1)
    kriging = fit_kriging(u, 2.0 - u[:, 0] * np.exp(0.3 * u[:, 1]))
    variance = np.diag(kriging.covariance(new)) + kriging.noise
    np.testing.assert_allclose(variance, kriging.predict(new).sd ** 2, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("y", [[np.inf] * 4, [-np.inf, np.inf], [0.0, 0.0, 0.0], [1e300, -3e300]])
def test_any_outcomes_are_compressed_to_finite_numbers_of_their_sign(y):
    y = np.array(y)
    z = compress_outcomes(y, outcome_scale(y)).z
    assert np.isfinite(z).all()
    np.testing.assert_array_equal(np.sign(z), np.sign(y))


def test_failure_begins_where_points_fail_if_f_jumps_there() -> None:
    """Beyond s = 2 f is -1, before it 0.5 + 3 (2 - s): extrapolated, that would be 0 at s = 2.17 only."""
    s = np.linspace(0.0, 4.0, 81)[:, None]
    kriging = fit_kriging(s, np.where(s[:, 0] >= 2.0, -1.0, 0.5 + 3 * (2.0 - s[:, 0])))
    fail = np.exp(kriging.predict(np.array([[1.9], [2.1]])).log_fail)
    assert fail[0] < 0.5 < fail[1]
