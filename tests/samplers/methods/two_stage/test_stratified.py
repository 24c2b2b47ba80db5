import math

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import simpson

from samplers.methods.two_stage.mixture.proposal import MixtureProposal, ProposalComponent
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.methods.two_stage.stratified import StratifiedSample
from samplers.problem import FunctionProblem
from samplers.proposals.components import (
    HalfSpaceNormal,
    IsotropicNormal,
    SubspaceGaussian,
    draw_components,
    draw_counts,
)

BETA = 2.0
P = stats.norm.sf(BETA)
PROBLEM = FunctionProblem(lambda u: BETA - u[:, 0], 1)


def on_the_line(mean, variance):
    return SubspaceGaussian(np.eye(1), np.array([mean]), np.array([variance]))


PARTS = [
    (IsotropicNormal(1), stats.norm(0, 1)),
    (on_the_line(2.3, 0.5), stats.norm(2.3, math.sqrt(0.5))),
    (on_the_line(-2.0, 1.0), stats.norm(-2.0, 1.0)),  # wasted: stratified, it adds no variance
    (HalfSpaceNormal(np.ones(1), 1.5), stats.truncnorm(1.5, np.inf)),
]
WEIGHTS = np.array([0.2, 0.3, 0.3, 0.2])
PROPOSAL = MixtureProposal([ProposalComponent(component, "gaussian") for component, _ in PARTS], WEIGHTS)
UNUSED = MixtureProposal(
    [*PROPOSAL.candidates, ProposalComponent(IsotropicNormal(1, 3.0), "wide")], np.append(WEIGHTS, 0.0)
)


def mixture(x):
    return sum(a * distribution.pdf(x) for a, (_, distribution) in zip(WEIGHTS, PARTS, strict=True))


def moment(distribution, power):
    """E[y^power], y = phi / q at failures, else 0, under one of the components."""
    x = np.linspace(BETA, 12, 10_001)
    return simpson(distribution.pdf(x) * (stats.norm.pdf(x) / mixture(x)) ** power, x=x)


WITHIN = sum(
    a * (moment(distribution, 2) - moment(distribution, 1) ** 2)
    for a, (_, distribution) in zip(WEIGHTS, PARTS, strict=True)
)
TOTAL = sum(a * moment(distribution, 2) for a, (_, distribution) in zip(WEIGHTS, PARTS, strict=True)) - P**2


def batch(counts, rng, proposal=PROPOSAL):
    counts = np.asarray(counts)
    u = draw_components(proposal.components, counts, rng)
    return ComponentDraws(proposal.components, counts, u, PROBLEM.evaluate(u))


def strata(*batches, proposal=PROPOSAL):
    found = StratifiedSample.empty(len(proposal.weights), 1, np.empty(0))
    for part in batches:
        found = found.add(part, proposal, PROBLEM, 0.0)
    return found


def variance_within(found):
    """The variance of p-hat as estimated, without what is added for the largest term."""
    largest = math.exp(float(found.draws.log_weights.max())) / found.draws.n
    return (found.cov * found.p) ** 2 - largest**2


def repeated(n, runs, rng, counts=None):
    return [strata(batch(draw_counts(WEIGHTS, n, rng) if counts is None else counts(), rng)) for _ in range(runs)]


@pytest.mark.parametrize("n", [100, 157])
def test_right_on_average_with_the_variance_that_it_says(n, rng):
    """Against integrals; 157 draws are not a whole number for each component."""
    runs = 600
    found = repeated(n, runs, rng)
    p = np.array([one.p for one in found])
    assert p.mean() == pytest.approx(P, abs=4 * math.sqrt(WITHIN / n / runs))
    assert p.var(ddof=1) == pytest.approx(WITHIN / n, rel=4 * math.sqrt(2.5 / runs))
    own = np.array([variance_within(one) for one in found])
    assert own.mean() == pytest.approx(WITHIN / n, abs=4 * own.std() / math.sqrt(runs) + 0.01 * WITHIN / n)


def test_its_variance_is_that_of_independent_draws_less_that_between_the_components(rng):
    runs, n = 600, 100
    independent = [one.p for one in repeated(n, runs, rng, lambda: rng.multinomial(n, WEIGHTS))]
    assert np.mean(independent) == pytest.approx(P, abs=4 * math.sqrt(TOTAL / n / runs))
    assert np.var(independent) == pytest.approx(TOTAL / n, rel=4 * math.sqrt(2.5 / runs))
    assert WITHIN < 0.8 * TOTAL
    one = repeated(20_000, 1, rng)[0]
    assert variance_within(one) / (one.draws.cov * one.p) ** 2 == pytest.approx(WITHIN / TOTAL, abs=0.03)


def test_components_with_few_draws_count_with_their_second_moment(rng):
    """Too large rather than too small: a variance of a handful of draws is worth nothing."""
    counts = np.array([DEFAULT_SETTINGS.min_stratum_draws - 1] * 4)
    own = [variance_within(strata(batch(counts, rng))) for _ in range(600)]
    n = counts.sum()
    second = sum(moment(distribution, 2) for _, distribution in PARTS) * (DEFAULT_SETTINGS.min_stratum_draws - 1) / n**2
    assert np.mean(own) == pytest.approx(second, abs=4 * np.std(own) / math.sqrt(600))


