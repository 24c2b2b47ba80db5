"""Refinement: update of the proposal components after each round of draws.

`start_refinement` describes the regions by the chains inside them, `refine_once` takes in the draws of a round. The
proposal for the next round follows from the state (`candidates.build_proposal`); all draws are kept by the caller
(`MultipleImportanceSample`).
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from samplers.methods.base import ComponentDraws
from samplers.methods.two_stage.edges import half_spaces, weighted_quantile
from samplers.methods.two_stage.mixture import (
    NO_REGION,
    Floor,
    GroupedPoints,
    MixtureProposal,
    ProposalComponent,
    fit_radial,
    fit_subspace_mixture,
    keep_floors,
    minimise_second_moment,
    refit_components,
    truncate_weights,
)
from samplers.methods.two_stage.regions import ExplorationResult, Region
from samplers.methods.two_stage.settings import HIGH_DIM, PROPOSAL
from samplers.methods.two_stage.stratified import MultipleImportanceSample
from samplers.problem import FloatArray
from samplers.proposals import (
    IsotropicNormal,
    LiftedComponent,
    SubspaceGaussian,
    VonMisesFisherNakagami,
    log_ratios,
)
from samplers.sample import effective_sample_size


class NearDraws(NamedTuple):
    """Draws of a round from components that lie near the regions, which base draws and radial ones are not."""

    u: FloatArray  # (n, d)
    f: FloatArray  # (n,)
    log_weights: FloatArray  # log(phi / q) with q the round's proposal, (n,)

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
    """Half-spaces and corners from regression of f around each region, none where `within` has them."""
    rounds: tuple[NearDraws, ...] = ()
    within: "RefinementState | None" = None
    """The same in the coordinates of the slopes, where the exploration has found some."""

    @property
    def regions(self) -> list[Region]:
        """Regions of failure."""
        return self.exploration.regions

    @property
    def dim(self) -> int:
        """Number of dimensions."""
        return int(self.regions[0].u.shape[1])

    @property
    def points(self) -> FloatArray:
        """Failing points of all chains, shape (n, d)."""
        return np.concatenate([region.points for region in self.regions])


def start_refinement(exploration: ExplorationResult, gamma: float, rng: np.random.Generator) -> RefinementState:
    """Return the initial state, from the exploration alone; also in the coordinates of its slopes."""
    state = _describe_regions(exploration, gamma, rng)
    axes = exploration.slopes
    if axes is None or axes.shape[1] == 0:
        return state
    return replace(state, within=_describe_regions(exploration.within(axes), gamma, rng))


def _describe_regions(exploration: ExplorationResult, gamma: float, rng: np.random.Generator) -> RefinementState:
    """Return the initial state in the coordinates of the exploration."""
    most = 8 if exploration.noisy else 3  # a region has some dozens of points; with noise all of it is one region
    explored = tuple(
        ProposalComponent(gaussian, "explored", k)
        for k, region in enumerate(exploration.regions)
        for gaussian in _fit_chains(region, most, rng)
    )
    sloped = exploration.slopes is not None and exploration.slopes.shape[1] > 0  # f is regressed among the slopes
    linear = tuple(
        ProposalComponent(proposal, "linear", k)
        for k, region in enumerate([] if sloped or exploration.noisy else exploration.regions)
        for proposal in half_spaces(region.points, region.u, region.f, gamma)
    )
    gaussians = [candidate.component for candidate in explored if isinstance(candidate.component, SubspaceGaussian)]
    return RefinementState(exploration=exploration, gamma=gamma, explored=explored, gaussians=gaussians, linear=linear)


def refine_once(
    state: RefinementState,
    history: MultipleImportanceSample,
    proposal: MixtureProposal,
    batch: ComponentDraws,
    rng: np.random.Generator,
) -> RefinementState:
    """Return the state after a round of draws."""
    kinds = np.repeat([candidate.kind for candidate in proposal.candidates], batch.counts)
    near = ~np.isin(kinds, ("base", "radial"))
    u = batch.u[near]
    return _learn(state, history, NearDraws(u, batch.f[near], proposal.log_weights(u)), rng)


def _learn(
    state: RefinementState,
    history: MultipleImportanceSample,
    draws: NearDraws,
    rng: np.random.Generator,
) -> RefinementState:
    """Return the state, and that in the coordinates of the slopes, moved to the failures of `history`."""
    axes, within = state.exploration.slopes, state.within
    if axes is not None and within is not None:
        within = _learn(within, history.within(axes), draws.within(axes), rng)
    state = replace(state, rounds=(*state.rounds, draws), within=within)
    if len(history.u) < 6:  # too few to move anything
        return state
    return replace(
        state, gaussians=refit_components(state.gaussians, history.u, history.log_weights), linear=_fit_linear(state)
    )


def typical_weights(state: RefinementState, proposal: MixtureProposal, history: MultipleImportanceSample) -> FloatArray:
    """Return the weight that a typical point of each region would have as a draw of a proposal, shape (m,).

    The upper quartile over the chains (the heaviest may be where hardly any failure is) of the mean over their likely
    states: those whose |u|^2 is within the weighted 99 % quantile of the failures that the rounds have met. Chains
    start far from where failures are likely, and a few may still be; 0 if a region has no likely state.
    """
    limit = math.inf
    if len(history.u):
        weights = np.exp(history.log_weights - history.log_weights.max())
        limit = weighted_quantile((history.u**2).sum(axis=1), weights, 0.99)
    typical = []
    for region in state.regions:
        chains, steps = region.chains.shape[:2]
        likely = (region.chains**2).sum(axis=2) <= limit
        weights = np.exp(proposal.log_weights(region.points)).reshape(chains, steps) * likely
        means = weights.sum(axis=1)[likely.any(axis=1)] / likely.sum(axis=1)[likely.any(axis=1)]
        typical.append(float(np.quantile(means, 0.75)) if len(means) else 0.0)
    return np.array(typical)


def nearest_regions(state: RefinementState, u: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the region of each point u (n, d), that of the densest Gaussian of the exploration, and log(q / phi)."""
    log_r = log_ratios([candidate.component for candidate in state.explored], u)
    regions = np.array([candidate.region for candidate in state.explored])
    return regions[log_r.argmax(axis=0)], log_r.max(axis=0)


