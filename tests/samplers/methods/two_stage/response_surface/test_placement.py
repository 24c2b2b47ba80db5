"""Placement: where the failures met say too little, predicted ones give a mixture with a smaller second moment."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats
from scipy.special import log_ndtr

import samplers
from samplers.limit_states import half_space
from samplers.methods.two_stage import method, stages
from samplers.methods.two_stage.candidates import build_proposal
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.refinement import refine_once, start_refinement
from samplers.methods.two_stage.regions import ExplorationResult, Region
from samplers.methods.two_stage.response_surface.placement import place_by_surface, predict_failures
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FunctionProblem
from samplers.proposals.components import IsotropicNormal, LiftedComponent

BETA, N = 3.0, 1500
UNPLACED = replace(DEFAULT_SETTINGS, surfaces=replace(DEFAULT_SETTINGS.surfaces, min_gain=np.inf))


def plane(u):
    """Fails from u1 = 3 on."""
    return BETA - u[:, 0]


def strip(u):
    """Falls towards u1 = 3 and fails from there to 3.5 only."""
    return np.where(u[:, 0] < BETA + 0.5, plane(u), 2.0 + u[:, 0] - BETA)


def one_sided(f, rng, dim=2, slopes=None):
    """Return state and history after wide draws and a round, for a region whose chains know the failures at u2 > 1."""
    problem = FunctionProblem(f, dim)
    chains = rng.standard_normal((20, 5, dim))
    chains[..., 0] = stats.truncnorm(BETA, BETA + 0.5).rvs((20, 5), random_state=rng)
    chains[..., 1] = stats.truncnorm(1.0, np.inf).rvs((20, 5), random_state=rng)
    around = rng.standard_normal((120, dim))
    around[:, 0] += BETA
    exploration = ExplorationResult([Region(chains, around, problem.evaluate(around))], noisy=False, slopes=slopes)
    settings, history = DEFAULT_SETTINGS.refinement, MultipleImportanceSample.empty(dim)
    state = start_refinement(exploration, 0.0, settings, rng)
    wide = IsotropicNormal(dim, 2.0)
    u = wide.sample(600, rng)
    history = history.add(ComponentDraws([wide], np.array([600]), u, problem.evaluate(u)), 0.0)
    proposal = build_proposal(state, history, settings)
    u, counts = proposal.draw(600, rng)
    batch = ComponentDraws(proposal.components, counts, u, problem.evaluate(u))
    history = history.add(batch, 0.0)
    return refine_once(state, history, proposal, batch, settings, rng), history


def beside(state, history):
    """The proposal of that state whose only sharp component is the Gaussian around the chains."""
    proposal = build_proposal(state, history, DEFAULT_SETTINGS.refinement, final=True)
    kinds = np.array([candidate.kind for candidate in proposal.candidates])
    weights = 0.05 * (kinds == "base") + 0.95 * (kinds == "explored") / np.count_nonzero(kinds == "explored")
    return replace(proposal, weights=weights)


def second_moment(proposal, rng, n=20_000):
    """Over p^2, by exact failures of the half-space."""
    u = rng.standard_normal((n, proposal.components[0].dim))
    u[:, 0] = stats.truncnorm(BETA, np.inf).rvs(n, random_state=rng)
    return float(np.exp(proposal.log_weights(u)).mean() / stats.norm.sf(BETA))


@pytest.mark.parametrize("sloped", [False, True], ids=["all coordinates", "two slopes"])
def test_a_mixture_that_reaches_one_side_is_replaced_by_a_better_one(sloped, rng):
    """The exact second moment falls, and base draws keep their share."""
    dim = 20 if sloped else 2
    state, history = one_sided(plane, rng, dim, np.eye(dim)[:, :2] if sloped else None)
    old = beside(state, history)
    new = place_by_surface(old, state, history, N, rng, final=True)
    assert second_moment(new, rng) * DEFAULT_SETTINGS.surfaces.min_gain < second_moment(old, rng)
    assert second_moment(new, rng) < 4.0
    assert new.candidates[0].kind == "base" and new.weights[0] >= DEFAULT_SETTINGS.refinement.base_share - 1e-12
    assert new.weights.sum() == pytest.approx(1.0)
    added = [one.component for one in new.candidates[len(old.candidates) :]]
    assert added and all(isinstance(one, LiftedComponent) == sloped for one in added)


def test_predicted_failures_fail_and_are_normal_given_that(rng):
    """Chains of a regression that is right draw the half-space's failures, those that the mixture misses included."""
    state, history = one_sided(plane, rng)
    chains = predict_failures(beside(state, history), state, history, N, rng)
    assert chains.shape == (5, DEFAULT_SETTINGS.surfaces.chains, 2)
    assert (plane(chains[-1]) <= 0).mean() > 0.97
    assert abs(chains[-1, :, 1].mean()) < 0.25 and abs(chains[-1, :, 1].std() - 1) < 0.15