def test_batches_together_are_one_sample(rng):
    first, second = batch([20, 30, 30, 20], rng), batch([40, 60, 60, 40], rng)
    found, swapped = strata(first, second), strata(second, first)
    assert found.draws.n == 300
    np.testing.assert_array_equal(found.counts, [60, 90, 90, 60])
    assert found.p == pytest.approx(swapped.p, rel=1e-12)
    assert found.cov == pytest.approx(swapped.cov, rel=1e-9)
    y = np.exp(PROPOSAL.log_weights(np.concatenate([first.u, second.u]))) * (np.concatenate([first.f, second.f]) <= 0)
    assert found.p == pytest.approx(y.mean(), rel=1e-12)


def test_draws_of_an_earlier_mixture_add_to_the_estimate_and_to_its_variance(rng):
    """Of two mixtures, a third of the draws from the earlier one: p = (n_1 p_1 + n_2 p_2) / n, errors uncorrelated."""
    earlier = MixtureProposal(PROPOSAL.candidates, np.array([0.5, 0.2, 0.1, 0.2]))
    found = []
    for _ in range(400):
        own = strata(batch(draw_counts(earlier.weights, 50, rng), rng, earlier), proposal=earlier)
        found.append(strata(batch(draw_counts(WEIGHTS, 100, rng), rng)).join(own))
    p = np.array([one.p for one in found])
    assert found[0].draws.n == found[0].counts.sum() == 150
    assert p.mean() == pytest.approx(P, abs=4 * p.std() / math.sqrt(400))
    own_variance = np.array([variance_within(one) for one in found])
    assert own_variance.mean() == pytest.approx(p.var(ddof=1), rel=4 * math.sqrt(2.5 / 400))
    alone = strata(batch([20, 30, 30, 20], rng))
    assert alone.join(StratifiedSample.empty(4, 1, np.empty(0))) is alone


def test_a_component_without_weight_changes_nothing():
    with_it = strata(batch([20, 30, 30, 20, 0], np.random.default_rng(1), UNUSED), proposal=UNUSED)
    without = strata(batch([20, 30, 30, 20], np.random.default_rng(1)))
    assert with_it.p == without.p
    assert with_it.cov == pytest.approx(without.cov)


def test_without_a_failing_draw_nothing_is_known_of_the_spread(rng):
    found = strata(batch([5, 0, 50, 0], np.random.default_rng(0)))
    assert found.p == 0
    assert found.cov == math.inf
    assert StratifiedSample.empty(4, 1, np.empty(0)).cov == math.inf


def test_weights_of_base_draws_are_bounded(rng):
    found = repeated(5000, 1, rng)[0]
    everything = np.concatenate([found.draws.log_weights, found.draws.log_weights_safe])
    assert math.exp(everything.max()) <= 1 / 0.2 + 1e-9


def test_sample_adds_up_to_p_and_serves_higher_thresholds(rng):
    """With base draws of an exploration for where the proposal hardly draws: P[f <= g] = P[u >= beta - g]."""
    found = repeated(4000, 1, rng)[0]
    base_u = rng.standard_normal((500, 1))
    sample = found.to_sample(PROPOSAL, PROBLEM.evaluate(base_u), base_u, 0.0)
    assert len(sample.f) == len(sample.weights) == len(sample.units) <= sample.n_units == 4500
    assert len(np.unique(sample.units)) == len(sample.units)
    assert sample.units.max() < sample.n_units
    assert sample.weights[sample.f <= 0].sum() == pytest.approx(found.p, rel=1e-12)
    np.testing.assert_allclose(PROBLEM.evaluate(sample.x), sample.f[sample.f <= 0])
    for g in (0.5, 1.0, 2.0, 4.0, 10.0):
        weights = sample.weights[sample.f <= g]
        assert weights.sum() == pytest.approx(stats.norm.sf(BETA - g), abs=4 * np.sqrt((weights**2).sum()))


def test_sample_without_base_draws(rng):
    found = repeated(4000, 1, rng)[0]
    sample = found.to_sample(PROPOSAL, np.empty(0), np.empty((0, 1)), 0.0)
    assert sample.n_units == len(sample.f) == 4000
    assert sample.weights.sum() == pytest.approx(1.0, abs=4 * np.sqrt((sample.weights**2).sum()))


def test_points_that_are_known_in_physical_space_are_not_mapped_again(rng, monkeypatch):
    """A base fitted to data takes as long to map the draws as they take to simulate."""
    drawn = batch([50, 50, 50, 50], rng)
    mapped = strata(drawn)

    def fail(self, u):
        raise AssertionError(f"expected no map; came {len(u)} points")

    monkeypatch.setattr(type(PROBLEM.base), "from_standard_normal", fail)
    with pytest.raises(AssertionError, match="came 200 points"):
        strata(drawn)
    known = strata(drawn._replace(x=drawn.u + 10.0))
    np.testing.assert_array_equal(known.draws.x, mapped.draws.x + 10.0)
    assert known.p == mapped.p


def test_the_bound_of_the_weights_follows_the_draws_of_the_base(rng):
    """No weight of a failing draw exceeds it, calibrated or not; batches have the larger of their bounds."""
    many, few = batch([200, 300, 300, 200], rng), batch([10, 30, 30, 30], rng)
    kinds = ["base", "gaussian", "tempered", "half-space"]
    candidates = [ProposalComponent(one, kind) for (one, _), kind in zip(PARTS, kinds, strict=True)]
    apart = MixtureProposal(candidates, WEIGHTS)
    found = strata(many, proposal=apart)
    assert found.largest_weight > 1 / 0.2  # some factor is above 1
    assert np.exp(found.draws.log_weights).max() <= found.largest_weight
    assert strata(few).largest_weight == pytest.approx(10.0)
    assert strata(few).join(found).largest_weight == pytest.approx(max(10.0, found.largest_weight))
