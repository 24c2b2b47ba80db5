"""Evaluator: what a problem gives is checked and counted, and rows on which it fails are found and no others lost."""

from types import SimpleNamespace

import numpy as np
import pytest

import samplers
from samplers.distributions import StandardNormal
from samplers.evaluate import Evaluator
from samplers.method import Interrupted, Outcome, Request, offer_of, request_gradients, request_terms
from samplers.problem import EvaluationError, TermGradients, Terms
from samplers.sample import Level, Status

X = np.array([[1.0, 0.0], [3.0, 0.0], [2.0, 7.5], [4.0, 0.0], [-1.0, 0.0]])
A = np.eye(2)


def evaluator(f, on_error="failure"):
    return Evaluator(SimpleNamespace(dim=2, base=StandardNormal(2), evaluate=f), on_error=on_error)


def raises_at_two(x):
    if (x[:, 0] == 2).any():
        raise RuntimeError("no\nroad")
    return x[:, 0]


def test_rows_that_raise_are_found_and_counted():
    one = evaluator(raises_at_two)
    np.testing.assert_array_equal(one.evaluate(X), [1.0, 3.0, np.nan, 4.0, -1.0])
    ((x, reason),) = one.faults
    assert (x.tolist(), reason) == ([2.0, 7.5], "RuntimeError: no road")
    assert (one.n_retried, one.n_made) == (5, 5)


@pytest.mark.parametrize(("share", "calls"), [(0.0002, 250), (0.01, 2500), (0.3, 6000), (1.0, 6000)])
def test_rows_that_raise_cost_at_most_a_fifth_more_than_one_by_one(share, calls):
    """And where few raise, far fewer calls."""
    x, bad = np.random.default_rng(1).random((5000, 2)), []

    def f(x):
        bad.append(len(x))
        if (x[:, 0] < share).any():
            raise ZeroDivisionError("diverged")
        return x[:, 0]

    found = evaluator(f).evaluate(x)
    np.testing.assert_array_equal(np.isnan(found), x[:, 0] < share)
    assert sum(bad) <= 2.2 * len(x) and len(bad) <= calls


def test_to_raise_names_the_first_row_and_keeps_the_cause():
    def f(x):
        bad = np.flatnonzero(x[:, 0] >= 2)
        if len(bad):
            raise RuntimeError(f"no road at {x[bad[-1], 0]:g}")
        return x[:, 0]

    expected = r"f failed twice on x = \[3\., 0\.\]: RuntimeError: no road at 3; on_error"
    with pytest.raises(EvaluationError, match=expected) as caught:
        evaluator(f, "raise").evaluate(X)
    assert str(caught.value.__cause__) == "no road at 3"


@pytest.mark.parametrize(("on_error", "fault"), [("raise", "raise"), ("bound", "nan")])
def test_a_fault_that_passes_costs_nothing_but_time(on_error, fault):
    calls = []

    def once(x):
        calls.append(len(x))
        if len(calls) == 1 and fault == "raise":
            raise OSError("busy")
        return np.where(len(calls) == 1, np.nan, x[:, 0])

    one = evaluator(once, on_error)
    np.testing.assert_array_equal(one.evaluate(X), X[:, 0])
    assert (one.faults, one.n_retried) == ([], 5)


def test_an_error_that_is_final_is_passed_on_at_once():
    class Gone(RuntimeError):
        final = True

    calls = []

    def f(x):
        calls.append(len(x))
        raise Gone("nobody is there")

    with pytest.raises(Gone, match="nobody is there"):
        evaluator(f).evaluate(X)
    assert calls == [5]


@pytest.mark.parametrize("wrong", [lambda x: x, lambda x: x[:-1, 0], lambda x: None])
def test_a_wrong_shape_is_an_error_also_of_a_part(wrong):
    """Put together, the parts might have the right one."""

    def f(x):
        if len(x) == 4:
            raise RuntimeError("no such road")
        return wrong(x)

    with pytest.raises(EvaluationError, match=r"Expected f to return shape \(1,\)"):
        evaluator(f, "bound").evaluate(X[:4])


def test_f_can_write_on_its_points_and_set_errors_of_numpy():
    def careless(x):
        np.seterr(all="raise")
        f = x[:, 0].copy()
        x[:] = 99.0
        if (f == 2).any():
            raise RuntimeError("no such road")
        return f

    before, x = np.geterr(), X.copy()
    np.testing.assert_array_equal(evaluator(careless).evaluate(x), [1.0, 3.0, np.nan, 4.0, -1.0])
    np.testing.assert_array_equal(x, X)
    assert np.geterr() == before


def test_a_problem_that_goes_on_by_itself_is_not_split():
    class Rowwise:
        dim, base, sizes = 2, StandardNormal(2), []

        def evaluate(self, x):
            raise AssertionError("its rows are asked for")

        def attempt(self, x):
            self.sizes.append(len(x))
            bad = np.flatnonzero(x[:, 0] == 2)
            return np.where(x[:, 0] == 2, np.nan, x[:, 0]), dict.fromkeys(bad.tolist(), "the ego raised")

    one = Evaluator(Rowwise(), on_error="bound")
    np.testing.assert_array_equal(one.evaluate(X), [1.0, 3.0, np.nan, 4.0, -1.0])
    assert (Rowwise.sizes, one.faults[0].reason, one.n_retried) == ([5, 1], "the ego raised", 1)


class Plain:
    """f is 1 everywhere, by the batch and by the row."""

    dim, base = 2, StandardNormal(2)

    def evaluate(self, x):
        return np.ones(len(x))

    def attempt(self, x):
        return np.ones(len(x)), {}


class Shifted(Plain):
    def evaluate(self, x):
        return super().evaluate(x) - 3.0


