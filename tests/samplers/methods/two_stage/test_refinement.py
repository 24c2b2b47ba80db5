"""Refinement of one or two regions whose failures are known: half-spaces in a few dimensions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.candidates import build_proposal
from samplers.methods.two_stage.mixture.proposal import MixtureProposal, ProposalComponent
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.refinement import (
    SHARP_KINDS,
    RefinementState,
    refine_once,
    start_refinement,
    typical_weights,
)
from samplers.methods.two_stage.regions import ExplorationResult, Region
from samplers.methods.two_stage.settings import RefinementSettings
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FunctionProblem
from samplers.proposals.components import (
    HalfSpaceIntersection,
    HalfSpaceNormal,
    HalfSpaceUnion,
    IsotropicNormal,
    SubspaceGaussian,
)

SETTINGS = RefinementSettings()
BETA = 3.0


def half_spaces(dim, regions):
    return FunctionProblem(lambda u: BETA - u[:, :regions].max(axis=1), dim)


def explored(exact_region, problem, regions, **kwargs):
    return ExplorationResult([exact_region(problem, k, BETA) for k in range(regions)], **{"noisy": False} | kwargs)


def draws(proposal, n, problem, rng):
    u, counts = proposal.draw(n, rng)
    return ComponentDraws(proposal.components, counts, u, problem.evaluate(u))


def refined(exact_region, problem, regions, rng, n=600):
    """Return the state before and after a round, and the draws."""
    before = start_refinement(explored(exact_region, problem, regions), 0.0, SETTINGS, rng)
    proposal = build_proposal(before, MultipleImportanceSample.empty(problem.dim), SETTINGS)
    batch = draws(proposal, n, problem, rng)
    history = MultipleImportanceSample.empty(problem.dim).add(batch, 0.0)
    after = refine_once(before, history, proposal, batch, SETTINGS, rng)
    return before, after, history, batch


@pytest.mark.parametrize("regions", [1, 2])
def test_the_exploration_gives_each_region_its_gaussians_and_its_half_space(exact_region, regions, rng):
    state = start_refinement(explored(exact_region, half_spaces(4, regions), regions), 0.0, SETTINGS, rng)
    assert {candidate.region for candidate in state.explored} == set(range(regions))
    assert len(state.gaussians) == len(state.explored) <= regions * SETTINGS.gaussians_per_region
    for k in range(regions):
        gaussian, half_space = (candidate.component for candidate in state.linear if candidate.region == k)
        assert isinstance(gaussian, SubspaceGaussian)
        assert isinstance(half_space, HalfSpaceNormal)
        assert half_space.axis[k] > 0.99
        assert half_space.start == pytest.approx(BETA, abs=0.1)
    assert (state.dim, state.rounds) == (4, ())
    assert state.points.shape == (100 * regions, 4)


def test_a_region_that_two_conditions_bound_has_a_corner(exact_region, rng):
    problem = FunctionProblem(lambda u: np.maximum(BETA - u[:, 0], 0.5 - u[:, 1]), 4)
    state = start_refinement(explored(exact_region, problem, 1), 0.0, SETTINGS, rng)
    (corner,) = (candidate.component for candidate in state.linear if candidate.kind == "corner")
    assert isinstance(corner, HalfSpaceIntersection)
    assert corner.axes[:, :2] == pytest.approx(np.eye(2), abs=0.05)
    assert corner.starts == pytest.approx([BETA, 0.5], abs=0.1)


def test_where_f_is_noisy_one_region_may_have_many_gaussians(rng):
    """Eight far clusters of chains are told apart by BIC."""
    centres = 6.0 * np.concatenate([np.eye(4), -np.eye(4)])
    chains = np.repeat(centres, 12, axis=0)[:, None] + 0.3 * rng.standard_normal((96, 5, 4))
    clusters = Region(chains, chains.reshape(-1, 4), rng.standard_normal(480))
    exploration = ExplorationResult([clusters], noisy=True)
    assert len(start_refinement(exploration, 0.0, SETTINGS, rng).explored) == SETTINGS.noisy_gaussians
    exploration = exploration._replace(noisy=False)
    assert len(start_refinement(exploration, 0.0, SETTINGS, rng).explored) == SETTINGS.gaussians_per_region


def test_a_round_moves_the_gaussians_and_leaves_the_state_before_as_it_was(exact_region, rng):
    problem = half_spaces(4, 1)
    before, after, history, batch = refined(exact_region, problem, 1, rng)
    assert before.rounds == ()
    assert len(after.rounds) == 1
    assert after.explored is before.explored
    centre = after.gaussians[0].centre
    assert not np.array_equal(centre, before.gaussians[0].centre)
    tail = stats.truncnorm(BETA, np.inf).mean()
    weights = np.exp(history.log_weights)
    error = 4 / np.sqrt(weights.sum() ** 2 / (weights**2).sum())
    if len(after.gaussians) == 1:
        np.testing.assert_allclose(centre, [tail, 0, 0, 0], atol=error)
    near = after.rounds[0]
    assert len(near.u) < len(batch.u)
    np.testing.assert_array_equal(problem.evaluate(near.u), near.f)


def test_hit_rate_is_that_of_the_sharp_components(exact_region, rng):
    """Two components: sharp draws of which 70 % fail, base draws of which none does."""
    state = start_refinement(explored(exact_region, half_spaces(2, 1), 1), 0.0, SETTINGS, rng)
    gaussian = SubspaceGaussian(np.eye(2), np.array([3.0, 0.0]), np.ones(2))
    proposal = MixtureProposal(
        [ProposalComponent(IsotropicNormal(2), "base"), ProposalComponent(gaussian, SHARP_KINDS[0], 0)],
        np.array([0.5, 0.5]),
    )
    f = np.concatenate([np.ones(100), np.where(np.arange(100) < 70, -1.0, 1.0)])
    batch = ComponentDraws(proposal.components, np.array([100, 100]), rng.standard_normal((200, 2)), f)
    history = MultipleImportanceSample.empty(2).add(batch, 0.0)
    after = refine_once(state, history, proposal, batch, SETTINGS, rng)
    assert after.hit_rate == pytest.approx(0.7)
    np.testing.assert_array_equal(after.rounds[0].u, batch.u[100:])
    np.testing.assert_array_equal(after.rounds[0].log_weights, proposal.log_weights(batch.u[100:]))


def test_without_failures_a_round_changes_no_component(exact_region, rng):
    problem = half_spaces(3, 1)
    state = start_refinement(explored(exact_region, problem, 1), 0.0, SETTINGS, rng)
    proposal = MixtureProposal([ProposalComponent(IsotropicNormal(3), "base")], np.ones(1))
    u = rng.standard_normal((100, 3))
    batch = ComponentDraws(proposal.components, np.array([100]), u, np.ones(100))
    history = MultipleImportanceSample.empty(3).add(batch, 0.0)
    after = refine_once(state, history, proposal, batch, SETTINGS, rng)
    assert after.gaussians is state.gaussians
    assert after.linear is state.linear
    assert after.hit_rate == 0.0


def test_linear_proposals_of_two_regions_are_learned_from_the_draws_nearest_to_each(exact_region, rng):
    after = refined(exact_region, half_spaces(4, 2), 2, rng)[1]
    for k in range(2):
        half_space = next(
            c.component for c in after.linear if c.region == k and isinstance(c.component, HalfSpaceNormal)
        )
        assert half_space.axis[k] > 0.995
        assert half_space.start == pytest.approx(BETA, abs=0.06)


def test_typical_weight_of_a_region_is_that_of_later_states_without_the_heaviest_chains(rng):
    """Chains from the origin to u_1 = 3, but for one that stays: under a Gaussian there it is the heaviest."""
    chains = np.zeros((8, 2, 2))
    chains[1:, 1, 0] = 3.0
    exploration = ExplorationResult([Region(chains, chains.reshape(-1, 2), -np.ones(16))], noisy=False)
    state = RefinementState(exploration=exploration, gamma=0.0, explored=(), gaussians=[], linear=())
    plain = MixtureProposal([ProposalComponent(IsotropicNormal(2), "base")], np.ones(1))
    np.testing.assert_allclose(typical_weights(state, plain), 1.0)
    far = SubspaceGaussian(np.eye(2), np.array([3.0, 0.0]), np.ones(2))
    proposal = MixtureProposal([ProposalComponent(far, "gaussian", 0)], np.ones(1))
    # phi / q = exp(9/2 - 3 u1): e^-4.5 at u1 = 3, e^4.5 at the origin
    np.testing.assert_allclose(typical_weights(state, proposal), np.exp(-4.5))


@pytest.mark.parametrize("min_refit_failures", [SETTINGS.min_refit_failures, 10**6])
def test_the_span_of_the_slopes_has_one_union_of_half_spaces(exact_region, rng, min_refit_failures):
    """After the exploration and after every round, also where a round has too few failures to fit Gaussians again."""
    dim, settings = 6, replace(SETTINGS, min_refit_failures=min_refit_failures)
    problem = half_spaces(dim, 2)
    state = start_refinement(explored(exact_region, problem, 2, slopes=np.eye(dim)[:, :3]), 0.0, settings, rng)
    history = MultipleImportanceSample.empty(dim)
    for _ in range(3):
        (union,) = (one.component for one in state.within.linear if isinstance(one.component, HalfSpaceUnion))
        for k in range(2):
            assert (union.axes[:, k] > 0.98).any()
        proposal = build_proposal(state, history, settings)
        assert [getattr(one.component, "within", None) for one in proposal.candidates].count(union) == 1
        batch = draws(proposal, 400, problem, rng)
        history = history.add(batch, 0.0)
        state = refine_once(state, history, proposal, batch, settings, rng)
