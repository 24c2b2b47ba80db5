"""Subset simulation (Au and Beck 2001) and adaptive subset simulation (Tian et al. 2024)."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from samplers.mcmc.chains import RootedPoints
from samplers.mcmc.kernels import FixedMetropolis, ScaledKernel
from samplers.method import Goal, Steps
from samplers.methods.base import Method
from samplers.methods.subset_levels import SubsetLevels
from samplers.problem import Inputs
from samplers.validation import check_choice, check_count, check_setting


@dataclass(frozen=True, kw_only=True)
class SubsetSimulation(Method):
    """Subset simulation with the component-wise modified Metropolis algorithm.

    P[f <= gamma] is the product of conditional probabilities P[F_j | F_(j-1)] of nested level
    sets F_j = {f <= b_j}. Level 0 is plain Monte Carlo; from level 1 on, every point inside F_j
    starts a Markov chain that stays in F_j. A move proposes a symmetric step of every component,
    keeps each with probability min(1, phi(new) / phi(old)), and is taken if it ends in F_j. Works
    in standard normal space. "SS" of Tian et al.

    Where the paper and this implementation differ:

    - *Chains* move together, one step per call of f, so that f gets about p0 N rows per call.
    - *A candidate equal to its point* (no component moved; every third or so in one dimension)
      is not simulated again; a level then costs less than (1 - p0) N.
    - *Ties.* Thresholds are outcomes that occurred, with their true share (`next_level`); the
      paper books p0 for every level but the last.
    - *c.o.v.* The larger of the paper's (equations 25 to 29, with levels taken as independent)
      and the one from the descent of the failing points (`descent_cov`), which does not.

    The script that Tian et al. released for this method does not run; where it can be read it maps
    to normal space through marginals only.

    The interval is log-normal with the t quantile of the independent paths that reach the failures
    (`effective_roots`), or Clopper-Pearson where level 0 already answers. p-hat has a bias of order
    1/N. A small max_sim is dealt with as in `AdaptiveSubsetSimulation`.

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
    stops_at_target: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check the settings."""
        who = "SubsetSimulation"
        check_count(who, "n", self.n, 10)
        check_count(who, "max_levels", self.max_levels, 1)
        check_setting(who, "p0", self.p0, 0.0, 0.5)
        check_choice(who, "distribution", self.distribution, ("uniform", "normal"))
        check_setting(who, "spread", self.spread, 0.0, math.inf)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Go from level to level until the share of failures among its points is p0 or more."""
        descent = SubsetLevels(n=self.n, p0=self.p0, max_levels=self.max_levels)
        return (
            yield from descent.steps(inputs, goal, rng, FixedMetropolis(self.spread, distribution=self.distribution))
        )


@dataclass(frozen=True, kw_only=True)
class AdaptiveSubsetSimulation(Method):
    """Subset simulation whose step adapts to the acceptance rate.

    P[f <= gamma] is the product of conditional probabilities P[F_j | F_(j-1)] of nested level
    sets F_j = {f <= b_j} (Tian et al., equations 4 to 6). Level 0 is plain Monte Carlo; from
    level 1 on, every point inside F_j starts a Markov chain that stays in F_j. Works in standard
    normal space.

    Where the paper, its released code and this implementation differ:

    - *Proposal.* The paper speaks of conditional sampling, with standard deviations of at most 1
      (equation 14), and prints a Metropolis ratio r = phi(new) / phi(old) per component (equations
      19, 20); the code draws the conditional (AR-1) proposal rho u + sigma xi, rho^2 = 1 - sigma^2,
      and has no ratio. Only one of the two is right at a time. The AR-1 proposal leaves N(0, 1)
      invariant on its own (its own Metropolis ratio is 1 everywhere); with r on top the invariant
      distribution would be phi^2, N(0, 1/2), and p far too small. The ratio r is exact for a symmetric step
      u + sigma xi. So "conditional" is the code's reading and "metropolis" the printed one with the
      step that it is right for. The default is "conditional": no component ever stays, so every
      candidate is new. A level of 1000 points is then worth 381 independent ones against 299 in 2
      dimensions and 385 against 372 in 100, and the spread of p-hat is 13 to 23 % smaller.
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
    log-normal with the t quantile of the independent paths that reach the failures
    (`effective_roots`), or Clopper-Pearson where level 0 already answers. p-hat has a bias of order
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
    stops_at_target: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check the settings."""
        who = "AdaptiveSubsetSimulation"
        check_count(who, "n", self.n, 10)
        check_count(who, "max_levels", self.max_levels, 1)
        check_setting(who, "p0", self.p0, 0.0, 0.5)
        check_setting(who, "scale", self.scale, 0.0, math.inf)
        check_setting(who, "target_acceptance", self.target_acceptance, 0.0, 1.0)
        check_choice(who, "proposal", self.proposal, ("conditional", "metropolis"))
        check_choice(who, "sigma0", self.sigma0, ("unit", "seeds"))

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator, known: RootedPoints | None = None) -> Steps:
        """Go from level to level until the share of failures among its points is p0 or more.

        Args:
            inputs: Of the problem.
            goal: Threshold and budget.
            rng: Source of randomness.
            known: Base draws whose outcomes are known, at most n: level 0 begins with them.
        """
        kernel = ScaledKernel(
            self.proposal, self.sigma0, self.scale, self.target_acceptance, deviations=np.ones(inputs.dim)
        )
        descent = SubsetLevels(n=self.n, p0=self.p0, max_levels=self.max_levels)
        return (yield from descent.steps(inputs, goal, rng, kernel, known))
