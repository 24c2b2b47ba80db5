from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import threading
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

import samplers
from samplers.estimation import EstimationInterrupted, defer_signals, show_bar
from samplers.limit_states import half_space
from samplers.method import Answer, Goal, Outcome
from samplers.problem import EvaluationError, FloatArray
from samplers.replicate import combine
from samplers.run import Progress, Run, RunArguments
from samplers.sample import Status, binomial_cov, clopper_pearson

EASY, INPUTS = half_space(2, 2.0).problem, samplers.FunctionProblem(dim=2)


def finished(run, f=EASY.f):
    while not run.done:
        run.tell(f(run.ask()))
    return run.result()


ALL = {"gamma": 0.5, "target_cov": 0.2, "confidence": 0.8, "on_error": "bound"}


@pytest.mark.parametrize(("method", "more"), [("mc", ALL), ("mc", {}), ("ce", {}), ("adss", {}), ("two-stage", {})])
def test_gives_what_estimate_gives(method, more):
    chosen, options = samplers.methods.get_method(method), {"seed": 3, "replicates": 3, "max_sim": 4501, **more}
    assert finished(chosen.start(INPUTS, **options)) == samplers.estimate(EASY, chosen, **options)


@pytest.mark.parametrize("options", [{}, {"on_error": "failure"}, {"workers": 2}])
def test_inputs_alone_cannot_be_simulated(options):
    with pytest.raises(EvaluationError, match=r"^This FunctionProblem has no f [^\n]*\.start\(problem\)[^\n]*$"):
        samplers.estimate(INPUTS, "mc", seed=0, max_sim=100, **options)


def test_the_same_batch_until_it_is_told_right():
    run = samplers.MonteCarlo(n=5, batch=3).start(INPUTS, seed=1)
    with pytest.raises(RuntimeError, match=r"call ask\(\)"):
        run.tell([1.0] * 3)
    first, again = run.ask(), run.ask()
    np.testing.assert_array_equal(first, again)
    first[:] = 99.0  # what the caller does with them is the caller's business
    np.testing.assert_array_equal(run.ask(), again)
    for wrong in (again[:-1, 0], again, 1.0, [np.nan] * 3, None):
        with pytest.raises(EvaluationError, match=r"Expected f to return shape \(3,\)|NaN for row 0"):
            run.tell(wrong)
    run.tell(list(again[:, 0]))
    with pytest.raises(RuntimeError, match=r"call ask\(\)"):
        run.tell([1.0] * 2)
    run.tell(run.ask()[:, 0])
    assert run.done and run.result().n_sim == 5
    with pytest.raises(RuntimeError, match="done"):
        run.ask()


def test_progress_and_a_result_at_any_moment():
    unknown = samplers.MonteCarlo().start(INPUTS, seed=1, replicates=3).result()
    assert (unknown.p, unknown.interval, unknown.cov, unknown.status) == (0.0, (0.0, 1.0), math.inf, "stopped")
    run = samplers.MonteCarlo(batch=10).start(INPUTS, max_sim=100, seed=1)
    assert (run.progress.n_sim, run.progress.max_sim) == (0, 100)
    run.tell(EASY.f(run.ask()))
    assert run.progress.n_sim == 10
    result = run.result()
    assert (result.n_sim, result.status) == (10, "stopped")
    assert any("Stopped after 10 simulations" in text for text in result.warnings)
    assert run.done
    assert run.result() == result


class Asks(samplers.methods.Method):
    """Asks for points three times; goes on when it is interrupted, or does not know of it; returns no outcome."""

    name, stops_at_target = "asks", False

    def __init__(self, points, goes_on=False):
        self.points, self.goes_on = points, goes_on

    def steps(self, inputs, goal, rng):
        for _ in range(3):
            with contextlib.suppress(*[samplers.methods.Interrupted] * self.goes_on):
                yield self.points


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_method_that_cannot_be_interrupted_leaves_p_unknown(goes_on):
    run = Asks(np.zeros((10, 2)), goes_on).start(INPUTS, seed=1)
    run.tell(run.ask()[:, 0])
    result = run.result()
    assert (result.n_sim, result.status) == (10, "stopped")
    assert (result.p, result.interval, result.cov) == (0.0, (0.0, 1.0), math.inf)
    assert any("p = 0 means not known" in text for text in result.warnings)


