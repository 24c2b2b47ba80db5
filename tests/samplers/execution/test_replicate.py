import math

import numpy as np
import pytest

from samplers.execution.replicate import NOT_KNOWN, Replicate
from samplers.method import Goal, Interrupted, Outcome
from samplers.trace import Status

OUTCOME = Outcome(p=0.5, interval=(0.4, 0.6), cov=0.1, status=Status.CONVERGED)
STOPPED = Outcome(p=0.25, interval=(0.0, 1.0), cov=0.5, status=Status.STOPPED)


def batches(*sizes, dim=2, seen=None, when_interrupted="conclude"):
    """Steps that request batches of these sizes and keep the values they are sent in `seen`."""
    try:
        for size in sizes:
            f = yield np.full((size, dim), float(size))
            if seen is not None:
                seen.append(f)
    except Interrupted:
        if when_interrupted == "conclude":
            return STOPPED
        if when_interrupted == "go on":
            yield np.zeros((1, dim))
        raise
    return OUTCOME


def start(steps, max_sim=None):
    return Replicate(steps, Goal(gamma=0.0, max_sim=max_sim), 2)


def test_points_are_requested_batch_by_batch_until_the_outcome():
    seen = []
    run = start(batches(3, 2, seen=seen))
    assert run.running
    assert run.requested.shape == (3, 2)
    run.tell(np.arange(3.0))
    assert (run.requested.shape, run.n_sim) == ((2, 2), 3)
    run.tell(np.arange(2.0))
    assert not run.running
    assert (run.outcome, run.n_sim, run.requested.shape) == (OUTCOME, 5, (0, 2))
    assert [f.tolist() for f in seen] == [[0.0, 1.0, 2.0], [0.0, 1.0]]


def test_empty_batches_are_answered_at_once():
    seen = []
    run = start(batches(0, 0, 1, 0, seen=seen))
    assert run.requested.shape == (1, 2)
    run.tell(np.array([7.0]))
    assert run.outcome is OUTCOME
    assert [f.tolist() for f in seen] == [[], [], [7.0], []]


def test_steps_that_need_no_simulation_have_their_outcome_at_once():
    run = start(batches())
    assert (run.running, run.n_sim, run.outcome) == (False, 0, OUTCOME)


def test_exactly_the_budget_may_be_requested_and_no_point_more():
    run = start(batches(3, 2, 1), max_sim=5)
    run.tell(np.zeros(3))
    with pytest.raises(RuntimeError, match="asked for 1 simulations with 0 of max_sim=5 left"):
        run.tell(np.zeros(2))


@pytest.mark.parametrize("shape", [(3,), (3, 1), (3, 3), (1, 3, 2)])
def test_points_of_the_wrong_shape_are_refused(shape):
    def steps():
        yield np.zeros(shape)

    with pytest.raises(ValueError, match=r"Expected x of shape \(n, 2\), got \("):
        start(steps())


def test_an_interrupted_method_concludes_from_what_it_was_told():
    run = start(batches(3, 2))
    run.tell(np.zeros(3))
    run.interrupt()
    assert (run.outcome, run.running, run.requested.shape) == (STOPPED, False, (0, 2))


@pytest.mark.parametrize("what", ["raise", "go on"])
def test_a_method_that_does_not_conclude_knows_nothing(what):
    run = start(batches(3, 2, when_interrupted=what))
    run.tell(np.zeros(3))
    run.interrupt()
    assert run.outcome is NOT_KNOWN
    assert (NOT_KNOWN.p, NOT_KNOWN.interval, NOT_KNOWN.cov) == (0.0, (0.0, 1.0), math.inf)


def test_a_method_that_was_told_nothing_is_not_interrupted_but_closed():
    closed = []

    def steps():
        try:
            yield np.zeros((1, 2))
        finally:
            closed.append(True)

    run = start(steps())
    run.interrupt()
    assert run.outcome is NOT_KNOWN
    assert closed == [True]


@pytest.mark.parametrize("value", [None, 0.5, {"p": 0.5}])
def test_steps_must_return_an_outcome(value):
    def steps():
        yield np.zeros((1, 2))
        return value

    run = start(steps())
    with pytest.raises(TypeError, match="Expected the steps of the method to return an Outcome"):
        run.tell(np.zeros(1))
