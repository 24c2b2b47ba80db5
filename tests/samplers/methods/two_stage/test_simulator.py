import numpy as np
import pytest

from samplers.methods.two_stage.simulator import Simulator
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
