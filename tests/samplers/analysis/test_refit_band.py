"""Bands of an exceedance curve from refits, on normal events whose tails are known to all digits."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from samplers.analysis import base_error
from samplers.analysis.base_error import compute_refit_band
from samplers.analysis.reweight import RefitSums
from samplers.sample import raise_log_end

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


def test_one_threshold_has_the_interval_of_its_own():
    """30 refits -1, 0, 1 of log p: t = 2.045, variance 20 / 29."""
    band = band_of(np.array([-7.0]), [[-8.0, -7.0, -6.0] * 10], np.array([2.0]), cov=0.1, lineages=5.0)
    half = 2.045230 * np.sqrt(20 / 29 + 0.01 + 0.04)
    assert np.log([band.low[0], band.high[0]]) == pytest.approx([-7.0 - half, -7.0 + raise_log_end(half, 5.0, 0.95)])
    assert band.spread[0] == pytest.approx(np.sqrt(20 / 29))


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


def test_nothing_is_known_of_thresholds_that_nothing_exceeds():
    band = band_of(np.array([-np.inf]), [np.zeros(30)], np.array([1.0]))
    assert (band.low[0], band.high[0]) == (0.0, 1.0)
    assert np.isnan(band.spread[0])
