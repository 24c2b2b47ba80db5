"""Uncovered failures: chains grow from failures that the next proposal hardly reaches, for components of their own.

A failing point u, met by a chain or by a draw, stands for phi(u) / q(u) / n of the estimate as one of n draws of the
proposal q. Where that is a large share of p, hardly a draw would come to the place, and the spread of the draws would
say nothing of it.
"""

from dataclasses import replace

import numpy as np

from samplers.methods.two_stage.mixture.proposal import MixtureProposal
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.refinement import RefinementState, start_refinement
from samplers.methods.two_stage.regions import SubsetPoints, grow_regions
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, RefinementSettings, TwoStageSettings
from samplers.methods.two_stage.simulator import SimulationSteps, Simulator
from samplers.methods.two_stage.stratified import MAX_LOG_WEIGHT
from samplers.problem import FloatArray


def find_uncovered(
    refinement: RefinementState,
    history: MultipleImportanceSample,
    proposal: MixtureProposal,
    n: int,
    settings: RefinementSettings = DEFAULT_SETTINGS.refinement,
) -> FloatArray:
    """Return the failing points (k, d) that would be too large shares of p as one of n draws, the heaviest first."""
    points = np.concatenate([history.u, *(region.chains[:, -1] for region in refinement.regions)])
    p = float(np.exp(history.log_weights).sum())
    weights = np.exp(np.minimum(proposal.log_weights(points), MAX_LOG_WEIGHT))
    heavy = np.flatnonzero(weights > settings.uncovered_share * n * p)
    return np.asarray(points[heavy[np.argsort(-weights[heavy])]])


def cover_failures(
    simulator: Simulator,
    refinement: RefinementState,
    points: FloatArray,
    room: int,
    rng: np.random.Generator,
    settings: TwoStageSettings = DEFAULT_SETTINGS,
) -> SimulationSteps[RefinementState]:
    """Grow chains from failing points (k, d) within about `room` simulations; return the state with their regions."""
    points = points[: room // settings.exploration.chain_cost]
    if len(points) == 0:
        return refinement
    gamma, none = refinement.gamma, SubsetPoints(points[:0], points[:0], np.empty(0))
    grown = yield from grow_regions(
        simulator, points, none, gamma, simulator.n_sim + room, rng, settings.regions, settings.mixture
    )
    grown = grown._replace(slopes=refinement.exploration.slopes)
    return _join(refinement, start_refinement(grown, gamma, settings.refinement, rng, settings.mixture))


def _join(refinement: RefinementState, added: RefinementState) -> RefinementState:
    """Return a state with the regions of another one after its own."""
    known = len(refinement.regions)
    within = refinement.within and added.within and _join(refinement.within, added.within)
    return replace(
        refinement,
        exploration=refinement.exploration._replace(regions=[*refinement.regions, *added.regions]),
        explored=(*refinement.explored, *(one._replace(region=known + one.region) for one in added.explored)),
        gaussians=[*refinement.gaussians, *added.gaussians],
        linear=(*refinement.linear, *(one._replace(region=known + one.region) for one in added.linear)),
        within=within,
    )
