"""Problems around others have terms and gradients where these have them, and not elsewhere."""

import numpy as np
import pytest

import rare_envs
import samplers
from rare_envs.egos.faults import FaultTolerant
from rare_envs.egos.wrapped_problem import WrappedProblem
from samplers.statistics import clopper_pearson


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


def test_scripts_with_compiled_rollouts_have_no_terms_beside_f_whichever_core_simulates() -> None:
    for core in ("torch", "auto"):
        problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", core=core)
        assert not problem.terms_with_f and not WrappedProblem(problem).terms_with_f
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure="clearance", core="torch")
    assert problem.terms_with_f and WrappedProblem(problem).terms_with_f


class Policy:
    """A black box: brakes the harder, the nearer the lead is."""

    def predict(self, observation: np.ndarray, **_: object) -> tuple[np.ndarray, None]:
        brake = -np.clip(1.0 - observation[:, 3], 0.0, 1.0)
        return np.stack((brake, 0.0 * brake), 1).astype(np.float32), None


@pytest.mark.slow
def test_a_black_box_on_the_highway_is_searched_by_terms_with_its_actions_as_given() -> None:
    """Of the two rates at a 95 % interval each, both can be wrong by chance in 1 of 400 runs."""
    problem = rare_envs.DrivingProblem("rare_envs/Highway-v0", ego=Policy())
    assert problem.gradient is not None and problem.gradient.black_box
    result = samplers.estimate(problem, samplers.TwoStage(), seed=0, max_sim=1500)
    f = problem.evaluate(problem.base.sample(1000, np.random.default_rng(1)))
    low, high = clopper_pearson(int((f <= 0).sum()), 1000, 0.95)
    assert low <= result.interval[1] and result.interval[0] <= high
    assert not any("subset simulation" in text for text in result.remarks)
