"""TwoStage: find every failure region, then estimate from a sample of mixtures made for them."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from samplers.method import Goal, Interrupted, Steps, offer_of
from samplers.methods.base import Method
from samplers.methods.two_stage import stages
from samplers.methods.two_stage.settings import TWO_STAGE
from samplers.methods.two_stage.stages import start_run
from samplers.methods.two_stage.terms.search import search_terms, suits_terms
from samplers.methods.two_stage.terms_alone import TermRecord, explore_terms
from samplers.problem import Inputs
from samplers.validation import check_count


@dataclass(frozen=True, kw_only=True)
class TwoStage(Method):
    """Explore, then estimate from draws that had no part in it; few simulations for any number of failure regions.

    1. *Exploration* (`exploration.py`, `regions.py`): base draws; wide draws from N(0, s^2 I), with s as
       large as the levels went deep; subset simulation from the base draws and, in the same batches, lines of descent,
       points that walk downhill each alone; chains inside the failure region from all of these. Two failing points are
       of one region if the point half way between them fails.
    2. *Refinement* (`refinement.py`): each region is described by Gaussians, by a hyperplane from
       linear regression of f where f is linear, by a corner of several where f is the greatest of linear functions,
       and by a radius.
       Three rounds of draws follow, each from a mixture of these, and up to two more while a draw is worth less than
       a tenth of a failure. The weights minimise the estimated variance (`mixture.py`), with lower limits for
       the base distribution, for tempered Gaussians (which bound weights where a Gaussian is a bad description) and
       for each region.
    3. *Estimate* (`stratified.py`): fresh draws from the last mixture, stratified by component, together with those of
       the rounds from the third on, each weighted as a draw of its own mixture.

    p-hat is unbiased, as the estimate from each mixture is given what came before it, with two exceptions. Whether
    another method takes over after the third round or later depends on draws that count. With a target c.o.v., the
    draws decide themselves when they end, which costs a bias of the order of its square (`docs/two_stage.md`).
    (Weighting all draws as if from one mixture, as adaptive multiple importance sampling does, would bias p by some
    per cent and make intervals too short.)

    All stages work in standard normal space, so that wide draws stay within the support of the parameters. A run
    yields 45 to 90 batches, half of them steps of the levels and the lines of descent. Regression of f, subset
    simulation and lines of descent use its values, everything else only its sign.

    *Noise.* f may have noise of its own that is no part of x: p is then the marginal probability. No stored outcome
    is simulated again. A noisy f is recognised by 30 points right beside failing ones. Regions are then not
    separated, and half of the draws come from tempered Gaussians: the best proposal where failure is by chance.
    Coordinates of x that the base distribution calls noise are not searched (`methods/noise_coordinates.py`).

    *Interval* (`regions.py`). Log-normal, with t quantiles where few draws carry the weight and Bernstein's
    bound where very few do; p-hat exp(q s) with s^2 = log(1 + c.o.v.^2). The upper end is at least Hall's, which
    knows the skewness of the weights, and holds the share M of p in regions that were not found:

        upper end = 97.5 % point of  p-hat exp(s Z) / (1 - M),    Z ~ N(0, 1),   M ~ Beta(1/10, nu)
        nu = distinct base draws whose line or path of levels failed + max(ESS, hits / 4) of the wide draws

    nu independent lineages all led to known regions; a region of share M would be missed by one with probability
    1 - M. The 97.5 % point of M is 0.24 for nu = 4, 0.04 for 25, 0.005 for 200. The c.o.v. is that of the sampling
    alone.

    *Warnings* (`stratified.py`): uneven weights, base draws that fail more often than p allows, rounds that
    contradict the estimate, regions that the last draws hardly reach, and a search of so few lineages that M may
    exceed 0.3; the message says what cannot be excluded in units of p. A region that neither f announces nor any draw
    has hit gives no warning; `Estimate.unseen` bounds its probability.

    *Terms.* Problems that offer terms and their gradients, in 30 dimensions or more and with 1,000 simulations or more,
    are searched by another algorithm (`terms/search.py`). Where terms are offered otherwise, all points of the
    exploration are simulated with them, and a term of which no state of the chains fails is searched alone
    (`terms_alone.py`); a remark names those that were the least somewhere and did not reach failure.

    *Other methods take over* where a tenth of the base draws fails, or no failure is found (plain Monte Carlo for the
    rest), and where no mixture describes the failures: dozens of regions, hundreds of dimensions without a direction
    that matters, failures that noise alone decides on. That is decided after each round, by what its draws are
    worth; adaptive subset simulation in all coordinates then goes on from the base draws (`stages.py`), and a remark
    says so.

    Args:
        n: Simulations where `max_sim` does not say how many; with a target c.o.v. final batches of a tenth of it
            are added until it is met.

    Example:
        A half-space in 100 dimensions, p = Phi(-3.5) = 2.33e-4:

        >>> import samplers
        >>> from samplers.limit_states import half_space
        >>> result = samplers.estimate(half_space(100).problem, samplers.TwoStage(n=2000), seed=0)
        >>> result.n_sim, f"{result.p:.1e}", result.cov < 0.05
        (2000, '2.3e-04', True)

    References:
        Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000 (defensive mixtures).
        Cappé, Douc, Guillin, Marin and Robert, "Adaptive importance sampling in general mixture classes",
        Statistics and Computing 18, 2008 (mixtures adapted in rounds).
        Hall, "On the removal of skewness by transformation", Journal of the Royal Statistical Society B 54, 1992.
        Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
        Probabilistic Engineering Mechanics 16, 2001.
    """

    n: int = 6000

    name: ClassVar[str] = "two-stage"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_count("TwoStage", "n", self.n, TWO_STAGE.min_exploration_budget)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Explore, refine, estimate."""
        return run_two_stage(inputs, goal, self.n if goal.max_sim is None else goal.max_sim, rng)


