"""Sums over strata, p = sum_k w_k p_k, against exact answers."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

import samplers
from samplers import FunctionProblem
from samplers.analysis import compute_exceedance, expect_over_failures, weigh_failures
from samplers.method import Outcome, Part
from samplers.problem import StandardNormal, read_strata
from samplers.proposals import Gaussian
from samplers.replicate import sum_strata
from samplers.sample import Sample, Status, bound_missed
from samplers.strata import StratifiedProblem, Stratum
from samplers.testing import check_base


def half_space(at, dim=2):
    """P[f <= 0] = Phi(-at)."""
    return FunctionProblem(lambda x: at - x.sum(axis=1) / dim**0.5, dim)


SHARES, AT = {"looked": 0.98986, "hurried": 0.01, "unseen": 1.4e-4}, {"looked": 4.0, "hurried": 3.0, "unseen": 1.0}
P = sum(SHARES[name] * norm.sf(AT[name]) for name in SHARES)  # 6.7e-5: 47, 20 and 33 %


def roads(shares=SHARES, **log_sd):
    """Three strata of very different size, of 2, 3 and 1 dimensions."""
    dims = {"looked": 2, "hurried": 3, "unseen": 1}
    return StratifiedProblem(
        [Stratum(name, shares[name], half_space(AT[name], dims[name]), log_sd.get(name)) for name in shares]
    )


def even(shares=(0.7, 0.3), at=(1.5, 1.0)):
    """Two strata that plain draws resolve."""
    names = "abcdef"
    return StratifiedProblem([Stratum(names[k], shares[k], half_space(at[k])) for k in range(len(shares))])


def exact(shares, at, above=0.0):
    """P[f <= above]."""
    return sum(share * norm.sf(a - above) for share, a in zip(shares, at, strict=True))


# ---- the sum


@pytest.mark.parametrize(
    ("method", "max_sim"),
    [
        *(("mc", 200_000), ("two-stage", 6000), ("adss", 12_000), ("ce", 9000), ("auto", None)),
        pytest.param("auto", 6000, marks=pytest.mark.slow),
    ],
)
def test_the_sum_is_exact(method, max_sim):
    result = samplers.estimate(roads(), method, seed=3, max_sim=max_sim, confidence=0.999)
    assert result.interval[0] < P < result.interval[1]
    assert abs(result.p - P) < 4 * result.cov * result.p
    assert result.p == pytest.approx(sum(part.share * part.p for part in result.parts))
    assert result.n_sim == sum(part.n_sim for part in result.parts) == sum(level.n_sim for level in result.trace)
    assert sum(part.of_sum for part in result.parts) == pytest.approx(1)
    if max_sim:
        assert result.n_sim <= max_sim
    for part in result.parts:
        assert part.interval[0] < norm.sf(AT[part.name]) < part.interval[1]


def test_the_ends_are_those_of_zou_and_donner():
    def part(name, share, p, low, high):
        return Part(
            name=name, share=share, outcome=Outcome(p=p, interval=(low, high), cov=0.1, status=Status.CONVERGED)
        )

    parts = part("a", 0.9, 1e-3, 4e-4, 2e-3), part("b", 0.1, 0.2, 0.15, 0.3)
    whole = sum_strata(parts, 0.95, ())
    assert whole.p == pytest.approx(0.0209)
    assert whole.interval[0] == pytest.approx(0.0209 - math.hypot(0.9 * 6e-4, 0.1 * 0.05))
    assert whole.interval[1] == pytest.approx(0.0209 + math.hypot(0.9 * 1e-3, 0.1 * 0.1))
    assert whole.cov == pytest.approx(math.hypot(0.9 * 1e-4, 0.1 * 0.02) / 0.0209)
    nothing = Outcome(p=0.0, interval=(0.0, 4e-3), cov=math.inf, status=Status.NO_HITS)
    with_none = sum_strata((Part(name="a", share=0.9, outcome=nothing), parts[1]), 0.95, ())
    assert with_none.interval == pytest.approx((0.015, 0.02 + math.hypot(0.9 * 4e-3, 0.01)))


def test_unbiased_and_covered_with_few_simulations():
    """100 plain draws for two strata: intervals of shares of draws hold p 95 times in 100 or more."""
    shares, at = (0.7, 0.3), (2.0, 0.5)
    p, results = exact(shares, at), [samplers.estimate(even(shares, at), "mc", seed=s, max_sim=100) for s in range(150)]
    found = np.array([result.p for result in results])
    assert abs(found.mean() - p) < 3.3 * found.std() / 150**0.5 + 0.1 * found.std()  # pooled pilots
    assert sum(r.interval[0] <= p <= r.interval[1] for r in results) >= 134  # 95 %, by chance lower in 1 of 700
    assert found.std() < 0.95 * math.sqrt(p * (1 - p) / 100)  # worth more than 100 draws of the whole


@pytest.mark.parametrize(("method", "max_sim"), [("mc", 8000), ("auto", None)])
def test_simulations_go_where_the_error_of_the_sum_is(method, max_sim):
    result = samplers.estimate(even((0.5, 0.5), (2.5, 0.0)), method, seed=0, max_sim=max_sim)
    small, large = result.parts  # standard deviations of 0.079 and 0.5
    assert small.n_sim >= 1000  # its pilot
    assert large.n_sim / result.n_sim == pytest.approx(0.5 / 0.579, abs=0.08)


def test_one_stratum_is_the_plain_estimate():
    whole = [SimpleNamespace(name="all", share=1.0, base=StandardNormal(2))]
    alone = type("Alone", (StandardNormal,), {"strata": whole})(2)
    for method in ("mc", "two-stage"):
        problems = FunctionProblem(half_space(2.5).f, base=alone), half_space(2.5)
        one, plain = (samplers.estimate(problem, method, seed=1, max_sim=2000) for problem in problems)
        assert one == plain and one.parts == ()
    assert read_strata(alone) == ()


def test_strata_of_a_stratum_are_strata_of_the_sum():
    """P = 0.5 (0.9998 1e-8 + 2e-4 0.3) + 0.5 1e-7: draws of one density would hardly meet the 0.3."""
    inner = even((0.9998, 2e-4), norm.isf((1e-8, 0.3)))
    problem = StratifiedProblem([Stratum("I", 0.5, inner), Stratum("J", 0.5, half_space(norm.isf(1e-7)))])
    check_base(problem.base, problem.dim)
    result = samplers.estimate(problem, seed=1, max_sim=6000)
    truth = 0.5 * exact((0.9998, 2e-4), norm.isf((1e-8, 0.3))) + 0.5e-7
    assert [part.name for part in result.parts] == ["I: a", "I: b", "J"] and result.cov < 0.1
    assert [part.share for part in result.parts] == pytest.approx([0.4999, 1e-4, 0.5])
    assert result.interval[0] < truth < result.interval[1]


def test_a_base_with_strata_serves_a_function():
    """Failure: x1 > 1 in the stratum of a tenth of x, x1 > 3 in the other."""
    problem = FunctionProblem(lambda x: np.where(x[:, 0] < 1, 1.0, 3.0) - x[:, 1], base=even((0.1, 0.9)).base)
    result = samplers.estimate(problem, seed=0, max_sim=6000)
    assert result.interval[0] < exact((0.1, 0.9), (1, 3)) < result.interval[1] and result.cov < 0.1
    rare = result.reweight(even((0.001, 0.999)).base)
    assert rare.interval[0] < exact((0.001, 0.999), (1, 3)) < rare.interval[1]


# ---- how a run goes


@pytest.mark.parametrize("method", ["mc", "two-stage", "adss", "ce"])
def test_an_interruption_anywhere_leaves_a_valid_estimate(method):
    problem = roads()
    whole = samplers.estimate(problem, method, seed=2, max_sim=4000)
    for after in np.linspace(1, whole.n_sim - 1, 5).astype(int):
        result = samplers.estimate(problem, method, seed=2, max_sim=4000, stop=lambda at, n=after: at.n_sim >= n)
        assert result.n_sim == sum(level.n_sim for level in result.trace)
        if result.n_sim < whole.n_sim:
            assert result.status is Status.STOPPED and result.interval[0] <= P <= result.interval[1]


def test_a_stratum_without_a_failure_raises_the_upper_end_alone():
    result = samplers.estimate(even((0.9, 0.1), (40.0, 1.0)), "mc", seed=0, max_sim=4000)
    none, some = result.parts
    assert none.p == 0 and none.interval == pytest.approx((0, 1 - 0.025 ** (1 / none.n_sim)))
    assert result.interval[0] == pytest.approx(0.1 * some.interval[0])
    above = math.hypot(0.9 * none.interval[1], 0.1 * (some.interval[1] - some.p))
    assert result.interval[1] == pytest.approx(result.p + above)
    assert result.status is Status.CONVERGED and result.warnings == ()
    assert (
        f"a (90 % of x): p below {none.interval[1]:.1e}, no failure in {none.n_sim:,} simulations" in result.details()
    )
    assert any("a may add up to" in text for text in result.remarks)
    assert result.curve([0.0]).high[0] == pytest.approx(result.interval[1], rel=0.05)
    same = result.reweight(even((0.9, 0.1), (40.0, 1.0)).base)
    assert same.interval[1] == pytest.approx(result.interval[1], rel=0.05)
    doubled = result.reweight(even((0.45, 0.55), (40.0, 1.0)).base)
    assert doubled.p == pytest.approx(5.5 * result.p) and doubled.interval[1] < 5.5 * same.interval[1]
    assert not result.meets(0.01) and result.meets(0.1)


def test_nothing_fails_anywhere():
    result = samplers.estimate(even((0.9, 0.1), (40.0, 40.0)), "two-stage", seed=0, max_sim=3000)
    assert result.p == 0 and result.status is Status.NO_HITS and 0 < result.interval[1] < 0.1
    assert result.warnings and math.isnan(result.parts[0].of_sum)


@pytest.mark.parametrize(("method", "max_sim"), [("mc", 10**6), ("two-stage", None), ("adss", None)])
def test_the_target_is_met_and_nothing_spent_on_what_does_not_matter(method, max_sim):
    problem, truth = even((0.5, 0.5), (4.0, 1.0)), exact((0.5, 0.5), (4.0, 1.0))  # 2e-4 and 0.9998 of the sum
    for seed in (0, 1):
        result = samplers.estimate(problem, method, seed=seed, max_sim=max_sim, target_cov=0.02)
        assert result.cov <= 0.02 and result.status is Status.CONVERGED
        assert abs(result.p - truth) < 4 * 0.02 * truth
        if method == "adss":
            assert result.parts[0].n_sim < 5000  # one run


@pytest.mark.parametrize("often", [0.3, 1e-7])
def test_the_default_searches_rare_strata_for_a_target(often):
    """1e-8 in 0.9998 of x: pilots of 1,000 plain draws see nothing of it."""
    shares, at = (0.9998, 2e-4), (norm.isf(1e-8), norm.isf(often))
    result = samplers.estimate(even(shares, at), seed=3, target_cov=0.1)
    assert result.cov <= 0.1 and result.interval[0] < exact(shares, at) < result.interval[1]
    assert result.n_sim < 15_000 and result.parts[0].method == "mc, two-stage"


def test_a_stratum_that_may_add_most_is_looked_at_before_the_target_counts_as_met():
    """A pilot of 125 draws misses p = 1e-3 in 0.99 of x; what the other stratum has, 0.01 times 0.16, is soon known."""
    for seed in range(5):
        result = samplers.estimate(even((0.99, 0.01), (3.09, 1.0)), "mc", seed=seed, max_sim=20_000, target_cov=0.2)
        assert result.parts[0].p > 0 and result.parts[0].n_sim > 2000


@pytest.mark.parametrize("max_sim", [1, 2, 4, 61, 100])
@pytest.mark.parametrize("method", ["mc", "two-stage", "ce", "adss", "auto"])
def test_tiny_budgets(method, max_sim):
    result = samplers.estimate(roads(), method, seed=0, max_sim=max_sim)
    assert result.n_sim <= max_sim and result.interval[0] <= P <= result.interval[1]
    assert (result.status is Status.NO_HITS) == (result.p == 0)
    if max_sim < 3:
        assert "not simulated" in result.details() and result.parts[0].n_sim == 1  # the largest first


def test_replicates_of_counts_are_pooled_by_stratum():
    problem = even()
    result = samplers.estimate(problem, "mc", seed=0, max_sim=20_000, replicates=4)
    for part in result.parts:
        hits, n = part.outcome.counts
        assert part.p == hits / n and n == part.n_sim
    assert result.interval[0] < exact((0.7, 0.3), (1.5, 1.0)) < result.interval[1]
    assert result.interval[1] / result.interval[0] < 1.2  # a t interval of 4 runs would be twice as wide


def test_a_stratum_that_a_replicate_has_not_simulated_does_not_count_in_it():
    always = FunctionProblem(lambda x: -np.ones(len(x)), 1)
    problem = StratifiedProblem([Stratum(*each, always) for each in (("a", 0.5), ("b", 0.3), ("c", 0.2))])
    result = samplers.estimate(problem, "mc", seed=0, max_sim=5, replicates=2)  # 2 and 3 simulations
    assert [part.p for part in result.parts] == [1.0, 1.0, 1.0] and [part.n_sim for part in result.parts] == [2, 2, 1]


def test_a_plan_takes_plain_draws_by_stratum():
    """Neyman: n = (sum of w_k sqrt(p_k (1 - p_k)))^2 / (p t)^2."""
    result = samplers.estimate(even((0.9, 0.1), (40.0, 1.0)), "mc", seed=0, max_sim=4000)
    (run,) = samplers.plan(result.pilot(), target_cov=0.1)
    p = result.parts[1].p
    assert run.n_sim == math.ceil((1 - p) / p / 0.01)


def test_levels_and_warnings_name_their_stratum():
    result = samplers.estimate(roads(), "adss", seed=1, max_sim=3000)
    assert {level.stratum for level in result.trace} == set(SHARES)
    assert all(text.split(":")[0] in SHARES for text in result.warnings)
    seen = []
    samplers.estimate(even(), "mc", seed=0, max_sim=40_000, progress=seen.append)
    assert seen[-1].p == pytest.approx(exact((0.7, 0.3), (1.5, 1.0)), rel=0.05)


def test_points_are_kept_with_weights_that_add_up():
    problem = even()
    for method in ("mc", "two-stage"):
        result = samplers.estimate(problem, method, seed=0, max_sim=3000, keep_points=True, replicates=2)
        table = result.to_arrow().to_pydict()
        weights = [w for w, failed in zip(table["weight"], table["failed"], strict=True) if failed and w is not None]
        assert sum(weights) == pytest.approx(result.p, rel=3 * result.cov)
        if method == "mc":
            assert sum(weights) == pytest.approx(result.p)
        stages = [(run, stage) for run, stage in zip(table["run"], table["stage"], strict=True)]
        strata = [[level.stratum for level in result.trace if level.run == run] for run in (0, 1)]
        assert all("ab"[int(x)] == strata[run][stage] for x, (run, stage) in zip(table["stratum"], stages, strict=True))


def test_rows_without_an_outcome():
    def f(x):
        return np.where(x[:, 1] > 2.0, np.nan, 1.0 - x[:, 0])

    parts = [Stratum("a", 0.6, FunctionProblem(f, 2)), Stratum("b", 0.4, half_space(1.5))]
    q = norm.sf(2.0)
    high, low = 0.6 * (q + (1 - q) * norm.sf(1)) + 0.4 * norm.sf(1.5), 0.6 * (1 - q) * norm.sf(1) + 0.4 * norm.sf(1.5)
    problem = StratifiedProblem(parts)
    counted = samplers.estimate(problem, "mc", seed=0, max_sim=40_000, on_error="failure", confidence=0.99)
    assert counted.interval[0] < high < counted.interval[1] and counted.interval[0] > low
    bounded = samplers.estimate(problem, "mc", seed=0, max_sim=40_000, on_error="bound", confidence=0.99)
    assert bounded.interval[0] < low and bounded.interval[1] == counted.interval[1]
    with pytest.raises(samplers.EvaluationError, match="f is NaN"):
        samplers.estimate(problem, "mc", seed=0, max_sim=1000)


@pytest.mark.parametrize("whole", [False, True])
def test_the_lower_end_of_failures_with_an_outcome_keeps_its_level(whole):
    """0.05 fail with an outcome, 0.05 without one: 2.5 % of lower ends lie above 0.05, in a sum and of one density."""

    def f(x, lost=lambda x: x[:, 1] > 0):
        return np.where(lost(x) & (x[:, 0] > 1.2816), np.nan, 1.2816 - x[:, 0])

    bad, good = (FunctionProblem(lambda x, k=k: f(x, lambda x: np.full(len(x), k)), 2) for k in (True, False))
    problem = FunctionProblem(f, 2) if whole else StratifiedProblem([Stratum("a", 0.5, bad), Stratum("b", 0.5, good)])
    lows = [
        samplers.estimate(problem, "mc", seed=seed, max_sim=2000, on_error="bound").interval[0] for seed in range(60)
    ]
    assert np.sum(np.array(lows) > 0.05) <= 5  # by chance more in 1 of 200


SLOW = pytest.mark.slow
RUNS = [("ce", 1), pytest.param("ce", 3, marks=SLOW), pytest.param("adss", 1, marks=SLOW)]


@pytest.mark.parametrize(("method", "replicates"), RUNS)
def test_the_lower_end_of_weighted_failures_with_an_outcome_keeps_its_level(method, replicates):
    """0.05 have no outcome, 9.5e-4 fail with one: so few of the draws that the error of p says nothing about theirs."""
    problem = FunctionProblem(lambda x: np.where(x[:, 1] > 1.6449, np.nan, 3.0902 - x[:, 0]), 2)
    asked = {"max_sim": 2000 * replicates, "replicates": replicates, "on_error": "bound"}
    runs = [samplers.estimate(problem, method, seed=seed, **asked) for seed in range(60)]
    assert sum(run.interval[0] > 9.5e-4 for run in runs) <= 5
    assert np.mean([run.interval[0] > 0 for run in runs]) > 0.3


# ---- what follows from the points


def test_a_base_with_other_strata_is_refused():
    result = samplers.estimate(even(), "mc", seed=0, max_sim=2000)
    a, b = even().strata
    with pytest.raises(ValueError, match="strata a, b, in this order; got b, a"):
        result.reweight(StratifiedProblem([b, a]).base)


def test_other_shares_by_reweighting():
    result = samplers.estimate(even(), "two-stage", seed=1, max_sim=4000)
    for shares in ((0.2, 0.8), (0.95, 0.05)):
        other = result.reweight(even(shares).base)
        assert other.interval[0] < exact(shares, (1.5, 1.0)) < other.interval[1]
        assert other.p == pytest.approx(sum(w * part.p for w, part in zip(shares, result.parts, strict=True)), rel=0.02)


@pytest.mark.parametrize("method", ["mc", "two-stage", "adss"])
def test_the_curve_of_a_sum(method):
    result = samplers.estimate(even(), method, seed=1, max_sim=8000)
    gammas = [0.0, 0.5, 1.0, 2.0]
    curve, truth = result.curve(gammas), [exact((0.7, 0.3), (1.5, 1.0), g) for g in gammas]
    assert (curve.low <= truth).all() and (truth <= curve.high).all()


def test_the_error_of_a_share_by_hand():
    """p = w_1 p_1 + w_2 p_2 with log w_2 of standard deviation 0.4: almost all of p, so log p has about as much."""
    problem = StratifiedProblem(
        [Stratum("a", 0.999, half_space(6.0)), Stratum("b", 0.001, half_space(1.0), log_sd=0.4)]
    )
    result = samplers.estimate(problem, "two-stage", seed=0, max_sim=6000)
    found = result.base_uncertainty
    assert found.spread == pytest.approx(0.4, rel=0.01) and len(found.value_refits) == 100
    half = 1.984 * math.sqrt(0.4**2 + result.cov**2 + 0.2**2)  # t of 99 degrees of freedom; 0.2: bias of a fit
    low, high = (result.p * math.exp(sign * half) for sign in (-1, 1))
    assert found.interval == pytest.approx((low, high), rel=0.02)
    assert found.fitted_to == "share of b" and found.expected == pytest.approx(result.p * math.exp(0.08), rel=0.05)
    assert samplers.estimate(even(), "mc", seed=0, max_sim=100).base_uncertainty is None


def test_refits_have_shares_that_add_up():
    base = roads(unseen=0.5, hurried=0.3).base
    shares = np.array([refit.shares for refit in base.refits])
    assert shares.sum(axis=1) == pytest.approx(np.ones(100)) and (shares > 0).all()
    assert np.log(shares).std(axis=0, ddof=1)[1:] == pytest.approx([0.3, 0.5], rel=1e-6)
    x = base.sample(50, np.random.default_rng(0))
    assert np.exp(base.refits[3].log_prob(x) - base.log_prob(x)) == pytest.approx(
        shares[3][x[:, 0].astype(int)] / np.array(base.shares)[x[:, 0].astype(int)]
    )
    result = samplers.estimate(roads(unseen=0.5, hurried=0.3), "two-stage", seed=0, max_sim=6000)
    by_hand = shares @ [part.p for part in result.parts]
    assert result.base_uncertainty.value_refits == pytest.approx(by_hand, rel=0.05)


def test_refits_of_a_base_of_a_stratum_are_those_of_the_sum():
    class FittedNormal(StandardNormal):
        refits = tuple(Gaussian(np.array([m, 0.0]), np.eye(2)) for m in (-0.2, 0.0, 0.2))
        clusters, fitted_to, family = 17, "40 events", "normal"

    fitted = FunctionProblem(lambda x: 2.0 - x[:, 0], base=FittedNormal(2), dim=2)
    result = samplers.estimate(
        StratifiedProblem([Stratum("a", 0.5, fitted), Stratum("b", 0.5, half_space(2.0))]), "mc", seed=0, max_sim=40_000
    )
    exact_refits = [0.5 * norm.sf(2 - m) + 0.5 * norm.sf(2) for m in (-0.2, 0.0, 0.2)]
    assert result.base_uncertainty.value_refits == pytest.approx(exact_refits, rel=0.15)
    assert result.base_uncertainty.clusters == 3  # no more than refits


def test_two_sums_are_compared():
    a, b = even((0.7, 0.3), (2.0, 1.5)), even((0.7, 0.3), (2.2, 1.5))
    comparison = samplers.compare(a, b, seed=0, max_sim=12_000)
    truth = exact((0.7, 0.3), (2.0, 1.5)) / exact((0.7, 0.3), (2.2, 1.5))
    assert comparison.interval[0] < truth < comparison.interval[1]
    assert comparison.interval[1] / comparison.interval[0] < 1.3
    for side, p in ((comparison.a, exact((0.7, 0.3), (2.0, 1.5))), (comparison.b, exact((0.7, 0.3), (2.2, 1.5)))):
        assert side.interval[0] < p < side.interval[1]


def test_kinds_and_expectations_hold_what_a_stratum_without_failures_may_add():
    """5e-4 in stratum a is 0.9 of p; 1,000 draws meet none of it in 2 of 3 runs. Two kinds have half of p each."""
    shares, at = (0.9998, 2e-4), norm.isf((5e-4, 0.3))
    problem, half, held = even(shares, at), exact(shares, at) / 2, []
    for seed in range(20):
        result = samplers.estimate(problem, "mc", seed=seed, max_sim=2000)
        kind = result.shares(lambda x: np.where(x[:, 1] > x[:, 2], "up", "down").tolist())["up"]
        failures = weigh_failures(result)
        above = failures.x[:, 1] - failures.x[:, 2]
        expected = expect_over_failures(failures, (above > 0) * 1.0)
        curve = compute_exceedance(result, failures, above, [0.0])
        ends = (kind.interval, expected.interval, (curve.low[0], curve.high[0]))
        held.append([low <= half <= high for low, high in ends])
    assert (np.sum(held, axis=0) >= 18).all()


def test_a_stratum_in_which_one_of_two_hardly_failed_may_add_to_it():
    """A fails in 0.1 of stratum a, B in 5e-4, which 500 draws meet in one run of five; both in 0.3 of a rare one."""
    shares, at = (0.9998, 2e-4), norm.isf((0.1, 5e-4, 0.3))

    def fails(i, column):
        strata = zip("ab", shares, ((at[i], column), (at[2], 0)), strict=True)
        return StratifiedProblem(
            [
                Stratum(name, w, FunctionProblem(lambda x, level=level, j=j: level - x[:, j], 2))
                for name, w, (level, j) in strata
            ]
        )

    p = [shares[0] * q + shares[1] * 0.3 for q in (0.1, 5e-4)]
    runs = [samplers.compare(fails(0, 0), fails(1, 1), "mc", seed=seed, max_sim=4000) for seed in range(20)]
    assert sum(run.b.interval[0] <= p[1] <= run.b.interval[1] for run in runs) >= 18
    assert sum(run.interval[0] <= p[0] / p[1] <= run.interval[1] for run in runs) >= 18
    assert any(
        "B may fail more often by up to" in text and "in a: too few failures found" in text for text in runs[0].warnings
    )


def test_kinds_of_failure_and_failing_points():
    result = samplers.estimate(even(), "two-stage", seed=0, max_sim=4000)
    shares = result.shares(lambda x: np.array(["a", "b"])[x[:, 0].astype(int)].tolist())
    for part in result.parts:
        assert shares[part.name].of_failures == pytest.approx(part.of_sum, rel=0.02)
        assert shares[part.name].interval[0] < part.share * part.p < shares[part.name].interval[1]
    failures = result.failures
    assert (np.diff(failures.log_p0) <= 0).all()
    assert failures.log_p0 == pytest.approx(even().base.log_prob(failures.x))
    assert result.sensitivity(parameters=False)


def test_the_largest_region_that_may_have_been_missed():
    """Lagrange: of w_1 m_1 + w_2 m_2 under (1 - m_1)^n_1 (1 - m_2)^n_2 = 0.05, by a grid."""
    for w, n in (((0.7, 0.3), (300, 50)), ((0.99, 0.01), (50, 3000)), ((0.5, 0.5), (10, 10))):
        m = 1 - 0.05 ** (np.linspace(0, 1, 20_001) / n[0])
        other = 1 - (0.05 / (1 - m) ** n[0]) ** (1 / n[1])
        largest = (w[0] * m + w[1] * other).max()
        assert bound_missed([(w[0], n[0]), (w[1], n[1])], 0.95) == pytest.approx(largest, rel=1e-6)
    assert bound_missed([(0.9, 0), (0.1, 10)], 0.95) == pytest.approx(0.9 + 0.1 * (1 - 0.05**0.1))
    equal = brentq(lambda m: (1 - m) ** 100 - 0.05, 0, 1)
    assert bound_missed([(0.4, 40), (0.6, 60)], 0.95) == pytest.approx(equal)


def test_what_is_saved_is_loaded(tmp_path):
    problem = roads(unseen=0.5)
    result = samplers.estimate(problem, seed=0, max_sim=3000)
    result.save(tmp_path / "result")
    loaded = samplers.Estimate.load(tmp_path / "result")
    assert loaded == result and loaded.parts == result.parts and str(loaded) == str(result)
    assert loaded.unseen == result.unseen
    nothing = samplers.estimate(problem, "mc", seed=0, max_sim=1)  # gain and shares of the sum are NaN
    nothing.save(tmp_path / "nothing")
    assert samplers.Estimate.load(tmp_path / "nothing") == nothing
    data = json.loads(result.to_json())
    assert [part["name"] for part in data["parts"]] == list(SHARES)
    assert data["parts"][2]["p"] == result.parts[2].p and data["parts"][2]["of_sum"] == result.parts[2].of_sum


# ---- the problem


def test_the_base_fits_together():
    problem = roads()
    check_base(problem.base, problem.dim)
    for stratum in problem.base.strata:
        check_base(stratum.base, problem.dim)
    u = np.random.default_rng(0).standard_normal((1000, 4))
    u[:12, 0] = [-38, -9, -7, -4, 0, 2.5, 3.6, 3.7, 4, 6, 9, 38]
    x = problem.base.from_standard_normal(u)
    assert x[:12, 0].astype(int).tolist() == [0, 0, 0, 0, 0, 1, 1, 2, 2, 2, 2, 2]
    assert problem.base.to_standard_normal(x)[1:10] == pytest.approx(u[1:10], abs=1e-6)
    assert problem.column_names == ("stratum", "x1", "x2", "x3") and problem.chunk_size == 16


def test_strata_may_come_from_any_iterable():
    parts = {name: Stratum(name, 0.5, half_space(1.0)) for name in "ab"}
    for given in (parts.values(), (each for each in parts.values()), np.array([*parts.values()])):
        assert [each.name for each in StratifiedProblem(given).strata] == ["a", "b"]


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: StratifiedProblem([]), "at least one"),
        (lambda: StratifiedProblem([half_space(1.0)]), "Stratum"),
        (lambda: StratifiedProblem(Stratum("a", 1.0, half_space(1.0))), "at least one"),
        (lambda: even((0.7, 0.2)), "add up to 1, got 0.7 .* 0.2 = 0.9"),
        (lambda: StratifiedProblem([Stratum("a", 0.5, half_space(1.0))] * 2), "different names"),
        (lambda: Stratum("a", 0.0, half_space(1.0)), "share of 'a'"),
        (lambda: Stratum("a", 0.5, lambda x: x), "problem with dim"),
        (lambda: Stratum("a", 0.5, half_space(1.0), log_sd=-1.0), "log_sd of 'a'"),
        (
            lambda: read_strata(SimpleNamespace(strata=[SimpleNamespace(name="a", share=1.0, base=None)])),
            "base distribution of stratum 'a'",
        ),
    ],
)
def test_errors_say_what_is_wrong(make, text):
    with pytest.raises(ValueError, match=text):
        make()


def test_where_nothing_fails_further_simulations_are_plain_draws() -> None:
    """Of n draws without a failure the upper end is 1 - .025^(1/n): all count, as those of a search do not."""
    safe = FunctionProblem(lambda x: np.ones(len(x)), dim=2)
    failing = FunctionProblem(lambda x: 1.0 - x[:, 0], dim=1)  # Phi(-1) = .159
    problem = StratifiedProblem([Stratum("safe", 0.9, safe), Stratum("failing", 0.1, failing)])
    problem.plain_draws = 50_000
    nothing, _ = samplers.estimate(problem, seed=0).parts
    assert nothing.n_sim >= 50_000
    assert nothing.interval[0] == 0 < nothing.interval[1] <= 1 - 0.025 ** (1 / 50_000)
    limited = samplers.estimate(problem, seed=0, max_sim=40_000)
    assert limited.n_sim <= 40_000 and limited.parts[0].interval[1] < 3.0 / 5000
    assert limited.interval[0] < 0.1 * 0.1587 < limited.interval[1]


def test_where_a_search_would_gain_little_the_default_makes_plain_draws() -> None:
    """Twelve separate regions with p = 12 x .001: a search that misses some would be too low, plain draws are not."""
    centres = norm.ppf((np.arange(12) + 0.5) / 12)

    def f(x: np.ndarray) -> np.ndarray:
        width = 0.001 * np.sqrt(2 * np.pi) * np.exp(centres**2 / 2) / 2  # of a region of probability .001
        return (np.abs(x[:, :1] - centres) / width).min(axis=1) - 1.0

    often, rare = FunctionProblem(f, dim=2), FunctionProblem(lambda x: 5.0 - x[:, 0], dim=2)
    problem = StratifiedProblem([Stratum("often", 1e-3, often), Stratum("rare", 0.999, rare)])
    for seed in range(3):
        result = samplers.estimate(problem, seed=seed, max_sim=8000)
        part = result.parts[0]
        assert part.method == "mc" and part.interval[0] < 0.012 < part.interval[1]
        assert result.parts[1].method == "mc, two-stage" and 0.5 < result.parts[1].p / norm.sf(5.0) < 2.0


def test_simulations_go_where_the_upper_end_of_the_sum_rests() -> None:
    """2e-4 of x fail in .3, the others never: of n plain draws among these the upper end is some 3.7 / n.

    The first half of 5,000 simulations is for pilots and a search; all that come after are draws of the others.
    """
    safe = FunctionProblem(lambda x: np.ones(len(x)), dim=2)
    problem = StratifiedProblem([Stratum("safe", 0.9998, safe), Stratum("failing", 2e-4, half_space(norm.isf(0.3)))])
    for goal in ({}, {"target_cov": 0.1}):
        result = samplers.estimate(problem, seed=0, max_sim=5000, **goal)
        nothing, _ = result.parts
        assert nothing.n_sim > 4000 and result.interval[0] < 6e-5 < result.interval[1] < 1.5 * 3.7 / 4000
        assert result.status is Status.BUDGET  # 15 p is no end


def test_a_lucky_draw_of_a_pilot_is_not_the_estimate() -> None:
    """3e-5 of a stratum fails: one of 500 plain draws does in 1.5 % of the runs, here in this, and says 2e-3."""
    seen: list[int] = []

    def f(x):
        seen.append(len(x))
        return np.where((len(seen) == 1) & (np.arange(len(x)) == 0), -1.0, norm.isf(3e-5) - x[:, 0])

    problem = StratifiedProblem([Stratum("rare", 0.99, FunctionProblem(f, 2)), Stratum("often", 0.01, half_space(1.0))])
    part = samplers.estimate(problem, seed=0, max_sim=4000).parts[0]
    assert 2e-5 < part.p < 4e-5 and part.interval[0] < 3e-5 < 1e-3 < part.interval[1]


class Misled(samplers.methods.Method):
    """A search whose 100 base draws none fail, and whose 500 others find p = 1e-11 with a c.o.v. of 0.12."""

    name, stops_at_target = "misled", True

    def __init__(self, failing: int, lineages: float, low: float) -> None:
        self.failing, self.lineages, self.low = failing, lineages, low

    def steps(self, inputs, goal, rng):
        yield inputs.base.sample(min(goal.budget, 600), rng)
        k, n = self.failing, 500
        weights, f = np.repeat([1e-11 / k, 0.0], [k, n - k]), np.repeat([-1.0, 1.0], [k, n - k])
        points = Sample(
            f=f, weights=weights, units=np.arange(n), n_units=n, x=np.zeros((k, inputs.dim)), lineages=self.lineages
        )
        known = {"p": 1e-11, "cov": 0.12, "interval": (self.low, 1.5e-11), "status": Status.CONVERGED}
        return Outcome(**known, sample=points, base_draws=100)


@pytest.mark.parametrize(
    ("failing", "lineages", "low", "believed"),
    [(5, 4, 8e-12, False), (5, 20, 8e-12, True), (50, 4, 8e-12, True), (50, 4, 1.6e-14, True), (50, 20, 1e-14, False)],
)
def test_what_few_searches_describe_badly_or_leave_open_by_decades_is_an_upper_end(
    failing: int, lineages: float, low: float, believed: bool
) -> None:
    """Three decades: from 1.5e-14 to 1.5e-11."""
    problem = StratifiedProblem([Stratum("rare", 0.9, half_space(40.0)), Stratum("often", 0.1, half_space(1.0))])
    result = samplers.estimate(problem, Misled(failing, lineages, low), seed=0, max_sim=5000)
    rare, often = result.parts
    assert rare.resolved == believed
    if believed:
        assert rare.interval[1] == pytest.approx(1.5e-11)
    else:
        draws = rare.outcome.base_draws  # 200 of two searches, the others plain draws of their own
        assert draws > 1200 and rare.interval[1] == pytest.approx(1 - 0.025 ** (1 / draws))
        assert "too few failures found (p = 1.0e-11)" in str(rare) and rare.interval[0] == 0
        assert result.interval[0] == pytest.approx(0.1 * often.interval[0], rel=1e-12)
