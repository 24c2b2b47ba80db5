"""Subset simulation (Au and Beck 2001) and adaptive subset simulation (Tian et al. 2024)."""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal, Protocol

import numpy as np

from samplers.importance import COARSE_ESS
from samplers.mcmc import Chains, Kernel, NextLevel, RootedPoints, descend, independent_chains, judge_levels
from samplers.method import Goal, Outcome, Steps, no_outcome_share
from samplers.methods.base import Method
from samplers.problem import Inputs, check_settings
from samplers.sample import Layer, Level, Sample, Status, clopper_pearson, next_level

FEWEST_LEVELS = 2
"""Levels to plan the rest of a budget for at least."""


class SubsetMethod(Method, Protocol):
    """What both kinds of subset simulation share: the levels, given a kernel; a subclass has these settings."""

    n: int
    p0: float
    max_levels: int
    stops_at_target: ClassVar[bool] = False

    def _descend(
        self, inputs: Inputs, goal: Goal, rng: np.random.Generator, kernel: Kernel, known: RootedPoints | None = None
    ) -> Steps:
        """Go from level to level until the share of failures among its points is p0 or more."""
        u, f = (np.empty((0, inputs.dim)), np.empty(0)) if known is None else (known.u, known.f)
        budget, gamma = goal.budget + len(f), goal.gamma
        fitting = int(budget / (1 + 3 * (1 - self.p0)))  # four levels, to p0^4; seeds are not simulated again
        n = min(self.n, max(math.ceil(10 / self.p0), fitting))  # at least ten seeds
        new = rng.standard_normal((max(min(n, budget), len(f)) - len(f), inputs.dim))
        if len(new):
            outcomes = yield inputs.base.from_standard_normal(new)
            u, f = np.concatenate([u, new]), np.concatenate([f, outcomes])
        first = independent_chains(u, f)._replace(n_new=len(new))
        plan = partial(self._plan_next, n, gamma, goal.budget - len(new))
        found = yield from descend(inputs, first, kernel, plan, gamma, rng, goal.on_level)
        outcome = summarise(inputs, [level.chains for level in found.levels], goal, found.trace, found.status)
        if budget < n:
            about = f"max_sim leaves {budget} of the {n} simulations that level 0 needs at least: plain draws only."
            return outcome.remark_first(about)
        few = f"max_sim leaves {budget} simulations: {n} points per level, not {self.n}."
        return outcome.remark_first(few) if n < self.n / 2 else outcome

    def _plan_next(
        self, n: int, gamma: float, budget: int, chains: Chains, depth: int, n_sim: int, rng: np.random.Generator
    ) -> NextLevel | Status:
        """Return the next level, of n points, or how the run ends: converged once p0 of the present points fail.

        Its seeds are all points below the threshold, as the estimate of the error needs them.
        """
        left = budget - n_sim
        threshold = next_level(chains.f[chains.used], self.p0, gamma)
        if threshold == gamma:
            return Status.CONVERGED
        if left == 0 and chains.f.size < n:
            return Status.BUDGET  # too few points of level 0 to speak of ties
        if threshold is None or depth + 1 >= self.max_levels:
            return Status.STALLED
        seeds = chains.where(chains.f <= threshold)
        n_seeds = len(seeds.f)
        if left < n_seeds:
            return Status.BUDGET  # not one step for every chain
        longest = max(50, math.ceil(1 / self.p0))  # more steps from a handful of seeds add little
        total = max(min(n, n_seeds + left, n_seeds * longest), n_seeds)
        lengths = total // n_seeds + (rng.permutation(n_seeds) < total % n_seeds)  # equal, or differing by 1 at random
        return NextLevel(threshold, seeds, np.asarray(lengths, dtype=np.int64))


