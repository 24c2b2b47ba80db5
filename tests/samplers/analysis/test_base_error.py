"""Intervals that the events behind a fitted base allow: of p, of a ratio, of a curve."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import samplers
from tests.samplers.fitted_bases import (
    BASE,
    BETA,
    FAR,
    FAR_BASE,
    SHIFTED,
    FittedWithEnsemble,
    HalfSpace,
    fitted,
    normal,
    run,
)

WIDE = [normal(mean, sd) for mean in np.linspace(-2.0, 2.0, 6) for sd in (0.5, 0.75, 1.0, 1.5, 2.0)]
"""30 refits so far apart that the events determine nothing."""


def after(result, lineages):
    """Return a result as if so many independent searches had found its failures; inf for plain draws."""
    return replace(result, sample=replace(result.sample, lineages=lineages))


def test_the_interval_by_hand():
    """30 refits of 17 scenes: 16 degrees of freedom; t = 2.120. Plain draws miss no region."""
    result = after(run(BASE), math.inf)
    found = result.base_uncertainty
    spread = np.std(np.log(found.value_refits), ddof=1)
    half = 2.119905 * math.sqrt(spread**2 + result.cov**2 + 0.04)
    assert found.interval == pytest.approx((result.p * math.exp(-half), result.p * math.exp(half)), rel=1e-6)
    assert found.expected == pytest.approx(result.p * math.exp(spread**2 / 2))
    assert found.spread == pytest.approx(spread)
    assert (found.value, found.bound, found.reason, found.n_sim) == (result.p, None, "", 0)
    exact = np.log([refit.p for refit in SHIFTED])
    assert found.spread == pytest.approx(exact.std(ddof=1), rel=0.05)
    assert np.log(found.value_refits) == pytest.approx(exact, abs=0.3)


def test_the_upper_end_holds_what_a_search_may_have_missed():
    """97.5 % point of p exp(S T) / (1 - M), M ~ Beta(1/10, lineages); the other numbers do not change."""
    without, found = (after(run(BASE), lineages).base_uncertainty for lineages in (math.inf, 3.0))
    assert (found.interval[0], found.spread, found.expected) == (without.interval[0], without.spread, without.expected)
    rng = np.random.default_rng(0)
    sigma = math.log(without.interval[1] / without.value) / stats.norm.ppf(0.975)
    drawn = sigma * rng.standard_normal(10**6) - np.log1p(-rng.beta(0.1, 3.0, 10**6))
    assert np.quantile(drawn, 0.975) > math.log(without.interval[1] / without.value) + 0.03
    assert math.log(found.interval[1] / found.value) == pytest.approx(np.quantile(drawn, 0.975), abs=0.02)


def test_events_that_do_not_determine_p_give_a_bound_and_no_interval():
    result = run(fitted(WIDE))
    found = result.base_uncertainty
    assert found.spread > 2
    assert found.interval is found.expected is None
    half = 2.119905 * math.sqrt(found.spread**2 + result.cov**2 + 0.04)
    assert found.bound == pytest.approx(min(1.0, result.p * math.exp(half)), rel=1e-6)
    assert "too few recorded events for limits in this family" in result.details()
    assert "predictive mean" not in result.details()
    assert "no lower or upper limit (95 %)\nLimited by   " in str(result)
    assert "too few recorded events for a lower limit; below 0.010 in this family" in str(replace(found, bound=0.01))


def test_a_base_without_refits_prints_what_it_did():
    plain, fitted_run = run(normal()), run(BASE)
    assert plain.base_uncertainty is run(fitted()).base_uncertainty is None
    assert plain.to_dict()["base_uncertainty"] is None
    lines = [
        line for line in fitted_run.details().splitlines() if "base distribution" not in line and "family" not in line
    ]
    assert plain.details().splitlines() == lines
    assert (plain.p, plain.interval, plain.n_sim) == (fitted_run.p, fitted_run.interval, fitted_run.n_sim)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda: samplers.estimate(HalfSpace(BASE, 9.0), "mc", seed=1, max_sim=100), "nothing failed"),
        (lambda: replace(run(BASE), sample=None), "gave no weighted points"),
        (lambda: run(fitted(SHIFTED[:1])), "needs 2 refits and 2 clusters, got 1 and 17"),
        (lambda: run(fitted(SHIFTED, clusters=1)), "needs 2 refits and 2 clusters, got 30 and 1"),
        (lambda: run(fitted([*SHIFTED, Impossible()])), "1 of 31 refits have no density at any failing point"),
    ],
)
def test_where_the_spread_is_not_known_one_sentence_says_why(change, text):
    result = change()
    found = result.base_uncertainty
    assert found.interval is found.expected is found.bound is None
    assert math.isnan(found.spread)
    assert text in found.reason
    assert f"base distribution  no interval: {found.reason}" in result.details()
    assert json.loads(result.to_json())["base_uncertainty"]["spread"] is None


@pytest.mark.parametrize("max_sim", [1, 2, 20])
@pytest.mark.parametrize("method", ["two-stage", "mc", "adss", "ce", "surrogate"])
@pytest.mark.parametrize("beta", [0.0, 3.0])
def test_after_hardly_any_simulations_one_line_says_what_is_known(method, max_sim, beta):
    result = samplers.estimate(HalfSpace(BASE, beta), method, seed=1, max_sim=max_sim)
    found = result.base_uncertainty
    (line,) = (each.strip() for each in result.details().splitlines() if "base distribution" in each)
    if found.interval is not None:
        assert 0.0 <= found.interval[0] <= result.p <= found.interval[1] <= 1.0
        assert line.startswith("base distribution 95 %")
    else:
        assert line.startswith(("base distribution  no interval: ", "base distribution  too few recorded events for "))
        assert "nothing failed" in line or result.p > 0
    assert "nan" not in line and "inf " not in line
    json.loads(result.to_json())


def test_of_a_run_that_was_stopped_the_interval_holds_that_of_the_sampling():
    """Of the first batch of a search, some dozen failures, a c.o.v. above 0.4: few draws are worth a wider quantile."""
    started = samplers.TwoStage().start(HalfSpace(fitted([normal()] * 30)), seed=1, max_sim=3000)
    started.tell(BETA - started.ask()[:, 0])
    result = started.result()
    low, high = result.base_uncertainty.interval
    assert result.n_sim < 3000 and result.failures.total < 40 and result.cov > 0.4
    assert low <= result.interval[0] < result.interval[1] <= high
    assert result.details().count("base distribution 95 %") == 1


class Impossible:
    """N(0, 1), without density where the half-space fails; its draws from the base at the front door do not."""

    def log_prob(self, x):
        return np.where(x[:, 0] < 2.99, normal().log_prob(x), -np.inf)


def test_a_further_run_is_made_exactly_where_the_points_do_not_reach_the_refits():
    near = run(fitted(SHIFTED, FittedWithEnsemble))
    assert near.ensemble_run is None
    assert near.base_uncertainty.n_sim == 0
    three = run(fitted([*SHIFTED[:27], *FAR[27:]], FittedWithEnsemble))
    assert sum(ess < 10 for ess in three.base_uncertainty.ess_refits) == 3
    assert three.ensemble_run is None
    assert run(FAR_BASE).ensemble_run is not None


def test_the_further_run_knows_p_of_the_refits_and_leaves_p_as_it_is():
    result, without = run(FAR_BASE), run(FAR_BASE, ensemble_run=False)
    assert without.ensemble_run is None
    assert (result.p, result.interval, result.n_sim) == (without.p, without.interval, without.n_sim)
    found = result.base_uncertainty
    assert 0 < found.n_sim == result.ensemble_run.n_sim <= 3000  # max_sim limits it anew
    assert np.log(found.value_refits) == pytest.approx(np.log([refit.p for refit in FAR]), abs=0.3)
    assert min(found.ess_refits) > 10
    assert f"with {found.n_sim:,} more simulations from the mixture of the refits" in result.details()
    assert sum(ess < 10 for ess in without.base_uncertainty.ess_refits) == 4
    assert without.base_uncertainty.warnings == (
        "4 of 30 refits rest on fewer than 10 effective failing points: their interval is imprecise; "
        "more simulations (max_sim) help.",
    )
    assert "\nWarning      4 of 30 refits" in str(without)
    assert result.ensemble_run.p == pytest.approx(np.mean([refit.p for refit in FAR]), rel=0.1)
