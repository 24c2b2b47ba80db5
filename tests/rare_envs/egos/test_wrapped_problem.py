"""Problems around others have terms and gradients where these have them, and not elsewhere."""

import numpy as np

import rare_envs
import samplers
from rare_envs.egos.faults import FaultTolerant
from rare_envs.egos.wrapped_problem import WrappedProblem


def test_terms_and_gradients_go_through_any_number_of_problems() -> None:
    inner = rare_envs.DrivingProblem("rare_envs/CutIn-v0", measure="clearance")
    outer = WrappedProblem(FaultTolerant(WrappedProblem(inner)))
    x = inner.base.sample(20, np.random.default_rng(0))
    assert outer.terms is not None and outer.gradient is not None and inner.gradient is not None
    found, expected = outer.terms(x, 0.5), inner.terms(x, 0.5)
    for name in ("f", "values", "ticks", "threshold", "names"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    asked = (x, expected.least, expected.ticks[np.arange(20), expected.least], 0.5)
    np.testing.assert_array_equal(outer.gradient(*asked).values, inner.gradient(*asked).values)
    assert abs(outer.gradient(*asked).cost - inner.gradient(*asked).cost) < 1e-9


def test_a_problem_without_terms_gets_none() -> None:
    plain = samplers.FunctionProblem(lambda x: 1.0 - x[:, 0], dim=2)
    without_gradient = samplers.FunctionProblem(dim=2, terms=lambda x: 1.0 - x)
    assert WrappedProblem(plain).terms is None and WrappedProblem(plain).gradient is None
    assert WrappedProblem(without_gradient).terms is not None
    assert WrappedProblem(without_gradient).gradient is None


def test_a_measure_without_moments_has_terms_and_no_gradient() -> None:
    wrapped = FaultTolerant(rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure="pet"))
    assert wrapped.terms is not None and wrapped.gradient is None
