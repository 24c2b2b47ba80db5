"""Candidates: the components that a proposal may be mixed from, and the shares that minimise its variance."""

from dataclasses import replace

import numpy as np
from scipy.special import log_ndtr

from samplers.methods.two_stage.mixture.boundary import fit_radial
from samplers.methods.two_stage.mixture.mixture_weights import Floor, minimise_second_moment, raise_to_floors
from samplers.methods.two_stage.mixture.proposal import MixtureProposal, ProposalComponent
from samplers.methods.two_stage.mixture.settings import (
    DEFAULT_MIXTURE_SETTINGS,
    EdgeSettings,
    MixtureSettings,
)
from samplers.methods.two_stage.mixture.subspace_em import truncate_weights
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.refinement import RefinementState
from samplers.methods.two_stage.settings import RefinementSettings
from samplers.problem import FloatArray
from samplers.proposals.components import (
    IsotropicNormal,
    LiftedComponent,
    SubspaceGaussian,
    log_ratios,
)
from samplers.proposals.von_mises_fisher import VonMisesFisherNakagami


def build_proposal(
    state: RefinementState,
    history: MultipleImportanceSample,
    settings: RefinementSettings,
    mixture: MixtureSettings = DEFAULT_MIXTURE_SETTINGS,
    *,
    final: bool = False,
) -> MixtureProposal:
    """Return the mixture for the next draws.

    Its weights minimise the second moment of the estimate over the failures in `history`, with lower limits; before
    the first round they are `settings.initial_shares`.

    Args:
        state: What is known of the regions.
        history: All draws so far.
        settings: Shares and lower limits.
        mixture: Of edges and weights.
        final: For the estimate: what is no use is dropped.
    """
    candidates = list_candidates(state, history, settings, mixture.edges)
    kinds = np.array([candidate.kind for candidate in candidates])
    start = np.array([settings.initial_shares[c.kind] / np.count_nonzero(kinds == c.kind) for c in candidates])
    weights = start / start.sum()
    if not state.rounds or len(history.u) == 0:
        return MixtureProposal(candidates, weights)
    floors = _set_floors(state, history, candidates, settings, radial=state.dim <= settings.radial_dim, final=final)
    u, log_w = history.u, history.log_weights
    if state.noisy:
        u, log_w = _smooth_indicators(history, state.gamma, settings)
    log_r = log_ratios([candidate.component for candidate in candidates], u)
    weights = minimise_second_moment(log_r, log_w, weights, floors, mixture.weights)
    keeps = kinds == "base"
    if not final:
        explored = np.isin(kinds, ["explored", "linear", "corner", "spread"])
        weights = np.where(explored, np.maximum(weights, settings.explored_share), weights)
        keeps = keeps | explored
    weights = np.where((weights < settings.min_share) & ~keeps, 0.0, weights)
    return MixtureProposal(candidates, raise_to_floors(weights / weights.sum(), floors))


def list_candidates(
    state: RefinementState,
    history: MultipleImportanceSample,
    settings: RefinementSettings,
    edges: EdgeSettings = DEFAULT_MIXTURE_SETTINGS.edges,
) -> list[ProposalComponent]:
    """Return the components that the next proposal may have; the first is the base distribution."""
    gaussians = [
        ProposalComponent(gaussian, "gaussian", explored.region)
        for gaussian, explored in zip(state.gaussians, state.explored, strict=True)
    ]
    regional = gaussians + ([] if state.noisy else list(state.linear)) + (list(state.explored) if state.rounds else [])
    candidates = [
        ProposalComponent(IsotropicNormal(state.dim), "base"),
        ProposalComponent(IsotropicNormal(state.dim, settings.wide_scale), "wide"),
        *_fit_radial_components(state, history, settings, edges),
        *regional,
        *_fit_directional_components(state, history),
        *_temper_gaussians(regional, settings.noisy_tempering if state.noisy else settings.tempering),
    ]
    candidates += _lift_candidates(state, history, settings, edges)
    return [candidate for candidate in candidates if candidate.kind in settings.initial_shares]


def _lift_candidates(
    state: RefinementState, history: MultipleImportanceSample, settings: RefinementSettings, edges: EdgeSettings
) -> list[ProposalComponent]:
    """Return components in the span of the slopes, if the exploration has found some, N(0, 1) across it."""
    axes = state.exploration.slopes
    if state.within is None or axes is None:
        return []
    failures = history.within(axes)
    inside = [c for c in list_candidates(state.within, failures, settings, edges) if c.kind not in ("base", "wide")]
    inside.append(ProposalComponent(_fit_spread(state.within, failures), "spread"))
    return [candidate._replace(component=LiftedComponent(candidate.component, axes)) for candidate in inside]


def _fit_spread(state: RefinementState, history: MultipleImportanceSample) -> SubspaceGaussian:
    """Return the Gaussian around the origin that is as wide as the failures, and at least N(0, I)."""
    u, weights = _weighted_failures(state, history)
    values, axes = np.linalg.eigh((u * weights[:, None]).T @ u)
    return SubspaceGaussian(axes, np.zeros(len(values)), np.maximum(values, 1.0))


