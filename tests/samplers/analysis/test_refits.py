"""Refits of a fitted base: p under each, further runs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.analysis.reweight import (
    check_refits,
    expect_over_families,
    find_log_ends,
    needs_ensemble_run,
    reweight_to_refits,
    split_families,
)
from tests.samplers.fitted_bases import FittedWithEnsemble, HalfSpace, fitted, normal, resampled, run


@pytest.mark.parametrize("method", ["mc", "two-stage", "ce", "adss"])
def test_p_of_each_refit_is_the_exact_one(method):
    """The error of log p_b is about 1 / sqrt(ess): four times that, and the error of the run itself."""
    base = fitted(resampled(400, 10))
    result = run(base, method, max_sim=40_000 if method == "mc" else None)
    sums = reweight_to_refits(result, base.refits)
    errors = np.abs(sums.log_p[0] - np.log([refit.p for refit in base.refits]))
    assert (sums.ess > 10).all()
    assert (errors < 4 * (1 / np.sqrt(sums.ess[0]) + result.cov)).all()
    assert errors.mean() < 0.3


def test_parts_of_p_add_up():
    refits = resampled(38, 4)
    result = run(fitted(refits))
    side = (result.sample.x[:, 1] > 0).astype(float)
    parts = reweight_to_refits(result, refits, np.stack([side, 1 - side]))
    whole = reweight_to_refits(result, refits)
    assert np.exp(parts.log_p).sum(axis=0) == pytest.approx(np.exp(whole.log_p[0]))
    nothing = reweight_to_refits(result, refits, np.zeros((1, len(side))))
    assert np.isneginf(nothing.log_p).all()
    assert (nothing.ess == 0).all()


def test_the_decision_needs_points_and_an_ensemble():
    far = [normal(7.0, 0.3)] * 30
    result = run(fitted(far, FittedWithEnsemble), ensemble_run=False)
    assert needs_ensemble_run(result)
    assert not needs_ensemble_run(replace(result, sample=None))
    assert not needs_ensemble_run(run(fitted(far)))  # no ensemble
    assert not needs_ensemble_run(run(samplers.distributions.StandardNormal(2)))
    nothing_failed = samplers.estimate(HalfSpace(fitted(far, FittedWithEnsemble), 9.0), "mc", seed=1, max_sim=100)
    assert not needs_ensemble_run(nothing_failed)


def test_a_part_that_the_points_do_not_reach_asks_for_a_further_run():
    """Refits at 3: plain draws of N(0, 1) beyond 2 are worth a tenth of their number there."""
    base = fitted([normal(3.0, 0.5)] * 30, FittedWithEnsemble)
    result = samplers.estimate(HalfSpace(base, 2.0), "mc", seed=1, max_sim=10_000, ensemble_run=False)

    def shares(*above):
        return lambda x: np.array([x[:, 1] > each for each in above], dtype=float)

    assert not needs_ensemble_run(result)
    assert not needs_ensemble_run(result, shares(-9.0, -9.0))
    assert needs_ensemble_run(result, shares(-9.0, 1.0))
    assert not needs_ensemble_run(result, shares(-9.0, 9.0))  # another run would have as few in the second part


density = normal().log_prob
CUT = SimpleNamespace(log_prob=lambda x: np.where(x[:, 0] <= 1.0, density(x), -np.inf))
WIDER = SimpleNamespace(log_prob=density, sample=lambda n, rng: np.full((n, 2), np.nan))
NOWHERE = SimpleNamespace(log_prob=lambda x: np.full(len(x), np.nan))
OTHER = SimpleNamespace(dim=3, log_prob=lambda x: stats.norm.logpdf(x).sum(axis=1))


@pytest.mark.parametrize(
    ("refit", "text"),
    [
        (CUT, "Refit 2 of 2 has another support"),
        (WIDER, "Refit 2 of 2 has another support"),
        (NOWHERE, "Refit 2 of 2 has another support"),
        (OTHER, "Refit 2 of 2 does not fit its base distribution: Expected a distribution in 2 dimensions, got .* 3"),
        ("us101", "Refit 2 of 2 does not fit .* log_prob, got 'us101'"),
    ],
)
def test_a_refit_that_does_not_fit_is_refused_before_the_first_simulation(refit, text):
    base = fitted([normal(), refit])
    with pytest.raises(ValueError, match=text):
        check_refits(base, 2)

    class Never(HalfSpace):
        def evaluate(self, x):
            raise AssertionError("simulated")

    with pytest.raises(ValueError, match=text):
        samplers.estimate(Never(base), seed=0)
    check_refits(fitted([normal(), normal()]), 2)


OWN = np.array([-1.0, 0.0, 1.0] * 20)
"""60 refits around 0, variance 40 / 59."""
T = {4: 2.776445, 11: 2.200985, 59: 2.000995, 64: 1.997730}
"""97.5 % points of Student's t from a table."""


def ends_of(log_p, values, family_of, other_variance=0.0, clusters=1000):
    return find_log_ends(split_families(log_p, values, family_of), other_variance, 0.95, clusters)


@pytest.mark.parametrize(("shift", "end"), [(-8.0, 0), (8.0, 1)])
def test_another_family_moves_the_end_on_its_side_alone(shift, end):
    """12 refits of its own around its mean: variance 8 / 11, and 11 degrees of freedom."""
    values = np.concatenate([OWN, shift + OWN[:12]])
    wanted = np.array([-1.0, 1.0]) * T[59] * np.sqrt(40 / 59)
    wanted[end] = shift + np.sign(shift) * T[11] * np.sqrt(8 / 11)
    assert ends_of(0.0, values, np.repeat([0, 3], [60, 12])) == pytest.approx(tuple(wanted))


def test_a_family_of_few_refits_takes_the_pooled_spread_and_one_of_hardly_any_none():
    values = np.concatenate([OWN, 5.0 + OWN[:6], [90.0]])
    family_of = np.repeat([0, 1, 2], [60, 6, 1])
    pooled = (40 + 4) / (67 - 3)
    low, high = ends_of(0.0, values, family_of)
    assert low == pytest.approx(-T[59] * np.sqrt(40 / 59))
    assert high == pytest.approx(5.0 + T[64] * np.sqrt(pooled))


def test_what_two_families_expect_by_hand():
    """60 refits around log 0.01 and 30 around log 1e-5, of variances 40 / 59 and 20 / 29.

    2 / 3 of 0.01 exp(20 / 59) = 0.014035 and 1 / 3 of 1e-5 exp(10 / 29) = 1.412e-5. The spread over all, 3.4, would
    have made exp(5.7) = 290 times p of it.
    """
    values = np.concatenate([np.log(0.01) + OWN, np.log(1e-5) + OWN[:30]])
    assert values.std(ddof=1) == pytest.approx(3.38, abs=0.01)
    families = split_families(np.log(0.01), values, np.repeat([0, 1], [60, 30]))
    assert expect_over_families(families) == pytest.approx(0.014035 * 2 / 3 + 1.412e-5 / 3, rel=1e-3)
