import numpy as np
import pytest

from samplers.method import Interrupted
from samplers.methods.two_stage.discovery.joint_batches import join_batches
from samplers.methods.two_stage.simulator import Simulator
from samplers.problem import FunctionProblem
from tests.samplers.methods.two_stage.driven import driven

PROBLEM = FunctionProblem(lambda u: u[:, 0] + 10 * u[:, 1], 2)


def walk(simulator, sizes, rng):
    """Simulate so many fresh points in each of some steps; return all points and outcomes."""
    points, outcomes = [np.empty((0, 2))], [np.empty(0)]
    for n in sizes:
        points.append(rng.standard_normal((n, 2)))
        outcomes.append((yield from simulator.evaluate(points[-1])))
    return np.concatenate(points), np.concatenate(outcomes)


def sizes_of(steps):
    """Return the rows of each batch, and what the steps return."""
    sizes = []
    found = driven(steps, FunctionProblem(lambda u: sizes.append(len(u)) or PROBLEM.evaluate(u), 2))
    return sizes, found


@pytest.mark.parametrize("other", [(), (4,), (5, 6), (7, 7, 7, 7, 7)])
def test_each_gets_what_it_would_get_alone(other):
    """In as many batches as the longer one has, each as large as those of both."""
    own, simulator = (3, 1, 2), Simulator(PROBLEM)
    sizes, found = sizes_of(
        join_batches(walk(simulator, own, np.random.default_rng(1)), walk(simulator, other, np.random.default_rng(2)))
    )
    longest = max(len(own), len(other))
    padded = [np.pad(each, (0, longest - len(each))) for each in (own, other)]
    np.testing.assert_array_equal(sizes, np.sum(padded, axis=0))
    assert simulator.n_sim == sum(own) + sum(other)
    for result, steps, seed in zip(found, (own, other), (1, 2), strict=True):
        alone = driven(walk(Simulator(PROBLEM), steps, np.random.default_rng(seed)), PROBLEM)
        np.testing.assert_array_equal(result[0], alone[0])
        np.testing.assert_array_equal(result[1], alone[1])
        np.testing.assert_array_equal(result[1], PROBLEM.evaluate(result[0]))


def test_two_that_need_no_simulation_need_no_batch():
    sizes, (first, second) = sizes_of(
        join_batches(walk(Simulator(PROBLEM), (), None), walk(Simulator(PROBLEM), (0, 0), np.random.default_rng(0)))
    )
    assert sizes == []
    assert len(first[0]) == len(second[0]) == 0


def test_joint_batches_can_be_joined_again(rng):
    simulator = Simulator(PROBLEM)
    inner = join_batches(walk(simulator, (1, 1), rng), walk(simulator, (2,), rng))
    sizes, ((one, two), three) = sizes_of(join_batches(inner, walk(simulator, (4, 4, 4), rng)))
    assert sizes == [7, 5, 4]
    assert [len(each[0]) for each in (one, two, three)] == [2, 2, 12]


def test_an_interruption_reaches_both(rng):
    """Each may still count what it made before; no simulations of the batch that was waited for are counted."""
    heard = []

    def listen(steps):
        try:
            return (yield from steps)
        except Interrupted:
            heard.append(True)
            raise

    simulator = Simulator(PROBLEM)
    steps = join_batches(listen(walk(simulator, (3, 3), rng)), listen(walk(simulator, (2, 2), rng)))
    x = next(steps)
    steps.send(PROBLEM.evaluate(x))
    with pytest.raises(Interrupted):
        steps.throw(Interrupted())
    assert heard == [True, True]
    assert simulator.n_sim == 5


def test_an_error_in_one_ends_both(rng):
    def fail():
        yield rng.standard_normal((1, 2))
        raise ValueError("broken")

    steps = join_batches(fail(), walk(Simulator(PROBLEM), (1, 1), rng))
    next(steps)
    with pytest.raises(ValueError, match="broken"):
        steps.send(np.zeros(2))
