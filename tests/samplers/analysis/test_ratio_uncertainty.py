"""Ratios of two probabilities under refits of one base."""

import json
import math

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.analysis.base_error import summarise_refits
from samplers.analysis.reweight import RefitSums
from tests.samplers.fitted_bases import BASE, FAR, FAR_BASE, SHIFTED, HalfSpace, normal


def exact_ratios(refits, betas=(3.0, 3.3)):
    one, two = (np.array([stats.norm.sf(b, r.means[0], r.sds[0]) for r in refits]) for b in betas)
    return one / two


def test_two_sides_of_one_run():
    """`compare` takes both from the same draws: the same refits, another error of the run."""
    found = samplers.compare(HalfSpace(BASE, 3.0), HalfSpace(BASE, 3.3), seed=2, max_sim=6000)
    ratio = found.base_uncertainty
    assert np.log(ratio.value_refits) == pytest.approx(np.log(exact_ratios(SHIFTED)), abs=0.25)
    assert ratio.value == found.ratio == pytest.approx(exact_ratios([normal()])[0], rel=0.1)
    assert ratio.interval[0] < found.interval[0] < found.interval[1] < ratio.interval[1]
    whole = found.either.base_uncertainty
    assert math.log(ratio.interval[1] / ratio.interval[0]) < 0.5 * math.log(whole.interval[1] / whole.interval[0])
    text = found.details()
    assert f"  base distribution 95 %  {ratio.interval[0]:.2g} to {ratio.interval[1]:.2g} (38 + 15 events" in text
    assert "errors of the family are not included" in text
    assert json.loads(json.dumps(found.to_dict()))["base_uncertainty"]["value_refits"] == list(ratio.value_refits)


def test_the_further_run_of_a_comparison_simulates_both():
    rows = []

    class Counting(HalfSpace):
        def evaluate(self, x):
            rows.append(len(x))
            return super().evaluate(x)

    both = Counting(FAR_BASE, 3.0), Counting(FAR_BASE, 3.3)
    found = samplers.compare(*both, seed=2, max_sim=6000)
    assert found.n_sim + found.base_uncertainty.n_sim == sum(rows)
    assert 0 < found.n_sim <= 6000
    assert 0 < found.base_uncertainty.n_sim <= 6000
    assert np.log(found.base_uncertainty.value_refits) == pytest.approx(np.log(exact_ratios(FAR)), abs=0.25)
    assert f"{found.base_uncertainty.n_sim:,} more simulations from the mixture of the refits" in found.details()
    forbidden = samplers.compare(*both, seed=2, max_sim=6000, ensemble_run=False)
    assert forbidden.base_uncertainty.n_sim == 0
    assert "rest on fewer than 10" in forbidden.base_uncertainty.warnings[0]


def test_the_interval_of_a_comparison_holds_that_of_its_sampling():
    """Where a few draws fail on both sides, their errors cancel, and the interval of counts alone says how few."""
    found = samplers.compare(*(HalfSpace(BASE, beta) for beta in (2.5, 2.5)), "mc", seed=1, max_sim=800)
    assert found.interval is not None and 0 < found.a.p == found.b.p
    low, high = found.base_uncertainty.interval
    assert low <= found.interval[0] < 0.5 and high >= found.interval[1] > 2.0


def test_one_that_never_fails_leaves_no_interval():
    found = samplers.compare(HalfSpace(BASE, 2.0), HalfSpace(BASE, 9.0), "mc", seed=2, max_sim=2000).base_uncertainty
    assert found.interval is None
    assert found.reason == "A or B never failed."
    assert str(found) == "base distribution  no interval: A or B never failed."
    assert found.to_dict()["value"] is None


def test_ratios_that_the_events_do_not_determine():
    log_p = np.stack([np.linspace(-20.0, -1.0, 30), np.full(30, -5.0)])
    sums = RefitSums(log_p, np.full((2, 30), 50.0))
    found = summarise_refits(2.0, 0.1, 0.95, BASE, lambda: sums, is_ratio=True)
    assert found.interval is None
    assert found.spread == pytest.approx(log_p[0].std(ddof=1))
    assert "too few recorded events for limits of the ratio (standard deviation of its logarithm 5." in str(found)
    log_p[1, 3] = -np.inf
    unknown = summarise_refits(2.0, 0.1, 0.95, BASE, lambda: sums, is_ratio=True)
    assert unknown.reason.startswith("1 of 30 refits have no density")
    assert math.isnan(unknown.spread)
