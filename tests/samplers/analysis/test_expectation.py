"""Expectations over failures and exceedance curves, on half-spaces whose tails are known."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.analysis import base_error
from samplers.analysis.base_error import compute_refit_band
from samplers.analysis.expectation import compute_exceedance, expect_over_failures, expect_under_refits
from samplers.analysis.reweight import RefitSums
from samplers.analysis.weighted import weigh_failures
from samplers.sample import raise_log_end
from tests.samplers.analysis.parametric_normal import ALPHA, fitted, run
from tests.samplers.fitted_bases import FittedWithEnsemble, normal, resampled
from tests.samplers.fitted_bases import fitted as fitted_normal
from tests.samplers.fitted_bases import run as run_normal

BETA = 3.0
P = float(stats.norm.sf(BETA))
PHI = float(stats.norm.pdf(BETA))
METHODS = ["adss", "ce", "mc", "two-stage"]


def estimate_half_space(method="two-stage", seed=0, **options):
    """Return an estimate of P = Phi(-3) in two dimensions."""
    return samplers.estimate(samplers.FunctionProblem(lambda x: BETA - x[:, 0], 2), method, seed=seed, **options)


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


def test_expectations_under_refits_are_those_of_the_tail():
    """E[(Z - 3)^+] = phi(3) - 3 Phi(-3) of Z = alpha . u under each refit, by its mean and variance along alpha."""
    base = fitted()
    result = run(base, max_sim=6000)
    failures = weigh_failures(result, most=1500)
    beyond = -result.sample.f[result.sample.f <= 0][failures.rows]
    found = expect_under_refits(result, failures, beyond, expect_over_failures(failures, beyond))
    for refit, value in zip(base.refits, found.value_refits, strict=True):
        mean = ALPHA @ ((refit.mean - base.mean) / base.sd)
        sd = np.sqrt(ALPHA**2 @ (refit.sd / base.sd) ** 2)
        z = (BETA - mean) / sd
        assert value == pytest.approx(sd * (stats.norm.pdf(z) - z * stats.norm.sf(z)), rel=0.35)
    assert found.interval[1] / found.interval[0] > np.exp(
        2 * 2.04 * found.spread
    )  # t is 2.09 with 19 degrees of freedom


def test_bad_input_is_refused():
    result = estimate_half_space()
    failures = weigh_failures(result)
    for values in (failures.x, np.full(len(failures.x), np.nan), np.full(len(failures.x), np.inf)):
        with pytest.raises(ValueError, match="Expected a number for each of"):
            compute_exceedance(result, failures, values, [1.0])
    with pytest.raises(ValueError, match="Expected finite thresholds"):
        compute_exceedance(result, failures, failures.x[:, 0], [np.inf])
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
    both = expect_under_refits(result, failures, ones, one, (more, np.ones(len(more.x))))
    alone = expect_under_refits(result, failures, ones, one)
    assert both.value_refits == pytest.approx(result.base_uncertainty.value_refits)
    assert both.n_sim == result.ensemble_run.n_sim
    assert min(alone.ess_refits) < 10 < min(both.ess_refits)
    assert both.value_refits == pytest.approx([refit.p for refit in base.refits], rel=0.3)


def test_the_mean_over_failures_is_that_of_the_truncated_normal():
    """E[X | X > 3] = phi(3) / Phi(-3) and E[X_2 | failure] = 0; errors are those of 30 seeds."""
    means, errors = [], []
    for seed in range(30):
        failures = weigh_failures(estimate_half_space("is", seed=seed, max_sim=1_500))
        mean, error = failures.mean_of(failures.x)
        means.append(mean)
        errors.append(error)
    z = (np.array(means) - [PHI / P, 0.0]) / errors
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(30)
    assert ((z.std(axis=0) > 0.6) & (z.std(axis=0) < 1.6)).all()


def test_errors_count_paths_of_chains_as_one():
    """Twice the points in the same units do not make a mean more certain."""
    failures = weigh_failures(estimate_half_space("mc", max_sim=20_000))
    double = {
        name: np.repeat(getattr(failures, name), 2, axis=0) for name in ("x", "rows", "has_outcome", "weights", "units")
    }
    again = type(failures)(**{**vars(failures), **double, "weights": double["weights"] / 2})
    for found, twice in zip(failures.mean_of(failures.x), again.mean_of(again.x), strict=True):
        assert np.allclose(found, twice)


def curve_of(result, thresholds, most=None):
    failures = weigh_failures(result, most)
    return compute_exceedance(result, failures, failures.x[:, 0], thresholds)


@pytest.mark.parametrize("method", ["adss", "ce", "mc", "two-stage"])
def test_the_curve_falls_from_p(method):
    result = estimate_half_space(method, max_sim=40_000 if method == "mc" else 8_000)
    curve = curve_of(result, [3.2, 0.0, 3.6])  # every failing point lies beyond 3
    assert curve.p[1] == pytest.approx(result.p, rel=1e-9)
    assert curve.p[1] > curve.p[0] > curve.p[2]
    for ends in (curve.low, curve.high):
        assert ends[1] >= ends[0] >= ends[2]
    assert ((curve.low <= curve.p) & (curve.p <= curve.high)).all()


def test_bands_hold_the_normal_tail_at_all_thresholds_together():
    """At a nominal 95 %, 40 runs each: fewer than 32 held has a probability under 1e-3."""
    thresholds = np.linspace(BETA, 3.8, 5)
    truth = stats.norm.sf(thresholds)
    for method, options in (("is", {"max_sim": 2_000}), ("mc", {"max_sim": 200_000})):
        held = 0
        for seed in range(40):
            curve = curve_of(estimate_half_space(method, seed, **options), thresholds)
            held += bool(((curve.low <= truth) & (truth <= curve.high)).all())
        assert held >= 32


def test_a_threshold_beyond_what_is_known_is_bounded_by_the_last_that_is():
    curve = curve_of(estimate_half_space(), [3.5, 50.0, 60.0])
    assert curve.p[1] == curve.p[2] == curve.low[1] == 0.0
    assert curve.high[1] == curve.high[2] == curve.high[0]


def test_the_comparison_is_strict_and_points_without_a_value_never_count():
    result = estimate_half_space("mc", max_sim=10_000)
    failures = weigh_failures(result)
    ties = compute_exceedance(result, failures, np.full(len(failures.x), 2.0), [1.0, 2.0, 3.0])
    assert ties.p.tolist() == [pytest.approx(result.p), 0.0, 0.0]
    none = compute_exceedance(result, failures, np.full(len(failures.x), -np.inf), [-1e300, 0.0])
    assert none.p.tolist() == [0.0, 0.0]


def test_one_threshold_has_the_interval_that_refits_allow_and_several_have_a_wider_band():
    """P[x_1 > t] under N(m, s) is known: its spread over the refits is the exact one, the interval p exp(-+ t S)."""
    base = fitted_normal(resampled(400, 20))
    result = run_normal(base)
    for t in (3.5, 3.0):
        curve = curve_of(result, [t])
        exact = np.std([stats.norm.logsf(t, refit.means[0], refit.sds[0]) for refit in base.refits], ddof=1)
        assert curve.base.spread[0] == pytest.approx(exact, rel=0.1)
        half = stats.t.ppf(0.975, base.clusters - 1) * math.sqrt(curve.base.spread[0] ** 2 + curve.cov[0] ** 2 + 0.2**2)
        ends = curve.p[0] * np.exp([-half, raise_log_end(half, result.sample.lineages, 0.95)])
        assert (curve.base.low[0], curve.base.high[0]) == pytest.approx(tuple(ends))
    whole = result.base_uncertainty
    assert curve.base.spread[0] == pytest.approx(whole.spread)
    assert (curve.base.low[0], curve.base.high[0]) == pytest.approx(whole.interval, rel=0.02)
    both = curve_of(result, [3.5, 3.0])
    assert both.base.low[1] < curve.base.low[0] < curve.base.high[0] < both.base.high[1]
    assert json.loads(json.dumps(curve.to_dict(), allow_nan=False))["base"]["n_refits"] == 20


def test_what_refits_do_not_determine_has_an_upper_end_only():
    base = fitted_normal([normal(mean) for mean in (-1.5, -1.0, 0.0, 0.0, 1.0, 1.5)])
    result = run_normal(base)
    curve = curve_of(result, [3.0, 50.0])
    assert curve.base.spread[0] > 2.0
    assert curve.base.low.tolist() == [0.0, 0.0]
    assert curve.p[0] < curve.base.high[0] == pytest.approx(result.base_uncertainty.bound, rel=0.02)
    assert curve.base.high[1] == curve.base.high[0]
    assert np.isnan(curve.base.spread[1])
    assert curve_of(estimate_half_space(), [3.5]).base is None
    for few in (fitted_normal(base.refits[:1]), fitted_normal(base.refits, clusters=1)):
        assert curve_of(run_normal(few), [3.0]).base is None


THRESHOLDS = np.array([0.0, 1.0, 2.0, 3.0])
N_EVENTS, N_REFITS = 40, 30


def band_of(log_p, log_p_refits, thresholds=THRESHOLDS, family_of=None, correlation=None, cov=0.0, **options):
    """Return the band of known probabilities (k,) and those of refits (k, R)."""
    log_p_refits = np.asarray(log_p_refits, dtype=float)
    k, n = log_p_refits.shape
    fitted = SimpleNamespace(refits=[None] * n, clusters=1000, fitted_to="40 events", family="normal")
    if family_of is not None:
        fitted.refit_families = family_of
    sums = RefitSums(log_p_refits, np.full((k, n), 100.0))
    correlation = np.eye(k) if correlation is None else correlation
    options = {"confidence": 0.95, "seed": 0, **options}
    return compute_refit_band(thresholds, np.exp(log_p), np.full(k, cov), correlation, sums, fitted, **options)


def band_of_events(rng, thresholds):
    """Return the band for P[X > t] from 40 events of N(0, 1), the moments of which are the fit."""
    events = rng.standard_normal(N_EVENTS)
    samples = [events, *events[rng.integers(N_EVENTS, size=(N_REFITS, N_EVENTS))]]
    log_p = np.array([stats.norm.logsf(thresholds, each.mean(), each.std(ddof=1)) for each in samples]).T
    return band_of(log_p[:, 0], log_p[:, 1:], thresholds)


@pytest.mark.slow
def test_the_band_holds_all_thresholds_together_where_intervals_of_each_do_not(monkeypatch):
    """Of 300 draws of the events 95 % are wanted: under 273 has a probability of 0.1 %.

    Without the allowance for the bias of a mixture's fit, which the moments of a normal distribution do not have.
    """
    monkeypatch.setattr(base_error, "FIT_BIAS", 1e-6)
    truth, rng = stats.norm.sf(THRESHOLDS), np.random.default_rng(1)
    together = each = 0
    for _ in range(300):
        state = rng.bit_generator.state
        band = band_of_events(rng, THRESHOLDS)
        together += bool(((band.low <= truth) & (truth <= band.high)).all())
        held = []
        for i in range(len(truth)):
            rng.bit_generator.state = state
            one = band_of_events(rng, THRESHOLDS[i : i + 1])
            held.append(one.low[0] <= truth[i] <= one.high[0])
        each += all(held)
    assert together >= 273 > each


def test_both_ends_fall_and_a_threshold_without_a_spread_takes_those_beside_it():
    values = np.array([-1.0, 0.0, 1.0] * 10)
    log_p = np.array([-7.0, -5.0, -7.5, -6.0])  # at thresholds 3, 1, 4, 2
    refits = [3.0 * values - 7.0, values - 5.0, 0.1 * values - 7.5, np.full(30, -np.inf)]
    band = band_of(log_p, refits, np.array([3.0, 1.0, 4.0, 2.0]))
    order = [1, 3, 0, 2]
    assert (np.diff(band.low[order]) <= 0).all() and (np.diff(band.high[order]) <= 0).all()
    assert band.high[3] == band.high[1] < 1.0
    assert band.low[3] == band.low[0] == band.low[2] > 0.0  # that of a higher threshold bounds those below it
    assert band.spread[0] > 2.0 and np.isnan(band.spread[3])
