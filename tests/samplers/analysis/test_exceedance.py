"""Exceedance of a quantity at failures, with bands."""

import json
import math

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.analysis.expectation import compute_exceedance
from samplers.analysis.weighted import weigh_failures
from samplers.sample import raise_log_end
from tests.samplers.fitted_bases import fitted, normal, resampled
from tests.samplers.fitted_bases import run as run_fitted

BETA = 2.5


def run(method="two-stage", seed=0, **options):
    return samplers.estimate(samplers.FunctionProblem(lambda x: BETA - x[:, 0], 2), method, seed=seed, **options)


def curve_of(result, thresholds, most=None):
    failures = weigh_failures(result, most)
    return compute_exceedance(result, failures, failures.x[:, 0], thresholds)


@pytest.mark.parametrize("method", ["adss", "ce", "mc", "two-stage"])
def test_the_curve_falls_from_p(method):
    result = run(method, max_sim=8_000)
    curve = curve_of(result, [3.0, 0.0, 3.5])  # every failing point lies beyond 2.5
    assert curve.p[1] == pytest.approx(result.p, rel=1e-9)
    assert curve.p[1] > curve.p[0] > curve.p[2]
    for ends in (curve.low, curve.high):
        assert ends[1] >= ends[0] >= ends[2]
    assert ((curve.low <= curve.p) & (curve.p <= curve.high)).all()


def test_bands_hold_the_normal_tail_at_all_thresholds_together():
    """At a nominal 95 %, 40 runs each: fewer than 32 held has a probability under 1e-3."""
    thresholds = np.linspace(BETA, 3.3, 5)
    truth = stats.norm.sf(thresholds)
    for method, options in (("is", {"max_sim": 2_000}), ("mc", {"max_sim": 40_000})):
        held = 0
        for seed in range(40):
            curve = curve_of(run(method, seed, **options), thresholds)
            held += bool(((curve.low <= truth) & (truth <= curve.high)).all())
        assert held >= 32


def test_a_threshold_beyond_what_is_known_is_bounded_by_the_last_that_is():
    curve = curve_of(run(), [3.0, 50.0, 60.0])
    assert curve.p[1] == curve.p[2] == curve.low[1] == 0.0
    assert curve.high[1] == curve.high[2] == curve.high[0]


def test_the_comparison_is_strict_and_points_without_a_value_never_count():
    result = run("mc", max_sim=10_000)
    failures = weigh_failures(result)
    ties = compute_exceedance(result, failures, np.full(len(failures.x), 2.0), [1.0, 2.0, 3.0])
    assert ties.p.tolist() == [pytest.approx(result.p), 0.0, 0.0]
    none = compute_exceedance(result, failures, np.full(len(failures.x), -np.inf), [-1e300, 0.0])
    assert none.p.tolist() == [0.0, 0.0]


def test_json_and_picture(tmp_path):
    curve = curve_of(run(), [2.5, 3.0, 50.0])
    assert json.loads(json.dumps(curve.to_dict(), allow_nan=False))["p"] == curve.p.tolist()
    from matplotlib.figure import Figure

    figure = Figure()
    axes = curve.plot(figure.subplots())
    assert axes.get_yscale() == "log"
    figure.savefig(tmp_path / "curve.png")


def test_bad_input_is_refused():
    result = run()
    failures = weigh_failures(result)
    for values in (failures.x, np.full(len(failures.x), np.nan), np.full(len(failures.x), np.inf)):
        with pytest.raises(ValueError, match="Expected a number for each of"):
            compute_exceedance(result, failures, values, [1.0])
    with pytest.raises(ValueError, match="Expected finite thresholds"):
        compute_exceedance(result, failures, failures.x[:, 0], [np.inf])


def test_one_threshold_has_the_interval_that_refits_allow_and_several_have_a_wider_band():
    """P[x_1 > t] under N(m, s) is known: its spread over the refits is the exact one, the interval p exp(-+ t S)."""
    base = fitted(resampled(400, 20))
    result = run_fitted(base)
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
    base = fitted([normal(mean) for mean in (-1.5, -1.0, 0.0, 0.0, 1.0, 1.5)])
    result = run_fitted(base)
    curve = curve_of(result, [3.0, 50.0])
    assert curve.base.spread[0] > 2.0
    assert curve.base.low.tolist() == [0.0, 0.0]
    assert curve.p[0] < curve.base.high[0] == pytest.approx(result.base_uncertainty.bound, rel=0.02)
    assert curve.base.high[1] == curve.base.high[0]
    assert np.isnan(curve.base.spread[1])
    assert curve_of(run(), [3.0]).base is None
    for few in (fitted(base.refits[:1]), fitted(base.refits, clusters=1)):
        assert curve_of(run_fitted(few), [3.0]).base is None
