"""From regions of failure to a proposal: rounds of draws, each from a better mixture than the one before."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from samplers.methods.two_stage.mixture.linear_model import failure_edge, half_space_proposals, weighted_quantile
from samplers.methods.two_stage.mixture.mixture_weights import Floor, minimise_second_moment, raise_to_floors
from samplers.methods.two_stage.mixture.proposal import NO_REGION, MixtureProposal, ProposalComponent
from samplers.methods.two_stage.mixture.screening import FailureScreen, train_screen
from samplers.methods.two_stage.mixture.subspace_em import (
    HIGH_DIM,
    GroupedPoints,
    fit_mixture,
    refit_components,
    truncate_weights,
)
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.regions import ExplorationResult, Region
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FloatArray
from samplers.proposals.components import HalfSpaceNormal, IsotropicNormal, RadialLaw, SubspaceGaussian, log_ratios

BASE_FLOOR = 0.05
"""Share of base draws: no weight exceeds 1 / BASE_FLOOR."""
TEMPERED_FLOOR = 0.1
TEMPERED_MORE = 0.2
"""Share of tempered bumps, and how much more where half of the other draws do not fail."""
BASE_NOISY = 0.1
TEMPERED_NOISY = 0.5
"""Their share where f is noisy: there they are what is best."""
REGION_FLOOR = 0.5
REGION_FLOOR_LAST = 0.2
"""Share of draws that is dealt out evenly among the regions, in the rounds and in the estimate. Weights of a region's
first draws can be so uneven that it seems to have no mass: it must not be lost by that."""
SHELL_FLOOR = 0.1
"""Share of shells where the regions are no more than pieces of one."""
SMALLEST = 0.004
"""Components with less of the draws than this are left out."""
KEPT = 0.01
"""But those that the exploration led to keep this much until the last round."""
START = {
    "base": 0.1,
    "wide": 0.05,
    "shell": 0.1,
    "bump": 0.5,
    "plane": 0.5,
    "first": 0.2,
    "tempered": 0.25,
    "slice": 0.1,
}
SHARP_KINDS = ("bump", "plane", "first", "slice", "shell")


class Refinement:
    """What is known of the regions, and the proposals that follow from it.

    Args:
        found: By the exploration, at least one region.
        history: Draws made so far.
        gamma: Threshold of failure.
        rng: Source of randomness.
    """

    def __init__(
        self, found: ExplorationResult, history: MultipleImportanceSample, gamma: float, rng: np.random.Generator
    ) -> None:
        regions = found.regions
        self._dim = regions[0].u.shape[1]
        self._regions = regions
        self.noisy = found.noisy
        """Whether f has noise of its own."""
        self.levels = found.levels
        """Levels that subset simulation passed on the way down."""
        self._scattered = found.scattered
        self._history = history
        self._gamma = gamma
        self._rng = rng
        self._sharp_hits = 1.0
        self._points = np.concatenate([region.points for region in regions])
        bumps = [(bump, k) for k, region in enumerate(regions) for bump in self._fit_region(region)]
        self._first = [ProposalComponent(bump, "first", k) for bump, k in bumps]
        self._bumps = [bump for bump, _ in bumps]
        self._fresh: list[SubspaceGaussian] = []
        self._planes = [
            ProposalComponent(part, "plane", k)
            for k, region in enumerate(regions)
            for part in half_space_proposals(region.points, region.u, region.f, gamma)
        ]
        self._near: list[tuple[FloatArray, FloatArray]] = []
        self._near_log_weights = np.empty(0)

    def proposal(self, *, last: bool = False) -> MixtureProposal:
        """Return the mixture for the next draws; `last`: for the estimate."""
        seen = len(self._near) > 0
        candidates = self._candidates(seen)
        kinds = np.array([candidate.kind for candidate in candidates])
        regions = np.array([candidate.region for candidate in candidates])
        start = np.array([START[kind] / np.count_nonzero(kinds == kind) for kind in kinds])
        weights = start / start.sum()
        if not seen or len(self._history.u) == 0:
            return MixtureProposal(candidates, weights)
        floors = self._floors(kinds, regions, REGION_FLOOR_LAST if last else REGION_FLOOR)
        u, log_w = self._smooth_indicators() if self.noisy else (self._history.u, self._history.log_weights)
        log_r = log_ratios([candidate.component for candidate in candidates], u)
        weights = minimise_second_moment(log_r, log_w, weights, floors)
        stays = kinds == "base"
        if not last:
            explored = np.isin(kinds, ["first", "plane"])
            weights = np.where(explored, np.maximum(weights, KEPT), weights)
            stays = stays | explored
        weights = np.where((weights < SMALLEST) & ~stays, 0.0, weights)
        proposal = MixtureProposal(candidates, raise_to_floors(weights / weights.sum(), floors))
        screen = self._train_screen() if last and not self.noisy and self._dim <= HIGH_DIM else None
        return proposal if screen is None else proposal.with_screen(screen, self._rng)

    def typical_weights(self, proposal: MixtureProposal) -> FloatArray:
        """Return what the exploration's points in each region would weigh on average as draws of a proposal, (m,).

        Without the heaviest of three chains or more: one may have strayed to where hardly any failure is.
        """
        typical = []
        for region in self._regions:
            chains = np.sort(np.exp(proposal.log_weights(region.points)).reshape(region.chains.shape[:2]).mean(axis=1))
            typical.append(float(chains[:-1].mean() if len(chains) > 2 else chains.mean()))
        return np.array(typical)

    def _train_screen(self) -> FailureScreen | None:
        """Return a screen that has learned from the chains and the draws of all rounds."""
        u = np.concatenate([region.u for region in self._regions] + [u for u, _ in self._near[:-1]])
        f = np.concatenate([region.f for region in self._regions] + [f for _, f in self._near[:-1]])
        u_new, f_new = self._near[-1]
        return train_screen((u, f <= self._gamma), (u_new, f_new <= self._gamma), self._near_log_weights)

    def learn(self, proposal: MixtureProposal, batch: ComponentDraws, *, afresh: bool) -> None:
        """Take in the outcomes of draws; `afresh`: also fit new bumps to all failures."""
        self._history.add(batch, self._gamma)
        kinds = np.repeat([candidate.kind for candidate in proposal.candidates], batch.counts)
        sharp = np.isin(kinds, SHARP_KINDS)
        self._sharp_hits = float((batch.f[sharp] <= self._gamma).mean()) if sharp.any() else 0.0
        near = ~np.isin(kinds, ["wide", "shell", "base"])
        self._near.append((batch.u[near], batch.f[near]))
        self._near_log_weights = proposal.log_weights(batch.u[near])
        if len(self._history.u) > 5:
            self._bumps = refit_components(self._bumps, self._history.u, self._history.log_weights)
            self._fresh = self._fit_failures() if afresh and self._dim <= HIGH_DIM else []
            if afresh or self._dim > HIGH_DIM or len(self._regions) > 1:
                self._planes = self._fit_planes()

    def _smooth_indicators(self) -> tuple[FloatArray, FloatArray]:
        """Return all draws u (n, d), weighted also by the probability that they fail, as logistic regression has it.

        With a noisy f the few failures among the draws near the origin carry large weights by chance. What the
        weights of the mixture have to guard against is how likely such draws are to fail.
        """
        from sklearn.linear_model import LogisticRegression  # slow to import, and seldom needed
        from sklearn.preprocessing import PolynomialFeatures

        u, f, log_w = self._history.everything()
        x = PolynomialFeatures(2 if self._dim <= 20 else 1, include_bias=False).fit_transform(u)
        fails = f <= self._gamma
        odds = LogisticRegression(C=100.0, max_iter=2000, random_state=0).fit(x, fails).decision_function(x) / 1.702
        # The logistic curve has far heavier tails than noise that is near normal: log_ndtr(odds / 1.702) has not.
        return u, log_w + log_ndtr(odds)

    def _fit_region(self, region: Region) -> list[SubspaceGaussian]:
        chains, steps, _ = region.chains.shape
        n = chains * steps
        points = GroupedPoints(
            u=region.points,
            weights=np.full(n, 1 / n),
            ess=2.0 * chains,
            groups=np.repeat(np.arange(chains), steps),
        )
        most = 8 if self.noisy else 3
        return fit_mixture(points, most if self._dim <= HIGH_DIM else 1, self._rng).bumps

    def _fit_failures(self) -> list[SubspaceGaussian]:
        """Return a mixture fitted to all failures, where their weights carry one."""
        weights = truncate_weights(self._history.log_weights)
        ess = 1 / float((weights**2).sum())
        if ess < max(60, 6 * self._dim):
            return []
        return fit_mixture(GroupedPoints(self._history.u, weights, ess, np.arange(len(weights))), 8, self._rng).bumps

    def _fit_planes(self) -> list[ProposalComponent]:
        """Return planes from what was known of each region and the draws nearest to it."""
        u, f = np.concatenate([u for u, _ in self._near]), np.concatenate([f for _, f in self._near])
        log_r = log_ratios([first.component for first in self._first], u)
        owner = np.array([first.region for first in self._first])[log_r.argmax(axis=0)]
        owner = np.where(log_r.max(axis=0) > 1, owner, NO_REGION)
        fails = f <= self._gamma
        planes = []
        for k, region in enumerate(self._regions):
            own = owner == k
            points = np.concatenate([region.points, u[own & fails]])
            parts = half_space_proposals(
                points, np.concatenate([region.u, u[own]]), np.concatenate([region.f, f[own]]), self._gamma
            )
            planes += [ProposalComponent(part, "plane", k) for part in parts]
        return planes

    def _candidates(self, seen: bool) -> list[ProposalComponent]:
        bumps = [ProposalComponent(b, "bump", c.region) for b, c in zip(self._bumps, self._first, strict=True)]
        bumps += [ProposalComponent(bump, "bump") for bump in self._fresh]
        planes = [] if self.noisy else self._planes
        first = self._first if seen else []
        found = [
            ProposalComponent(IsotropicNormal(self._dim), "base"),
            ProposalComponent(IsotropicNormal(self._dim, 1.5), "wide"),
        ]
        found += self._shells() + bumps + planes + first
        if not self.noisy:
            found += [ProposalComponent(part, "slice") for part in self._slices(seen)]
        for candidate in bumps + planes + first:
            if isinstance(candidate.component, SubspaceGaussian):
                for power in (0.5, 0.25) if self.noisy else (0.5,):
                    found.append(ProposalComponent(candidate.component.temper(power), "tempered", candidate.region))
        return found

    def _floors(self, kinds: NDArray[np.str_], regions: NDArray[np.int64], for_regions: float) -> list[Floor]:
        tempered = TEMPERED_NOISY if self.noisy else TEMPERED_FLOOR + TEMPERED_MORE * (1 - self._sharp_hits)
        base = BASE_NOISY if self.noisy else BASE_FLOOR
        floors = [Floor(kinds == "tempered", tempered)]
        n = len(self._regions)
        if self._scattered:
            floors.append(Floor(kinds == "shell", SHELL_FLOOR))
        elif n > 1:
            floors += [Floor((regions == k) & (kinds != "tempered"), for_regions / n) for k in range(n)]
        return [*floors, Floor(kinds == "base", base)]

    def _shells(self) -> list[ProposalComponent]:
        if self._dim < 2:
            return []
        shells = [fit_radial(self._points, np.ones(len(self._points)))]
        if len(self._history.u) >= 20:
            log_w = self._history.log_weights
            shells.append(fit_radial(self._history.u, np.exp(log_w - log_w.max())))
        return [ProposalComponent(shell, "shell") for shell in shells]

    def _slices(self, seen: bool) -> list[HalfSpaceNormal]:
        """Return slices through the edge of each bump's failures, plain and with the bump's shape across."""
        u = self._history.u if seen else self._points
        log_w = self._history.log_weights if seen else np.zeros(len(u))
        bumps = self._bumps + self._fresh
        if len(u) == 0:
            return []
        owner = log_ratios(bumps, u).argmax(axis=0)
        own = [owner == k for k in range(len(bumps))]
        return [
            part
            for bump, rows in zip(bumps, own, strict=True)
            if np.count_nonzero(rows) >= 10
            for part in fit_half_spaces(bump, u[rows], np.exp(log_w[rows] - log_w[rows].max()))
        ]


def fit_half_spaces(bump: SubspaceGaussian, u: FloatArray, weights: FloatArray) -> list[HalfSpaceNormal]:
    """Return slices that start at the 2 % quantile of failures u (n, d) with weights (n,) along a bump's centre."""
    centre, dim = bump.centre, len(bump.axes)
    norm = float(np.linalg.norm(centre))
    if norm < 1e-6:
        return []
    axis = centre / norm
    start = failure_edge(u @ axis, weights, float(weights.sum()) ** 2 / float((weights**2).sum()), 0.02) - 0.02
    if start < 0.5:
        return []
    parts = [HalfSpaceNormal(axis, start)]
    if bump.axes.shape[1] == dim > 1:
        across = np.eye(dim) - np.outer(axis, axis)
        values, vectors = np.linalg.eigh(across @ (bump.axes * bump.variance @ bump.axes.T) @ across)
        within = np.argsort(np.abs(vectors.T @ axis))[: dim - 1]
        axes = vectors[:, within]
        parts.append(
            HalfSpaceNormal(axis, start, SubspaceGaussian(axes, axes.T @ centre, np.maximum(values[within], 1e-6)))
        )
    return parts


def fit_radial(u: FloatArray, weights: FloatArray) -> RadialLaw:
    """Return the shell whose |u|^2 has the moments of points u (n, d) with weights (n,)."""
    square = np.einsum("ij,ij->i", u, u)
    start = 0.98 * weighted_quantile(square, weights, 0.01)
    beyond_start = square > start
    s, w = square[beyond_start] - start, weights[beyond_start]
    mean = float(np.average(s, weights=w))
    variance = max(float(np.average((s - mean) ** 2, weights=w)), 1e-6)
    return RadialLaw(u.shape[1], start, max(mean * mean / variance, 0.3), max(variance / mean, 1e-3))
