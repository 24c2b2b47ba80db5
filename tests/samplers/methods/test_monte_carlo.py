import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space

EASY = half_space(2, beta=1.5)


def test_is_the_share_of_failures_with_the_exact_interval():
    result = samplers.estimate(EASY.problem, "mc", seed=1, max_sim=2000)
    assert result.p == result.failures.total / 2000
    assert result.gain == pytest.approx(1.0)
    assert result.interval == samplers.statistics.clopper_pearson(result.failures.total, 2000, 0.95)


def test_stops_at_the_target():
    method = samplers.MonteCarlo(batch=500)
    result = samplers.estimate(EASY.problem, method, seed=1, target_cov=0.1)
    assert result.cov <= 0.1
    assert result.status == "converged"
    # (1 - p) / (p 0.01) = 1397 expected, and one batch more at most
    assert 1000 <= result.n_sim <= 2500
    assert result.trace[-2].cov > 0.1


def test_says_when_the_target_was_missed():
    result = samplers.estimate(EASY.problem, "mc", seed=1, target_cov=0.01, max_sim=3000)
    assert result.status == "budget"
    assert any("target" in text for text in result.remarks)


def test_without_max_sim_n_is_the_limit():
    result = samplers.estimate(EASY.problem, samplers.MonteCarlo(n=2000), seed=1, target_cov=0.01)
    assert result.n_sim == 2000
    assert result.status == "budget"


def test_few_hits_are_worth_a_warning():
    result = samplers.estimate(EASY.problem, "mc", seed=2, max_sim=30)
    assert 0 < result.failures.total < 5
    assert "coarse" in result.warnings[0]


def test_draws_from_the_base_itself():
    """Its points come from base.sample: a base needs no map from standard normal space."""

    class Base(samplers.StandardNormal):
        def from_standard_normal(self, u):
            raise NotImplementedError  # as a base says that it has no map

    class Problem:
        dim, base = 2, Base(2)

        def evaluate(self, x):
            return x[:, 0]

    assert samplers.estimate(Problem(), "mc", seed=1, max_sim=100).p > 0.3


@pytest.mark.parametrize("settings", [{"n": 0}, {"batch": 0}, {"n": 10.5}])
def test_settings_out_of_range(settings):
    with pytest.raises(ValueError, match="whole number of at least 1"):
        samplers.MonteCarlo(**settings)


def test_gives_all_its_draws_with_equal_weight(recorder):
    f = recorder(EASY.problem.f)
    result = samplers.estimate(samplers.FunctionProblem(f, 2), samplers.MonteCarlo(batch=300), seed=1, max_sim=1000)
    sample = result.sample
    np.testing.assert_array_equal(sample.f, EASY.problem.f(f.points))
    np.testing.assert_array_equal(sample.weights, 1e-3)
    np.testing.assert_array_equal(sample.units, np.arange(1000))
    assert sample.n_units == 1000
    np.testing.assert_array_equal(sample.x, f.points[sample.f <= 0])


def test_the_papers_stop_at_a_relative_half_width_of_a_fifth():
    result = samplers.estimate(EASY.problem, samplers.MonteCarlo(batch=100), seed=1, target_cov=0.102)
    half_width = (result.interval[1] - result.interval[0]) / 2
    assert half_width / result.p == pytest.approx(0.2, rel=0.05)