def run_two_stage(inputs: Inputs, goal: Goal, budget: int, rng: np.random.Generator) -> Steps:
    """Estimate P[f(X) <= goal.gamma] with settings that need not be the default ones."""
    offer = offer_of(inputs)
    if offer is not None and suits_terms(inputs, offer, budget):
        return (yield from search_terms(inputs, offer, goal, budget, rng))
    record = TermRecord(offered=offer is not None and offer.with_f)
    outcome = yield from _explore_and_estimate(inputs, goal, budget, rng, record)
    return replace(outcome, remarks=(*outcome.remarks, *record.unreached.describe(outcome.p)))


def _explore_and_estimate(
    inputs: Inputs, goal: Goal, budget: int, rng: np.random.Generator, record: TermRecord
) -> Steps:
    """Run all stages; `record` takes the terms of what the exploration simulates."""
    context, state = start_run(inputs, goal, budget, rng)
    if budget < TWO_STAGE.min_exploration_budget:
        least = TWO_STAGE.min_exploration_budget
        about = f"max_sim leaves {budget} simulations, too few for an exploration ({least}): base draws only."
        return (yield from stages.run_monte_carlo(context, state)).remark_first(about)
    try:
        state = yield from record.watch(stages.draw_first(context, state))
        if state.base_share(goal.gamma) >= TWO_STAGE.common_share:
            return (yield from stages.run_monte_carlo(context, state, counted=False))
        state, exploration = yield from record.watch(stages.explore(context, state))
        room, first = context.left, state.history.batches[0]
        exploration = yield from explore_terms(context.simulator, exploration, record, first, goal.gamma, room, rng)
        if not exploration.regions:
            return (yield from stages.run_monte_carlo(context, state))
        refinement, proposal = stages.begin_refinement(context, state, exploration)
        room = context.left
        number, final = 0, False
        while not final:
            number += 1
            steps = stages.refine(context, state, refinement, number, room, proposal)
            state, refinement, proposal, final = yield from steps
            if stages.gives_up(context, state, refinement, proposal, number, final=final):
                return (yield from stages.fall_back(context, state, exploration.levels))
    except Interrupted:
        return stages.estimate_early(context, state)
    outcome = yield from stages.estimate_afresh(context, state, refinement, proposal)
    if budget >= TWO_STAGE.sufficient_budget:
        return outcome
    enough = TWO_STAGE.sufficient_budget
    about = f"A search of only {budget:,} simulations may miss failure regions ({enough:,} are recommended)."
    return replace(outcome, warnings=(*outcome.warnings, about))
