"""Surrogate: an unbiased estimate whatever kriging says, few simulations, coverage."""

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import norm

import samplers
from samplers.limit_states import two_modes
from samplers.methods.kriging import Prediction, fit_kriging
from samplers.methods.surrogate import Pool, draw_to_simulate, isotropic_mixture
from samplers.problem import FunctionProblem, StandardNormal


def pool_of(mean, n=4000, dim=2, seed=0, sd=0.3):
    """A pool whose surrogate predicts `mean(u)` with one standard deviation everywhere."""
    mixture = isotropic_mixture(dim)
    u = mixture.sample(n, np.random.default_rng(seed))
    log_weights = StandardNormal(dim).log_prob(u) - mixture.log_prob(u)
    return Pool(u, log_weights, Prediction(mean(u), np.full(n, sd)))


@pytest.mark.parametrize(
    ("seen_as", "expected"),
    [(2.5, 0.012), pytest.param(99.0, 0.104, marks=pytest.mark.slow)],
    ids=["half a unit off", "nothing fails"],
)
def test_the_estimate_is_unbiased_whatever_the_surrogate_says(seen_as, expected):
    """P[u_1 > 2] over 300 pools of 1,000 draws, 60 of them simulated; expected: error / p by the known densities."""
    rng, estimates = np.random.default_rng(1), []
    for seed in range(300):
        pool = pool_of(lambda u: seen_as - u[:, 0], n=1000, seed=seed)
        chosen, log_weights, _ = draw_to_simulate(pool, 60, rng)
        estimates.append(np.exp(log_weights)[pool.u[chosen, 0] > 2.0].sum() / 60)
    error = np.std(estimates, ddof=1) / np.sqrt(300)
    assert abs(np.mean(estimates) - norm.sf(2.0)) < 4 * error
    assert error == pytest.approx(expected * norm.sf(2.0), rel=0.3)


def run(f, dim, seed=0):
    return samplers.estimate(FunctionProblem(f, dim), "surrogate", seed=seed, max_sim=300)


@pytest.mark.slow
def test_capped_floored_outcomes_of_a_few_simulations_give_a_narrow_interval():
    """-1 on collision, else a time that is capped at most points; P = Phi(-3) Phi(1)."""

    def f(u):
        depth = np.maximum(3.0 - u[:, 0], u[:, 1] - 1.0)
        return np.where(depth <= 0, -1.0, np.minimum(2.0 * depth, 3.0))

    p = ndtr(-3.0) * ndtr(1.0)
    results = [run(f, 3, seed) for seed in range(2)]
    ratios = np.array([result.p for result in results]) / p
    assert np.sqrt(np.mean((ratios - 1) ** 2)) < 0.3  # 300 base draws: 1.7
    assert sum(result.interval[0] <= p <= result.interval[1] for result in results) >= 1


@pytest.mark.slow
def test_two_regions_and_few_batches():
    reference = two_modes()
    started = samplers.Surrogate().start(reference.problem, seed=1, max_sim=300)
    sizes = []
    while not started.done:
        x = started.ask()
        sizes.append(len(x))
        started.tell(reference.problem.f(x))
    result = started.result()
    assert len(sizes) <= 30  # the simulator works on whole batches
    assert result.interval[0] <= reference.p <= result.interval[1]
    assert sum(sizes[-2:]) >= 100  # a third of them at least is left for the estimate, in two parts
    assert [level.n_sim for level in result.trace[-2:]] == sizes[-2:]


@pytest.mark.slow
def test_no_failure_is_left_to_plain_monte_carlo():
    result = run(lambda u: 20.0 - u[:, 0], 2)
    assert result.p == 0
    assert result.status is samplers.Status.NO_HITS
    assert any("for learning failed" in text for text in result.remarks)


def points(n, dim, seed=0, scale=2.0):
    return scale * np.random.default_rng(seed).standard_normal((n, dim))


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
    """Fresh points whose more likely side is not theirs, after 80 points."""
    u, new = points(80, 2), points(2000, 2, seed=1)
    prediction = fit_kriging(u, f(u)).predict(new)
    assert ((prediction.mean <= 0) != (f(new) <= 0)).mean() < 0.02


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


def test_failure_begins_where_points_fail_if_f_jumps_there() -> None:
    """Beyond s = 2 f is -1, before it 0.5 + 3 (2 - s): extrapolated, that would be 0 at s = 2.17 only."""
    s = np.linspace(0.0, 4.0, 81)[:, None]
    kriging = fit_kriging(s, np.where(s[:, 0] >= 2.0, -1.0, 0.5 + 3 * (2.0 - s[:, 0])))
    fail = np.exp(kriging.predict(np.array([[1.9], [2.1]])).log_fail)
    assert fail[0] < 0.5 < fail[1]
