"""Adaptive subset simulation (Tian et al. 2024)."""

import math
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.intervals import (
    binomial_cov,
    clopper_pearson,
    correlation_factor,
    log_normal,
)
from samplers.kernels import accepted_step, adapted_scale, conditional_proposal, proposal_sigma
from samplers.levels import next_level
from samplers.method import (
    Goal,
    Interrupted,
    Outcome,
    Steps,
    check_choice,
    check_count,
    check_setting,
    no_outcome_share,
)
from samplers.problem import FloatArray, Inputs
from samplers.result import Level, Status

ACCEPTANCE_RANGE = (0.15, 0.85)
LONGEST_CHAIN = 50
"""More steps than this from a handful of seeds cost calls of f and add little."""
FEW_CHAINS = 20
LARGE_COV = 0.5
FEWEST_SEEDS = 10
"""A level is not made smaller for the sake of the budget than this many seeds allow."""
USUAL_LEVELS = 4
"""Levels that shall fit into a small budget: down to p = p0^4, 1e-4."""


class Chains(NamedTuple):
    """Points of one level, chain by chain. Level 0 is N chains of length 1."""

    u: FloatArray
    """Shape (chains, steps, d); row i is chain i in time order, its seed first."""
    f: FloatArray
    """Shape (chains, steps)."""
    lengths: NDArray[np.int64]
    """Steps of each chain that are used, seed included, shape (chains,)."""
    roots: NDArray[np.int64]
    """Point of level 0 from which each chain descends, shape (chains,)."""
    n_new: int
    """Simulations made for this level."""
    acceptance: float | None
    """Share of accepted moves."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """Mask of the used entries, shape (chains, steps)."""
        return np.arange(self.f.shape[1]) < self.lengths[:, None]


class Seeds(NamedTuple):
    """Points from which the chains of a level start."""

    u: FloatArray
    """Shape (n, d)."""
    f: FloatArray
    """Their stored outcomes, shape (n,)."""
    roots: NDArray[np.int64]
    """Points of level 0 from which they descend, shape (n,)."""


class Passed(NamedTuple):
    """What the levels passed so far say."""

    p: float = 1.0
    """Probability of the last level reached."""
    cov: float = 0.0
    """Its coefficient of variation."""


@dataclass(frozen=True, kw_only=True)
class AdaptiveSubsetSimulation:
    """Subset simulation with conditional sampling whose step adapts to the acceptance rate.

    P[f <= gamma] is the product of conditional probabilities P[F_j | F_(j-1)] of nested level
    sets F_j = {f <= b_j} (Tian et al., equations 4 to 6). Level 0 is plain Monte Carlo; from
    level 1 on, every point inside F_j starts a Markov chain that stays in F_j. Works in standard
    normal space.

    Where the paper, its released code and this implementation differ:

    - *Proposal.* The paper prints a Metropolis ratio per component (equations 19, 20) under a
      conditional (AR-1) proposal; the code draws the AR-1 proposal and needs no ratio. Ours
      does as the code, which is exact.
    - *Adaptation.* Paper and code run N_a = 10 chains to their end, then adapt the scale for the
      next 10. Ours moves all chains together, one step per call of f, and adapts after each step
      with the same rule (equation 16), so that f gets about p0 N rows per call and a level takes
      about 1/p0 - 1 calls. The scale is carried to the next level; paper and code start again.
    - *sigma0.* 1 ("unit") as the code has hard-selected it; the paper's seed standard deviations
      (equations 17, 18) are "seeds" (the code's version of them averages over the wrong axis).
      They depend on the very points that are moved, which biases p where d is large: -12 % on a
      hypersphere with d = 20, against +4 % with 1.
    - *Seeds* keep their stored outcome; the code simulates them again, which costs p0 N calls
      per level and biases p when f is noisy.
    - *End.* No level is simulated once p0 N points have f <= gamma; the code runs one more.
    - *Ties.* Thresholds are outcomes that occurred, with their true share (`next_level`); the
      code takes an interpolated percentile and books p0 whatever the share.
    - *c.o.v.* Au and Beck's chain correlation, chains kept apart; the code mixes the chains. The
      released "Cov" column is the square of a c.o.v.

    The c.o.v. is the larger of two: Au and Beck's, which takes the levels as independent, and the
    one from the descent of the failing points (`descent_cov`), which does not. The interval is
    log-normal, or Clopper-Pearson where level 0 already answers. p-hat has a bias of order 1/N
    (+1 to +4 % at N = 1000 and p = 2e-4).

    Where max_sim does not hold four levels of n points (3.7 n with p0 = 0.1), N is what lets them
    fit, but at least 10 / p0; a warning says so where that is less than half of n. With a smaller
    max_sim there is level 0 only.

    Args:
        n: Points per level, N. (The paper has 500.)
        p0: Wanted conditional probability of each level.
        sigma0: Proposal standard deviations before scaling: 1, or those of the seeds.
        scale: First value of the scale lambda.
        target_acceptance: Acceptance rate that the scale is steered to, a*.
        max_levels: Levels after which the method gives up.

    References:
        Tian, Fu, Zhang, Tang and Sun, "Accelerated verification of autonomous driving systems
        based on adaptive subset simulation", IEEE Transactions on Intelligent Vehicles, 2024.
        Lee and Whiteley, "Variance estimation in the particle filter", Biometrika 105, 2018.
    """

    n: int = 1000
    p0: float = 0.1
    sigma0: Literal["unit", "seeds"] = "unit"
    scale: float = 0.6
    target_acceptance: float = 0.44
    max_levels: int = 30

    name: ClassVar[str] = "adss"
    stops_at_target: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check the settings."""
        who = "AdaptiveSubsetSimulation"
        check_count(who, "n", self.n, 10)
        check_count(who, "max_levels", self.max_levels, 1)
        check_setting(who, "p0", self.p0, 0.0, 0.5)
        check_setting(who, "scale", self.scale, 0.0, math.inf)
        check_setting(who, "target_acceptance", self.target_acceptance, 0.0, 1.0)
        check_choice(who, "sigma0", self.sigma0, ("unit", "seeds"))

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Go from level to level until the share of failures among its points is p0 or more."""
        fitted = replace(self, n=self._points(goal.budget))
        outcome = yield from fitted._descend(inputs, goal, rng)
        return replace(outcome, warnings=(*self._about_budget(fitted.n, goal.budget), *outcome.warnings))

    def _points(self, budget: int) -> int:
        """Return the points per level: fewer than n where the budget does not hold the usual levels."""
        fitting = int(budget / (1 + (USUAL_LEVELS - 1) * (1 - self.p0)))  # seeds are not simulated again
        return min(self.n, max(math.ceil(FEWEST_SEEDS / self.p0), fitting))

    def _about_budget(self, n: int, budget: int) -> list[str]:
        """Return the warning about a budget that is too small for n points per level."""
        if budget < n:
            return [f"max_sim leaves {budget} of the {n} simulations that level 0 needs at least: plain draws only."]
        coarse = n < self.n / 2
        return [f"max_sim leaves {budget} simulations: {n} points per level, not {self.n}."] if coarse else []

    def _descend(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Run with n points per level, as far as the budget goes."""
        chains = yield from first_level(inputs, min(self.n, goal.budget), rng)
        left = goal.budget - chains.n_new
        passed, scale, trace = Passed(), self.scale, list[Level]()
        while True:
            level = next_level(chains.f[chains.used], self.p0, goal.gamma)
            stop = self._reason_to_stop(chains, level, goal.gamma, left, len(trace))
            threshold = goal.gamma if stop is not None or level is None else level
            trace.append(described(chains, threshold, passed))
            goal.on_level(trace[-1])
            if stop is not None:
                return finish(chains, goal, passed, trace, stop)
            passed = after(passed, trace[-1])
            chains, scale = yield from self._next(inputs, chains, threshold, scale, left, rng)
            left -= chains.n_new

    def _reason_to_stop(
        self, chains: Chains, level: float | None, gamma: float, left: int, depth: int
    ) -> Status | None:
        """Return how the run ends with these chains, or None if it goes on to `level`."""
        if level == gamma:
            return Status.CONVERGED
        if left == 0 and chains.f.size < self.n:
            return Status.BUDGET  # too few points of level 0 to speak of ties
        if level is None or depth + 1 >= self.max_levels:
            return Status.STALLED
        n_seeds = int(np.count_nonzero(chains.f[chains.used] <= level))
        return Status.BUDGET if left < n_seeds else None  # not one step for every chain

    def _next(
        self,
        inputs: Inputs,
        chains: Chains,
        level: float,
        scale: float,
        left: int,
        rng: np.random.Generator,
    ) -> Generator[FloatArray, FloatArray, tuple[Chains, float]]:
        """Simulate the points of the next level; return them and the adapted scale."""
        seeds = inside(chains, level)
        n = len(seeds.f)
        longest = max(LONGEST_CHAIN, math.ceil(1 / self.p0))
        total = max(min(self.n, n + left, n * longest), n)
        return (yield from self._grow(inputs, seeds, level, total, scale, rng))

    def _grow(
        self,
        inputs: Inputs,
        seeds: Seeds,
        level: float,
        total: int,
        scale: float,
        rng: np.random.Generator,
    ) -> Generator[FloatArray, FloatArray, tuple[Chains, float]]:
        """Grow a chain from every seed until there are `total` points; all chains move together.

        Where total is no multiple of the number of seeds, randomly chosen chains get one step
        more. Returns the chains and the scale after the last step.
        """
        n = len(seeds.f)
        lengths = total // n + (rng.permutation(n) < total % n)
        u = np.zeros((n, int(lengths.max()), inputs.dim))
        f = np.full(u.shape[:2], np.inf)
        u[:, 0], f[:, 0] = seeds.u, seeds.f
        sigma0 = np.ones(inputs.dim) if self.sigma0 == "unit" else deviations(seeds.u)
        moved = 0
        for t in range(1, f.shape[1]):
            on = lengths > t
            sigma = proposal_sigma(scale, sigma0)
            proposal = conditional_proposal(u[on, t - 1], sigma, rng)
            f_proposal = yield inputs.base.from_standard_normal(proposal)
            step = accepted_step(u[on, t - 1], f[on, t - 1], proposal, f_proposal, level)
            u[on, t], f[on, t] = step.u, step.f
            moved += int(step.accepted.sum())
            scale = adapted_scale(
                scale,
                float(step.accepted.mean()),
                t,
                self.target_acceptance,
                1 / float(sigma0.min()),
            )
        new = total - n
        return Chains(u, f, lengths, seeds.roots, new, moved / new if new else None), scale


def first_level(inputs: Inputs, n: int, rng: np.random.Generator) -> Generator[FloatArray, FloatArray, Chains]:
    """Draw the n independent points of level 0."""
    u = rng.standard_normal((n, inputs.dim))
    f = yield inputs.base.from_standard_normal(u)
    return Chains(u[:, None], f[:, None], np.ones(n, dtype=np.int64), np.arange(n), n, None)


def inside(chains: Chains, level: float) -> Seeds:
    """Return the points with f <= level: true number, outcomes as stored, repeats included."""
    chain, step = np.nonzero(chains.used & (chains.f <= level))
    return Seeds(chains.u[chain, step], chains.f[chain, step], chains.roots[chain])


def deviations(u: FloatArray) -> FloatArray:
    """Return the standard deviation of points u (n, d) in each dimension; 1 where it is 0."""
    spread = u.std(axis=0, ddof=1) if len(u) > 1 else np.zeros(u.shape[1])
    return np.where(spread > 0, spread, 1.0)


def described(chains: Chains, threshold: float, passed: Passed) -> Level:
    """Return the record of a level: the true share of its points with f <= threshold."""
    below = chains.used & (chains.f <= threshold)
    total = int(chains.lengths.sum())
    share = int(below.sum()) / total
    effective = total / (1 + correlation_factor(below, chains.lengths))
    return Level(
        gamma=threshold,
        p=share,
        estimate=passed.p * share,
        n_sim=chains.n_new,
        n_points=total,
        cov=binomial_cov(share, effective),
        acceptance=chains.acceptance,
        ess=effective,
    )


def after(passed: Passed, level: Level) -> Passed:
    """Return the product with one more level, taken as independent of the others."""
    square = (1 + passed.cov**2) * (1 + level.cov**2) - 1
    return Passed(p=passed.p * level.p, cov=math.sqrt(square))


def finish(chains: Chains, goal: Goal, passed: Passed, trace: list[Level], status: Status) -> Outcome:
    """Return the outcome: the last of `trace` counted f <= gamma."""
    p = passed.p * trace[-1].p
    _, hits, roots = inside(chains, goal.gamma)
    cov = max(after(passed, trace[-1]).cov, descent_cov(roots, trace[0].n_points))
    if len(trace) == 1:
        interval = clopper_pearson(len(hits), trace[0].n_points, goal.confidence)
    elif len(hits) == 0:
        # No hit in correlated points: bound the last share as if each chain were one point.
        upper = clopper_pearson(0, len(chains.lengths), goal.confidence)[1]
        interval = 0.0, log_normal(passed.p, passed.cov, goal.confidence)[1] * upper
    else:
        interval = log_normal(p, cov, goal.confidence)
    return Outcome(
        p=p,
        interval=interval,
        cov=cov,
        status=status if len(hits) else Status.NO_HITS,
        warnings=tuple(_warnings(trace, status, len(hits), cov)),
        trace=tuple(trace),
        no_outcome_share=no_outcome_share(hits),
    )


def descent_cov(roots: NDArray[np.int64], n: int) -> float:
    """Return the c.o.v. of p-hat that the descent of the failing points shows.

    With h_i failing points descending from point i of n at level 0, p-hat is proportional to the
    mean of the h_i. Were the thresholds fixed, these would be independent, so
    c.o.v.^2 = sum h_i^2 / (sum h_i)^2 - 1/n. Unlike the product over levels this holds the
    correlation between levels: a lucky point at level 0 is lucky at all.

    Args:
        roots: For each failing point the point of level 0 from which it descends, shape (k,).
        n: Points of level 0.
    """
    if roots.size == 0:
        return math.inf
    h = np.bincount(roots).astype(np.float64)
    return math.sqrt(max(float((h * h).sum()) / float(h.sum()) ** 2 - 1 / n, 0.0))


def _warnings(trace: list[Level], status: Status, hits: int, cov: float) -> list[str]:
    found = []
    depth = len(trace) - 1
    if status is Status.STALLED:
        found.append(f"No progress beyond level {depth}: f ties there or the number of levels is used up.")
    if status is Status.BUDGET:
        found.append(f"max_sim was used up at level {depth}; p rests on {hits} failing points.")
    if hits == 0:
        found.append("No failure was seen: p = 0 with a one-sided interval.")
    elif cov > LARGE_COV:
        found.append(f"The c.o.v. is {cov:.2f}: few independent paths lead to the failures seen.")
    low, high = ACCEPTANCE_RANGE
    for k, level in enumerate(trace):
        if level.acceptance is not None and not low <= level.acceptance <= high:
            found.append(
                f"Acceptance {level.acceptance:.2f} at level {k} is outside [{low}, {high}]: the chains explore badly."
            )
    for k, level in enumerate(trace[:-1], start=1):
        seeds = round(level.p * level.n_points)
        if seeds < FEW_CHAINS:
            found.append(f"Level {k} grew from {seeds} seeds only: the estimate is coarse.")
    return found
