"""The cross-entropy method (O'Kelly et al. 2018, algorithm 1)."""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, TypeVar

import numpy as np

from samplers.importance import (
    LEAST_ROUNDS,
    LEAST_SEARCH_BUDGET,
    SEARCH_SHARE,
    Round,
    Search,
    Space,
    count_final_draws,
    defensive_mixture,
    draw_after_search,
    round_record,
    search_warnings,
)
from samplers.method import Goal, Interrupted, Steps
from samplers.methods.base import Method
from samplers.methods.blocks import GaussianBlock, MixtureBlock, NormalBlock, Product, announced_blocks
from samplers.problem import FloatArray, Inputs, check_number, check_settings, check_whole, is_number
from samplers.proposals import Gaussian, ProposalDistribution
from samplers.sample import Level, Status, next_level, normalise_weights


class Iterate(NamedTuple):
    """One proposal of the search, with the results of its draws."""

    proposal: Product
    quantile: float
    """The rho-quantile of f under the proposal."""
    level: float
    """gamma_k: the quantile, but not less than gamma."""
    record: Level


def best_iterate(iterates: Sequence[Iterate], choice: str) -> Iterate | None:
    """Return the iterate to sample from; None if there is none.

    The one with the lowest rho-quantile, with choice "cov" not counted below gamma; among equals that with the
    smallest c.o.v.
    """

    def rank(iterate: Iterate) -> tuple[float, float]:
        return (iterate.quantile if choice == "quantile" else iterate.level, iterate.record.cov)

    return min(iterates, key=rank, default=None)


SettingT = TypeVar("SettingT")