def test_a_mixture_that_is_good_stays(rng):
    """Nothing is heavy: the same object comes back, without a regression."""
    state, history = one_sided(plane, rng)
    good = place_by_surface(beside(state, history), state, history, N, rng, final=True)
    assert place_by_surface(good, state, history, N, rng, final=True) is good


def test_a_gain_that_is_too_small_changes_nothing(rng):
    """The limit is on the second moment of old over new."""
    state, history = one_sided(plane, rng)
    old = beside(state, history)
    assert place_by_surface(old, state, history, N, rng, UNPLACED, final=True) is old


def test_a_regression_that_is_wrong_places_nothing(rng):
    """Beyond a strip f falls on, and nothing fails."""
    state, history = one_sided(strip, rng)
    old = beside(state, history)
    assert place_by_surface(old, state, history, N, rng, final=True) is old


@pytest.mark.parametrize(("f", "p"), [(plane, stats.norm.sf(3.0)), (strip, stats.norm.sf(3.0) - stats.norm.sf(3.5))])
def test_draws_of_a_placed_mixture_give_the_right_p_whatever_the_regression_says(f, p, rng):
    """All are believed here, that of the strip as well: weights are phi over the mixture that was drawn from."""
    believing = replace(DEFAULT_SETTINGS.surfaces, min_accuracy=0.0, min_placed_accuracy=0.0, min_gain=0.0)
    state, history = one_sided(f, rng)
    old = beside(state, history)
    new = place_by_surface(old, state, history, N, rng, replace(DEFAULT_SETTINGS, surfaces=believing), final=True)
    u, _ = new.draw(20_000, rng)
    y = np.exp(new.log_weights(u)) * (f(u) <= 0)
    assert new is not old
    assert abs(y.mean() - p) < 4 * y.std() / len(y) ** 0.5 < 0.2 * p


@pytest.mark.parametrize(("dim", "asked"), [(2, [False, True]), (DEFAULT_SETTINGS.surfaces.max_dim + 1, [])])
def test_components_are_placed_before_draws_that_count_in_few_dimensions(dim, asked, monkeypatch):
    """Of three rounds the third counts, and what follows it is the last proposal."""
    calls = []

    def place(proposal, *inputs, final):
        calls.append(final)
        return proposal

    monkeypatch.setattr(stages, "place_by_surface", place)
    samplers.estimate(half_space(dim).problem, "two-stage", seed=0, max_sim=2000)
    assert calls == asked


LOGNORMAL, WEIBULL = [(1.0, 0.5), (0.6, 0.7), (1.2, 0.4), (0.4, 0.8)], [(0.5, 0.8), (0.3, 0.7), (0.8, 1.1)]
"""Loads by median and spread, and by scale and shape."""
LIMIT, P = 14.5, 2.928e-4
"""p by Asmussen and Kroese's estimator, good to 0.1 %."""


def loads(u):
    """What is left of a resistance under seven loads with heavy tails."""
    heavy = [m * np.exp(s * u[:, k]) for k, (m, s) in enumerate(LOGNORMAL)]
    heavy += [c * (-log_ndtr(-u[:, 4 + k])) ** (1 / a) for k, (c, a) in enumerate(WEIBULL)]
    return LIMIT - np.sum(heavy, axis=0)


def test_placement_reaches_what_the_failures_met_do_not_show(monkeypatch):
    """Seed 7 hardly reaches two of the loads by the failures met: without placement its draws are worth little."""
    placed = samplers.estimate(FunctionProblem(loads, 7), "two-stage", seed=7, max_sim=6000)
    monkeypatch.setattr(method, "run_two_stage", partial(method.run_two_stage, settings=UNPLACED))
    unplaced = samplers.estimate(FunctionProblem(loads, 7), "two-stage", seed=7, max_sim=6000)
    for result in (placed, unplaced):
        assert abs(result.p - P) < 3 * result.cov * result.p
    assert placed.cov < 0.5 * unplaced.cov
