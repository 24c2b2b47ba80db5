import numpy as np
from scipy import stats

from samplers.distributions import IndependentDistributions, ScipyDistribution, ScipyMultivariateNormal

PARTS = (
    ScipyDistribution(stats.gamma(2.0)),
    ScipyMultivariateNormal(stats.multivariate_normal([0.0, 1.0], [[1.0, 0.5], [0.5, 2.0]])),
)


def test_each_part_has_its_columns():
    base = IndependentDistributions(PARTS)
    u = np.random.default_rng(0).standard_normal((6, 3))
    x = base.from_standard_normal(u)
    np.testing.assert_array_equal(x[:, :1], PARTS[0].from_standard_normal(u[:, :1]))
    np.testing.assert_array_equal(x[:, 1:], PARTS[1].from_standard_normal(u[:, 1:]))
    np.testing.assert_allclose(base.to_standard_normal(x), u, atol=1e-9)
    np.testing.assert_allclose(base.log_prob(x), PARTS[0].log_prob(x[:, :1]) + PARTS[1].log_prob(x[:, 1:]))
    assert base.sample(5, np.random.default_rng(1)).shape == (5, 3)