def least_described(state: RefinementState, u: FloatArray, log_weights: FloatArray) -> float:
    """Return effective over actual failures among failing draws u (n, d), in the region where that is least.

    Another region may be described so well that the draws are worth enough all in all. Regions with fewer than 10 do
    not count; 1 if no region has as many, or f is noisy.
    """
    if len(u) == 0 or state.exploration.noisy:
        return 1.0
    nearest, _ = nearest_regions(state, u)
    weights = [log_weights[nearest == k] for k in range(len(state.regions))]
    return min((effective_sample_size(own) / len(own) for own in weights if len(own) >= 10), default=1.0)


def _fit_chains(region: Region, most: int, rng: np.random.Generator) -> list[SubspaceGaussian]:
    """Return at most `most` Gaussians fitted to the chains of a region; a chain belongs to one of them."""
    chains, steps, dim = region.chains.shape
    n = chains * steps
    points = GroupedPoints(
        u=region.points,
        weights=np.full(n, 1 / n),
        ess=2.0 * chains,  # a chain is worth two independent points
        groups=np.repeat(np.arange(chains), steps),
    )
    return fit_subspace_mixture(points, most if dim <= HIGH_DIM else 1, rng)


def _fit_linear(state: RefinementState) -> tuple[ProposalComponent, ...]:
    """Return half-spaces and corners from what was known of each region and the draws nearest to it."""
    if state.within is not None or state.exploration.noisy:
        return ()
    u, f = np.concatenate([draws.u for draws in state.rounds]), np.concatenate([draws.f for draws in state.rounds])
    owner, log_r = nearest_regions(state, u)
    owner = np.where(log_r > 1.0, owner, NO_REGION)  # the densest Gaussian of its own is e times phi or more
    fails = f <= state.gamma
    proposals: list[ProposalComponent] = []
    for k, region in enumerate(state.regions):
        own = owner == k
        failures = np.concatenate([region.points, u[own & fails]])
        around, outcomes = np.concatenate([region.u, u[own]]), np.concatenate([region.f, f[own]])
        found = half_spaces(failures, around, outcomes, state.gamma)
        proposals += [ProposalComponent(component, "linear", k) for component in found]
    return tuple(proposals)