@dataclass(frozen=True, kw_only=True)
class CrossEntropy(Method):
    """Importance sampling from a proposal found by the cross-entropy method.

    Search (algorithm 1): draw N_k points from the proposal theta_k, take as gamma_k the
    rho-quantile of f, but not less than gamma, and move theta to the Kullback-Leibler projection
    of alpha_k Q_k + (1 - alpha_k) P_theta, where Q_k is the base distribution given f <= gamma_k
    (equation 2). For an exponential family that is a matter of the expected sufficient
    statistics; those under Q_k come from the elite points with the joint likelihood ratio
    p0 / p_theta (equation 3), in logarithms.
    Estimate: fresh draws, independent of the search given the proposal, from
    base_share of the base distribution + wide_share of the widened proposal + the rest proposal, so that
    p-hat is unbiased and no weight exceeds 1 / base_share.

    Families. In standard normal space: one Gaussian with mean and covariance ("gaussian"), with
    the mean only ("mean"), or a mixture of Gaussians ("mixture"), which can follow several
    regions of failure. In physical space: the paper's blocks ("blocks"), for a base distribution
    that announces its own (`base.blocks`, see `announced_blocks`; `Product` is one): Beta in a
    box, Normal with fixed covariance and its mean in a box, Gaussian, mixture.

    Where the paper, its released code and this implementation differ:

    - *gamma_k.* The algorithm box says "minimum of gamma and the quantile", the text
      gamma_k >= gamma; the latter is meant and done here.
    - *Equation 3* divides by N_k; we divide by the sum of the weights, so that Q_k has mass 1.
      The code divides by N rho even where more points than that are below gamma.
    - *Likelihood ratio.* The code updates each block with its own ratio; here that is
      likelihood_ratio="block". It varies less in many dimensions, but is not the projection of
      equation 2: coordinates are moved towards the distribution of points with f <= gamma_k under a
      product that is the base distribution in the one block and the proposal in all others.
    - *Projection.* As in the paper. The code's programme for the mean of a Normal has the
      covariance where its inverse belongs, and its Beta box is [0.5, 5], the paper's [1.5, 7].
    - *Family.* The default is not the paper's: one Gaussian with its covariance covers curved
      and two-lobed regions better than products. The covariance is drawn towards the present
      one (`shrink_towards_present`).
    - *End.* The paper runs K = 100 iterations of 5000; ours ends the search when two
      proposals have reached gamma, unless early_end=False. Search simulations are part of n_sim.
    - *Choice.* The paper takes the iterate with the lowest rho-quantile (choice="quantile"), the
      code that with the lowest mean of the elite. Ours does not count quantiles below gamma;
      among equals the smallest c.o.v. decides: an ever lower quantile favours one mode.
    - *Ties.* gamma_k is an outcome that occurred; if most outcomes tie, the largest below.
    - *Weights.* The paper samples from the proposal alone, whose weights are unbounded.

    The paper's settings: CrossEntropy(family="blocks", rho=0.01, alpha=0.8, n_iteration=5000,
    max_iterations=100, early_end=False, choice="quantile", n_final=100_000, wide_share=0).

    In some hundred dimensions a covariance cannot be learned from a thousand draws and the
    weights degenerate: the result then carries warnings and a very wide interval. The mean of a
    Normal of d dimensions is learned from m effective elite points up to a shift of about
    sqrt(d / m) standard deviations, which is what a small radius guards against.

    The interval is log-normal; where the base draws already fail with a share of rho or more,
    plain Monte Carlo draws and Clopper-Pearson take over. A run that is stopped before its final
    draws gives the estimate of the base draws and the last proposal's, taken as one sample.

    Args:
        family: "gaussian", "mean", "mixture" or "blocks", see above.
        components: Gaussians of the family "mixture" at most.
        likelihood_ratio: "joint" (equation 3) or "block" (as in the released code).
        rho: Elite fraction. (The paper has 0.01 with N_k = 5000.)
        alpha: Step size alpha_k in (0, 1], or several: the last one holds on.
        n_iteration: Draws per iteration, N_k, or several; at most a tenth of max_sim.
        max_iterations: Iterations at most, K.
        early_end: End the search once two proposals have reached gamma.
        choice: Which iterate to keep: "cov" or "quantile", see above.
        n_final: Final draws; with max_sim all that is left, with target_cov batches of this.
        base_share: Share of base draws in the final sample.
        wide_share: Share of draws from the widened proposal; may be 0.
        wide_factor: By how much its standard deviations are wider.

    References:
        O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle
        testing via rare-event simulation", NeurIPS 2018.
        Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda u: 4.0 - u[:, 0], dim=2)  # P = Phi(-4) = 3.17e-5
        >>> result = samplers.estimate(problem, samplers.CrossEntropy(), seed=0, max_sim=5000)
        >>> result.interval[0] < 3.167e-5 < result.interval[1], result.cov < 0.1
        (True, True)
        >>> [f"{level.gamma:.2f}" for level in result.trace]  # levels of the search, then the final draws
        ['2.80', '1.57', '0.62', '0.00', '0.00', '0.00']
    """

    family: Literal["gaussian", "mean", "mixture", "blocks"] = "gaussian"
    components: int = 3
    likelihood_ratio: Literal["joint", "block"] = "joint"
    rho: float = 0.1
    alpha: float | tuple[float, ...] = 0.8
    n_iteration: int | tuple[int, ...] = 1000
    max_iterations: int = 20
    early_end: bool = True
    choice: Literal["cov", "quantile"] = "cov"
    n_final: int = 4000
    base_share: float = 0.1
    wide_share: float = 0.2
    wide_factor: float = 1.5

    name: ClassVar[str] = "ce"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(
            self,
            family=("gaussian", "mean", "mixture", "blocks"),
            likelihood_ratio=("joint", "block"),
            choice=("cov", "quantile"),
            components=1,
            max_iterations=1,
            n_final=10,
            rho=(0.0, 0.5),
            base_share=(0.0, 1.0),
            wide_factor=(1.0, math.inf),
        )
        for size in as_tuple(self.n_iteration) or [None]:
            check_whole("CrossEntropy.n_iteration", size, 10)
        for step in as_tuple(self.alpha) or [None]:
            check_number("CrossEntropy.alpha", step, 0.0, math.nextafter(1.0, 2.0))
        if not (is_number(self.wide_share) and self.wide_share == 0):
            check_settings(self, wide_share=(0.0, 1.0 - self.base_share))

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Search for a proposal, then estimate with fresh draws."""
        base, space = self._start(inputs)
        search, iterates = yield from self._search(base, space, goal, rng)
        best = best_iterate(iterates, self.choice)
        sampler: ProposalDistribution = base
        base_share = 1.0
        if best is not None and len(iterates) > 1:  # else the base draws fail often enough, or there is no way on
            base_share = self.base_share
            wide = best.proposal.widen(self.wide_factor)
            sampler = defensive_mixture(base, wide, best.proposal, base_share, self.wide_share)
        limit = count_final_draws(goal, search.n_sim, self.n_final)
        final = yield from draw_after_search(inputs, goal, search, sampler, base_share, limit, self.n_final, rng, space)
        reached = best is not None and best.level == goal.gamma
        return final.outcome(goal, search.status, [] if reached else search_warnings(search, goal.gamma))

    def _start(self, inputs: Inputs) -> tuple[Product, Space]:
        """Return the base distribution by blocks, theta_0, and the space that the search works in."""
        if self.family == "blocks":
            base = announced_blocks(inputs)
            return base, Space(base, np.asarray)
        gaussian = Gaussian.standard(inputs.dim)
        if self.family == "mixture":
            base = Product((MixtureBlock(gaussian, self.components),))
        else:
            base = Product((GaussianBlock(gaussian) if self.family == "gaussian" else NormalBlock(gaussian),))
        return base, Space(base, inputs.base.from_standard_normal)

    def _search(
        self, base: Product, space: Space, goal: Goal, rng: np.random.Generator
    ) -> Generator[FloatArray, FloatArray, tuple[Search, list[Iterate]]]:
        """Run algorithm 1, as a rule until two proposals have reached gamma."""
        rounds, iterates = list[Round](), list[Iterate]()

        def ended(status: Status) -> tuple[Search, list[Iterate]]:
            return Search(rounds, [iterate.record for iterate in iterates], status), iterates

        if goal.budget < LEAST_SEARCH_BUDGET:
            return ended(Status.BUDGET)
        proposal, spent = base, 0
        for k in range(self.max_iterations):
            size = min(value_at(self.n_iteration, k), goal.budget // LEAST_ROUNDS)
            if spent + size > int(SEARCH_SHARE * goal.budget):
                return ended(Status.BUDGET)
            u = proposal.sample(size, rng)
            try:
                f = yield space.to_x(u)
            except Interrupted:
                return ended(Status.STOPPED)
            spent += size
            level = next_level(f, self.rho, goal.gamma)
            lowest = float(f.min()) if level is None else level
            elite = u[f <= lowest]
            log_ratios = base.log_probs(elite) - proposal.log_probs(elite)
            rounds = [*rounds[:1], Round(base, proposal, u, f)]  # those that `pool_rounds` needs
            rank = int(np.ceil(self.rho * size)) - 1
            quantile = float(np.partition(f, rank)[rank])
            record = round_record(lowest, size, log_ratios.sum(axis=0))
            iterates.append(Iterate(proposal, quantile, lowest, record))
            goal.on_level(iterates[-1].record)
            if level is None:
                return ended(Status.STALLED)
            n_reached = sum(iterate.level == goal.gamma for iterate in iterates)
            if n_reached == 2 - (k == 0) and (self.early_end or k == 0):
                return ended(Status.CONVERGED)
            proposal = self._project(proposal, elite, log_ratios, value_at(self.alpha, k))
        return ended(Status.CONVERGED if level == goal.gamma else Status.STALLED)

    def _project(self, proposal: Product, elite: FloatArray, log_ratios: FloatArray, alpha: float) -> Product:
        """Return the proposal after one step of equation 2 towards the elite points."""
        if self.likelihood_ratio == "joint":
            log_ratios = np.broadcast_to(log_ratios.sum(axis=0), log_ratios.shape)
        return proposal.project(elite, np.stack([normalise_weights(ratios) for ratios in log_ratios]), alpha)


def as_tuple(setting: SettingT | tuple[SettingT, ...]) -> tuple[SettingT, ...]:
    """Return a setting that may be one value or several as several."""
    return tuple(setting) if isinstance(setting, tuple | list) else (setting,)


def value_at(setting: SettingT | tuple[SettingT, ...], k: int) -> SettingT:
    """Return the value of a setting at iteration k; the last one given holds on."""
    values = as_tuple(setting)
    return values[min(k, len(values) - 1)]
