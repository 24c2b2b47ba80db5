"""Expectations over failures and exceedance curves, on half-spaces whose tails are known."""

import numpy as np
import pytest
from scipy import stats

from samplers.analysis.expectation import FurtherFailures, expect_over_failures, expect_under_refits
from samplers.analysis.weighted import weigh_failures
from tests.samplers.analysis.half_space_tail import BETA, METHODS, PHI, P, estimate_half_space
from tests.samplers.analysis.parametric_normal import ALPHA, fitted, run
from tests.samplers.fitted_bases import FittedWithEnsemble, normal
from tests.samplers.fitted_bases import fitted as fitted_normal
from tests.samplers.fitted_bases import run as run_normal


@pytest.mark.parametrize("method", METHODS)
def test_the_expectation_of_one_is_p_with_its_cov(method):
    """With h = 1 the sum is p, and its c.o.v. at least that of the estimate."""
    result = estimate_half_space(method, max_sim=8_000)
    failures = weigh_failures(result)
    found = expect_over_failures(failures, np.ones(len(failures.x)))
    assert found.value == pytest.approx(result.p, rel=1e-12)
    assert found.per_failure == pytest.approx(1.0)
    assert found.cov >= 0.999 * result.cov
    assert found.interval[0] < result.p < found.interval[1]


def test_the_expectation_is_that_of_the_half_normal_tail():
    """E[(X - 3); X > 3] = phi(3) - 3 Phi(-3), within four standard errors, of which the interval has two."""
    result = estimate_half_space(max_sim=6_000)
    failures = weigh_failures(result)
    found = expect_over_failures(failures, failures.x[:, 0] - BETA)
    assert found.value == pytest.approx(PHI - BETA * P, rel=4 * found.cov)
    assert found.cov < 0.1
    assert np.log(found.interval[1] / found.value) == pytest.approx(1.96 * found.cov, rel=0.1)


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


def test_bad_input_is_refused():
    failures = weigh_failures(estimate_half_space())
    for values in (-failures.x[:, 0], failures.x, np.full(len(failures.x), np.nan)):
        with pytest.raises(ValueError, match="finite value >= 0 for each"):
            expect_over_failures(failures, values)
    with pytest.raises(ValueError, match="0 at every failing point"):
        expect_over_failures(failures, np.zeros(len(failures.x)))


def test_points_of_the_further_run_count_where_the_first_has_few():
    """h = 1: what is known under refits is p itself, from the same choice of run."""
    base = fitted_normal([normal(0.0)] * 6 + [normal(7.0, 0.2 + 0.01 * i) for i in range(4)], kind=FittedWithEnsemble)
    result = run_normal(base)
    assert result.ensemble_run is not None
    failures, more = weigh_failures(result), weigh_failures(result.ensemble_run)
    ones = np.ones(len(failures.x))
    one = expect_over_failures(failures, ones)
    both = expect_under_refits(result, failures, ones, one, FurtherFailures(more, np.ones(len(more.x))))
    alone = expect_under_refits(result, failures, ones, one)
    assert both.p_refits == pytest.approx(result.base_uncertainty.p_refits)
    assert both.n_sim == result.ensemble_run.n_sim
    assert min(alone.ess_refits) < 10 < min(both.ess_refits)
    assert both.p_refits == pytest.approx([refit.p for refit in base.refits], rel=0.3)