def build_proposal(
    state: RefinementState, history: MultipleImportanceSample, *, final: bool = False
) -> MixtureProposal:
    """Return the mixture for the next draws.

    Its weights minimise the second moment of the estimate over the failures in `history`, with lower limits; before
    the first round they are `settings.initial_shares`.
    """
    candidates = list_candidates(state, history)
    kinds = np.array([candidate.kind for candidate in candidates])
    start = np.array([PROPOSAL.initial_shares[c.kind] / np.count_nonzero(kinds == c.kind) for c in candidates])
    weights = start / start.sum()
    if not state.rounds or len(history.u) == 0:
        return MixtureProposal(candidates, weights)
    floors = _set_floors(state, history, candidates, radial=state.dim <= PROPOSAL.radial_dim, final=final)
    u, log_w = history.u, history.log_weights
    if state.exploration.noisy:
        u, log_w = _smooth_indicators(history, state.gamma)
    log_r = log_ratios([candidate.component for candidate in candidates], u)
    weights = minimise_second_moment(log_r, log_w, weights, floors)
    keeps = kinds == "base"
    if not final:
        explored = np.isin(kinds, ["explored", "linear", "spread"])
        weights = np.where(explored, np.maximum(weights, 0.01), weights)  # kept until the last round
        keeps = keeps | explored
    weights = np.where((weights < 0.004) & ~keeps, 0.0, weights)  # some draws in thousands
    return MixtureProposal(candidates, keep_floors(weights / weights.sum(), floors))


def list_candidates(state: RefinementState, history: MultipleImportanceSample) -> list[ProposalComponent]:
    """Return the components that the next proposal may have; the first is the base distribution."""
    noisy, several = state.exploration.noisy, state.dim >= 2
    owners = zip(state.gaussians, (one.region for one in state.explored), strict=True)
    regional = [ProposalComponent(gaussian, "gaussian", region) for gaussian, region in owners]
    regional += [*(() if noisy else state.linear), *(state.explored if state.rounds else ())]
    laws = [fit_radial(state.points, np.ones(len(state.points)))] if several else []
    if several and len(history.u) >= 20:  # moments of |u|^2 need so many
        laws.append(fit_radial(history.u, np.exp(history.log_weights - history.log_weights.max())))
    directional = []
    if state.exploration.scattered and several:  # failures are something like a shell or a cone
        directional = [VonMisesFisherNakagami.fit(*_weighted_failures(state, history))]
    return [
        ProposalComponent(IsotropicNormal(state.dim), "base"),
        *(ProposalComponent(law, "radial") for law in laws),
        *regional,
        *(ProposalComponent(law, "directional") for law in directional),
        *(
            ProposalComponent(one.component.temper(power), "tempered", one.region)
            for one in regional
            if isinstance(one.component, SubspaceGaussian)
            for power in ((0.5, 0.25) if noisy else (0.5,))
        ),
        *_lift_candidates(state, history),
    ]


def _lift_candidates(state: RefinementState, history: MultipleImportanceSample) -> list[ProposalComponent]:
    """Return components in the span of the slopes, if the exploration has found some, N(0, 1) across it."""
    axes = state.exploration.slopes
    if state.within is None or axes is None:
        return []
    failures = history.within(axes)
    inside = [c for c in list_candidates(state.within, failures) if c.kind != "base"]
    u, weights = _weighted_failures(state.within, failures)
    values, across = np.linalg.eigh((u * weights[:, None]).T @ u)  # as wide as the failures, at least N(0, I)
    spread = SubspaceGaussian(across, np.zeros(len(values)), np.maximum(values, 1.0))
    inside.append(ProposalComponent(spread, "spread"))
    return [candidate._replace(component=LiftedComponent(candidate.component, axes)) for candidate in inside]


