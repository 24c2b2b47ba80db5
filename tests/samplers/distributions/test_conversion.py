import sys

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.distributions import IndependentDistributions, as_distribution


def test_a_base_distribution_stays_as_it_is():
    base = samplers.StandardNormal(3)
    assert as_distribution(base) is base
    assert samplers.FunctionProblem(lambda x: x[:, 0], base=base).dim == 3


def test_one_coordinate_is_repeated():
    base = as_distribution(stats.norm(2.0, 1.0), dim=3)
    np.testing.assert_array_equal(base.from_standard_normal(np.zeros((1, 3))), [[2.0, 2.0, 2.0]])


@pytest.mark.parametrize("base", ["us101", stats.norm, samplers.StandardNormal, [], [1.0], 3.0])
def test_other_things_are_refused(base):
    with pytest.raises(ValueError, match=r"Expected a frozen distribution of scipy\.stats"):
        as_distribution(base)


def test_dimensions_must_fit():
    with pytest.raises(ValueError, match="base distribution of 3 dimensions, got 2"):
        samplers.FunctionProblem(lambda x: x[:, 0], dim=3, base=stats.multivariate_normal([0.0, 0.0]))


def test_a_base_without_a_dimension_needs_dim():
    class Mine:
        sample = log_prob = to_standard_normal = from_standard_normal = staticmethod(lambda *args: None)

    with pytest.raises(ValueError, match="Expected dim"):
        samplers.FunctionProblem(lambda x: x[:, 0], base=Mine())
    assert samplers.FunctionProblem(lambda x: x[:, 0], dim=2, base=Mine()).dim == 2


def test_lists_are_independent_in_their_order():
    base = as_distribution([stats.uniform(5.0, 1.0), stats.multivariate_normal([1.0, 2.0])])
    assert isinstance(base, IndependentDistributions)
    x = base.sample(4, np.random.default_rng(0))
    assert ((x[:, 0] > 5.0) & (x[:, 0] < 6.0)).all()
    np.testing.assert_allclose(base.log_prob(x), stats.multivariate_normal([1.0, 2.0]).logpdf(x[:, 1:]))


def test_openturns_is_not_imported():
    assert "openturns" not in {name for name in sys.modules if "samplers" in name}
    for name, module in sys.modules.items():
        if name.startswith("samplers.") and module is not None:
            assert not hasattr(module, "openturns"), name
