import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.analysis.failure_weights import (
    choose_failures,
    expect_over_failures,
    expect_under_refits,
    mean_over_failures,
    weigh_failures,
)
from tests.samplers.analysis.parametric_normal import ALPHA, fitted, run

BETA = 3.0
P = float(stats.norm.sf(BETA))
PHI = float(stats.norm.pdf(BETA))
METHODS = sorted(samplers.METHODS)


def half_space(method="two-stage", seed=0, **options):
    return samplers.estimate(samplers.FunctionProblem(lambda x: BETA - x[:, 0], 2), method, seed=seed, **options)


@pytest.mark.parametrize("method", METHODS)
def test_weights_add_up_to_p(method):
    result = half_space(method, max_sim=8_000)
    failures = weigh_failures(result)
    assert failures.weights.sum() == pytest.approx(result.p, rel=1e-12)
    assert failures.total == len(failures.x) == np.count_nonzero(result.sample.f <= 0.0)
    some = weigh_failures(result, most=5)
    assert len(some.x) == 5
    assert some.weights.sum() == pytest.approx(result.p, rel=1e-12)
    assert np.array_equal(some.x, failures.x[some.rows])


def test_the_points_of_shares_are_those_of_the_weights():
    result, seen = half_space(), []
    result.shares(lambda x: seen.append(x) or ["any"] * len(x), most=50)
    assert np.array_equal(seen[0], weigh_failures(result, most=50).x)


@pytest.mark.parametrize("method", METHODS)
def test_the_expectation_of_one_is_p_with_its_cov(method):
    """With h = 1 the sum is p, and its c.o.v. at least that of the estimate."""
    result = half_space(method, max_sim=8_000)
    failures = weigh_failures(result)
    found = expect_over_failures(failures, np.ones(len(failures.x)))
    assert found.value == pytest.approx(result.p, rel=1e-12)
    assert found.per_failure == pytest.approx(1.0)
    assert found.cov >= 0.999 * result.cov
    assert found.interval[0] < result.p < found.interval[1]


def test_the_expectation_is_that_of_the_half_normal_tail():
    """E[(X - 3); X > 3] = phi(3) - 3 Phi(-3), within four standard errors, of which the interval has two."""
    result = half_space(max_sim=6_000)
    failures = weigh_failures(result)
    found = expect_over_failures(failures, failures.x[:, 0] - BETA)
    assert found.value == pytest.approx(PHI - BETA * P, rel=4 * found.cov)
    assert found.cov < 0.1
    assert np.log(found.interval[1] / found.value) == pytest.approx(1.96 * found.cov, rel=0.1)


def test_intervals_of_expectations_hold():
    """At a nominal 95 %, 40 runs: fewer than 32 held has a probability under 1e-3."""
    held = 0
    for seed in range(40):
        failures = weigh_failures(half_space("is", seed=seed, max_sim=1_500))
        low, high = expect_over_failures(failures, failures.x[:, 0] - BETA).interval
        held += low <= PHI - BETA * P <= high
    assert held >= 32


def test_the_expectation_scales_with_the_quantity():
    failures = weigh_failures(half_space())
    h = failures.x[:, 0]
    one, thousand = (expect_over_failures(failures, scale * h) for scale in (1.0, 1000.0))
    assert thousand.value == pytest.approx(1000 * one.value)
    assert thousand.interval == pytest.approx(tuple(1000 * end for end in one.interval))
    assert thousand.cov == pytest.approx(one.cov)


def test_the_mean_over_failures_is_that_of_the_truncated_normal():
    """E[X | X > 3] = phi(3) / Phi(-3) and E[X_2 | failure] = 0; errors are those of 30 seeds."""
    means, errors = [], []
    for seed in range(30):
        failures = weigh_failures(half_space("is", seed=seed, max_sim=1_500))
        mean, error = mean_over_failures(failures, failures.x)
        means.append(mean)
        errors.append(error)
    z = (np.array(means) - [PHI / P, 0.0]) / errors
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(30)
    assert ((z.std(axis=0) > 0.6) & (z.std(axis=0) < 1.6)).all()


def test_errors_count_paths_of_chains_as_one():
    """Twice the points in the same units do not make a mean more certain."""
    failures = weigh_failures(half_space("mc", max_sim=20_000))
    double = {
        name: np.repeat(getattr(failures, name), 2, axis=0) for name in ("x", "rows", "has_outcome", "weights", "units")
    }
    again = type(failures)(**{**vars(failures), **double, "weights": double["weights"] / 2})
    for found, twice in zip(mean_over_failures(failures, failures.x), mean_over_failures(again, again.x), strict=True):
        assert np.allclose(found, twice)


def test_bad_input_is_refused():
    failures = weigh_failures(half_space())
    with pytest.raises(ValueError, match=r"^No point failed \(f <= 0\): there is nothing to analyse\.$"):
        weigh_failures(samplers.estimate(samplers.FunctionProblem(lambda x: 9.0 - x[:, 0], 2), "mc", max_sim=100))
    with pytest.raises(ValueError, match="most of at least 1"):
        choose_failures(half_space().sample, 0.0, 0)
    for values in (-failures.x[:, 0], failures.x, np.full(len(failures.x), np.nan)):
        with pytest.raises(ValueError, match="finite value >= 0 for each"):
            expect_over_failures(failures, values)
    with pytest.raises(ValueError, match="0 at every failing point"):
        expect_over_failures(failures, np.zeros(len(failures.x)))


def test_the_uncertainty_of_one_under_refits_is_that_of_p():
    result = run(fitted(), max_sim=6000)
    failures = weigh_failures(result)
    ones = np.ones(len(failures.x))
    found = expect_under_refits(result, failures, 2 * ones, expect_over_failures(failures, 2 * ones))
    whole = result.base_uncertainty
    assert found.p_refits == pytest.approx([2 * p for p in whole.p_refits])
    assert found.spread == pytest.approx(whole.spread)
    assert found.interval == pytest.approx(tuple(2 * end for end in whole.interval), rel=0.01)
    assert found.expected == pytest.approx(2 * whole.expected)


def test_expectations_under_refits_are_those_of_the_tail():
    """E[(Z - 3)^+] = phi(3) - 3 Phi(-3) of Z = alpha . u under each refit, by its mean and variance along alpha."""
    base = fitted()
    result = run(base, max_sim=6000)
    failures = weigh_failures(result, most=1500)
    beyond = -result.sample.f[result.sample.f <= 0][failures.rows]
    found = expect_under_refits(result, failures, beyond, expect_over_failures(failures, beyond))
    for refit, value in zip(base.refits, found.p_refits, strict=True):
        mean = ALPHA @ ((refit.mean - base.mean) / base.sd)
        sd = np.sqrt(ALPHA**2 @ (refit.sd / base.sd) ** 2)
        z = (BETA - mean) / sd
        assert value == pytest.approx(sd * (stats.norm.pdf(z) - z * stats.norm.sf(z)), rel=0.35)
    assert found.interval[1] / found.interval[0] > np.exp(
        2 * 2.04 * found.spread
    )  # t is 2.09 with 19 degrees of freedom


def test_without_refits_there_is_no_such_uncertainty():
    result = half_space()
    failures = weigh_failures(result)
    ones = np.ones(len(failures.x))
    assert expect_under_refits(result, failures, ones, expect_over_failures(failures, ones)) is None