def _weighted_failures(state: RefinementState, history: MultipleImportanceSample) -> tuple[FloatArray, FloatArray]:
    """Return the failing draws u (n, d) and their weights (n,), before the first round the points of all chains."""
    if state.rounds and len(history.u):
        return history.u, truncate_weights(history.log_weights)
    return state.points, np.full(len(state.points), 1 / len(state.points))


def _set_floors(
    state: RefinementState,
    history: MultipleImportanceSample,
    candidates: list[ProposalComponent],
    *,
    radial: bool,
    final: bool,
) -> list[Floor]:
    """Return the least shares: of each region and its tempered Gaussians, spread and radial components and base draws.

    They add up to 1 at most: base draws keep theirs, which bounds all weights, the others are lowered in proportion.
    """
    kinds = np.array([candidate.kind for candidate in candidates])
    regions = np.array([candidate.region for candidate in candidates])
    noisy, n = state.exploration.noisy, len(state.regions)
    tempered = PROPOSAL.tempered_share[noisy]
    floors = [Floor(kinds == "tempered", tempered)]
    if n > 1 and not state.exploration.scattered:
        # by the roots of the weighted failures nearest to each region: between equal shares, which many small regions
        # would spend, and the failures' own
        u, weights = _weighted_failures(state, history)
        owners = np.array([explored.region for explored in state.explored])
        nearest = owners[log_ratios(state.gaussians, u).argmax(axis=0)]
        roots = np.sqrt(np.bincount(nearest, weights=weights, minlength=n))
        shares = roots / roots.sum()
        floors = [Floor((kinds == "tempered") & (regions == k), tempered * shares[k]) for k in range(n)]
    if state.exploration.scattered or (state.rounds and state.rounds[-1].worth(state.gamma) < PROPOSAL.good_rate):
        floors.append(Floor(kinds == "spread", PROPOSAL.spread_share))
    if state.exploration.scattered or (radial and not noisy):
        floors.append(Floor(kinds == "radial", PROPOSAL.radial_share))
    if n > 1 and not state.exploration.scattered:
        share = PROPOSAL.region_share[final]
        floors += [Floor((regions == k) & (kinds != "tempered"), share / n) for k in range(n)]
    base = PROPOSAL.base_share[noisy]
    floors = [floor for floor in floors if floor.members.any()]
    fit = min(1.0, (1 - base) / max(sum(floor.least for floor in floors), base))
    floors = [floor._replace(least=fit * floor.least) for floor in floors]
    return [*floors, Floor(kinds == "base", base)] if "base" in kinds else floors


def _smooth_indicators(history: MultipleImportanceSample, gamma: float) -> tuple[FloatArray, FloatArray]:
    """Return all draws u (n, d), and log weights (n,) that hold the probability that they fail, by logistic regression.

    With a noisy f the few failures among the draws near the origin carry large weights by chance. What the weights of
    the mixture have to guard against is how likely such draws are to fail.
    """
    from sklearn.linear_model import LogisticRegression  # slow to import, and seldom needed
    from sklearn.preprocessing import PolynomialFeatures

    u, f, log_w = history.all_draws()
    degree = 2 if u.shape[1] <= 20 else 1  # 231 coefficients at most
    x = PolynomialFeatures(degree, include_bias=False).fit_transform(u)
    model = LogisticRegression(C=100.0, max_iter=2000, random_state=0)  # hardly any penalty
    # Noise is near normal, and the logistic curve has far heavier tails: its log odds over the argument of Phi that is
    # next to them (Camilli, "Origin of the scaling constant d = 1.7 in item response theory", 1994)
    return u, log_w + log_ndtr(model.fit(x, f <= gamma).decision_function(x) / 1.702)
