"""Testing: checks that every method must pass, and every base distribution, for those of your own.

A method that fails raises an AssertionError that says what was expected. The seeds are fixed, so
the same method passes or fails every time. All runs together take a few 100,000 calls of cheap
functions.
"""

import math
import random
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtr

from samplers.bases import find_base_fault
from samplers.estimation import estimate
from samplers.limit_states import half_space, normal_cdf, two_modes
from samplers.method import Stepping
from samplers.problem import Distribution, FloatArray, FunctionProblem
from samplers.replicate import NOT_KNOWN
from samplers.result import Estimate
from samplers.run import Run, RunArguments
from samplers.sample import Status

__all__ = ["check_base", "check_method"]


def check_method(method: Stepping) -> None:
    """Run all checks on a method with these settings, and without max_sim too; an AssertionError if one fails."""
    for check in METHOD_CHECKS:
        check(method)


def check_base(base: Distribution, dim: int) -> None:
    """Check that the density of a base distribution of d coordinates and its map fit 200 of its draws.

    `samplers.estimate` makes this check itself. An AssertionError says
    what does not fit, with a probability below 1e-6 if all fits.
    """
    fault = find_base_fault(base, dim)
    if fault is not None:
        raise AssertionError(f"{type(base).__name__}: {fault}.")


def check_form(method: Stepping) -> None:
    """Check that the method has a name, says whether it stops at the target, and has steps."""
    _expect(isinstance(method, Stepping), method, "expected the attributes name, stops_at_target and steps")
    _expect(isinstance(method.name, str) and method.name != "", method, f"expected a name, got {method.name!r}")
    stops = method.stops_at_target
    _expect(isinstance(stops, bool), method, f"expected stops_at_target to be True or False, got {stops!r}")


def check_counts(method: Stepping) -> None:
    """Check that every simulation is in n_sim and in one level of the trace, every failing point in the failures."""
    for max_sim in (None, 2500):
        _estimate(method, half_space(2, 3.0).problem.evaluate, 2, seed=3, max_sim=max_sim)


def check_budget(method: Stepping) -> None:
    """Check that max_sim is never exceeded, however small, by one run or by replicates together."""
    for max_sim, replicates in [(1, 1), (2, 1), (7, 1), (7, 7), (50, 1), (500, 1), (1001, 3), (1950, 1), (3000, 1)]:
        f = half_space(2, 3.0).problem.evaluate
        result = _estimate(method, f, 2, seed=3, max_sim=max_sim, replicates=replicates)
        _expect(result.n_sim <= max_sim, method, f"max_sim={max_sim} was exceeded: {result.n_sim} simulations")
        if result.p == 0:
            _expect(result.status == Status.NO_HITS, method, f"p = 0 calls for no_hits, got {result.status}")


def check_seed(method: Stepping) -> None:
    """Check that the seed alone decides the result: nothing is drawn from global generators."""

    def state() -> tuple[object, bytes]:
        return random.getstate(), repr(np.random.get_state(legacy=False)).encode()  # noqa: NPY002 (nobody uses it)

    problem = two_modes().problem
    first, other = (estimate(problem, method, seed=seed, max_sim=5000) for seed in (5, 6))
    before = state()
    again = estimate(problem, method, seed=5, max_sim=5000)
    _expect(state() == before, method, "it draws from a global generator; use rng alone")
    _expect(first == again, method, f"the same seed gave {first.p} and {again.p}")
    _expect(first.failures != other.failures, method, "another seed gave the same failing points")


def check_no_failure(method: Stepping) -> None:
    """Check that p = 0 with a one-sided interval and a warning if nothing fails, also where f goes downhill."""

    def falling(slope: float, x: FloatArray) -> FloatArray:
        return 30.0 - slope * x[:, 0]

    for dim, max_sim, slope in ((1, 5000, 0.0), (2, 5000, 0.0), (6, 5000, 0.0), (3, 3000, 1.0)):
        result = _estimate(method, partial(falling, slope), dim, seed=1, max_sim=max_sim)
        low, high = result.interval
        wanted = f"nothing failed: expected p = 0, interval (0, more), got\n{result}"
        _expect(result.p == low == 0 < high, method, wanted)
        _expect(len(result.warnings) > 0, method, "nothing failed: expected a warning")
        _expect(result.status == Status.NO_HITS, method, f"nothing failed: expected no_hits, got {result.status}")
        _expect(slope > 0 or high < 0.02, method, f"{max_sim} points without failure bound p by {high:.2g}")


