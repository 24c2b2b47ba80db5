"""Surrogate: kriging of f learns where it fails, and importance sampling on the simulator gives the estimate.

Pool: many draws from a known mixture, judged by the surrogate; the few that are simulated are chosen among them.

With N draws u_i from a mixture Q, w_i = phi(u_i) / Q(u_i), and a point i simulated with probability b_i in each of n
trials, the mean of 1[f(u_i) <= gamma] w_i / (N b_i) over the trials is an unbiased estimate of p whatever b is. With
b_i in proportion to w_i sqrt(P[fail | u_i]) its variance is least if the surrogate is right (compare Dubourg, Sudret
and Deheeger 2013, who take P[fail | u] itself).
"""

import math
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtri

from samplers.bases import Gaussian
from samplers.importance import Draws, count_final_draws, weighted_interval
from samplers.method import Goal, Interrupted, KeptDraws, Outcome, PlainDraws, Steps
from samplers.methods.base import Method, SimulationSteps, Simulator, marginalise_noise
from samplers.methods.kriging import MANY_DIMS, Kriging, Prediction, fit_kriging
from samplers.methods.two_stage.regions import count_lineages
from samplers.problem import FloatArray, Inputs, StandardNormal, check_settings
from samplers.proposals import Mixture, fit_proposal_mixture, fit_shrunk_gaussian
from samplers.sample import (
    Status,
    add_unseen,
    clopper_pearson,
    degrees_of_freedom,
    effective_sample_size,
    log_normal_interval,
    normalise_weights,
)

LEAST_BUDGET = 60  # With fewer simulations all are base draws
SCALES = (1.0, 1.5, 2.2, 3.0)
"""Standard deviations of the first design, a quarter each; at 3 a plane at beta = 4.5 is crossed by one in 15."""
DOUBT = 4.0
"""Factor on standard deviations of a surrogate that is not believed: points are left out at a learned limit state lie
close together, so that their residuals say little of what is between them."""
FINAL_POOL = 20_000  # Draws of the last pool; its own error is 1 / sqrt(those that may fail), a part of the c.o.v.
PART_SHARES, BASE = np.array([0.75, 0.1, 0.15]), 1
"""Shares of what the surrogate says, of base draws, and of what it would say if it were doubted. No weight exceeds
1 / the share of base draws but for the error of the pool. On the IDM cut-in, 300 simulations, 10 seeds: without doubted
draws and random points 8 of 10 intervals held p and the gain was 34; with doubted draws alone 10 and 76, with both 10
and 190."""
LEAST_SKILL = 0.4
"""Share of the variance of f that is to be predicted of points left out, in many dimensions: with 100 base draws it is
0.41 to 0.95 where one or two planes or a sum of claims fail, 0.28 for four planes, up to 0.13 for a ring or a first
passage, if nothing is to be learned from a few hundred simulations."""
LEAST_LEFT = 600  # Simulations that another method is to have if it takes over where f is not learned


class Pool(NamedTuple):
    """N draws u (N, d) of a mixture Q, log(phi / Q) (N,) and what the surrogate says of them."""

    u: FloatArray
    log_weights: FloatArray
    prediction: Prediction

    @classmethod
    def draw(cls, kriging: Kriging, mixture: Mixture, n: int, rng: np.random.Generator) -> "Pool":
        """Draw n points of a mixture."""
        u = mixture.sample(n, rng)
        return cls(u, log_density_ratio(u, mixture), kriging.predict(u))

    @property
    def doubted(self) -> "Pool":
        """The pool under a surrogate that is not believed: its standard deviations are DOUBT times as large."""
        return self._replace(prediction=Prediction(self.prediction.mean, DOUBT * self.prediction.sd))

    @property
    def log_proposal(self) -> FloatArray:
        """log(w sqrt(P[fail])) but for a constant: which draws to simulate for the estimate, shape (N,)."""
        return self.log_weights + 0.5 * self.prediction.log_fail

    @property
    def log_open(self) -> FloatArray:
        """log(w sqrt(P[fail] P[safe])) but for a constant: which draws to learn from, shape (N,)."""
        return self.log_proposal + 0.5 * self.prediction.log_safe

    def forecast_cov(self, n: int) -> float:
        """Return the c.o.v. of n draws if the surrogate is right: n cov^2 = (sum w sqrt(P) / sum w P)^2 - 1."""
        ratio = float(logsumexp(self.log_proposal)) - logsumexp(self.log_weights + self.prediction.log_fail)
        return float(np.sqrt(np.expm1(min(2 * ratio, 100.0)) / max(n, 1)))

    def temper(self) -> FloatArray:
        """Return the logarithms of the proposal (N,); of a smaller power of P[fail] where few carry its weight."""
        power = 0.5
        while power > 0.01 and effective_sample_size(self.log_weights + power * self.prediction.log_fail) < 30:
            power *= 0.8  # 30 are enough to fit a mixture to
        return self.log_weights + power * self.prediction.log_fail


