import functools
import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.analysis.base_error import summarise_ratio
from samplers.analysis.refits import RefitSums
from tests.samplers.fitted_bases import FittedNormal, FittedWithEnsemble, HalfSpace, fitted, normal, resampled

SHIFTED = [normal(mean) for mean in np.linspace(-0.6, 0.6, 30)]
FAR = [*SHIFTED[:26], *[normal(7.0, 0.2 + 0.01 * i) for i in range(4)]]
BASE, FAR_BASE = fitted(SHIFTED), fitted(FAR, FittedWithEnsemble)


class TwoFamilies(FittedNormal):
    """Of 50 refits the last 20 are of a family of their own."""

    @property
    def refit_families(self):
        return [0] * 30 + [1] * 20


@functools.cache
def estimates(base=None, betas=(3.0, 3.3), **options):
    base = BASE if base is None else base
    return [samplers.estimate(HalfSpace(base, beta), seed=2, max_sim=3000, **options) for beta in betas]


def exact_ratios(refits, betas=(3.0, 3.3)):
    one, two = (np.array([stats.norm.sf(b, r.means[0], r.sds[0]) for r in refits]) for b in betas)
    return one / two


def test_the_ratio_under_each_refit_is_the_exact_one():
    found = samplers.compute_ratio_uncertainty(*estimates())
    assert np.log(found.ratio_refits) == pytest.approx(np.log(exact_ratios(SHIFTED)), abs=0.25)
    assert found.ratio == pytest.approx(exact_ratios([normal()])[0], rel=0.1)


def test_the_interval_by_hand():
    first, second = estimates()
    found = samplers.compute_ratio_uncertainty(first, second)
    pairs = zip(first.base_uncertainty.p_refits, second.base_uncertainty.p_refits, strict=True)
    spread = np.std([math.log(a / b) for a, b in pairs], ddof=1)
    half = 2.119905 * math.sqrt(spread**2 + first.cov**2 + second.cov**2 + 0.04)
    ratio = first.p / second.p
    assert found.interval == pytest.approx((ratio * math.exp(-half), ratio * math.exp(half)), rel=1e-6)
    assert found.spread == pytest.approx(spread)


def test_another_family_of_refits_moves_the_end_on_its_side_alone():
    """20 refits in which both egos fail alike, of a family of their own, around a ratio of 1 for 4 of the fit itself.

    One spread over all would raise the upper end as well. t is 2.045 for 30 refits and 2.093 for 20.
    """
    own, other = math.log(4.0) + np.linspace(-0.3, 0.3, 30), np.linspace(-0.1, 0.1, 20)
    base = fitted(SHIFTED + SHIFTED[:20], TwoFamilies, clusters=500)
    sums = RefitSums(np.stack([np.concatenate([own, other]) - 9.0, np.full(50, -9.0)]), np.full((2, 50), 100.0))
    low, high = summarise_ratio(4.0, 0.1, sums, base, 0.95).interval
    assert low == pytest.approx(math.exp(-2.093024 * math.sqrt(other.var(ddof=1) + 0.05)))
    assert high == pytest.approx(4.0 * math.exp(2.045230 * math.sqrt(own.var(ddof=1) + 0.05)))


def test_the_ratio_is_known_better_than_either():
    first, second = estimates()
    found = samplers.compute_ratio_uncertainty(first, second)
    width, *widths = (math.log(each[1] / each[0]) for each in (found.interval, *_intervals(first, second)))
    assert width < 0.5 * min(widths)


def _intervals(*results):
    return [result.base_uncertainty.interval for result in results]