def summarise(inputs: Inputs, levels: list[Chains], goal: Goal, trace: list[Level], status: Status) -> Outcome:
    """Return the outcome of all levels, of the last of which `trace` counts f <= gamma.

    The upper limit is at most that of the base draws of level 0 alone.
    """
    hits, p = levels[-1].where(levels[-1].f <= goal.gamma).f, trace[-1].estimate
    cov, (low, high) = judge_levels(levels[-1], goal, trace)
    of_base = len(levels[0].where(levels[0].f <= goal.gamma).f)
    most = clopper_pearson(of_base, trace[0].n_points, goal.confidence)[1]
    about = _describe_end(len(trace) - 1, status, len(hits))
    chains = [
        f"Acceptance {level.acceptance:.2f} at level {k} is outside [0.15, 0.85]: the chains explore badly."
        for k, level in enumerate(trace)
        if level.acceptance is not None and not 0.15 <= level.acceptance <= 0.85  # they hardly move, or by short steps
    ]
    enough = status is Status.BUDGET and len(hits) >= COARSE_ESS  # the interval says what fewer levels leave open
    return Outcome(
        p=p,
        interval=(low, max(p, min(high, most))),
        cov=cov,
        status=status if len(hits) or status is Status.STOPPED else Status.NO_HITS,
        warnings=(*(() if enough else about), *chains),
        remarks=tuple(about) if enough else (),
        trace=tuple(trace),
        no_outcome_share=no_outcome_share(hits),
        base_draws=trace[0].n_points,
        sample=weighted_points(inputs, levels, trace, goal.gamma),
    )


def weighted_points(inputs: Inputs, levels: list[Chains], trace: list[Level], gamma: float) -> Sample:
    """Return the points of all levels: of level j those above the next threshold, with weight P_j / N_j."""
    reached = np.cumprod([1.0, *(record.p for record in trace[:-1])])
    weights = reached / [record.n_points for record in trace]
    thresholds = [math.inf, *(record.gamma for record in trace[:-1]), -math.inf]
    points = [chains.where(chains.used) for chains in levels]
    layers = tuple(
        Layer(f=of.f, weights=np.full(len(of.f), weight), units=of.roots, low=low, high=high)
        for of, weight, high, low in zip(points, weights, thresholds, thresholds[1:], strict=False)
    )
    kept = [(layer, (layer.f > layer.low) | (layer.low == -math.inf)) for layer in layers]
    last = points[-1]  # every point with f <= gamma is one of these
    return Sample(
        f=np.concatenate([layer.f[above] for layer, above in kept]),
        weights=np.concatenate([layer.weights[above] for layer, above in kept]),
        units=np.concatenate([layer.units[above] for layer, above in kept]),
        n_units=trace[0].n_points,
        x=inputs.base.from_standard_normal(last.u[last.f <= gamma]),
        layers=layers,
    )


def _describe_end(depth: int, status: Status, hits: int) -> list[str]:
    """Return what the end of the run at level `depth` and its failures may leave doubtful."""
    failing = f"{hits} failing point{'' if hits == 1 else 's'}"
    about = {
        Status.STALLED: f"No progress beyond level {depth}: f is constant there, or the limit on levels was reached.",
        Status.BUDGET: f"max_sim was used up at level {depth}; p rests on {failing}.",
        Status.STOPPED: f"Stopped at level {depth}; p rests on {failing}.",
    }
    found = [about[status]] if status in about else []
    if hits == 0:
        found.append("No failure was seen: p = 0 with a one-sided interval.")
    return found


