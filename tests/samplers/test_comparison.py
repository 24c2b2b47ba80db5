"""Two functions on the same points: their ratio, and what the events behind the base leave of it."""

import json
import math

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers import FunctionProblem
from samplers.analysis.base_error import summarise_refits
from samplers.analysis.reweight import RefitSums
from tests.samplers.fitted_bases import BASE, FAR, FAR_BASE, SHIFTED, HalfSpace, normal

PHI = stats.norm.cdf


def half_space(beta, direction):
    unit = np.array(direction) / np.linalg.norm(direction)
    return FunctionProblem(lambda u: beta - u @ unit, len(unit))


NESTED = half_space(3.5, [1.0, 0, 0, 0]), half_space(3.7, [1.0, 0, 0, 0]), PHI(-3.5) / PHI(-3.7)
TILTED = half_space(3.5, [1.0, 0, 0, 0]), half_space(3.5, [1.0, 0.3, 0, 0]), 1.0
APART = half_space(3.5, [1.0, 0, 0, 0]), half_space(3.7, [0, 1.0, 0, 0]), PHI(-3.5) / PHI(-3.7)
each = pytest.mark.parametrize(("a", "b", "ratio"), [NESTED, TILTED, APART], ids=["nested", "tilted", "apart"])


@each
def test_the_ratio_and_both_probabilities_are_right(a, b, ratio):
    found = samplers.compare(a, b, seed=1, max_sim=8000)
    assert found.interval[0] < ratio < found.interval[1]
    assert abs(math.log(found.ratio / ratio)) < 0.25
    assert found.a.interval[0] < PHI(-3.5) < found.a.interval[1]
    assert found.ratio == pytest.approx(found.a.p / found.b.p)
    assert found.a.p + found.b.p - found.both == pytest.approx(found.either.p)
    assert found.n_sim <= 8000
    assert found.warnings == ()


def test_functions_that_are_nearly_alike_are_told_apart_better_than_by_runs_of_their_own():
    a, b = half_space(3.5, [1.0, 0]), half_space(3.51, [1.0, 0])
    runs = [samplers.compare(a, b, seed=seed, max_sim=6000) for seed in range(5)]
    alone = [samplers.estimate(problem, seed=0, max_sim=3000).cov for problem in (a, b)]
    ratio = PHI(-3.5) / PHI(-3.51)
    held = sum(found.interval[0] < ratio < found.interval[1] for found in runs)
    assert held >= 3  # fewer of 5 at 95 % in 1 of 900
    half = np.median([0.5 * math.log(found.interval[1] / found.interval[0]) for found in runs])
    assert half < 0.7 * 1.96 * math.hypot(*alone)


def test_monte_carlo_with_hand_counted_hits():
    """Four failing draws of A, two of B, one of both."""

    def picks(hits):
        seen: dict[float, int] = {}

        def f(x):
            ranks = [seen.setdefault(float(value), len(seen)) for value in x[:, 0]]
            return np.where(np.isin(ranks, hits), -1.0, 1.0)

        return FunctionProblem(f, 1)

    found = samplers.compare(picks([0, 1, 2, 3]), picks([0, 4]), "mc", seed=0, max_sim=200)
    assert (found.ratio, found.a.p, found.b.p, found.both) == pytest.approx((2.0, 0.04, 0.02, 0.01))
    shares = {"both": 0.01, "only_a": 0.03, "only_b": 0.01, "neither": 0.95}
    assert found.shares == found.to_dict()["shares"] == pytest.approx(shares)
    assert found.interval[0] < 1.0 < found.interval[1]
    assert "imprecise" in found.warnings[-1]
    text = str(found)
    assert "A fails 2.0 times as often as B; 95 % interval " in text and ": undecided which one" in text
    assert "\nTogether     both 0.010, only A 0.030, only B 0.010\n" in text


def test_problems_with_another_x_are_refused():
    plane = half_space(3.0, [1.0, 0])
    with pytest.raises(ValueError, match="4 and 2 dimensions"):
        samplers.compare(NESTED[0], plane)
    with pytest.raises(ValueError, match="same base distribution"):
        samplers.compare(plane, FunctionProblem(plane.f, base=[stats.uniform(-1.0, 2.0)] * 2))


@pytest.mark.slow
@each
def test_intervals_hold_the_ratio(a, b, ratio):
    found = [samplers.compare(a, b, seed=seed, max_sim=6000) for seed in range(60)]
    held = sum(one.interval[0] < ratio < one.interval[1] for one in found)
    assert held >= stats.binom.ppf(1e-3, 60, 0.9)
    logs = np.log([one.ratio / ratio for one in found])
    assert abs(logs.mean()) < 4 * logs.std(ddof=1) / math.sqrt(60) + 0.01


@pytest.mark.parametrize("max_sim", [1, 0, 2.5])
def test_a_budget_is_for_both(max_sim):
    with pytest.raises(ValueError, match=rf"max_sim \(of A and B together\) .* at least 2, got {max_sim}"):
        samplers.compare(*NESTED[:2], seed=0, max_sim=max_sim)


def test_without_failures_of_one_the_text_has_a_bound():
    a, never = half_space(2.0, [1.0, 0]), half_space(30.0, [1.0, 0])
    above, below = (samplers.compare(*two, seed=0, max_sim=4000) for two in ((a, never), (never, a)))
    for found, limit, safe in (
        (above, f"more than {float(f'{above.interval[0]:.2g}'):.0f}", "B"),
        (below, f"less than {below.interval[1]:#.2g}", "A"),
    ):
        assert f"A fails {limit} times as often as B (95 %); no failure of {safe} found\n" in str(found)
        assert f"\n{safe}            no failure found; below " in str(found)
    neither = samplers.compare(never, never, "mc", seed=0, max_sim=200)
    assert str(neither).startswith("Ratio        not known: no failure of A or B found\n")
    for found in (above, below, neither):
        assert "inf" not in str(found) + repr(found)
        assert "nan" not in str(found) + repr(found)


def test_a_comparison_comes_back_from_its_file(tmp_path):
    found = samplers.compare(NESTED[0], NESTED[1], seed=0, max_sim=3000)
    found.save(tmp_path / "comparison")
    assert samplers.comparison.Comparison.load(tmp_path / "comparison") == found
    assert "\n" not in repr(found)
    assert len(found.to_pandas()) == len(found.either.sample.f)


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
