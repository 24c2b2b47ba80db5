"""Refinement: update of the proposal components after each round of draws.

`start_refinement` describes the regions by the chains inside them, `refine_once` takes in the draws of a round. The
proposal for the next round follows from the state (`candidates.build_proposal`); all draws are kept by the caller
(`MultipleImportanceSample`).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from samplers.methods.two_stage.mixture.greatest_of_planes import intersection_of_half_spaces
from samplers.methods.two_stage.mixture.least_of_planes import union_of_half_spaces
from samplers.methods.two_stage.mixture.linear_model import half_space_proposals
from samplers.methods.two_stage.mixture.proposal import NO_REGION, MixtureProposal, ProposalComponent
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, MixtureSettings, SubspaceSettings
from samplers.methods.two_stage.mixture.subspace_em import (
    GroupedPoints,
    fit_subspace_mixture,
    refit_components,
)
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.regions import ExplorationResult, Region
from samplers.methods.two_stage.settings import RefinementSettings
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FloatArray
from samplers.proposals.components import HalfSpaceUnion, SubspaceGaussian, log_ratios
from samplers.statistics.weights import effective_sample_size

SHARP_KINDS = ("gaussian", "linear", "corner", "explored", "radial")
"""Components that are meant to hold failures only."""
TYPICAL_QUANTILE = 0.75
"""Of the mean weights of chains: that of the heaviest may be where hardly any failure is."""
DISTANT_KINDS = ("base", "wide", "radial")
"""Components whose draws are not near any region."""


class NearDraws(NamedTuple):
    """Draws of a round from components that lie near the regions."""

    u: FloatArray
    """Shape (n, d)."""
    f: FloatArray
    """Outcomes, shape (n,)."""
    log_weights: FloatArray
    """log(phi / q) with q the round's proposal, shape (n,)."""

    def worth(self, gamma: float) -> float:
        """Return the independent failures for each draw."""
        return effective_sample_size(self.log_weights[self.f <= gamma]) / max(len(self.f), 1)

    def within(self, axes: FloatArray) -> "NearDraws":
        """Return them in the coordinates of orthonormal axes (d, r)."""
        return self._replace(u=self.u @ axes)


@dataclass(frozen=True, eq=False, kw_only=True)
class RefinementState:
    """What is known of the regions after some rounds of draws."""

    exploration: ExplorationResult
    """Regions of the exploration, at least one."""
    gamma: float
    """Threshold of failure."""
    explored: tuple[ProposalComponent, ...]
    """Gaussians fitted to the chains of each region; they stay as they are."""
    gaussians: list[SubspaceGaussian]
    """The same, moved to the weighted failures: one for each of `explored`."""
    linear: tuple[ProposalComponent, ...]
    """Half-spaces and corners from linear regression of f around each region, and of its pieces in the slopes' span."""
    rounds: tuple[NearDraws, ...] = ()
    hit_rate: float = 1.0
    """Share of the last round's draws from SHARP_KINDS that failed."""
    within: "RefinementState | None" = None
    """The same in the coordinates of the slopes, where the exploration has found some."""

    @property
    def regions(self) -> list[Region]:
        """Regions of failure."""
        return self.exploration.regions

    @property
    def noisy(self) -> bool:
        """Whether f has noise of its own."""
        return self.exploration.noisy

    @property
    def scattered(self) -> bool:
        """Whether the regions are no more than pieces of something like a shell."""
        return self.exploration.scattered

    @property
    def dim(self) -> int:
        """Number of dimensions."""
        return int(self.regions[0].u.shape[1])

    @property
    def points(self) -> FloatArray:
        """Failing points of all chains, shape (n, d)."""
        return np.concatenate([region.points for region in self.regions])


def start_refinement(
    exploration: ExplorationResult,
    gamma: float,
    settings: RefinementSettings,
    rng: np.random.Generator,
    mixture: MixtureSettings = DEFAULT_MIXTURE_SETTINGS,
) -> RefinementState:
    """Return the initial state, from the exploration alone; also in the coordinates of its slopes.

    Args:
        exploration: Regions of the exploration, at least one.
        gamma: Threshold of failure.
        settings: Numbers of Gaussians.
        rng: Source of randomness of the fits.
        mixture: Of the fits.
    """
    state = _describe_regions(exploration, gamma, settings, rng, mixture)
    axes = exploration.slopes
    if axes is None or axes.shape[1] == 0:
        return state
    within = _describe_regions(exploration.within(axes), gamma, settings, rng, mixture)
    return replace(state, within=_add_pieces(within, rng, mixture))


def _describe_regions(
    exploration: ExplorationResult,
    gamma: float,
    settings: RefinementSettings,
    rng: np.random.Generator,
    mixture: MixtureSettings,
) -> RefinementState:
    """Return the initial state in the coordinates of the exploration."""
    most = settings.noisy_gaussians if exploration.noisy else settings.gaussians_per_region
    explored = tuple(
        ProposalComponent(gaussian, "explored", k)
        for k, region in enumerate(exploration.regions)
        for gaussian in _fit_chains(region, most, settings.points_per_chain, rng, mixture.subspace)
    )
    linear = tuple(
        proposal
        for k, region in enumerate(exploration.regions)
        for proposal in _propose_edges(k, region.points, region.u, region.f, gamma, mixture)
    )
    gaussians = [candidate.component for candidate in explored if isinstance(candidate.component, SubspaceGaussian)]
    return RefinementState(exploration=exploration, gamma=gamma, explored=explored, gaussians=gaussians, linear=linear)