def test_two_sides_of_one_run():
    """`compare` takes both from the same draws: the same refits, another error of the run."""
    base = BASE
    found = samplers.compare(HalfSpace(base, 3.0), HalfSpace(base, 3.3), seed=2, max_sim=6000)
    ratio = found.base_uncertainty
    assert np.log(ratio.ratio_refits) == pytest.approx(np.log(exact_ratios(SHIFTED)), abs=0.25)
    assert ratio.ratio == found.ratio
    assert ratio.interval[0] < found.interval[0] < found.interval[1] < ratio.interval[1]
    whole = found.either.base_uncertainty
    assert math.log(ratio.interval[1] / ratio.interval[0]) < 0.5 * math.log(whole.interval[1] / whole.interval[0])
    text = str(found)
    assert f"  base distribution 95 %  {ratio.interval[0]:.2g} to {ratio.interval[1]:.2g} (38 + 15 events" in text
    assert "errors of the family are not included" in text
    assert json.loads(json.dumps(found.to_dict()))["base_uncertainty"]["ratio_refits"] == list(ratio.ratio_refits)


def test_a_comparison_without_refits_says_what_it_did():
    found = samplers.compare(HalfSpace(normal(), 3.0), HalfSpace(normal(), 3.3), seed=2, max_sim=6000)
    assert found.base_uncertainty is None
    assert found.to_dict()["base_uncertainty"] is None
    assert "base distribution" not in str(found)


def test_the_further_run_of_a_comparison_simulates_both():
    rows = []

    class Counting(HalfSpace):
        def evaluate(self, x):
            rows.append(len(x))
            return super().evaluate(x)

    base = FAR_BASE
    found = samplers.compare(Counting(base, 3.0), Counting(base, 3.3), seed=2, max_sim=6000)
    assert found.n_sim + found.base_uncertainty.n_sim == sum(rows)
    assert 0 < found.n_sim <= 6000
    assert 0 < found.base_uncertainty.n_sim <= 6000
    assert np.log(found.base_uncertainty.ratio_refits) == pytest.approx(np.log(exact_ratios(FAR)), abs=0.25)
    assert f"{found.base_uncertainty.n_sim:,} simulations under their mixture" in str(found)
    forbidden = samplers.compare(Counting(base, 3.0), Counting(base, 3.3), seed=2, max_sim=6000, ensemble_run=False)
    assert forbidden.base_uncertainty.n_sim == 0
    assert "rest on under 10" in forbidden.base_uncertainty.warnings[0]


def test_the_further_run_of_a_comparison_is_made_for_the_side_that_lacks_points():
    """B fails where A does and x_2 >= 1, so p_A / p_B = 1 / Phi(-1) = 6.30 under each refit."""

    class Corner(HalfSpace):
        def evaluate(self, x):
            return np.maximum(super().evaluate(x), 1.0 - x[:, 1])

    base = fitted([normal(3.0, 0.5)] * 30, FittedWithEnsemble)
    a, b = HalfSpace(base, 2.0), Corner(base, 2.0)
    without = samplers.compare(a, b, "mc", seed=1, max_sim=20_000, ensemble_run=False).base_uncertainty
    found = samplers.compare(a, b, "mc", seed=1, max_sim=20_000)
    assert max(without.ess_refits) < 10.0 < min(found.either.base_uncertainty.ess_refits)
    assert min(found.base_uncertainty.ess_refits) > 1000.0
    assert found.base_uncertainty.n_sim == 20_000
    assert np.array(found.base_uncertainty.ratio_refits) == pytest.approx(1 / stats.norm.sf(1.0), rel=0.1)
    alone = samplers.estimate(a, "mc", seed=1, max_sim=10_000)
    assert alone.ensemble_run is None  # A by itself needs none


def test_two_runs_with_further_runs():
    first, second = estimates(FAR_BASE)
    found = samplers.compute_ratio_uncertainty(first, second)
    assert found.n_sim == first.ensemble_run.n_sim + second.ensemble_run.n_sim
    assert np.log(found.ratio_refits) == pytest.approx(np.log(exact_ratios(FAR)), abs=0.25)


