"""Requests for terms and gradients: answers, counts, budget, rows that raise, replicates, interruption."""

import numpy as np
import pytest

import samplers
from samplers.errors import EvaluationError
from samplers.execution.executors.packing import join_terms, select_rows
from samplers.execution.replicate import Replicate
from samplers.execution.responder import Responder, hide_missing
from samplers.execution.run import Run
from samplers.method import (
    Goal,
    GradientRequest,
    Interrupted,
    Outcome,
    TermsOffer,
    TermsRequest,
    offer_of,
    request_gradients,
    request_terms,
)
from samplers.problem import TermGradients, Terms
from samplers.trace import Level, Status

A = np.array([[1.0, 0.0], [0.0, 1.0]])


def series(terms=lambda x: 2.0 - x, gradient=lambda x, term: -A[term], cost=2.5):
    return samplers.FunctionProblem(dim=2, terms=terms, gradient=gradient, gradient_cost=cost)


class Asks(samplers.Method):
    """Simulates base draws with their terms, then asks for some gradients, and goes on with plain points."""

    name, stops_at_target = "asks", False

    def __init__(self, n=10, gradients=4, plain=3):
        self.n, self.gradients, self.plain = n, gradients, plain
        self.seen = []

    def steps(self, inputs, goal, rng):
        status = Status.CONVERGED
        if offer_of(inputs) is None:
            f = yield inputs.base.sample(self.n, rng)
            return Outcome.of_counts(int((f <= goal.gamma).sum()), self.n, goal.confidence, ())
        x = inputs.base.sample(self.n, rng)
        terms = yield from request_terms(x)
        level = Level(gamma=0.0, p=0.0, estimate=0.0, n_sim=self.n, n_points=self.n, cov=1.0)
        goal.on_level(level)
        try:
            rows = np.arange(self.gradients)
            gradients = yield from request_gradients(x[rows], terms.least[rows], terms.ticks[rows, terms.least[rows]])
            f = yield x[: self.plain]
            self.seen.append((x, terms, gradients, f))
        except Interrupted:
            status = Status.STOPPED
        hits = int((terms.f <= goal.gamma).sum())
        return Outcome(p=hits / self.n, interval=(0.0, 1.0), cov=1.0, status=status, trace=(level,))


def test_requests_are_answered_and_counted_gradients_at_their_cost():
    method = Asks()
    result = samplers.estimate(series(), method, seed=1, max_sim=30)
    (x, terms, gradients, f) = method.seen[0]
    np.testing.assert_array_equal(terms.values, 2.0 - x)
    np.testing.assert_array_equal(terms.f, (2.0 - x).min(axis=1))
    np.testing.assert_array_equal(gradients.values, -A[terms.least[:4]])
    np.testing.assert_array_equal(f, terms.f[:3])
    assert result.n_sim == 10 + 10 + 3  # 4 gradients of 2.5 simulations each
    assert result.failures.total == int((terms.f <= 0).sum() + (f <= 0).sum())


def test_a_cost_is_rounded_up_to_whole_simulations():
    assert samplers.estimate(series(cost=0.3), Asks(), seed=1).n_sim == 10 + 2 + 3


def test_without_terms_or_outside_of_estimate_nothing_is_offered():
    plain = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
    assert samplers.estimate(plain, Asks(), seed=1).n_sim == 10
    run = Asks().start(series(), seed=1)
    assert run.ask().shape == (10, 2)
    run.tell(np.zeros(10))
    assert run.done


def test_replicates_get_the_answers_that_they_would_get_alone():
    together = Asks()
    samplers.estimate(series(), together, seed=3, replicates=3)
    assert len(together.seen) == 3
    for x, terms, gradients, f in together.seen:
        np.testing.assert_array_equal(terms.values, 2.0 - x)
        np.testing.assert_array_equal(gradients.values, -A[terms.least[:4]])
        np.testing.assert_array_equal(f, (2.0 - x[:3]).min(axis=1))