def check_failure_everywhere(method: Stepping) -> None:
    """Check that p = 1 with an interval that reaches down a little where everything fails."""
    for dim in (1, 2):
        result = _estimate(method, lambda x: np.full(len(x), -1.0), dim, seed=1, max_sim=3000)
        low, high = result.interval
        _expect(result.p == 1 and result.cov == 0, method, f"expected p = 1 with c.o.v. 0, got {result.p}")
        _expect(0.99 < low < 1 == high, method, f"expected an interval in [0.99, 1], got [{low}, {high}]")
        _expect(result.status == Status.CONVERGED, method, f"expected converged, got {result.status}")


def check_outcomes(method: Stepping) -> None:
    """Check p if f ties at gamma, which is failure, where it is infinite, and if rows have no outcome."""
    for what, f, gamma, seeds in (
        ("whole numbers", lambda x: np.floor(x[:, 0] + 4.5), 2.0, range(5)),
        ("infinite outcomes", lambda x: np.where(x[:, 0] > 1.5, -np.inf, np.inf), 0.0, (1,)),
        ("rows without an outcome", lambda x: np.where(x[:, 1] > 1.5, np.nan, 10.0 - x[:, 0]), 0.0, (1,)),
    ):
        for seed in seeds:
            problem = FunctionProblem(f, 2)  # rows without an outcome are tried again, beyond its counts
            result = estimate(problem, method, gamma, seed, max_sim=5000, on_error="failure")
            _expect_near(method, result, normal_cdf(-1.5), what)


def check_dimensions(method: Stepping) -> None:
    """Check that one dimension is enough, and that with 1,500 the result is right or has a warning."""
    p = normal_cdf(-2.0)
    one = _estimate(method, half_space(1, 2.0).problem.evaluate, 1, seed=1, max_sim=5000)
    _expect_near(method, one, p, "one dimension")
    many = _estimate(method, half_space(1500, 2.0).problem.evaluate, 1500, seed=1, max_sim=3000)
    holds = many.interval[0] <= p <= many.interval[1]
    _expect(holds or len(many.warnings) > 0, method, f"1,500 dimensions: missed p without a warning\n{many}")


def check_interruption(method: Stepping) -> None:
    """Check that a run that is stopped after any batch has a result with all that was simulated."""
    problem, arguments = half_space(2, 3.0).problem, RunArguments(seed=2, max_sim=4000)

    def take(batches: float) -> tuple[Run, int, int]:
        """Return the run after so many batches, these and its simulations."""
        run, n, rows = Run(problem, method, arguments), 0, 0
        while n < batches and not run.done:
            x = run.ask()
            n, rows = n + 1, rows + len(x)
            run.tell(problem.evaluate(x))
        return run, n, rows

    _, whole, _ = take(math.inf)
    for after in sorted({math.ceil(whole * i / 12) for i in range(1, 12)} & set(range(1, whole))):
        run, _, rows = take(after)
        result = run.result()
        known = not set(NOT_KNOWN.warnings) & set(result.warnings)
        _expect(known, method, f"Interrupted after batch {after}: expected an Outcome from what there is")
        _expect_sound(method, result, rows)