def log_density_ratio(u: FloatArray, mixture: Mixture) -> FloatArray:
    """Return log(phi / Q) at u (n, d), shape (n,)."""
    return StandardNormal(u.shape[1]).log_prob(u) - mixture.log_prob(u)


def isotropic_mixture(dim: int, scales: tuple[float, ...] = SCALES) -> Mixture:
    """Return the equal mixture of N(0, s^2 I), from which the first pool is drawn."""
    return Mixture(np.full(len(scales), 1 / len(scales)), [Gaussian(np.zeros(dim), s * np.eye(dim)) for s in scales])


def fit_mixture(pool: Pool, rng: np.random.Generator) -> Mixture:
    """Return base, wide and fitted Gaussians, the last fitted to draws of the pool in proportion to the proposal."""
    rows, counts = np.unique(rng.choice(len(pool.u), 800, p=normalise_weights(pool.temper())), return_counts=True)
    dim, n_wide = pool.u.shape[1], len(SCALES) - 1
    fitted = fit_proposal_mixture(fit_shrunk_gaussian, pool.u[rows], counts / 800, 5, 3 * dim, rng)
    shares = np.array([0.2, *np.full(n_wide, 0.2 / n_wide), 0.6])
    wider = 1 + 0.5 / math.sqrt(dim)  # log weights then vary by 0.7 whatever the dimension
    return Mixture(shares, [*isotropic_mixture(dim).components, fitted.widen(wider)])


