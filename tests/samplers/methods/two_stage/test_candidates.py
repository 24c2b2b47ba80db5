"""Candidates and shares of a proposal, for regions whose failures are known."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.candidates import (
    PredictedFailures,
    _smooth_indicators,
    build_proposal,
    list_candidates,
)
from samplers.methods.two_stage.mixture.proposal import NO_REGION
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.refinement import NearDraws, refine_once, start_refinement
from samplers.methods.two_stage.regions import ExplorationResult
from samplers.methods.two_stage.settings import RefinementSettings
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FunctionProblem
from samplers.proposals.components import IsotropicNormal, LiftedComponent, SubspaceGaussian

SETTINGS = RefinementSettings()
BETA = 3.0


def half_spaces(dim, regions):
    return FunctionProblem(lambda u: BETA - u[:, :regions].max(axis=1), dim)


def started(exact_region, rng, dim=3, regions=1, noisy=False, scattered=False):
    """Return the state before any round, an empty history and the problem."""
    problem = half_spaces(dim, regions)
    exploration = ExplorationResult([exact_region(problem, k, BETA) for k in range(regions)], noisy, scattered)
    return start_refinement(exploration, 0.0, SETTINGS, rng), MultipleImportanceSample.empty(dim), problem


def after_round(exact_region, rng, n=800, **kwargs):
    """Return state and history after a round."""
    state, history, problem = started(exact_region, rng, **kwargs)
    proposal = build_proposal(state, history, SETTINGS)
    u, counts = proposal.draw(n, rng)
    batch = ComponentDraws(proposal.components, counts, u, problem.evaluate(u))
    history = history.add(batch, 0.0)
    return refine_once(state, history, proposal, batch, SETTINGS, rng), history, problem


def share(proposal, *kinds):
    return sum(a for a, candidate in zip(proposal.weights, proposal.candidates, strict=True) if candidate.kind in kinds)


def kinds_of(candidates):
    return Counter(candidate.kind for candidate in candidates)


def test_the_first_proposal_has_the_initial_shares(exact_region, rng):
    """Of the kinds that are there, in proportion; `explored` is the same as `gaussian` before the first round."""
    state, history, _ = started(exact_region, rng)
    proposal = build_proposal(state, history, SETTINGS)
    present = {kind: a for kind, a in SETTINGS.initial_shares.items() if kind in kinds_of(proposal.candidates)}
    assert set(SETTINGS.initial_shares) - set(present) == {"corner", "explored", "spread", "directional"}
    for kind, a in present.items():
        assert share(proposal, kind) == pytest.approx(a / sum(present.values()))


def sloped(exact_region, rng, regions=2, dim=30):
    """Return the state of half-spaces along the first axes of 30, whose slopes are known, and an empty history."""
    problem = half_spaces(dim, regions)
    found = [exact_region(problem, k, BETA) for k in range(regions)]
    exploration = ExplorationResult(found, noisy=False, slopes=np.eye(dim)[:, :regions])
    return start_refinement(exploration, 0.0, SETTINGS, rng), MultipleImportanceSample.empty(dim), problem


def test_candidates_in_the_span_of_the_slopes_are_normal_across_it(exact_region, rng):
    """Each region has components there; the one as wide as all failures is around the origin."""
    state, history, _ = sloped(exact_region, rng)
    lifted = [one for one in list_candidates(state, history, SETTINGS) if isinstance(one.component, LiftedComponent)]
    assert {one.region for one in lifted} == {NO_REGION, 0, 1}
    assert {"gaussian", "linear", "radial", "spread", "tempered"} <= set(kinds_of(lifted))
    for one in lifted:
        across = one.component.sample(200, rng)[:, 2:]
        assert stats.kstest(across.ravel(), "norm").pvalue > 1e-4
    (spread,) = (one.component.within for one in lifted if one.kind == "spread")
    points = state.points[:, :2]
    np.testing.assert_allclose(spread.centre, 0.0)
    np.testing.assert_allclose((spread.axes * spread.variance) @ spread.axes.T, points.T @ points / len(points))


def test_draws_of_a_round_move_the_components_in_the_span(exact_region, rng):
    """As those in all coordinates: in the span a Gaussian is exact, in thirty dimensions it is shrunk."""
    state, history, problem = sloped(exact_region, rng, regions=1)
    proposal = build_proposal(state, history, SETTINGS)
    u, counts = proposal.draw(2000, rng)
    batch = ComponentDraws(proposal.components, counts, u, problem.evaluate(u))
    history = history.add(batch, 0.0)
    after = refine_once(state, history, proposal, batch, SETTINGS, rng)
    mean, variance = stats.truncnorm(BETA, np.inf).stats("mv")
    (gaussian,) = after.within.gaussians
    assert gaussian.centre[0] == pytest.approx(mean, abs=0.03)
    assert variance < gaussian.variance[0] < 1.5 * variance  # raised by two standard errors
    assert len(after.within.rounds) == 1
    assert after.within.hit_rate == after.hit_rate


@pytest.mark.parametrize(("worth", "floor"), [(0.05, SETTINGS.spread_share), (0.5, 0.0)])
def test_the_spread_has_a_share_while_draws_are_worth_little(exact_region, rng, worth, floor):
    """A draw of these is worth a twentieth, or half, of a failure; in a half-space the spread buys nothing."""
    state, history, problem = sloped(exact_region, rng, regions=1)
    u = state.points
    n = round(len(u) / worth)
    f = np.append(np.full(len(u), -1.0), np.ones(n - len(u)))
    draws = NearDraws(np.concatenate([u, np.zeros((n - len(u), 30))]), f, np.zeros(n))
    drawn = build_proposal(state, history, SETTINGS)
    v, counts = drawn.draw(1000, rng)
    history = history.add(ComponentDraws(drawn.components, counts, v, problem.evaluate(v)), 0.0)
    after = build_proposal(replace(state, rounds=(draws,)), history, SETTINGS)
    assert draws.worth(0.0) == pytest.approx(worth)
    assert share(after, "spread") == pytest.approx(floor, abs=0.05)


def test_base_draws_keep_their_share_where_all_floors_are_more_than_everything(exact_region, rng):
    """Half for two regions, 40 % for the spread, 10 % and more for tempered Gaussians, 5 % of base draws: over 1."""
    state, history, problem = sloped(exact_region, rng, regions=2)
    drawn = build_proposal(state, history, SETTINGS)
    u, counts = drawn.draw(1000, rng)
    history = history.add(ComponentDraws(drawn.components, counts, u, problem.evaluate(u)), 0.0)
    few = NearDraws(np.concatenate([state.points, np.zeros((20 * len(state.points), 30))]), np.empty(0), np.empty(0))
    few = few._replace(f=problem.evaluate(few.u), log_weights=np.zeros(len(few.u)))
    after = build_proposal(replace(state, rounds=(few,), hit_rate=0.3), history, SETTINGS)
    assert few.worth(0.0) < SETTINGS.good_rate
    assert share(after, "base") == pytest.approx(SETTINGS.base_share)
    assert (after.weights >= 0).all()
    assert share(after, "spread") > 0.3


def test_candidates_of_a_linear_region(exact_region, rng):
    """One of each kind at least; the base distribution stands first, for its draws are counted."""
    state, history, _ = after_round(exact_region, rng)
    candidates = list_candidates(state, history, SETTINGS)
    assert candidates[0].kind == "base"
    kinds = kinds_of(candidates)
    assert set(kinds) == set(SETTINGS.initial_shares) - {"corner", "spread", "directional"}
    assert kinds["radial"] == 2
    gaussian = [c for c in candidates if isinstance(c.component, SubspaceGaussian) and c.kind != "tempered"]
    assert kinds["tempered"] == len(gaussian) * len(SETTINGS.tempering)


def test_pieces_of_a_cone_have_a_direction_in_common(exact_region, rng):
    """Half-spaces along the three axes as pieces of one set: it lies towards (1, 1, 1)."""
    state, history, _ = started(exact_region, rng, regions=3, scattered=True)
    (cone,) = (one for one in list_candidates(state, history, SETTINGS) if one.kind == "directional")
    assert cone.region == NO_REGION
    np.testing.assert_allclose(cone.component.mu, np.ones(3) / 3**0.5, atol=0.15)
    assert cone.component.omega == pytest.approx((state.points**2).sum(axis=1).mean())


def test_in_one_dimension_nothing_is_radial(exact_region, rng):
    state, history, _ = started(exact_region, rng, dim=1)
    assert "radial" not in kinds_of(list_candidates(state, history, SETTINGS))


def test_a_noisy_f_has_no_edges_and_more_tempered_gaussians(exact_region, rng):
    state, history, _ = after_round(exact_region, rng, noisy=True)
    kinds = kinds_of(list_candidates(state, history, SETTINGS))
    assert not {"linear", "half-space"} & set(kinds)
    assert kinds["tempered"] == 2 * (kinds["gaussian"] + kinds["explored"])
    proposal = build_proposal(state, history, SETTINGS, final=True)
    assert share(proposal, "tempered") >= SETTINGS.noisy_tempered_share - 1e-9
    assert share(proposal, "base") >= SETTINGS.noisy_base_share - 1e-9


@pytest.mark.parametrize("final", [False, True])
def test_lower_limits_of_one_region(exact_region, rng, final):
    state, history, _ = after_round(exact_region, rng)
    proposal = build_proposal(state, history, SETTINGS, final=final)
    assert proposal.weights.sum() == pytest.approx(1.0)
    assert share(proposal, "base") >= SETTINGS.base_share - 1e-9
    assert share(proposal, "tempered") >= SETTINGS.tempered_share - 1e-9
    used = proposal.weights[1:][proposal.weights[1:] > 0]
    assert used.min() > 0.9 * SETTINGS.min_share  # but for raising others to their limits
    kept = [a for a, c in zip(proposal.weights, proposal.candidates, strict=True) if c.kind in ("explored", "linear")]
    assert final or min(kept) > 0.8 * SETTINGS.explored_share


def test_more_tempered_draws_where_the_others_miss(exact_region, rng):
    state, history, _ = after_round(exact_region, rng)
    missing = build_proposal(replace(state, hit_rate=0.0), history, SETTINGS)
    assert share(missing, "tempered") >= SETTINGS.tempered_share + SETTINGS.extra_tempered_share - 1e-9


@pytest.mark.parametrize("final", [False, True])
def test_every_region_keeps_tempered_draws(exact_region, rng, final):
    """Both half-spaces fail alike, so that each has half of the tempered draws; 0.7 of that allows for chance."""
    state, history, _ = after_round(exact_region, rng, regions=2)
    proposal = build_proposal(state, history, SETTINGS, final=final)
    for k in range(2):
        tempered = [c.kind == "tempered" and c.region == k for c in proposal.candidates]
        assert proposal.weights[tempered].sum() >= 0.7 * SETTINGS.tempered_share / 2


@pytest.mark.parametrize(("final", "least"), [(False, 0.25), (True, 0.1)])
def test_no_region_is_lost(exact_region, rng, final, least):
    """The second region has no failure in the history: it keeps half of what is dealt out all the same."""
    state, history, _ = started(exact_region, rng, regions=2)
    proposal = build_proposal(state, history, SETTINGS)
    u, counts = proposal.draw(800, rng)
    batch = ComponentDraws(proposal.components, counts, u, BETA - u[:, 0])
    history = history.add(batch, 0.0)
    state = refine_once(state, history, proposal, batch, SETTINGS, rng)
    shares = build_proposal(state, history, SETTINGS, final=final)
    for k in range(2):
        own = [a for a, c in zip(shares.weights, shares.candidates, strict=True) if c.region == k]
        assert sum(own) >= least - 1e-9


@pytest.mark.parametrize(
    ("dim", "noisy", "least"), [(3, False, SETTINGS.radial_share), (21, False, 0.0), (3, True, 0.0)]
)
def test_radial_draws_reach_failures_beside_the_regions_in_few_dimensions(exact_region, rng, dim, noisy, least):
    state, history, _ = after_round(exact_region, rng, dim=dim, noisy=noisy)
    final = build_proposal(state, history, SETTINGS, final=True)
    assert least - 1e-9 <= share(final, "radial") <= 1.1 * least


def test_pieces_of_a_shell_share_one_limit(exact_region, rng):
    state, history, _ = after_round(exact_region, rng, regions=2, scattered=True)
    proposal = build_proposal(state, history, SETTINGS)
    assert share(proposal, "radial") >= SETTINGS.radial_share - 1e-9


def test_the_last_proposal_is_nearly_the_best_for_a_half_space(exact_region, rng):
    """Weights under it vary as the floors for base and tempered draws let them: E[w^2] / E[w]^2 < 1.5 at failures."""
    state, history, problem = after_round(exact_region, rng, n=2000)
    proposal = build_proposal(state, history, SETTINGS, final=True)
    u, _ = proposal.draw(20_000, rng)
    w = np.where(problem.evaluate(u) <= 0, np.exp(proposal.log_weights(u)), 0.0)
    error = w.std() / np.sqrt(20_000)
    assert w.mean() == pytest.approx(stats.norm.sf(BETA), abs=4 * error)
    assert (w**2).mean() / w.mean() ** 2 < 1.5


def test_smoothed_weights_count_draws_by_how_likely_they_fail(rng):
    """Failure with probability Phi(u1 - 3) whatever else: all draws carry weight, in proportion to it."""
    n = 6000
    u = 2.0 * rng.standard_normal((n, 2))
    f = np.where(rng.random(n) < stats.norm.cdf(u[:, 0] - 3), -1.0, 1.0)
    history = MultipleImportanceSample.empty(2).add(ComponentDraws([IsotropicNormal(2, 2.0)], np.array([n]), u, f), 0.0)
    points, log_weights = _smooth_indicators(history, 0.0, SETTINGS)
    probability = log_weights - history.all_draws()[2]
    near = np.abs(points[:, 0] - 3) < 1.5
    found, expected = np.exp(probability[near]), stats.norm.cdf(points[near, 0] - 3)
    assert np.abs(found - expected).mean() < 0.05
    # P[U1 + noise > 3] with two standard normals
    assert np.exp(log_weights).sum() == pytest.approx(stats.norm.sf(3 / np.sqrt(2)), rel=0.25)


@pytest.mark.parametrize("kind", ["gaussian", "tempered"])
def test_a_kind_without_a_share_is_not_placed_either(exact_region, rng, kind):
    state, history, _ = after_round(exact_region, rng)
    shares = {name: a for name, a in SETTINGS.initial_shares.items() if name != kind}
    gaussian = SubspaceGaussian(np.eye(3)[:, :1], np.array([BETA]), np.array([1.0]))
    predicted = PredictedFailures(history.u[:50], [gaussian])
    proposal = build_proposal(state, history, replace(SETTINGS, initial_shares=shares), predicted=predicted)
    assert kind not in kinds_of(proposal.candidates)
    assert proposal.weights.sum() == pytest.approx(1.0)