def test_terms_of_all_replicates_come_in_one_call_gradients_in_one_each():
    calls = []

    def count(name, function):
        def call(*arguments):
            calls.append((name, len(arguments[0])))
            return function(*arguments)

        return call

    problem = series(count("terms", lambda x: 2.0 - x), count("gradient", lambda x, term: -A[term]))
    samplers.estimate(problem, Asks(plain=0), seed=3, replicates=2)
    assert calls == [("terms", 20), ("gradient", 4), ("gradient", 4)]


def test_a_run_that_is_stopped_while_it_waits_for_gradients_has_its_outcome():
    result = samplers.estimate(series(), Asks(), seed=1, stop=lambda at: at.n_sim == 10)
    assert (result.status, result.n_sim) == (Status.STOPPED, 10)


@pytest.mark.parametrize("max_sim", [9, 19, 22])
def test_a_method_that_asks_for_more_than_the_budget_is_refused(max_sim):
    with pytest.raises(RuntimeError, match="must keep to goal"):
        samplers.estimate(series(), Asks(), seed=1, max_sim=max_sim)


def test_requests_that_the_run_does_not_offer_are_refused():
    def steps(request):
        yield request
        return None

    x, zero = np.zeros((1, 2)), np.zeros(1, dtype=int)
    for offer in (None, TermsOffer()):
        with pytest.raises(RuntimeError, match="cannot answer"):
            Replicate(steps(GradientRequest(x, zero, zero)), Goal(gamma=0.0), 2, offer)
    with pytest.raises(RuntimeError, match="cannot answer"):
        Replicate(steps(TermsRequest(x)), Goal(gamma=0.0), 2)
    with pytest.raises(ValueError, match=r"shape \(n, 3\)"):
        Replicate(steps(TermsRequest(x)), Goal(gamma=0.0), 3, TermsOffer())


def fails_beyond(limit, function):
    def call(x, *arguments):
        if (x[:, 0] > limit).any():
            raise RuntimeError("off the map")
        return function(x, *arguments)

    return call


@pytest.mark.parametrize("on_error", ["failure", "bound"])
def test_rows_on_which_terms_raise_fail_in_every_term(on_error):
    method = Asks(plain=0, n=50, gradients=0 + 1)
    problem = series(terms=fails_beyond(1.0, lambda x: 9.0 - x))
    result = samplers.estimate(problem, method, seed=2, on_error=on_error)
    x, terms, _, _ = method.seen[0]
    lost = x[:, 0] > 1.0
    assert 2 <= lost.sum() == result.failures.total
    assert np.isneginf(terms.f[lost]).all()
    assert np.isneginf(terms.values[lost]).all()
    np.testing.assert_array_equal(terms.values[~lost], 9.0 - x[~lost])
    assert any("were simulated again" in text for text in result.remarks)
    assert any("gave no outcome" in text for text in result.warnings)


def test_a_row_on_which_terms_raise_is_named():
    with pytest.raises(EvaluationError, match="terms raised for row"):
        samplers.estimate(series(terms=fails_beyond(1.0, lambda x: 9.0 - x)), Asks(n=50), seed=2)


def test_terms_that_are_nan_are_no_outcome():
    problem = series(terms=lambda x: np.where(x > 1.0, np.nan, 9.0 - x))
    with pytest.raises(EvaluationError, match="f returned NaN"):
        samplers.estimate(problem, Asks(n=50), seed=2)
    method = Asks(n=50)
    samplers.estimate(problem, method, seed=2, on_error="failure")
    x, terms, _, _ = method.seen[0]
    np.testing.assert_array_equal(np.isneginf(terms.f), (x > 1.0).any(axis=1))