def test_the_interval_of_a_comparison_holds_that_of_its_sampling():
    """Where a few draws fail on both sides, their errors cancel, and the interval of counts alone says how few."""
    found = samplers.compare(*(HalfSpace(BASE, beta) for beta in (2.5, 2.5)), "mc", seed=1, max_sim=800)
    assert found.interval is not None and 0 < found.a.p == found.b.p
    low, high = found.base_uncertainty.interval
    assert low <= found.interval[0] < 0.5 and high >= found.interval[1] > 2.0


def test_one_that_never_fails_leaves_no_interval():
    base = BASE
    found = samplers.compare(HalfSpace(base, 2.0), HalfSpace(base, 9.0), "mc", seed=2, max_sim=2000).base_uncertainty
    assert found.interval is None
    assert found.reason == "one of the two never failed."
    assert str(found) == "base distribution  no interval: one of the two never failed."
    assert found.to_dict()["ratio"] is None


def test_ratios_that_the_events_do_not_determine():
    base = BASE
    log_p = np.stack([np.linspace(-20.0, -1.0, 30), np.full(30, -5.0)])
    found = summarise_ratio(2.0, 0.1, RefitSums(log_p, np.full((2, 30), 50.0)), base, 0.95)
    assert found.interval is None
    assert found.spread == pytest.approx(log_p[0].std(ddof=1))
    assert "the events do not determine the ratio: the spread of its logarithm is 5." in str(found)
    log_p[1, 3] = -np.inf
    unknown = summarise_ratio(2.0, 0.1, RefitSums(log_p, np.full((2, 30), 50.0)), base, 0.95)
    assert unknown.reason.startswith("1 of 30 refits have no density")
    assert math.isnan(unknown.spread)


@dataclass(frozen=True, eq=False)
class WithNoise(FittedNormal):
    """The same base with a coordinate of noise."""

    def sample(self, n, rng):
        return np.column_stack([super().sample(n, rng), rng.standard_normal(n)])

    def log_prob(self, x):
        return super().log_prob(x[:, :2]) + stats.norm.logpdf(x[:, 2])

    def to_standard_normal(self, x):
        return np.column_stack([super().to_standard_normal(x[:, :2]), x[:, 2]])

    from_standard_normal = to_standard_normal  # N(0, 1): the identity


def test_one_of_the_two_may_have_noise_coordinates():
    plain, _ = estimates()
    base = WithNoise(np.zeros(1), np.ones(1), refits=tuple(WithNoise(r.means, r.sds) for r in SHIFTED))
    noisy = samplers.estimate(HalfSpace(base, 3.3, dim=3), seed=2, max_sim=3000)
    found = samplers.compute_ratio_uncertainty(plain, noisy)
    assert np.log(found.ratio_refits) == pytest.approx(np.log(exact_ratios(SHIFTED)), abs=0.3)


@pytest.mark.parametrize(
    ("other", "text"),
    [
        (lambda: fitted(resampled(38)), "under the same refits"),
        (lambda: fitted(SHIFTED[:20]), "got 30 of .* and 20 of"),
        (lambda: fitted(SHIFTED, family="3 components"), r"\(3 components\)"),
        (normal, "same base distribution with refits, got FirstCoordinate"),
    ],
)
def test_other_refits_are_refused(other, text):
    first, second = estimates()[0], estimates(other())[1]
    with pytest.raises(ValueError, match=text):
        samplers.compute_ratio_uncertainty(first, second)


def test_other_confidence_and_no_failures_are_refused():
    first, second = estimates()
    with pytest.raises(ValueError, match=r"same confidence, got 0\.95 and 0\.9"):
        samplers.compute_ratio_uncertainty(first, replace(second, confidence=0.9))
    nothing = samplers.estimate(HalfSpace(BASE, 9.0), "mc", seed=1, max_sim=100)
    with pytest.raises(ValueError, match="nothing failed"):
        samplers.compute_ratio_uncertainty(first, nothing)
