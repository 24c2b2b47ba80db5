"""The cross-entropy method (O'Kelly et al. 2018, algorithm 1)."""

import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from samplers.bases import Gaussian
from samplers.distributions import GaussianBlock, MixtureBlock, NormalBlock, Product, announced_blocks
from samplers.importance import Search
from samplers.method import Goal, Steps
from samplers.methods.base import Method
from samplers.problem import FloatArray, Inputs, check_settings, is_number
from samplers.sample import Status, next_level, normalise_weights


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
    that announces its own (`base.blocks`; `Product` is one): Beta in a
    box, Normal with fixed covariance and its mean in a box, Gaussian, mixture.

    Differences between the paper, its released code and this implementation:

    - *gamma_k* >= gamma, as the text says; the algorithm box has "minimum of gamma and the quantile".
    - *Equation 3* divides by N_k, the code by N rho; we divide by the sum of the weights, so that Q_k has mass 1.
    - *Likelihood ratio.* Joint, as in equation 2; the code's, by block, is likelihood_ratio="block" (less variance).
    - *Projection.* The code has the covariance where its inverse belongs, and a Beta box of [0.5, 5], not [1.5, 7].
    - *Family.* One Gaussian, its covariance drawn towards the present one, covers curved regions better than products.
    - *End.* When two proposals have reached gamma; the paper's K = 100 iterations: early_end=False.
    - *Choice.* The lowest rho-quantile is choice="quantile"; ours does not count quantiles below gamma, as an ever
      lower one favours one mode, and takes the smallest c.o.v. among equals.
    - *Ties.* gamma_k is an outcome that occurred; if most outcomes tie, the largest below.
    - *Weights.* The paper samples from the proposal alone, whose weights are unbounded.

    The paper's settings: CrossEntropy(family="blocks", rho=0.01, alpha=0.8, n_iteration=5000,
    max_iterations=100, early_end=False, choice="quantile", n_final=100_000, wide_share=0).

    In some hundred dimensions a covariance cannot be learned from a thousand draws and the
    weights degenerate: the result then carries warnings and a very wide interval. The mean of a
    Normal of d dimensions is learned from m effective elite points up to a shift of about
    sqrt(d / m) standard deviations, which is what a small radius guards against.

    The interval is log-normal; if the base draws already fail with a share of rho or more,
    plain Monte Carlo draws and Clopper-Pearson take over. A run that is stopped before its final
    draws gives the estimate of the base draws and the last proposal's, taken as one sample.

    Args:
        family: "gaussian", "mean", "mixture" or "blocks", see above.
        components: Gaussians of the family "mixture" at most.
        likelihood_ratio: "joint" (equation 3) or "block" (as in the released code).
        rho: Elite fraction. (The paper has 0.01 with N_k = 5000.)
        alpha: Step size alpha_k in (0, 1].
        n_iteration: Draws per iteration, N_k; at most a tenth of max_sim.
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
    alpha: float = 0.8
    n_iteration: int = 1000
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
            n_iteration=10,
            alpha=(0.0, math.nextafter(1.0, 2.0)),
            rho=(0.0, 0.5),
            base_share=(0.0, 1.0),
            wide_factor=(1.0, math.inf),
        )
        if not (is_number(self.wide_share) and self.wide_share == 0):
            check_settings(self, wide_share=(0.0, 1.0 - self.base_share))

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Search for a proposal, then estimate with fresh draws."""
        base = self._start(inputs)
        search = Search(inputs, goal, rng, base, np.asarray if self.family == "blocks" else None)
        proposals, quantiles = yield from self._search(search, base)
        firsts = quantiles if self.choice == "quantile" else [level.gamma for level in search.trace]
        ranks = [(first, level.cov) for first, level in zip(firsts, search.trace, strict=True)]
        best = ranks.index(min(ranks)) if ranks else 0
        reached = bool(ranks) and search.trace[best].gamma == goal.gamma
        found = proposals[best] if len(proposals) > 1 else None  # base draws fail often enough, or there is no way on
        sampler = search.mix(found, self.base_share, self.wide_share, self.wide_factor)
        return (yield from search.finish(sampler, self.n_final, [] if reached else search.warnings()))

    def _start(self, inputs: Inputs) -> Product:
        """Return the base distribution by blocks, theta_0, in the space that the search works in."""
        if self.family == "blocks":
            return announced_blocks(inputs)
        gaussian = Gaussian.standard(inputs.dim)
        if self.family == "mixture":
            return Product((MixtureBlock(gaussian, self.components),))
        return Product((GaussianBlock(gaussian) if self.family == "gaussian" else NormalBlock(gaussian),))

    def _search(
        self, search: Search, base: Product
    ) -> Generator[FloatArray, FloatArray, tuple[list[Product], list[float]]]:
        """Run algorithm 1; return the proposals drawn from and the rho-quantile of f under each."""
        proposals, quantiles, gamma, n_reached = [base], list[float](), search.goal.gamma, 0
        while last := (yield from search.draw(proposals[-1], self.n_iteration, self.max_iterations)):
            del search.rounds[1:-1]  # `Search.pool_rounds` takes the first and the last one
            level = next_level(last.f, self.rho, gamma)
            lowest = float(last.f.min()) if level is None else level
            elite = last.u[last.f <= lowest]
            log_ratios = base.log_probs(elite) - proposals[-1].log_probs(elite)
            rank = int(np.ceil(self.rho * len(last.f))) - 1
            quantiles.append(float(np.partition(last.f, rank)[rank]))
            search.record(lowest, log_ratios.sum(axis=0))
            if level is None:
                break
            first, n_reached = len(quantiles) == 1, n_reached + (level == gamma)
            if n_reached == 2 - first and (self.early_end or first):
                search.status = Status.CONVERGED
                break
            proposals.append(self._project(proposals[-1], elite, log_ratios))
        else:
            if search.status is Status.STALLED and search.trace[-1].gamma == gamma:
                search.status = Status.CONVERGED
        return proposals[: len(quantiles)], quantiles

    def _project(self, proposal: Product, elite: FloatArray, log_ratios: FloatArray) -> Product:
        """Return the proposal after one step of equation 2 towards the elite points."""
        if self.likelihood_ratio == "joint":
            log_ratios = np.broadcast_to(log_ratios.sum(axis=0), log_ratios.shape)
        return proposal.project(elite, np.stack([normalise_weights(ratios) for ratios in log_ratios]), self.alpha)