class Around:
    def __init__(self, problem):
        self.problem = problem

    def __getattr__(self, name):
        return getattr(self.problem, name)

    def evaluate(self, x):
        return self.problem.evaluate(x) - 3.0


def test_an_f_of_ones_own_is_the_one_that_counts():
    """In a subclass, in a wrapper and on an instance."""
    changed = Plain()
    changed.evaluate = lambda x: np.full(len(x), -2.0)
    for problem in (Shifted(), Around(Plain()), changed):
        assert set(Evaluator(problem).evaluate(X)) == {-2.0}
    assert set(Evaluator(Plain()).evaluate(X)) == {1.0}


# Terms and gradients


def series(terms=lambda x: 2.0 - x, gradient=lambda x, term: -A[term], cost=2.5):
    return samplers.FunctionProblem(dim=2, terms=terms, gradient=gradient, gradient_cost=cost)


class Asks(samplers.methods.Method):
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


@pytest.mark.parametrize("replicates", [1, 3])
def test_requests_are_answered_and_counted_gradients_at_their_cost(replicates):
    method = Asks()
    result = samplers.estimate(series(), method, gamma=0.5, seed=1, replicates=replicates)
    assert len(method.seen) == replicates
    for x, terms, gradients, f in method.seen:
        np.testing.assert_array_equal(terms.values, 2.0 - x)
        np.testing.assert_array_equal(gradients.values, -A[terms.least[:4]])
        np.testing.assert_array_equal(f, (2.0 - x).min(axis=1)[:3])
        assert terms.threshold == 0.5
    assert result.n_sim == replicates * (10 + 10 + 3)  # 4 gradients of 2.5 simulations each
    assert samplers.estimate(series(cost=0.3), Asks(), seed=1).n_sim == 10 + 2 + 3  # whole ones


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


def test_without_terms_or_outside_of_estimate_nothing_is_offered():
    plain = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
    assert samplers.estimate(plain, Asks(), seed=1).n_sim == 10
    run = Asks().start(series(), seed=1)
    run.tell(np.zeros(len(run.ask())))
    assert run.done


def fails_beyond(limit, function):
    def call(x, *arguments):
        if (x[:, 0] > limit).any():
            raise RuntimeError("off the map")
        return function(x, *arguments)

    return call


def test_rows_on_which_terms_raise_or_are_nan_fail_in_every_term():
    for terms, lost_in in (
        (fails_beyond(1.0, lambda x: 9.0 - x), lambda x: x[:, 0] > 1.0),
        (lambda x: np.where(x > 1.0, np.nan, 9.0 - x), lambda x: (x > 1.0).any(axis=1)),
    ):
        method = Asks(n=50, plain=0, gradients=1)
        result = samplers.estimate(series(terms), method, seed=2, on_error="bound")
        x, seen, _, _ = method.seen[0]
        lost = lost_in(x)
        assert 2 <= lost.sum() == result.failures.total
        assert np.isneginf(seen.f[lost]).all() and np.isneginf(seen.values[lost]).all()
        np.testing.assert_array_equal(seen.values[~lost], 9.0 - x[~lost])
        assert any("were simulated again" in text for text in result.remarks)
        with pytest.raises(EvaluationError, match="f failed twice on x = "):
            samplers.estimate(series(terms), Asks(n=50), seed=2)


def test_gradients_that_raise_are_missing_and_cost_the_most():
    method = Asks(n=50, gradients=50)
    problem = series(gradient=fails_beyond(1.0, lambda x, term: -A[term]), cost=2.0)
    result = samplers.estimate(problem, method, seed=2, on_error="failure")
    x, _, gradients, _ = method.seen[0]
    np.testing.assert_array_equal(np.isnan(gradients.values).all(axis=1), x[:, 0] > 1.0)
    assert result.n_sim == 50 + 100 + 3
    assert not any("gave no outcome" in text for text in result.warnings)  # they have one
    with pytest.raises(EvaluationError, match="The gradient failed twice on x = "):
        samplers.estimate(problem, Asks(n=50, gradients=50), seed=2)


class Given:
    """A problem that gives what it is told to."""

    dim, base, gradient_cost = 2, StandardNormal(2), 1.0

    def __init__(self, values=lambda x: x, cost=1.0):
        self.values, self.cost = values, cost

    def evaluate(self, x):
        return x[:, 0]

    def terms(self, x, gamma=0.0):
        values = self.values(x)
        return Terms(x[:, 0], values, np.zeros(np.shape(values), dtype=int), gamma)

    def gradient(self, x, term, ticks, gamma=0.0):
        return TermGradients(np.zeros(x.shape), cost=self.cost * len(x))


def test_terms_and_gradients_of_a_wrong_shape_or_cost_are_an_error():
    for values in (lambda x: x[:, 0], lambda x: x[1:], lambda x: x[:, :0]):
        with pytest.raises(EvaluationError, match="Expected values and ticks of shape"):
            samplers.estimate(Given(values), Asks(), seed=2)
    with pytest.raises(EvaluationError, match=r"gradients of shape \(4, 2\)"):
        samplers.estimate(series(gradient=lambda x, term: x[:, :1]), Asks(), seed=2)
    with pytest.raises(EvaluationError, match="cost at most gradient_cost"):
        samplers.estimate(Given(cost=2.0), Asks(), seed=2)
    with pytest.raises(ValueError, match="gradient_cost"):
        one = Given()
        one.gradient_cost = 0.0
        Evaluator(one)


def test_the_number_of_terms_is_the_same_in_every_batch():
    one = Evaluator(Given(lambda x: x[:, : len(x)]))
    one.respond([Request("terms", (X[:2],))])
    with pytest.raises(EvaluationError, match=r"same number of terms in every batch, got \[1, 2\]"):
        one.respond([Request("terms", (X[:1],))])
