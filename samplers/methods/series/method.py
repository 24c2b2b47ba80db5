"""Series: failures of a least over terms, by walks along their gradients."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from samplers.method import Goal, Steps, offer_of
from samplers.methods.base import Method
from samplers.methods.series.search import search_terms
from samplers.methods.series.settings import ROUNDS
from samplers.problem import Inputs, check_settings


@dataclass(frozen=True, kw_only=True)
class Series(Method):
    """Search by terms: series systems in tens to thousands of dimensions whose terms have gradients.

    f is the least of terms (which car is hit, ahead or behind), and each term's failures are nearly a half-space. In
    standard normal space:

    1. *Walks* lead from low base draws of every term that matters down its gradient to its failures.
    2. *Rounds.* Term j is drawn from Gaussians q_j in the subspace V_j of its gradients and N(0, I) across it, fitted
       after every round to all draws so far. The weight of a draw is exact:

           phi / q = 1 / (a_0 + (1 - a_0) sum_j pi_j q_j(V_j' u) / phi_r(V_j' u))

    3. *Estimate.* p = sum_r c_r mean(w_r 1{f <= gamma}) over three final rounds whose shares c_r are fixed beforehand.

    Each p_r is unbiased given what came before it: wrong terms or gradients cost accuracy, not truth. Failures of terms
    without a proposal of their own that carry more than 5 % of p give a warning. Where a tenth of the base draws fails,
    plain Monte Carlo takes over, and where no proposal describes the failures, adaptive subset simulation in the order
    of the terms; a remark says so. Gradients count as simulations at what they cost. Other problems, and coordinates
    that are noise, are those of `TwoStage`; noise is searched here like the rest of x.

    Args:
        n: Simulations where `max_sim` does not say how many; with a target c.o.v. final batches are added until it is
            met.

    Example:
        Two half-spaces in 100 dimensions, p = 1 - (1 - Phi(-3.5))^2 = 4.65e-4:

        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(
        ...     dim=100,
        ...     terms=lambda x: 3.5 - x[:, :2],
        ...     gradient=lambda x, term: -np.eye(100)[term],
        ... )
        >>> result = samplers.estimate(problem, samplers.Series(n=2000), seed=0)
        >>> result.n_sim, f"{result.p:.1e}", result.cov < 0.05
        (2000, '4.7e-04', True)

    References:
        Cappé, Douc, Guillin, Marin and Robert, "Adaptive importance sampling in general mixture classes", Statistics
        and Computing 18, 2008 (mixtures adapted in rounds).
        Uribe, Papaioannou, Marzouk and Straub, "Cross-entropy-based importance sampling with failure-informed dimension
        reduction for rare event simulation", SIAM/ASA Journal on Uncertainty Quantification 9, 2021 (subspaces of
        gradients).
        Veach and Guibas, "Optimally combining sampling techniques for Monte Carlo rendering", SIGGRAPH 1995 (balance
        heuristic).
    """

    n: int = 6000

    name: ClassVar[str] = "series"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, n=ROUNDS.min_budget)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Walk, draw and refit, estimate; a ValueError where the problem offers no terms with gradients."""
        offer = offer_of(inputs)
        if offer is None or offer.gradient_cost is None:
            raise ValueError(
                "Series needs a problem with `terms` and `gradient` (see `samplers.Problem`); 'auto' does not."
            )
        return search_terms(inputs, offer, goal, self.n if goal.max_sim is None else goal.max_sim, rng)
