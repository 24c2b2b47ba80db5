import numpy as np

import samplers
from samplers.execution.responder import Responder
from samplers.method import Goal, Outcome, TermsRequest
from samplers.methods.two_stage.terms.order import order_by_terms, ordering_values
from samplers.problem import Terms
from samplers.sample import Sample
from samplers.trace import Status


def test_the_order_fails_just_where_f_does():
    """f is a flag, the terms are distances with threshold 0; a point without an outcome is below everything."""
    f = np.array([-1.0, 5.0, 5.0, -1.0, -np.inf])
    values = np.array([[-0.5, 3.0], [0.2, 9.0], [7.0, 4.0], [0.1, 1.0], [-np.inf, -np.inf]])
    terms = Terms(f, values, np.zeros(values.shape, dtype=int), 0.0)
    order = ordering_values(terms, gamma=2.0)
    np.testing.assert_array_equal(order <= 2.0, f <= 2.0)
    np.testing.assert_allclose(order, [1.5, 2.2, 6.0, 2.0, -np.inf])


class Flag:
    """A collision is -1, anything else 5; the clearance is the one term."""

    dim, base = 3, samplers.StandardNormal(3)

    def terms(self, x, gamma=0.0):
        values = (2.0 - x[:, :1]) + 0.0
        return Terms(self.evaluate(x), values, np.zeros(values.shape, dtype=int), 0.0)

    def evaluate(self, x):
        return np.where(x[:, 0] >= 2.0, -1.0, 5.0)


def test_steps_see_the_order_and_their_outcome_has_f(rng):
    seen = []

    def steps():
        x = rng.standard_normal((200, 3))
        order = yield x
        seen.append((x, order))
        sample = Sample(f=order, weights=np.full(200, 1 / 200), units=np.arange(200), n_units=200, x=x[order <= 0])
        return Outcome(p=0.1, interval=(0.0, 1.0), cov=1.0, status=Status.CONVERGED, sample=sample)

    wrapped, problem = order_by_terms(steps(), 0.0), Flag()
    request = next(wrapped)
    assert isinstance(request, TermsRequest)
    try:
        wrapped.send(Responder(problem, 0.0).respond([request])[0])
    except StopIteration as end:
        outcome = end.value
    x, order = seen[0]
    np.testing.assert_allclose(order, 2.0 - x[:, 0])
    np.testing.assert_array_equal(outcome.sample.f, problem.evaluate(x))


def test_subset_simulation_stalls_on_a_flag_and_not_in_the_order_of_its_terms():
    """P = Phi(-4) = 3.2e-5 behind a flag that tells nothing before; 3 standard errors of about 0.25."""

    class Far(Flag):
        def terms(self, x, gamma=0.0):
            return Terms(self.evaluate(x), 4.0 - x[:, :1], np.zeros((len(x), 1), dtype=int), 0.0)

        def evaluate(self, x):
            return np.where(x[:, 0] >= 4.0, -1.0, 5.0)

    class Ordered(samplers.Method):
        name, stops_at_target = "ordered", False

        def steps(self, inputs, goal: Goal, rng):
            return order_by_terms(samplers.AdaptiveSubsetSimulation(n=1000).steps(inputs, goal, rng), goal.gamma)

    assert samplers.estimate(Far(), "adss", seed=1).p == 0
    result = samplers.estimate(Far(), Ordered(), seed=1)
    assert abs(result.p / 3.17e-5 - 1) < 0.75
    assert set(result.sample.f) <= {-1.0, 5.0}