@dataclass(frozen=True, kw_only=True)
class SubsetSimulation(SubsetMethod):
    """Subset simulation with the component-wise modified Metropolis algorithm; "SS" of Tian et al.

    P[f <= gamma] is the product of conditional probabilities P[F_j | F_(j-1)] of nested level
    sets F_j = {f <= b_j}. Level 0 is plain Monte Carlo; from level 1 on, every point inside F_j
    starts a Markov chain that stays in F_j. A move proposes a symmetric step of every component,
    keeps each with probability min(1, phi(new) / phi(old)), and is taken if it ends in F_j. Works
    in standard normal space.

    Differences between the paper and this implementation:

    - *Chains* move together, one step per call of f, so that f gets about p0 N rows per call.
    - *A candidate equal to its point* (every third or so in one dimension) is not simulated again.
    - *Ties.* Thresholds are outcomes that occurred, with their true share; the paper books p0 for all but the last.
    - *c.o.v.* The larger of the paper's (equations 25 to 29), which takes the levels as independent,
      and the one from the descent of the failing points, which does not.

    The interval is log-normal with the t quantile of the independent paths that reach the failures, or Clopper-Pearson
    where level 0 already answers. p-hat has a bias of order 1/N. A small max_sim is dealt with as in
    `AdaptiveSubsetSimulation`.

    Args:
        n: Points per level, N. (Tian et al. have 500.)
        p0: Wanted conditional probability of each level.
        distribution: Distribution of a component's steps: "uniform" as Au and Beck, "normal" as Tian et al.
        spread: Half-width of the uniform, standard deviation of the normal distribution.
        max_levels: Levels after which the method gives up.

    References:
        Au and Beck, "Estimation of small failure probabilities in high dimensions by subset
        simulation", Probabilistic Engineering Mechanics 16, 2001.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda u: 3.5 - u.sum(axis=1) / 10**0.5, dim=10)  # P = 2.33e-4
        >>> result = samplers.estimate(problem, samplers.SubsetSimulation(n=500), seed=0)
        >>> result.interval[0] < 2.326e-4 < result.interval[1], len(result.trace), result.n_sim < 2000
        (True, 4, True)
    """

    n: int = 1000
    p0: float = 0.1
    distribution: Literal["uniform", "normal"] = "uniform"
    spread: float = 1.0
    max_levels: int = 30

    name: ClassVar[str] = "ss"

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, n=10, max_levels=1, p0=(0.0, 0.5))
        check_settings(self, distribution=("uniform", "normal"), spread=(0.0, math.inf))

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Go from level to level until the share of failures among its points is p0 or more."""
        return self._descend(inputs, goal, rng, Kernel(self.distribution, self.spread))


@dataclass(frozen=True, kw_only=True)
class AdaptiveSubsetSimulation(SubsetMethod):
    """Subset simulation whose step adapts to the acceptance rate.

    P[f <= gamma] is the product of conditional probabilities P[F_j | F_(j-1)] of nested level
    sets F_j = {f <= b_j} (Tian et al., equations 4 to 6). Level 0 is plain Monte Carlo; from
    level 1 on, every point inside F_j starts a Markov chain that stays in F_j. Works in standard
    normal space.

    Differences between the paper, its released code and this implementation:

    - *Proposal.* "conditional" is the code's, u' = rho u + sigma xi, which needs no ratio; the paper prints a ratio
      with it, phi(new) / phi(old) per component, which makes the invariant distribution N(0, 1/2). "metropolis" is that
      ratio with the symmetric step that it is right for; a level of it is worth 3 to 22 % fewer independent points.
    - *Adaptation.* After each step of all chains together, by the rule of equation 16, and carried to the next level;
      paper and code adapt after every 10 whole chains and start again at each level.
    - *sigma0.* 1 ("unit") as in the code; "seeds" are the paper's deviations (equations 17, 18), which depend on the
      very points that are moved: a bias of -12 % on a hypersphere with d = 20, against +4 % with 1.
    - *Seeds* keep their outcome; the code simulates them again, p0 N calls per level and a bias where f is noisy.
    - *End.* No level is simulated once p0 N points have f <= gamma; the code runs one more.
    - *Ties.* Thresholds are outcomes that occurred, with their true share; the code interpolates and books p0.
    - *c.o.v.* By Au and Beck with chains kept apart; the code mixes them, and its "Cov" is the square of a c.o.v.

    The c.o.v. is the larger of two: Au and Beck's, which takes the levels as independent, and the
    one from the descent of the failing points, which does not. The interval is
    log-normal with the t quantile of the independent paths that reach the failures,
    or Clopper-Pearson where level 0 already answers. p-hat has a bias of order
    1/N (+1 to +4 % at N = 1000 and p = 2e-4).

    Where max_sim does not hold four levels of n points (3.7 n with p0 = 0.1), N is what lets them
    fit, but at least 10 / p0; a warning says so where that is less than half of n. With a smaller
    max_sim there is level 0 only.

    Args:
        n: Points per level, N. (The paper has 500.)
        p0: Wanted conditional probability of each level.
        proposal: "conditional" as in the released code or "metropolis" as printed, see above.
        sigma0: Proposal standard deviations before scaling: 1, or those of the seeds.
        scale: First value of the scale lambda.
        target_acceptance: Acceptance rate that the scale is steered to, a*.
        max_levels: Levels after which the method gives up.

    References:
        Tian, Fu, Zhang, Tang and Sun, "Accelerated verification of autonomous driving systems
        based on adaptive subset simulation", IEEE Transactions on Intelligent Vehicles, 2024.
        Papaioannou, Betz, Zwirglmaier and Straub, "MCMC algorithms for subset simulation",
        Probabilistic Engineering Mechanics 41, 2015.
        Lee and Whiteley, "Variance estimation in the particle filter", Biometrika 105, 2018.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda u: 3.5 - u.sum(axis=1) / 10**0.5, dim=10)  # P = 2.33e-4
        >>> result = samplers.estimate(problem, samplers.AdaptiveSubsetSimulation(), seed=0)
        >>> result.interval[0] < 2.326e-4 < result.interval[1], result.n_sim
        (True, 3700)
        >>> [f"{level.gamma:.2f}" for level in result.trace]  # thresholds b_1, b_2, ... down to gamma
        ['2.17', '1.15', '0.34', '0.00']
    """

    n: int = 1000
    p0: float = 0.1
    proposal: Literal["conditional", "metropolis"] = "conditional"
    sigma0: Literal["unit", "seeds"] = "unit"
    scale: float = 0.6
    target_acceptance: float = 0.44
    max_levels: int = 30

    name: ClassVar[str] = "adss"

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, n=10, max_levels=1, p0=(0.0, 0.5), scale=(0.0, math.inf), target_acceptance=(0.0, 1.0))
        check_settings(self, proposal=("conditional", "metropolis"), sigma0=("unit", "seeds"))

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator, known: RootedPoints | None = None) -> Steps:
        """Go from level to level until the share of failures among its points is p0 or more.

        Level 0 begins with base draws whose outcomes are known, at most n.
        """
        proposal: Literal["conditional", "normal"] = "conditional" if self.proposal == "conditional" else "normal"
        kernel = Kernel(proposal, self.scale, self.target_acceptance, by_seeds=self.sigma0 == "seeds")
        return self._descend(inputs, goal, rng, kernel, known)


def spend_on_subset_simulation(
    inputs: Inputs, goal: Goal, levels: int, budget: int, known: RootedPoints | None, rng: np.random.Generator
) -> Steps:
    """Run adaptive subset simulation with the points per level that a budget or a target c.o.v. asks for."""
    levels, n_known = max(levels, FEWEST_LEVELS), 0 if known is None else len(known.f)
    n = int((budget + n_known) / (1 + 0.9 * (levels + 0.5)))  # seeds, a tenth, are not simulated again
    if goal.target_cov is not None:  # a point is worth 1 / 30: p0 / (1 - p0), and correlation along the chains
        n = min(n, math.ceil(30 * (levels + 1) / goal.target_cov**2))
    n = max(n, 10)
    known = known and known.select(np.arange(min(n, n_known)))
    outcome = yield from AdaptiveSubsetSimulation(n=n).steps(inputs, replace(goal, max_sim=budget), rng, known)
    about = (
        "No proposal describes the failures: p is from adaptive subset simulation with the remaining "
        f"{budget:,} simulations; run by itself (--method adss) it uses all of them."
    )
    counted_before = 0 if known is None else len(known.f)
    return replace(outcome.remark_first(about), base_draws=outcome.base_draws - counted_before)