def draw_to_simulate(pool: Pool, n: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Choose n draws of a pool to simulate for the estimate: their rows, log(w / (N b)), and 1 for base draws, (n,)."""
    logs = pool.log_proposal, pool.log_weights, pool.doubted.log_proposal
    parts = np.array([normalise_weights(log) for log in logs])
    part = rng.choice(len(parts), n, p=PART_SHARES)
    rows = np.empty(n, dtype=np.int64)
    for k in range(len(parts)):
        rows[part == k] = rng.choice(len(pool.u), int((part == k).sum()), p=parts[k])
    return rows, pool.log_weights[rows] - np.log(len(pool.u) * (PART_SHARES @ parts[:, rows])), part == BASE


def choose_batch(pool: Pool, n: int, rng: np.random.Generator) -> FloatArray:
    """Choose the next n points of a pool to learn from, shape (n, d), without replacement.

    Seven in ten where the surrogate leaves open whether they fail, as phi sqrt(P[fail] P[safe]); the others where it
    would if it were doubted, far from its limit state, which tell whether it is right there.
    """
    n_far = int(0.3 * n)
    keys = pool.log_open + rng.gumbel(size=len(pool.u))  # the largest: draws without replacement
    near = np.argsort(-keys, kind="stable")[: n - n_far]
    keys = pool.doubted.log_open + rng.gumbel(size=len(pool.u))
    keys[near] = -np.inf
    return np.take(pool.u, np.append(near, np.argsort(-keys, kind="stable")[:n_far]), axis=0)


class SurrogateRun:
    """One run, with what has been simulated so far.

    If `may_leave`, the run gives up when f is not learned and another method would do better with the rest: `steps`
    then returns None.
    """

    def __init__(
        self, inputs: Inputs, goal: Goal, budget: int, rng: np.random.Generator, may_leave: bool = False
    ) -> None:
        self.whole, self.inputs = inputs, marginalise_noise(inputs, rng)
        self.goal, self.budget, self.rng, self.may_leave = goal, budget, rng, may_leave
        self.simulator = Simulator(self.inputs, goal)
        dim = self.inputs.dim
        self.u, self.f = np.empty((0, dim)), np.empty(0)
        self.many = dim > MANY_DIMS
        self.scales = (1.0,) if self.many else SCALES  # of the first design; wide draws say little in many dimensions
        size = min(budget // 3, 100) if self.many else min(budget // 4, 30 + 10 * dim)
        self.n_base = max(size // len(self.scales), 1)
        self.n_design, self.failing_batches = self.n_base * len(self.scales), 0
        self.learned, self.skill = False, 0.0  # whether failures were foreseen; the share of f predicted of base draws

    def steps(self) -> Generator[FloatArray, FloatArray, Outcome | None]:
        """Learn; then estimate, or leave it to plain Monte Carlo."""
        if self.budget < LEAST_BUDGET:
            about = f"max_sim leaves {self.budget} simulations, too few to learn from ({LEAST_BUDGET}): "
            return (yield from self.draw_base()).remark_first(about + "base draws only.")
        try:
            if self.many:  # subset simulation may go on with them
                design = self.rng.standard_normal((self.n_base, self.inputs.dim))
            else:
                from scipy.stats import qmc  # takes a second to import

                cubes = [qmc.LatinHypercube(self.inputs.dim, rng=self.rng).random(self.n_base) for _ in self.scales]
                design = np.concatenate([s * ndtri(cube) for s, cube in zip(self.scales, cubes, strict=True)])
            yield from self._simulate(design)
            if (self.f[: self.n_base] <= self.goal.gamma).mean() >= 0.1:  # plain Monte Carlo is as good
                return (yield from self.draw_base())
            kriging = fit_kriging(self.u, self.f - self.goal.gamma, None)
            if self.many and self.may_leave:  # whether draws fail does not decide: another method may count them in p
                safe = self.f > self.goal.gamma
                self.skill = fit_kriging(self.u[safe], self.f[safe] - self.goal.gamma, None).skill
                if self.skill < LEAST_SKILL:
                    return None
            kriging, mixture = yield from self._learn(kriging)
        except Interrupted:
            return self.estimate_early(Status.STOPPED)
        if self.may_leave and not (self.learned or self.many) and self.budget - len(self.f) >= LEAST_LEFT:
            return None
        if not (self.f <= self.goal.gamma).any():
            about = f"None of {len(self.f):,} simulations for learning failed: base draws take the rest."
            return (yield from self.draw_base()).remark_first(about)
        return (yield from self._estimate(kriging, mixture))

    def draw_base(self) -> Steps:
        """Spend the rest on base draws; those of the design do not count, for they may have decided it."""
        left = self.budget - len(self.f)
        goal = self.goal if self.goal.max_sim is None else replace(self.goal, max_sim=left)
        outcome = yield from self.go_on(PlainDraws(n=left, batch=left).steps(self.whole, goal, self.rng))
        return replace(outcome, counts=None)  # no share of draws to be pooled: this run came to it by chance

    def go_on(self, steps: Steps) -> Steps:
        """Leave the rest to another method; return its outcome as that of the whole run."""
        try:
            outcome = yield from steps
        except Interrupted:
            return self.estimate_early(Status.STOPPED)
        weights = tuple(replace(each, first=len(self.f) + each.first) for each in outcome.draw_weights)
        return replace(outcome, trace=(*self.simulator.trace, *outcome.trace), draw_weights=weights)

    def _simulate(self, u: FloatArray) -> SimulationSteps[FloatArray]:
        """Simulate u (n, d) to learn from; return their outcomes (n,)."""
        f = yield from self.simulator.evaluate(u)
        self._keep(u, f)
        self.simulator.record(float((f <= self.goal.gamma).mean()), math.nan, len(f), math.inf)
        return f

    def _keep(self, u: FloatArray, f: FloatArray) -> None:
        """Learn from points u (n, d) with outcomes f (n,) too."""
        self.u, self.f = np.concatenate([self.u, u]), np.concatenate([self.f, f])

    def _learn(self, kriging: Kriging) -> SimulationSteps[tuple[Kriging, Mixture]]:
        """Simulate batches where the surrogate is in doubt, until it is good enough or has its share of the budget."""
        most = min(int(2 / 3 * self.budget), 300)  # the cost of kriging grows with the cube
        if self.may_leave and not self.many and self.budget >= LEAST_LEFT + 200:
            most = 200
        size = max((most - self.n_design) // 16, 6)  # simulators run the points of one batch side by side
        mixture, good, surprises = isotropic_mixture(self.inputs.dim), 0, list[float]()
        while len(self.f) < most and good < 2:
            pool = Pool.draw(kriging, mixture, 3000, self.rng)
            batch = choose_batch(pool, min(size, most - len(self.f)), self.rng)
            predicted = np.exp(kriging.predict(batch).log_fail)
            fails = (yield from self._simulate(batch)) <= self.goal.gamma
            self.failing_batches += bool(fails.any())
            surprises.append(float(fails.sum() - predicted.sum()))
            # 1.5 standard errors of two batches: at a limit state that is elsewhere all of their points fail, or none
            allowed = 1.5 * math.sqrt(2 * float((predicted * (1 - predicted)).sum()) + 1)
            sharp = fails.any() and pool.forecast_cov(self.budget - len(self.f)) < 0.02
            good = good + 1 if sharp and abs(sum(surprises[-2:])) <= allowed else 0
            mixture = fit_mixture(pool, self.rng)
            kriging = fit_kriging(self.u, self.f - self.goal.gamma, kriging)
        self.learned = good == 2
        return kriging, mixture

    def _draw_pool(self, kriging: Kriging, mixture: Mixture) -> tuple[Pool, Mixture]:
        """Return the pool for the estimate, and its mixture."""
        for _ in range(3):
            mixture = fit_mixture(Pool.draw(kriging, mixture, FINAL_POOL // 4, self.rng), self.rng)
        return Pool.draw(kriging, mixture, FINAL_POOL, self.rng), mixture

    def _estimate(self, kriging: Kriging, mixture: Mixture) -> Steps:
        """Draw until the budget is used or the target is met; p rests on these draws alone.

        The surrogate learns from each part before the next is drawn, which is unbiased given what was before.
        """
        goal, cov, status = self.goal, math.inf, Status.CONVERGED
        draws = Draws(0, np.empty(0), np.empty(0))
        of_base, likely = self.f[: self.n_base], np.empty(0)  # outcomes of base draws; P[fail] of the final ones
        left = count_final_draws(goal, len(self.f), self.budget - len(self.f))
        pool, mixture = self._draw_pool(kriging, mixture)
        size = min(1000, math.ceil(left / 2)) if goal.target_cov is None else max(self.budget // 10, 1)
        while left > 0 and not (goal.target_cov is not None and draws.n and cov <= goal.target_cov):
            rows, log_weights, from_base = draw_to_simulate(pool, min(size, left), self.rng)
            u = pool.u[rows]
            x = self.inputs.base.from_standard_normal(u)
            try:
                f = yield from self.simulator.simulate(x)
            except Interrupted:
                status = Status.STOPPED
                break
            likely = np.concatenate([likely, np.exp(pool.prediction.log_fail[rows])])
            draws = draws.join(Draws.from_outcomes(f, log_weights, x, goal.gamma))
            of_base = np.concatenate([of_base, f[from_base]])
            may_fail = effective_sample_size(pool.log_weights + pool.prediction.log_fail)
            cov = math.hypot(draws.cov, math.sqrt(1 / may_fail))
            left -= len(f)
            self.simulator.record(float((f <= goal.gamma).mean()), draws.p, len(f), cov, draws.ess)
            if left > 0 and draws.n < 1000:  # kriging costs the cube of their number
                self._keep(u, f)
                kriging = fit_kriging(self.u, self.f - goal.gamma, kriging)
                pool, mixture = self._draw_pool(kriging, mixture)
        if draws.n == 0:
            return self.estimate_early(status if status is Status.STOPPED else Status.BUDGET)
        return self._conclude(draws, cov, status, pool, of_base, likely)

    def _conclude(
        self, draws: Draws, cov: float, status: Status, pool: Pool, of_base: FloatArray, likely: FloatArray
    ) -> Outcome:
        """Return the outcome of the final draws, of which kriging said how `likely` they fail.

        Failures that are not as many as kriging said, by 4 standard deviations, give a warning.
        """
        goal, hits, foreseen = self.goal, len(draws.f), float(likely.sum())
        largest = float(np.exp(logsumexp(pool.log_weights))) / (FINAL_POOL * float(PART_SHARES[BASE]))
        design = self.u[: self.n_design][self.f[: self.n_design] <= goal.gamma]
        wide = log_density_ratio(design, isotropic_mixture(self.inputs.dim, self.scales))
        lineages = max(count_lineages(self.failing_batches, wide), 1.0)
        if draws.ess < 10:  # what the base draws alone say may be more
            low, high = weighted_interval(draws, goal.confidence, largest, cov)
            most = clopper_pearson(int((of_base <= goal.gamma).sum()), len(of_base), goal.confidence)[1]
        else:
            freedom, most = degrees_of_freedom(draws.ess, independent=True), 1.0
            low, high = log_normal_interval(draws.p, cov, goal.confidence, freedom)
        high = max(draws.p, min(add_unseen(draws.p, high, lineages, goal.confidence), most))
        outcome = draws.outcome(goal, status, self.simulator.trace, largest, len(of_base) - self.n_base)
        contradicted = abs(hits - foreseen) > 4 * math.sqrt(float((likely * (1 - likely)).sum()) + 1)
        about = f"Kriging foresaw {foreseen:.0f} failures among the final draws, and {hits} failed"
        return replace(
            outcome,
            p=min(draws.p, 1.0),
            interval=(low, min(high, 1.0)),
            cov=cov,
            status=Status.NO_HITS if status is Status.CONVERGED and not hits else status,
            warnings=(f"{about}: it does not describe f.",) * contradicted if hits else outcome.warnings,
            remarks=outcome.warnings if hits else (),  # few draws are the rule here, and the interval says it
            sample=replace(draws.sample, lineages=lineages),
        )

    def estimate_early(self, status: Status) -> Outcome:
        """Return what the base draws of the first design say, for a run that ends before its estimate."""
        draws = KeptDraws(self.goal.gamma, self.whole.dim)
        draws.add(self.inputs.base.from_standard_normal(self.u[: self.n_base]), self.f[: self.n_base])
        return replace(draws.outcome(self.goal, self.simulator.close_trace()), counts=None, status=status)


@dataclass(frozen=True, kw_only=True)
class Surrogate(Method):
    """Kriging as a guide and importance sampling on the simulator: for 100 to 1,000 simulations where f is smooth.

    1. *Learning* (`kriging.py`): a first design of Latin hypercubes of N(0, s^2 I), s = 1 to 3, then batches: seven in
       ten points where phi sqrt(P[fail] P[safe]) is large, P by kriging, the others where it would be with standard
       deviations four times as large. It takes two thirds of the budget at most, and ends earlier where the failures
       of two batches were foreseen and the rest is forecast to give a c.o.v. of 2 %.
    2. *Estimate*: fresh draws, 75 % of q ~ phi sqrt(P[fail]), 15 % of the same with the larger standard deviations,
       10 % of the base distribution, weighted by phi over the density of this mixture, and nothing else. The surrogate
       only says where to simulate, and learns from the first half of the draws before the second is made. Given the
       learning p-hat is unbiased; its c.o.v. includes the error of the density's constant, which is a mean over a pool
       of 20,000 draws that are not simulated.

    *Interval.* Log-normal with t quantiles; where under 10 effective draws failed the lesser of Bernstein's bound and
    that of the base draws. The upper limit also holds what no draw can have met (`two_stage/regions.py`, a batch of
    learning with failures as a lineage). With a few hundred simulations that is a large part of it.

    *Noise.* Coordinates that the base distribution calls noise are drawn, not learned; kriging takes what they do to f,
    and noise that is no part of x, as a nugget.

    *Many dimensions.* In more than 20 the covariance has a linear part and one length, and the design is of base draws.

    *Plain Monte Carlo takes over*, with a remark, where learning meets no failure and below 60 simulations; without one
    where a tenth of the first base draws fails.

    Dubourg, Sudret and Deheeger draw from P[fail] phi by Markov chains; we choose from weighted draws of a mixture,
    which gives independent draws, and add base draws, which bound the weights of failures that the surrogate denies.

    Args:
        n: Simulations where `max_sim` does not say how many.

    References:
        Dubourg, Sudret and Deheeger, "Metamodel-based importance sampling for structural reliability analysis",
        Probabilistic Engineering Mechanics 33, 2013.

    Example:
        Two regions of failure, p = 2 Phi(-3.5) = 4.65e-4:

        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda u: 3.5 - np.abs(u[:, 0]), dim=2)
        >>> result = samplers.estimate(problem, samplers.Surrogate(), seed=0, max_sim=150)
        >>> result.n_sim, result.interval[0] < 4.65e-4 < result.interval[1], result.cov < 0.2
        (150, True, True)
    """

    n: int = 1000

    name: ClassVar[str] = "surrogate"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, n=LEAST_BUDGET)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Learn, then estimate."""
        budget = self.n if goal.max_sim is None else goal.max_sim
        outcome = yield from SurrogateRun(inputs, goal, budget, rng).steps()
        assert outcome is not None  # it was not to leave
        return outcome
