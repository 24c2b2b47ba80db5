import math

import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space
from samplers.method import Goal, GradientRequest, Outcome, TermsOffer, TermsRequest, combine
from samplers.problem import EvaluationError, StandardNormal
from samplers.run import EvaluationLog, InputsOnly, Replicate, Run, RunArguments
from samplers.sample import binomial_cov, clopper_pearson
from tests.samplers.conftest import QUICK_METHODS

EASY = half_space(2, 2.0).problem


class Places:
    """What `start` needs of a problem: no f."""

    dim, base = 2, samplers.StandardNormal(2)


def finished(run, f=EASY.f):
    while not run.done:
        run.tell(f(run.ask()))
    return run.result()


FEW = {"surrogate": 450}
"""Simulations of three replicates, of the methods whose own work takes long."""


@pytest.mark.parametrize("method", QUICK_METHODS)
@pytest.mark.parametrize("options", [{}, {"replicates": 3, "max_sim": 4501}], ids=str)
def test_gives_what_estimate_gives(method, options):
    chosen = samplers.get_method(method)
    if "max_sim" in options and method in FEW:
        options = {**options, "max_sim": FEW[method] + 1}
    told = finished(chosen.start(Places(), seed=3, **options))
    assert told == samplers.estimate(EASY, chosen, seed=3, **options)


def test_every_argument_of_estimate_is_taken():
    options = {
        "gamma": 0.5, "seed": 2, "max_sim": 9000, "target_cov": 0.2, "confidence": 0.8, "replicates": 2,
        "on_error": "bound",
    }  # fmt: skip
    told = finished(samplers.MonteCarlo(batch=50).start(Places(), **options))
    assert told == samplers.estimate(EASY, samplers.MonteCarlo(batch=50), **options)
    assert told != finished(samplers.MonteCarlo(batch=50).start(Places(), **{**options, "target_cov": 0.1}))


def test_the_same_batch_until_it_is_told():
    run = samplers.MonteCarlo(batch=100).start(Places(), seed=1)
    first = run.ask()
    first_again = run.ask()
    np.testing.assert_array_equal(first, first_again)
    first[:] = 99.0  # what the caller does with them is the caller's business
    np.testing.assert_array_equal(run.ask(), first_again)
    run.tell(EASY.f(first_again))
    assert not np.array_equal(run.ask()[:2], first_again[:2])


def test_a_wrong_answer_can_be_told_again():
    run = samplers.MonteCarlo(n=5).start(Places(), seed=1)
    x = run.ask()
    for wrong in (x[:-1, 0], x, 1.0, [np.nan] * 5, None):
        with pytest.raises(EvaluationError, match=r"Expected f to return shape \(5,\)|NaN for row 0"):
            run.tell(wrong)
    run.tell(list(x[:, 0]))
    assert run.done
    assert run.result().n_sim == 5


def test_what_is_asked_in_the_wrong_order():
    run = samplers.MonteCarlo(n=5, batch=3).start(Places(), seed=1)
    with pytest.raises(RuntimeError, match=r"call ask\(\)"):
        run.tell([1.0] * 3)
    run.tell(run.ask()[:, 0])
    with pytest.raises(RuntimeError, match=r"call ask\(\)"):
        run.tell([1.0] * 2)
    run.tell(run.ask()[:, 0])
    with pytest.raises(RuntimeError, match="done"):
        run.ask()
    with pytest.raises(RuntimeError, match=r"call ask\(\)"):
        run.tell([1.0])


def test_progress_and_a_result_at_any_moment():
    run = samplers.MonteCarlo(batch=10).start(Places(), max_sim=100, seed=1)
    assert (run.progress.n_sim, run.progress.max_sim) == (0, 100)
    run.tell(EASY.f(run.ask()))
    assert run.progress.n_sim == 10
    result = run.result()
    assert (result.n_sim, result.status) == (10, "stopped")
    assert any("Stopped after 10 simulations" in text for text in result.warnings)
    assert run.done
    assert run.result() == result


def test_stopped_before_anything_was_told():
    run = samplers.MonteCarlo().start(Places(), seed=1, replicates=3)
    run.ask()
    result = run.result()
    assert (result.p, result.interval, result.cov, result.n_sim) == (0.0, (0.0, 1.0), math.inf, 0)
    assert result.status == "stopped"
    assert math.isnan(result.gain)


class Batches(samplers.Method):
    """Plain draws in four batches; does with `Interrupted` what it is told to."""

    name, stops_at_target = "batches", False

    def __init__(self, when_interrupted="raise"):
        self.when_interrupted = when_interrupted

    def steps(self, inputs, goal, rng):
        f = np.empty(0)
        for _ in range(4):
            try:
                f = np.append(f, (yield inputs.base.sample(10, rng)))
            except samplers.Interrupted:
                if self.when_interrupted == "raise":
                    raise
                if self.when_interrupted == "go on":
                    continue
                return samplers.Outcome(p=0.5, interval=(0.4, 0.6), cov=0.1, status=samplers.Status.STOPPED)
        p = float(np.mean(f <= goal.gamma))
        return samplers.Outcome(p=p, interval=(0.0, 1.0), cov=0.1, status=samplers.Status.CONVERGED)


