"""Runs of the method, beyond what every method is tested for."""

import numpy as np
import pytest
from scipy.special import ndtr

import samplers
from samplers.limit_states import half_space, two_modes
from samplers.problem import FunctionProblem


def run(f, dim, seed=0, max_sim=300, **options):
    return samplers.estimate(FunctionProblem(f, dim), "surrogate", seed=seed, max_sim=max_sim, **options)


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


def test_a_surrogate_without_skill_says_so():
    """Every point fails by chance of its own: nothing can be learned."""
    rng = np.random.default_rng(5)
    result = run(lambda u: np.where(rng.random(len(u)) < 0.01, -1.0, 1.0), 4)
    assert any("fits f poorly" in text for text in result.warnings)
    assert result.interval[0] <= 0.01 <= result.interval[1]


def test_no_failure_is_left_to_plain_monte_carlo():
    result = run(lambda u: 20.0 - u[:, 0], 2)
    assert result.p == 0
    assert result.status is samplers.Status.NO_HITS
    assert any("for learning failed" in text for text in result.remarks)


def test_common_failure_is_left_to_plain_monte_carlo():
    result = run(lambda u: -u[:, 0], 2)
    assert result.base_draws > 200  # all but the design
    assert result.interval[0] < 0.5 < result.interval[1]


def test_a_target_ends_the_draws():
    result = run(half_space(2, 3.0).problem.f, 2, max_sim=5000, target_cov=0.1)
    assert result.cov <= 0.1
    assert result.n_sim < 2000


@pytest.mark.slow
@pytest.mark.parametrize(("dim", "beta"), [(2, 3.5), (8, 3.0)])
def test_mean_and_coverage_over_many_seeds(dim, beta, study):
    found = study(half_space(dim, beta), samplers.Surrogate(n=300), 100)
    assert abs(found.ratios.mean() - 1) < 4 * found.ratios.std(ddof=1) / 10
    assert found.covered >= 88
