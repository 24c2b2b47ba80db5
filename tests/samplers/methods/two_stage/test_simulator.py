import numpy as np
import pytest

from samplers.method import Goal
from samplers.methods.two_stage.simulator import Simulator, close_trace, extend_trace
from samplers.problem import FunctionProblem

PROBLEM = FunctionProblem(lambda u: u.sum(axis=1), 3)


def test_points_are_yielded_in_physical_space_and_counted_when_their_outcomes_come(rng):
    simulator, u = Simulator(PROBLEM), rng.standard_normal((4, 3))
    steps = simulator.evaluate(u)
    np.testing.assert_array_equal(next(steps), PROBLEM.base.from_standard_normal(u))
    assert simulator.n_sim == 0  # not yet: the run may be interrupted
    with pytest.raises(StopIteration) as end:
        steps.send(np.arange(4.0))
    np.testing.assert_array_equal(end.value.value, np.arange(4.0))
    assert simulator.n_sim == 4


def test_no_points_are_no_batch():
    simulator = Simulator(PROBLEM)
    with pytest.raises(StopIteration) as end:
        next(simulator.evaluate(np.empty((0, 3))))
    assert end.value.value.shape == (0,)
    assert simulator.n_sim == 0


def test_a_level_has_the_simulations_that_no_earlier_one_has():
    seen = []
    goal = Goal(gamma=0.5, on_level=seen.append)
    trace = extend_trace((), goal, 100, p=0.2, estimate=0.2, n_points=100, cov=0.2)
    trace = extend_trace(trace, goal, 130, p=0.5, estimate=0.1, n_points=25, cov=0.3, ess=12.0)
    assert [(level.n_sim, level.n_points, level.gamma) for level in trace] == [(100, 100, 0.5), (30, 25, 0.5)]
    assert close_trace(trace, goal, 130) == trace
    closed = close_trace(trace, goal, 137)
    assert [level.n_sim for level in closed] == [100, 30, 7]
    assert np.isnan(closed[-1].estimate)
    assert tuple(seen) == closed