@pytest.mark.parametrize("what", ["raise", "go on"])
def test_a_method_that_does_not_know_about_interruption(what):
    run = Batches(what).start(Places(), seed=1)
    run.tell(run.ask()[:, 0])
    result = run.result()
    assert (result.p, result.interval, result.cov, result.n_sim) == (0.0, (0.0, 1.0), math.inf, 10)
    assert result.status == "stopped"
    assert any("p = 0 stands for not known" in text for text in result.warnings)


def test_a_method_that_does():
    run = Batches("answer").start(Places(), seed=1)
    run.tell(run.ask()[:, 0])
    assert run.result().p == 0.5


def test_an_empty_batch_is_nobodys_business():
    class Empty(samplers.Method):
        name, stops_at_target = "empty", False

        def steps(self, inputs, goal, rng):
            for n in (0, 3, 0, 0, 2, 0):
                f = yield rng.standard_normal((n, inputs.dim))
                assert f.shape == (n,)
            return samplers.Outcome(p=0.5, interval=(0.0, 1.0), cov=0.1, status=samplers.Status.CONVERGED)

    run = Empty().start(Places(), seed=1)
    sizes = []
    while not run.done:
        sizes.append(len(run.ask()))
        run.tell(run.ask()[:, 0])
    assert sizes == [3, 2]
    assert run.result().n_sim == 5


class Wrong(samplers.Method):
    """Asks for points and returns something."""

    name, stops_at_target = "wrong", False

    def __init__(self, points, value=None):
        self.points, self.value = points, value

    def steps(self, inputs, goal, rng):
        yield self.points
        return self.value


@pytest.mark.parametrize("shape", [(3,), (3, 5), (1, 3, 2)])
def test_a_method_that_asks_for_points_of_the_wrong_shape(shape):
    with pytest.raises(ValueError, match=r"Expected x of shape \(n, 2\)"):
        Wrong(np.zeros(shape)).start(Places())


def test_a_method_must_return_an_outcome():
    run = Wrong(np.zeros((1, 2)), {"p": 0.5}).start(Places())
    with pytest.raises(TypeError, match="Expected the steps of the method to return an Outcome"):
        run.tell(run.ask()[:, 0])


def test_replicates_are_independent_and_all_counted(recorder):
    f = recorder(half_space().problem.f)
    problem = samplers.FunctionProblem(f, 2)
    result = samplers.estimate(problem, "adss", seed=1, replicates=4)
    assert result.n_sim == f.rows
    assert len(np.unique(f.points, axis=0)) == f.rows
    assert {level.run for level in result.trace} == {0, 1, 2, 3}
    ends = [level.estimate for level in result.trace if level.gamma == 0.0]
    assert len(set(ends)) == 4
    assert result.p == pytest.approx(np.mean(ends))


def one_after_another(problem, method, seed, replicates, max_sim):
    """The same runs without any interleaving."""
    outcomes = []
    for i in range(replicates):
        share = None if max_sim is None else max_sim // replicates
        goal = Goal(gamma=0.0, max_sim=share)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(i,)))
        run = Replicate(method.steps(problem, goal, rng), goal, problem.dim)
        while run.outcome is None:
            run.tell(problem.evaluate(run.requested))
        outcomes.append(run.outcome)
    return combine(outcomes, 0.95)


@pytest.mark.parametrize(
    ("method", "max_sim"),
    [(name, 6000 if k % 2 else None) for k, name in enumerate(sorted({*samplers.METHODS} - {*FEW}))],
)
def test_side_by_side_is_one_after_another_in_fewer_calls(method, max_sim, recorder):
    problem, chosen = half_space(3, 3.0).problem, samplers.get_method(method)
    alone, together = (recorder(problem.f) for _ in range(2))
    expected = one_after_another(samplers.FunctionProblem(alone, 3), chosen, 7, 3, max_sim)
    result = samplers.estimate(samplers.FunctionProblem(together, 3), chosen, seed=7, replicates=3, max_sim=max_sim)
    assert result.p == expected.p
    assert result.interval == expected.interval
    assert result.cov == expected.cov
    assert result.trace == expected.trace
    assert result.warnings == expected.warnings
    np.testing.assert_array_equal(np.unique(together.points, axis=0), np.unique(alone.points, axis=0))
    assert together.rows == alone.rows
    assert len(together.batches) < 0.6 * len(alone.batches)


def test_target_cov_adds_runs_until_it_is_met():
    result = samplers.estimate(half_space().problem, "adss", seed=1, target_cov=0.12)
    assert result.cov <= 0.12
    assert result.status == "converged"
    assert max(level.run for level in result.trace) + 1 >= 5
    enough = samplers.estimate(half_space().problem, "adss", seed=1, target_cov=0.5)
    assert {level.run for level in enough.trace} == {0}