def test_a_method_must_ask_for_points_and_return_an_outcome():
    for shape in ((3,), (3, 5), (1, 3, 2)):
        with pytest.raises(ValueError, match=r"Expected x of shape \(n, 2\)"):
            Asks(np.zeros(shape)).start(INPUTS)
    with pytest.raises(TypeError, match="Expected the steps of the method to return an Outcome"):
        finished(Asks(np.zeros((1, 2))).start(INPUTS))


@pytest.mark.parametrize(("method", "max_sim"), [("adss", None), ("mc", 6000), ("two-stage", 6000)])
def test_side_by_side_is_one_after_another_in_fewer_calls(method, max_sim, recorder, drive):
    alone, together = (recorder(half_space(3, 3.0).problem.f) for _ in range(2))
    chosen, problem = samplers.methods.get_method(method), samplers.FunctionProblem(alone, 3)
    goal = Goal(gamma=0.0, max_sim=max_sim and max_sim // 3)
    rngs = [np.random.default_rng(np.random.SeedSequence(7, spawn_key=(i,))) for i in range(3)]
    expected = combine([drive(chosen.steps(problem, goal, rng), problem).value for rng in rngs], 0.95)
    result = samplers.estimate(samplers.FunctionProblem(together, 3), chosen, seed=7, replicates=3, max_sim=max_sim)
    for name in ("p", "interval", "cov", "trace", "warnings"):
        assert getattr(result, name) == getattr(expected, name)
    np.testing.assert_array_equal(np.unique(together.points, axis=0), np.unique(alone.points, axis=0))
    assert together.rows == alone.rows
    assert len(together.batches) < 0.6 * len(alone.batches)


def test_target_cov_adds_runs_until_it_is_met():
    result = samplers.estimate(half_space().problem, "adss", seed=1, target_cov=0.12)
    assert result.cov <= 0.12 and result.status == "converged"
    assert max(level.run for level in result.trace) + 1 >= 5
    enough = samplers.estimate(half_space().problem, "adss", seed=1, target_cov=0.5)
    assert {level.run for level in enough.trace} == {0}


def test_target_cov_keeps_to_the_budget_and_says_so(recorder):
    f = recorder(half_space().problem.f)
    result = samplers.estimate(samplers.FunctionProblem(f, 2), "adss", seed=1, target_cov=0.05, max_sim=12_000)
    assert f.rows == result.n_sim <= 12_000 and result.status == "budget"
    assert any("target relative error 0.05 was not met" in text for text in result.remarks)
    assert not any("target" in text for text in result.warnings)  # less precise than asked for is no doubt


def test_target_cov_of_pooled_runs_uses_all_of_max_sim():
    """Three runs meet their share of the target early, all together they miss it at first."""
    reference = half_space(2, 3.0)
    budget = int((1 - reference.p) / reference.p / 0.05**2)
    missed, met = (
        samplers.estimate(
            reference.problem, samplers.MonteCarlo(batch=1000), seed=1, target_cov=0.05, replicates=3, max_sim=max_sim
        )
        for max_sim in (budget // 2 + 7, 2 * budget)
    )
    assert (missed.n_sim, missed.status) == (budget // 2 + 7, "budget")
    assert met.cov <= 0.05 and met.status == "converged" and met.n_sim < 1.5 * budget


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
    result = samplers.estimate(EASY, Fixed(pools), seed=1, target_cov=0.01, replicates=2, max_sim=1000)
    assert result.n_sim == n_sim


def stopped_after(batches, method, **options):
    """The result of a run that is stopped after so many batches."""
    run = Run(EASY, method, RunArguments(seed=1, **options))
    for _ in range(batches):
        run.tell(EASY.evaluate(run.ask()))
    return run.result()


def test_stopped_while_further_runs_are_made_for_the_target():
    """Two runs of 400 draws, then one more at a time: the third had not been told a thing, or is left out."""
    first = stopped_after(1, Fixed(False), replicates=2, target_cov=0.01)
    assert (first.n_sim, first.status) == (800, "stopped")
    assert not any("left out" in text for text in first.warnings)
    pooled = stopped_after(2, Fixed(True), replicates=2, target_cov=0.01)
    assert pooled.n_sim == 1200
    assert pooled.interval == clopper_pearson(pooled.failures.total, 1200, 0.95)


@pytest.fixture(autouse=True)
def interrupts() -> Iterator[None]:
    """SIGINT interrupts, also where the tests run in the background and ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class StopsAt:
    def __init__(self, call: int) -> None:
        self.left = call

    def __call__(self, x: FloatArray) -> FloatArray:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return 2.0 - x[:, 0]


@pytest.mark.parametrize("method", ["mc", "two-stage"])
def test_an_interrupted_estimation_has_what_it_knows(method: str) -> None:
    with pytest.raises(EstimationInterrupted, match=r"Interrupted after [\d,]+ simulations") as caught:
        samplers.estimate(samplers.FunctionProblem(StopsAt(3), 2), method, seed=1, max_sim=60_000, on_error="failure")
    known = caught.value.estimate
    assert known.status is Status.STOPPED
    assert known.n_sim > 0
    assert any("Interrupted after" in text for text in known.warnings)
    if method == "mc":  # P = 0.02275, 30,000 draws: c.o.v. 3.8 %
        assert known.n_sim == 30_000
        assert abs(known.p / 0.02275 - 1) < 5 * 0.038


def test_before_the_first_batch_there_is_nothing_to_know() -> None:
    with pytest.raises(KeyboardInterrupt) as caught:
        samplers.estimate(samplers.FunctionProblem(StopsAt(0), 2), "mc", seed=1)
    assert type(caught.value) is KeyboardInterrupt


def test_a_signal_while_the_method_computes_waits_until_it_can_conclude(monkeypatch: pytest.MonkeyPatch) -> None:
    take = samplers.run.Run.answer

    def answer(self: samplers.run.Run, answers: Sequence[Answer]) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        take(self, answers)

    monkeypatch.setattr(samplers.run.Run, "answer", answer)
    with pytest.raises(EstimationInterrupted) as caught:
        samplers.estimate(EASY, "mc", seed=1, max_sim=20_000)
    assert caught.value.estimate.n_sim == 10_000
    assert caught.value.estimate.p > 0


def test_the_second_signal_does_not_wait_and_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    steps = []
    with pytest.raises(KeyboardInterrupt), defer_signals():
        os.kill(os.getpid(), signal.SIGINT)
        steps.append("after the first")
        os.kill(os.getpid(), signal.SIGINT)
        steps.append("after the second")
    assert steps == ["after the first"]
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_estimate_without_touching_signals() -> None:
    results: list[samplers.Estimate] = []

    thread = threading.Thread(target=lambda: results.append(samplers.estimate(EASY, "mc", seed=1, max_sim=1000)))
    thread.start()
    thread.join()
    assert np.isfinite(results[0].p)


@pytest.mark.parametrize("method", ["mc", "two-stage"])
def test_listener_is_told_of_simulations_levels_and_p(method):
    seen = []
    problem = half_space().problem
    result = samplers.estimate(problem, method, seed=1, max_sim=3000, progress=seen.append)
    counts = [progress.n_sim for progress in seen]
    assert counts == sorted(counts) and counts[-1] == result.n_sim
    assert seen[0].max_sim == 3000 and math.isnan(seen[0].p)
    assert seen[-1].level == result.trace[-1].gamma
    assert seen[-1].p == pytest.approx(result.p)
    assert result == samplers.estimate(problem, method, seed=1, max_sim=3000)


def test_bar_goes_to_standard_error(capsys):
    result = samplers.estimate(half_space().problem, "adss", seed=1, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert f"{result.n_sim:,} simulations" in err
    assert f"P[f <= 0] = {result.p:.2e}" in err


def test_workers_and_both_times_fit_eighty_columns(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with show_bar(10_000) as show:
        show(Progress(n_sim=9_000, max_sim=10_000, level=0.0, p=1.2e-5, run=0, workers=12))
    last = capsys.readouterr().err.strip("\n").splitlines()[-1]
    assert len(last) <= 80 and re.search(r"\d:\d\d:\d\d$", last.strip())
    assert "9,000 done P[f <= 0] = 1.20e-05, 12 workers" in last and "left after" in last  # all of it
    assert "retries" not in last


@pytest.mark.parametrize("terminal", [False, True])
def test_bar_of_a_run_that_fails_leaves_nothing(capsys, monkeypatch, terminal):
    monkeypatch.setenv("TERM", "xterm")
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")  # rich then takes standard error for a terminal
    problem = samplers.FunctionProblem(lambda x: np.where(x[:, 0] > 3.0, np.nan, 5.0 - x[:, 0]), 1)
    with pytest.raises(samplers.EvaluationError):
        samplers.estimate(problem, samplers.MonteCarlo(batch=100), seed=1, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    # what was there is erased, and nothing is written after that
    assert ("simulations" in err and err.endswith("\x1b[2K")) if terminal else err == ""