def refine_once(
    state: RefinementState,
    history: MultipleImportanceSample,
    proposal: MixtureProposal,
    batch: ComponentDraws,
    settings: RefinementSettings,
    rng: np.random.Generator,
    mixture: MixtureSettings = DEFAULT_MIXTURE_SETTINGS,
) -> RefinementState:
    """Return the state after a round of draws.

    Args:
        state: Before it.
        history: All draws so far, those of this round included.
        proposal: What the round drew from.
        batch: Its draws.
        settings: How many failures a fit needs.
        rng: Source of randomness of the fits.
        mixture: Of the fits.
    """
    kinds = np.repeat([candidate.kind for candidate in proposal.candidates], batch.counts)
    sharp, near = np.isin(kinds, SHARP_KINDS), ~np.isin(kinds, DISTANT_KINDS)
    u = batch.u[near]
    draws = NearDraws(u, batch.f[near], proposal.log_weights(u))
    hit_rate = float((batch.f[sharp] <= state.gamma).mean()) if sharp.any() else 0.0
    return _learn(state, history, draws, hit_rate, settings, rng, mixture)


def _learn(
    state: RefinementState,
    history: MultipleImportanceSample,
    draws: NearDraws,
    hit_rate: float,
    settings: RefinementSettings,
    rng: np.random.Generator,
    mixture: MixtureSettings,
) -> RefinementState:
    """Return the state, and that in the coordinates of the slopes, moved to the failures of `history`."""
    axes, within = state.exploration.slopes, state.within
    if axes is not None and within is not None:
        within = _learn(within, history.within(axes), draws.within(axes), hit_rate, settings, rng, mixture)
        within = _add_pieces(within, rng, mixture)
    state = replace(state, rounds=(*state.rounds, draws), hit_rate=hit_rate, within=within)
    if len(history.u) < settings.min_refit_failures:
        return state
    return replace(
        state,
        gaussians=refit_components(state.gaussians, history.u, history.log_weights, mixture.subspace),
        linear=_fit_linear(state, settings, mixture),
    )


def _add_pieces(state: RefinementState, rng: np.random.Generator, mixture: MixtureSettings) -> RefinementState:
    """Return the state with the half-spaces of a piecewise linear f, where f is one, beside its other proposals."""
    known = [(region.u, region.f) for region in state.regions] + [(draws.u, draws.f) for draws in state.rounds]
    u, f = np.concatenate([points for points, _ in known]), np.concatenate([outcomes for _, outcomes in known])
    union = union_of_half_spaces(u, f, state.gamma, rng, mixture)
    others = tuple(one for one in state.linear if not isinstance(one.component, HalfSpaceUnion))
    return replace(state, linear=others if union is None else (*others, ProposalComponent(union, "linear")))


def typical_weights(state: RefinementState, proposal: MixtureProposal) -> FloatArray:
    """Return the weight that a typical point of each region would have as a draw of a proposal, shape (m,).

    The upper quartile over the chains of the mean over the second half of their states: starts are far from where
    failures are likely, and a few chains may still be.
    """
    typical = []
    for region in state.regions:
        late = region.chains[:, region.chains.shape[1] // 2 :]
        weights = np.exp(proposal.log_weights(late.reshape(-1, state.dim))).reshape(late.shape[:2])
        typical.append(float(np.quantile(weights.mean(axis=1), TYPICAL_QUANTILE)))
    return np.array(typical)


def _fit_chains(
    region: Region, most: int, points_per_chain: float, rng: np.random.Generator, subspace: SubspaceSettings
) -> list[SubspaceGaussian]:
    """Return at most `most` Gaussians fitted to the chains of a region; a chain belongs to one of them."""
    chains, steps, dim = region.chains.shape
    n = chains * steps
    points = GroupedPoints(
        u=region.points,
        weights=np.full(n, 1 / n),
        ess=points_per_chain * chains,
        groups=np.repeat(np.arange(chains), steps),
    )
    return fit_subspace_mixture(points, most if dim <= subspace.high_dim else 1, rng, subspace).components


def _fit_linear(
    state: RefinementState, settings: RefinementSettings, mixture: MixtureSettings
) -> tuple[ProposalComponent, ...]:
    """Return half-space proposals from what was known of each region and the draws nearest to it."""
    u, f = np.concatenate([draws.u for draws in state.rounds]), np.concatenate([draws.f for draws in state.rounds])
    log_r = log_ratios([candidate.component for candidate in state.explored], u)
    nearest = np.array([candidate.region for candidate in state.explored])[log_r.argmax(axis=0)]
    owner = np.where(log_r.max(axis=0) > settings.min_log_ratio, nearest, NO_REGION)
    fails = f <= state.gamma
    proposals: list[ProposalComponent] = []
    for k, region in enumerate(state.regions):
        own = owner == k
        failures = np.concatenate([region.points, u[own & fails]])
        around, outcomes = np.concatenate([region.u, u[own]]), np.concatenate([region.f, f[own]])
        proposals += _propose_edges(k, failures, around, outcomes, state.gamma, mixture)
    return tuple(proposals)


def _propose_edges(
    region: int,
    failures: FloatArray,
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    mixture: MixtureSettings,
) -> list[ProposalComponent]:
    """Return proposals from regression of f (n,) at u (n, d) around a region: a half-space, and a corner of several."""
    half_spaces = half_space_proposals(failures, u, f, gamma, mixture)
    corner = intersection_of_half_spaces(u, f, gamma, mixture)
    proposals = [ProposalComponent(component, "linear", region) for component in half_spaces]
    return proposals if corner is None else [*proposals, ProposalComponent(corner, "corner", region)]