def test_gradients_that_raise_are_missing_and_cost_the_most():
    method = Asks(n=50, gradients=50)
    problem = series(gradient=fails_beyond(1.0, lambda x, term: -A[term]), cost=2.0)
    result = samplers.estimate(problem, method, seed=2, on_error="failure")
    x, _, gradients, _ = method.seen[0]
    np.testing.assert_array_equal(np.isnan(gradients.values).all(axis=1), x[:, 0] > 1.0)
    assert result.n_sim == 50 + 100 + 3
    with pytest.raises(EvaluationError, match="The gradient raised for row"):
        samplers.estimate(problem, Asks(n=50, gradients=50), seed=2)


def test_gradients_of_a_wrong_shape_or_cost_are_an_error():
    with pytest.raises(EvaluationError, match=r"gradients of shape \(4, 2\)"):
        samplers.estimate(series(gradient=lambda x, term: x[:, :1]), Asks(), seed=2)

    class Costly:
        dim, base, gradient_cost = 2, samplers.StandardNormal(2), 1.0

        def evaluate(self, x):
            return x[:, 0]

        def terms(self, x, gamma=0.0):
            return Terms(x[:, 0], x, np.zeros(x.shape, dtype=int), gamma)

        def gradient(self, x, term, ticks, gamma=0.0):
            return TermGradients(np.zeros(x.shape), cost=2.0 * len(x))

    with pytest.raises(EvaluationError, match="cost at most gradient_cost"):
        samplers.estimate(Costly(), Asks(), seed=2)


@pytest.mark.parametrize(
    "values", [lambda x: x[:, 0], lambda x: x[1:], lambda x: x[:, :0]], ids=["flat", "short", "none"]
)
def test_terms_of_a_wrong_shape_are_an_error(values):
    class Wrong:
        dim, base = 2, samplers.StandardNormal(2)

        def evaluate(self, x):
            return x[:, 0]

        def terms(self, x, gamma=0.0):
            return Terms(x[:, 0], values(x), np.zeros(np.shape(values(x)), dtype=int), gamma)

    with pytest.raises(EvaluationError, match="Expected values and ticks of shape"):
        samplers.estimate(Wrong(), Asks(), seed=2)


def test_a_gradient_cost_must_be_a_positive_number():
    class Free:
        dim, base, gradient_cost = 2, samplers.StandardNormal(2), 0.0

        def evaluate(self, x):
            return x[:, 0]

        terms = gradient = evaluate

    with pytest.raises(ValueError, match="gradient_cost"):
        Responder(Free(), 0.0)


def test_the_threshold_follows_gamma():
    method = Asks()
    samplers.estimate(series(), method, gamma=1.5, seed=1)
    assert method.seen[0][1].threshold == 1.5


def test_terms_are_joined_selected_and_hidden():
    terms = Terms(np.array([1.0, 2.0]), np.array([[1.0, 3.0], [2.0, 5.0]]), np.array([[0, 4], [7, 1]]), 0.5, ("a", "b"))
    joined = join_terms([terms, select_rows(terms, [1])])
    np.testing.assert_array_equal(joined.f, [1.0, 2.0, 2.0])
    np.testing.assert_array_equal(joined.ticks[2], [7, 1])
    assert (joined.threshold, joined.names) == (0.5, ("a", "b"))
    hidden = hide_missing(terms, np.array([-np.inf, 2.0]))
    np.testing.assert_array_equal(hidden.values, [[-np.inf, -np.inf], [2.0, 5.0]])


def test_a_run_takes_answers_one_for_each_request():
    run = Run(series(), Asks(), samplers.RunArguments(seed=1), None, TermsOffer(2.5))
    (request,) = run.requests
    assert isinstance(request, TermsRequest)
    terms = series().terms(request.x)
    run.answer([terms])
    (request,) = run.requests
    assert isinstance(request, GradientRequest)
    run.answer([TermGradients(np.zeros((4, 2)), cost=10.0)])
    assert run.requests[0].shape == (3, 2)
    run.answer([np.ones(3)])
    assert run.done and run.result().n_sim == 23