def test_target_cov_keeps_to_the_budget_and_says_so(recorder):
    f = recorder(half_space().problem.f)
    problem = samplers.FunctionProblem(f, 2)
    result = samplers.estimate(problem, "adss", seed=1, target_cov=0.05, max_sim=12_000)
    assert f.rows == result.n_sim <= 12_000
    assert result.status == "budget"
    assert any("target c.o.v. 0.05 was not met" in text for text in result.remarks)
    assert not any("target" in text for text in result.warnings)  # less precise than wished is no doubt


def test_target_cov_of_pooled_runs_uses_all_of_max_sim():
    """Three runs meet their share of the target early, all together they miss it at first."""
    problem, method = half_space(2, 3.0).problem, samplers.MonteCarlo(batch=1000)
    budget = (1 - half_space(2, 3.0).p) / half_space(2, 3.0).p / 0.05**2
    missed = samplers.estimate(problem, method, seed=1, target_cov=0.05, replicates=3, max_sim=int(budget / 2) + 7)
    assert missed.n_sim == int(budget / 2) + 7
    assert missed.status == "budget"
    met = samplers.estimate(problem, method, seed=1, target_cov=0.05, replicates=3, max_sim=2 * int(budget))
    assert met.cov <= 0.05
    assert met.status == "converged"
    assert met.n_sim < 1.5 * budget


class Fixed:
    """Up to 400 plain draws, whatever the target; says that they pool, or not."""

    name, stops_at_target = "fixed", False

    def __init__(self, pools):
        self.pools = pools

    def steps(self, inputs, goal, rng):
        n = min(400, goal.budget)
        f = yield rng.standard_normal((n, 2))
        hits = int(np.count_nonzero(f <= goal.gamma))
        counts = (hits, n) if self.pools else None
        p, status = hits / n, samplers.Status.CONVERGED
        return Outcome(p=p, interval=(0.0, 1.0), cov=binomial_cov(p, n), status=status, counts=counts)


@pytest.mark.parametrize(("pools", "n_sim"), [(True, 1000), (False, 800)])
def test_a_rest_of_max_sim_is_used_where_runs_pool(pools, n_sim):
    """A run of 200 draws beside two of 400 would spoil a mean, not a pooled share."""
    problem = half_space(2, 1.0).problem
    result = samplers.estimate(problem, Fixed(pools), seed=1, target_cov=0.01, replicates=2, max_sim=1000)
    assert result.n_sim == n_sim


def test_a_target_out_of_reach_is_given_up_at_the_limit_of_the_method():
    method = samplers.MonteCarlo(n=1000)
    result = samplers.estimate(half_space().problem, method, seed=1, target_cov=0.01, replicates=3)
    assert result.n_sim == 3000


def test_target_cov_is_given_up_after_200_runs():
    method = samplers.AdaptiveSubsetSimulation(n=10)
    result = samplers.estimate(half_space(2, 2.0).problem, method, seed=1, target_cov=1e-3)
    assert max(level.run for level in result.trace) + 1 == 200
    assert result.status == "budget"


def stopped_after(batches, method, **options):
    """The result of a run that is stopped after so many batches, and the run."""
    problem = half_space(2, 2.0).problem
    run = Run(problem, method, RunArguments(seed=1, **options))
    for _ in range(batches):
        run.tell(problem.evaluate(run.ask()))
    return run.result()


def test_replicates_stopped_on_their_way():
    result = stopped_after(2, samplers.MonteCarlo(batch=100), replicates=3, max_sim=5000)
    assert (result.n_sim, result.status) == (600, "stopped")
    assert result.p == result.failures.total / 600
    assert result.interval == clopper_pearson(result.failures.total, 600, 0.95)
    assert len(result.sample.f) == 600


def test_stopped_while_further_runs_are_made_for_the_target():
    """Two runs of 400 draws, then one more at a time: the third had not been told a thing, or is left out."""
    first = stopped_after(1, Fixed(False), replicates=2, target_cov=0.01)
    assert (first.n_sim, first.status) == (800, "stopped")
    assert not any("left out" in text for text in first.warnings)
    pooled = stopped_after(2, Fixed(True), replicates=2, target_cov=0.01)
    assert pooled.n_sim == 1200
    assert pooled.interval == clopper_pearson(pooled.failures.total, 1200, 0.95)


# One replicate


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


# The log


def test_the_density_of_failures_is_asked_for_many_at_once(rng):
    """A batch of a few rows costs a base fitted to data milliseconds: only `keep` new ones, or a reader, ask for it."""

    class CountingNormal(StandardNormal):
        asked = 0

        def log_prob(self, x):
            CountingNormal.asked += 1
            return super().log_prob(x)

    log = EvaluationLog(InputsOnly(2, CountingNormal(2)), 0.0, keep=10)
    x = -np.abs(rng.standard_normal((24, 2)))
    for part in np.split(x, 8):
        log.record_f(part, part[:, 0])
    assert CountingNormal.asked == 2  # after 12 and 24
    assert log.failures.total == 24
    assert log.failures is log.failures
    log.record_f(x[:1], x[:1, 0])
    assert (log.failures.total, CountingNormal.asked) == (25, 3)