def check_sample(method: Stepping) -> None:
    """Check that the weighted points behind p, if there are any, add up to p and give a curve that holds the truth."""
    result = estimate(half_space(2, 2.0).problem, method, seed=4, max_sim=3000, replicates=2)
    sample = result.sample
    if sample is None:
        return
    m, k = len(sample.f), int(np.count_nonzero(sample.f <= 0))
    _expect(sample.weights.shape == sample.units.shape == (m,), method, f"expected {m} weights and units")
    _expect(bool((sample.weights >= 0).all()), method, "expected weights of at least 0")
    fits = bool(((sample.units >= 0) & (sample.units < sample.n_units)).all())
    _expect(fits, method, f"expected units in 0 to {sample.n_units - 1}")
    _expect(sample.x.shape == (k, 2), method, f"expected the {k} failing points, got x of shape {sample.x.shape}")
    p = float(sample.weights[sample.f <= 0].sum())
    near = abs(p - result.p) <= 3 * result.cov * result.p  # control variates may make a difference
    _expect(near, method, f"the weights of failing points add up to {p:.4g}, p is {result.p:.4g}")
    curve, truth = result.curve([0.0, 0.5, 1.0, 2.0, 3.0]), ndtr(np.array([-2.0, -1.5, -1.0, 0.0, 1.0]))
    held = (0.8 * curve.low <= truth) & (truth <= 1.2 * curve.high)
    _expect(bool(held.all()), method, f"the curve misses {truth}:\n{curve}")


def check_accuracy(method: Stepping) -> None:
    """Check ten runs on an easy problem for gross errors; this does not prove that the method is right."""
    reference = half_space(2, 2.0)
    results = [estimate(reference.problem, method, seed=seed, max_sim=2000) for seed in range(10)]
    ratios = np.array([result.p for result in results]) / reference.p
    allowed = 0.1 + 4 * ratios.std(ddof=1) / math.sqrt(10)
    _expect(abs(ratios.mean() - 1) < allowed, method, f"mean of 10 runs is {ratios.mean():.3g} times the true p")
    held = sum(result.interval[0] <= reference.p <= result.interval[1] for result in results)
    _expect(held >= 6, method, f"{held} of 10 intervals cover the true p")


METHOD_CHECKS: tuple[Callable[[Stepping], None], ...] = (
    *(check_form, check_counts, check_budget, check_seed, check_no_failure, check_failure_everywhere),
    *(check_outcomes, check_dimensions, check_interruption, check_sample, check_accuracy),
)


def _estimate(method: Stepping, f: Callable[[FloatArray], object], dim: int, **options: Any) -> Estimate:
    """Return an estimate whose books are those of f: its rows, and those of them that fail."""
    rows = failing = 0

    def counting(x: FloatArray) -> FloatArray:
        nonlocal rows, failing
        values = np.asarray(f(x), dtype=np.float64)
        rows, failing = rows + len(x), failing + int(np.count_nonzero(values <= 0))
        return values

    result = estimate(FunctionProblem(counting, dim), method, **options)
    _expect_sound(method, result, rows)
    total = result.failures.total
    _expect(total == failing, method, f"{failing} points failed, the result has {total}")
    return result


def _expect(holds: bool, method: Stepping, otherwise: str) -> None:
    if not holds:
        raise AssertionError(f"{getattr(method, 'name', method)!r}: {otherwise}.")  # a user's object


def _expect_sound(method: Stepping, result: Estimate, rows: int) -> None:
    (low, high), levels = result.interval, sum(level.n_sim for level in result.trace)
    _expect(result.n_sim == rows, method, f"{rows} simulations, n_sim says {result.n_sim}")
    _expect(levels == rows, method, f"{rows} simulations, the levels of the trace add up to {levels}")
    _expect(0 <= low <= result.p <= high <= 1, method, f"expected 0 <= low <= p <= high <= 1, got\n{result}")
    drawn = result.base_draws
    _expect(0 <= drawn <= rows, method, f"expected at most {rows} base draws, the result has {drawn}")
    _expect(0 < result.unseen <= 1, method, f"expected unseen in (0, 1], got {result.unseen}")
    _expect(result.cov >= 0, method, f"expected a c.o.v. of at least 0, got {result.cov}")
    _expect(result.p > 0 or high > 0, method, "p = 0 is never certain: expected an upper limit above 0")


def _expect_near(method: Stepping, result: Estimate, p: float, what: str) -> None:
    _expect(abs(result.p / p - 1) < 0.5, method, f"{what}: expected p near {p:.3g}, got\n{result}")
