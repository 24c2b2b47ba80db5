import math

import numpy as np
import pytest

import samplers
from samplers.errors import EvaluationError
from samplers.execution.run import split_budget
from samplers.limit_states import half_space

EASY = half_space(2, 2.0).problem


class Places:
    """What `start` needs of a problem: no f."""

    dim, base = 2, samplers.StandardNormal(2)


def finished(run, f=EASY.f):
    while not run.done:
        run.tell(f(run.ask()))
    return run.result()


@pytest.mark.parametrize("method", sorted(samplers.METHODS))
@pytest.mark.parametrize("options", [{}, {"replicates": 3, "max_sim": 4501}], ids=str)
def test_gives_what_estimate_gives(method, options):
    chosen = samplers.get_method(method)
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


@pytest.mark.parametrize(
    ("options", "expected"),
    [({"gamma": math.nan}, "gamma"), ({"max_sim": 2, "replicates": 3}, "max_sim"), ({"on_error": "no"}, "on_error")],
)
def test_bad_arguments(options, expected):
    with pytest.raises(ValueError, match=expected):
        samplers.MonteCarlo().start(Places(), **options)


@pytest.mark.parametrize("dim", [0, -1, 2.0, None])
def test_dimension_that_is_none(dim):
    class Wrong(Places):
        pass

    Wrong.dim = dim
    with pytest.raises(ValueError, match="dim to be a whole number of at least 1"):
        samplers.MonteCarlo().start(Wrong())
    with pytest.raises(ValueError, match="problem with dim and base, got object"):
        samplers.MonteCarlo().start(object())


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


def test_stopping_a_run_that_is_done_changes_nothing():
    run = samplers.MonteCarlo(n=50).start(Places(), seed=1)
    result = finished(run)
    run.stop()
    assert run.result() == result
    assert result.status != "stopped"


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


@pytest.mark.parametrize("shape", [(3,), (3, 5), (1, 3, 2)])
def test_a_method_that_asks_for_points_of_the_wrong_shape(shape):
    class Wrong(samplers.Method):
        name, stops_at_target = "wrong", False

        def steps(self, inputs, goal, rng):
            yield np.zeros(shape)

    with pytest.raises(ValueError, match=r"Expected x of shape \(n, 2\)"):
        Wrong().start(Places())


def test_a_method_without_an_outcome():
    class Silent(samplers.Method):
        name, stops_at_target = "silent", False

        def steps(self, inputs, goal, rng):
            yield np.zeros((1, 2))

    run = Silent().start(Places())
    run.ask()
    with pytest.raises(TypeError, match="return an Outcome, got None"):
        run.tell([1.0])


def test_shares_add_up():
    assert split_budget(None, 3) == [None] * 3
    for max_sim, replicates in ((1000, 3), (7, 7), (20, 6), (1, 1)):
        parts = split_budget(max_sim, replicates)
        assert sum(parts) == max_sim
        assert max(parts) - min(parts) <= 1
        assert len(parts) == replicates
