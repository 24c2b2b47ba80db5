"""The predicted c.o.v. is the true one where draws miss a part of the failures, and there is none where f deceives."""

import math

import numpy as np
import pytest
from scipy.special import ndtr

import samplers
from samplers.limit_states import half_space
from samplers.methods.two_stage import stages
from samplers.methods.two_stage.mixture.proposal import MixtureProposal, ProposalComponent
from samplers.methods.two_stage.response_surface.predicted_failures import PlannedDraws, Simulated
from samplers.methods.two_stage.response_surface.settings import DEFAULT_SURFACE_SETTINGS
from samplers.methods.two_stage.response_surface.spread import LastDraws, check_spread, predict_cov
from samplers.proposals.components import IsotropicNormal, SubspaceGaussian

BETA, N = 3.0, 2000


def plane(u):
    """Fails from u1 = 3 on."""
    return BETA - u[:, 0]


def strip(u):
    """Falls towards u1 = 3 and fails from there to 3.5 only."""
    return np.where(u[:, 0] < BETA + 0.5, plane(u), 2.0 + u[:, 0] - BETA)


def proposal(shift, spread, depth=0.15):
    """Base draws, one in twenty, and a Gaussian around (3.3, shift) with these variances along u2 and u1."""
    axes, mean = np.eye(2), np.array([BETA + 0.3, shift])
    gaussian = SubspaceGaussian(axes, mean, np.array([depth, spread]))
    return MixtureProposal(
        [ProposalComponent(IsotropicNormal(2), "base"), ProposalComponent(gaussian, "gaussian", 0)],
        np.array([0.05, 0.95]),
    )


def true_cov(q, p, f=plane):
    """The c.o.v. of n draws of q, by a grid over both coordinates."""
    a, b = np.meshgrid(np.linspace(BETA, 8, 1001), np.linspace(-6, 6, 1201), indexing="ij")
    u = np.column_stack([a.ravel(), b.ravel()])
    density = np.exp(-0.5 * (u**2).sum(axis=1)) / (2 * math.pi) * (f(u) <= 0)
    cell = (a[1, 0] - a[0, 0]) * (b[0, 1] - b[0, 0])
    second = float((density * np.exp(q.log_weights(u))).sum() * cell)
    return math.sqrt((second - p * p) / N) / p


def last_draws(q, f, p, cov, rng):
    """N draws of a proposal that claim this p and c.o.v."""
    u, _ = q.draw(N, rng)
    return LastDraws(PlannedDraws(q, N, p), cov, Simulated.of(u, f(u), 0.0))


def searched(f, rng, n=1500):
    """What a search has simulated: base and wide draws, and draws about the failures."""
    u = np.concatenate([rng.standard_normal((n, 2)), 2 * rng.standard_normal((n, 2))])
    u = np.concatenate([u, np.array([BETA, 0.0]) + rng.standard_normal((n, 2))])
    return Simulated.of(u, f(u), 0.0)


@pytest.mark.parametrize("axes", [None, np.eye(2)[:, :1]], ids=["all", "one slope"])
@pytest.mark.parametrize(("shift", "spread"), [(1.2, 0.3), (0.8, 0.2)])
def test_the_prediction_is_the_true_cov_of_draws_that_lie_beside(shift, spread, axes, rng):
    """The Gaussian reaches one side of the half-space only; the grid has the true c.o.v."""
    q, p = proposal(shift, spread), float(ndtr(-BETA))
    true = true_cov(q, p)
    predicted = [predict_cov(last_draws(q, plane, p, 0.02, rng), searched(plane, rng), axes, rng) for _ in range(5)]
    assert np.median(predicted) == pytest.approx(true, rel=0.15) and true > 0.1


def test_draws_that_claim_less_are_doubted_and_honest_ones_are_not(rng):
    """The warning names both figures; twice the stated c.o.v. is the limit."""
    q, p = proposal(1.2, 0.3), float(ndtr(-BETA))
    true, around = true_cov(q, p), searched(plane, rng)
    [warning] = check_spread(last_draws(q, plane, p, true / 4, rng), around, None, rng)
    assert f"the draws show {true / 4:.2g}" in warning
    assert check_spread(last_draws(q, plane, p, true, rng), around, None, rng) == []


def test_draws_that_reach_all_failures_need_no_regression(rng):
    """No failing point is heavy: nothing is predicted, at no cost."""
    q = proposal(0.0, 1.5, depth=1.0)
    assert predict_cov(last_draws(q, plane, float(ndtr(-BETA)), 0.02, rng), searched(plane, rng), None, rng) is None


def test_a_strip_that_looks_like_a_half_space_is_not_believed(rng):
    """f falls towards failure, but what was simulated beyond the strip does not fail."""
    p = float(ndtr(-BETA) - ndtr(-BETA - 0.5))
    draws = last_draws(proposal(1.2, 0.3), strip, p, 0.02, rng)
    shares = draws.draws.shares(searched(strip, rng).failing)
    assert np.count_nonzero(shares > DEFAULT_SURFACE_SETTINGS.heavy_share) >= 3
    assert predict_cov(draws, searched(strip, rng), None, rng) is None


def test_no_failing_draw_no_prediction(rng):
    """There is nothing that chains could start from."""
    draws = LastDraws(PlannedDraws(proposal(1.2, 0.3), N, 0.0), math.inf, Simulated.none(2))
    assert predict_cov(draws, searched(plane, rng), None, rng) is None


@pytest.mark.parametrize(("dim", "asked"), [(2, True), (DEFAULT_SURFACE_SETTINGS.max_dim + 1, False)])
def test_a_regression_is_asked_in_few_dimensions_only(dim, asked, monkeypatch):
    """In more the draws are not even kept for it."""
    calls = []
    monkeypatch.setattr(stages, "check_spread", lambda *inputs: calls.append(inputs) or [])
    samplers.estimate(half_space(dim).problem, "two-stage", seed=0, max_sim=2000)
    assert bool(calls) == asked
