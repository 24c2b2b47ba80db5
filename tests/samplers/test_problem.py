import numpy as np
import pytest
from scipy import stats

import samplers


def test_standard_normal_density_and_map(rng):
    base = samplers.StandardNormal(3)
    x = base.sample(50, rng)
    np.testing.assert_allclose(base.log_prob(x), stats.multivariate_normal(np.zeros(3)).logpdf(x))
    np.testing.assert_array_equal(base.from_standard_normal(base.to_standard_normal(x)), x)
    assert isinstance(base, samplers.Distribution)


def test_function_problem_is_a_problem():
    problem = samplers.FunctionProblem(lambda x: x.sum(axis=1), 2)
    assert isinstance(problem, samplers.Problem)
    np.testing.assert_array_equal(problem.evaluate(np.ones((3, 2))), [2.0, 2.0, 2.0])


@pytest.mark.parametrize("dim", [0, -1, 2.0, "2", True])
def test_dim_must_be_a_positive_whole_number(dim):
    with pytest.raises(ValueError, match="whole number of at least 1"):
        samplers.FunctionProblem(lambda x: x[:, 0], dim)


def test_f_must_be_callable():
    with pytest.raises(ValueError, match="function"):
        samplers.FunctionProblem(3.0, 2)