def _temper_gaussians(components: list[ProposalComponent], powers: tuple[float, ...]) -> list[ProposalComponent]:
    """Return the tempered versions of the Gaussians among the components."""
    return [
        ProposalComponent(candidate.component.temper(power), "tempered", candidate.region)
        for candidate in components
        if isinstance(candidate.component, SubspaceGaussian)
        for power in powers
    ]


def _fit_radial_components(
    state: RefinementState, history: MultipleImportanceSample, settings: RefinementSettings, edges: EdgeSettings
) -> list[ProposalComponent]:
    """Return radial components around the chains' points and around the weighted failures; none in one dimension."""
    if state.dim < 2:
        return []
    radial = [fit_radial(state.points, np.ones(len(state.points)), edges)]
    if len(history.u) >= settings.min_radial_failures:
        log_w = history.log_weights
        radial.append(fit_radial(history.u, np.exp(log_w - log_w.max()), edges))
    return [ProposalComponent(component, "radial") for component in radial]


def _fit_directional_components(state: RefinementState, history: MultipleImportanceSample) -> list[ProposalComponent]:
    """Return one direction with a radius, fitted to all failures, where these are something like a shell or a cone."""
    if not state.scattered or state.dim < 2:
        return []
    law = VonMisesFisherNakagami.fit(*_weighted_failures(state, history))
    return [ProposalComponent(law, "directional")]


def _weighted_failures(state: RefinementState, history: MultipleImportanceSample) -> tuple[FloatArray, FloatArray]:
    """Return the failing draws u (n, d) and their weights (n,), before the first round the points of all chains."""
    if state.rounds and len(history.u):
        return history.u, truncate_weights(history.log_weights)
    return state.points, np.full(len(state.points), 1 / len(state.points))


def _share_among_regions(state: RefinementState, history: MultipleImportanceSample) -> FloatArray:
    """Return shares of the regions, shape (m,): as the roots of their weighted failures, by the densest Gaussian there.

    The roots lie between equal shares, which many small regions would spend, and the failures' own.
    """
    regions = np.array([explored.region for explored in state.explored])
    u, weights = _weighted_failures(state, history)
    nearest = regions[log_ratios(state.gaussians, u).argmax(axis=0)]
    roots = np.sqrt(np.bincount(nearest, weights=weights, minlength=len(state.regions)))
    return np.asarray(roots / roots.sum())


def _set_floors(
    state: RefinementState,
    history: MultipleImportanceSample,
    candidates: list[ProposalComponent],
    settings: RefinementSettings,
    *,
    radial: bool,
    final: bool,
) -> list[Floor]:
    """Return the least shares: of each region and its tempered Gaussians, spread and radial components and base draws.

    They add up to 1 at most: base draws keep theirs, which bounds all weights, the others are lowered in proportion.

    Args:
        state: What is known of the regions.
        history: All draws so far.
        candidates: All components.
        settings: The shares.
        radial: Whether there are few enough dimensions for radial components to reach a place off the regions.
        final: For the estimate.
    """
    kinds = np.array([candidate.kind for candidate in candidates])
    regions = np.array([candidate.region for candidate in candidates])
    spread = state.scattered and state.within is not None
    extra = 0.0 if spread else settings.extra_tempered_share * (1 - state.hit_rate)
    tempered = settings.noisy_tempered_share if state.noisy else settings.tempered_share + extra
    n = len(state.regions)
    floors = [Floor(kinds == "tempered", tempered)]
    if n > 1 and not state.scattered:
        shares = _share_among_regions(state, history)
        floors = [Floor((kinds == "tempered") & (regions == k), tempered * shares[k]) for k in range(n)]
    if state.scattered or (state.rounds and state.rounds[-1].worth(state.gamma) < settings.good_rate):
        floors.append(Floor(kinds == "spread", settings.spread_share))
    if state.scattered or (radial and not state.noisy):
        floors.append(Floor(kinds == "radial", settings.radial_share))
    if n > 1 and not state.scattered:
        share = settings.final_region_share if final else settings.region_share
        floors += [Floor((regions == k) & (kinds != "tempered"), share / n) for k in range(n)]
    base = settings.noisy_base_share if state.noisy else settings.base_share
    floors = [floor for floor in floors if floor.members.any()]
    fit = min(1.0, (1 - base) / max(sum(floor.least for floor in floors), base))
    floors = [replace(floor, least=fit * floor.least) for floor in floors]
    return [*floors, Floor(kinds == "base", base)] if "base" in kinds else floors


def _smooth_indicators(
    history: MultipleImportanceSample, gamma: float, settings: RefinementSettings
) -> tuple[FloatArray, FloatArray]:
    """Return all draws u (n, d), and log weights (n,) that hold the probability that they fail, by logistic regression.

    With a noisy f the few failures among the draws near the origin carry large weights by chance. What the weights of
    the mixture have to guard against is how likely such draws are to fail.
    """
    from sklearn.linear_model import LogisticRegression  # slow to import, and seldom needed
    from sklearn.preprocessing import PolynomialFeatures

    u, f, log_w = history.all_draws()
    degree = 2 if u.shape[1] <= settings.quadratic_dim else 1
    x = PolynomialFeatures(degree, include_bias=False).fit_transform(u)
    model = LogisticRegression(C=settings.logistic_penalty, max_iter=settings.logistic_iterations, random_state=0)
    odds = model.fit(x, f <= gamma).decision_function(x) / settings.probit_scale
    return u, log_w + log_ndtr(odds)
