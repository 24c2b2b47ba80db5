"""Placement: components and weights of a proposal from failures that a regression of f predicts.

The weights of a mixture minimise the second moment of p-hat over the failures that were met. Where these are few and
their weights uneven, that says little of what was hardly met. A regression of f that has proved itself knows more:
states of chains on it are failures drawn from N(0, I), as many as are wanted and all of one weight. Gaussians are
fitted to a part of them, the weights of all components minimise

    sum_i phi(u_i) / q_a(u_i)    over the states u_i of another part

and the new mixture is taken where the same sum over the third part is well below that of the old one. It is a mixture
of known components as before, fixed before its draws: the regression decides how good it is, not whether p is right.
"""

from dataclasses import replace

import numpy as np

from samplers.methods.two_stage.candidates import PredictedFailures, build_proposal
from samplers.methods.two_stage.mixture.proposal import MixtureProposal
from samplers.methods.two_stage.mixture.subspace_em import GroupedPoints, fit_subspace_mixture
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.refinement import RefinementState
from samplers.methods.two_stage.response_surface.predicted_failures import (
    PlannedDraws,
    Simulated,
    believe_surface,
    walk_failures,
)
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, TwoStageSettings
from samplers.methods.two_stage.stratified import MAX_LOG_WEIGHT
from samplers.problem import FloatArray
from samplers.proposals.components import SubspaceGaussian
from samplers.statistics.weights import normalise_weights

PARTS = 3
"""Chains for Gaussians, for weights, and for the comparison."""


def place_by_surface(
    proposal: MixtureProposal,
    refinement: RefinementState,
    history: MultipleImportanceSample,
    n: int,
    rng: np.random.Generator,
    settings: TwoStageSettings = DEFAULT_SETTINGS,
    *,
    final: bool = False,
) -> MixtureProposal:
    """Return a mixture by predicted failures where it is well better for them than the proposal, else the proposal.

    Args:
        proposal: By the failures met.
        refinement: What is known of the regions.
        history: All draws so far.
        n: Draws of the last proposal.
        rng: Source of randomness of the regression, the chains and the fits.
        settings: When the regression is believed, and how much better the mixture must be.
        final: For the estimate.
    """
    chains = predict_failures(proposal, refinement, history, n, rng, settings)
    if chains is None:
        return proposal
    fitted, weighed, left_out = (chains[:, part::PARTS].reshape(-1, chains.shape[2]) for part in range(PARTS))
    gaussians = _fit_gaussians(fitted, refinement.exploration.slopes, rng, settings)
    predicted = PredictedFailures(weighed, gaussians)
    placed = build_proposal(
        refinement, history, settings.refinement, settings.mixture, final=final, predicted=predicted
    )
    better = _mean_weight(proposal, left_out) >= settings.surfaces.min_gain * _mean_weight(placed, left_out)
    return placed if better else proposal


def _fit_gaussians(
    u: FloatArray, axes: FloatArray | None, rng: np.random.Generator, settings: TwoStageSettings
) -> list[SubspaceGaussian]:
    """Return Gaussians fitted to states u (n, d), in the coordinates of axes (d, r) if there are any."""
    n = len(u)
    points = GroupedPoints(u if axes is None else u @ axes, np.full(n, 1 / n), n, np.arange(n))
    return fit_subspace_mixture(points, settings.surfaces.gaussians, rng, settings.mixture.subspace).components


def predict_failures(
    proposal: MixtureProposal,
    refinement: RefinementState,
    history: MultipleImportanceSample,
    n: int,
    rng: np.random.Generator,
    settings: TwoStageSettings = DEFAULT_SETTINGS,
) -> FloatArray | None:
    """Return states of chains on a regression of f, shape (states, chains, d); None where none is believed.

    Arguments as of `place_by_surface`.
    """
    axes, known = refinement.exploration.slopes, Simulated.of_search(history, refinement)
    surfaces = replace(settings.surfaces, min_heavy_accuracy=settings.surfaces.min_placed_accuracy)
    draws = PlannedDraws(proposal, n, float(np.exp(history.log_weights).sum()))
    if draws.p == 0:
        return None
    predict = believe_surface(known, draws, axes, rng, surfaces, settings.mixture.pieces)
    if predict is None:
        return None
    first = history.u[rng.choice(len(history.u), surfaces.chains, p=normalise_weights(history.log_weights))]
    return np.array(list(walk_failures(predict, first, surfaces.steps, rng)))[:: surfaces.kept_every]


def _mean_weight(proposal: MixtureProposal, u: FloatArray) -> float:
    return float(np.exp(np.minimum(proposal.log_weights(u), MAX_LOG_WEIGHT)).mean())
