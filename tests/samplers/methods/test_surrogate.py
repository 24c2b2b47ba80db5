"""Surrogate: an unbiased estimate whatever kriging says, few simulations, coverage."""

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import norm

import samplers
from samplers.limit_states import half_space, two_modes
from samplers.methods.kriging import Prediction
from samplers.methods.surrogate import Pool, build_pool_proposal, first_mixture
from samplers.problem import FunctionProblem, StandardNormal

SCALES = (1.0, 1.5, 2.2, 3.0)


def pool_of(mean, n=4000, dim=2, seed=0, sd=0.3):
    """A pool whose surrogate predicts `mean(u)` with one standard deviation everywhere."""
    mixture = first_mixture(dim, SCALES)
    u = mixture.sample(n, np.random.default_rng(seed))
    log_weights = StandardNormal(dim).log_prob(u) - mixture.log_prob(u)
    return Pool(u, log_weights, Prediction(mean(u), np.full(n, sd)))


@pytest.mark.parametrize(
    "seen_as",
    [pytest.param(2.0, marks=pytest.mark.slow), 2.5, pytest.param(99.0, marks=pytest.mark.slow)],
    ids=["right", "half a unit off", "nothing fails"],
)
def test_the_estimate_is_unbiased_whatever_the_surrogate_says(seen_as):
    """P[u_1 > 2] over 300 pools of 1,000 draws, 60 of them simulated."""
    rng, estimates = np.random.default_rng(1), []
    for seed in range(300):
        pool = pool_of(lambda u: seen_as - u[:, 0], n=1000, seed=seed)
        chosen, log_weights, _ = build_pool_proposal(pool, SCALES).draw(60, rng)
        estimates.append(np.exp(log_weights)[pool.u[chosen, 0] > 2.0].sum() / 60)
    error = np.std(estimates, ddof=1) / np.sqrt(300)
    assert abs(np.mean(estimates) - norm.sf(2.0)) < 4 * error
    assert error < 0.1 * norm.sf(2.0)


def test_many_dimensions_are_left_to_two_stage():
    result = samplers.estimate(half_space(30, 2.5).problem, samplers.Surrogate(n=100), seed=0)
    assert result.n_sim == 100  # too few for an exploration
    assert "two-stage takes over" in result.remarks[0]


@pytest.mark.slow
def test_noise_coordinates_are_not_searched():
    class Base(samplers.StandardNormal):
        noise = np.arange(102) >= 2

    class Noisy:
        """u_1 decides, with the simulator's own noise in 100 coordinates."""

        dim, base = 102, Base(102)

        def evaluate(self, x):
            return 3.0 - x[:, 0] + 0.3 * x[:, 2:].sum(axis=1) / 10.0

    result = samplers.estimate(Noisy(), "surrogate", seed=2, max_sim=300)
    p = ndtr(-3.0 / np.hypot(1.0, 0.3))
    assert not any("takes over" in text for text in result.remarks)
    assert result.interval[0] <= p <= result.interval[1]
    assert result.cov < 0.5


def run(f, dim, seed=0, max_sim=300, **options):
    return samplers.estimate(FunctionProblem(f, dim), "surrogate", seed=seed, max_sim=max_sim, **options)


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


@pytest.mark.slow
@pytest.mark.parametrize(("dim", "beta"), [(2, 3.5), (8, 3.0)])
def test_mean_and_coverage_over_many_seeds(dim, beta, study):
    found = study(half_space(dim, beta), samplers.Surrogate(n=300), 100)
    assert abs(found.ratios.mean() - 1) < 4 * found.ratios.std(ddof=1) / 10
    assert found.covered >= 88
