import math
from types import SimpleNamespace

import numpy as np
import pytest

import samplers
from samplers.analysis.weighted import cov_inflation, no_outcome_weight, require_sample
from samplers.sample import Sample

SAMPLE = Sample(
    f=np.array([-np.inf, -1.0, 2.0, -np.inf]),
    weights=np.array([0.1, 0.2, 0.3, 0.4]),
    units=np.arange(4),
    n_units=4,
    x=np.zeros((3, 1)),
)


def estimate(**attributes):
    return SimpleNamespace(
        **{"sample": SAMPLE, "cov": 0.3, "on_error": "raise", "method": samplers.MonteCarlo(), **attributes}
    )


def test_the_sample_or_an_error_that_names_the_method():
    assert require_sample(estimate()) is SAMPLE
    with pytest.raises(ValueError, match="The method 'mc' gave no weighted points"):
        require_sample(estimate(sample=None))


@pytest.mark.parametrize(
    ("cov", "own", "factor"),
    [(0.3, 0.2, 1.5), (0.3, 0.3, 1.0), (0.2, 0.4, 1.0), (math.inf, 0.2, 1.0), (0.3, 0.0, 1.0), (0.3, math.inf, 1.0)],
)
def test_the_cov_of_units_grows_to_that_of_the_estimate_and_never_shrinks(cov, own, factor):
    assert cov_inflation(estimate(cov=cov), own) == pytest.approx(factor)


@pytest.mark.parametrize(("on_error", "weight"), [("bound", 0.5), ("failure", 0.0), ("raise", 0.0)])
def test_points_without_an_outcome_leave_the_lower_end_only_if_they_bound_it(on_error, weight):
    assert no_outcome_weight(estimate(on_error=on_error), SAMPLE) == pytest.approx(weight)


def test_an_estimate_is_a_weighted_estimate():
    result = samplers.estimate(samplers.FunctionProblem(lambda x: x[:, 0], 1), "mc", seed=1, max_sim=100)
    assert require_sample(result).n_units == 100
