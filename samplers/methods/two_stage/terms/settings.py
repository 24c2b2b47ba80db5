"""Settings of the search by terms, each with its reason.

"Prototype" are runs of another program on Highway-v0 (428 and 1,448 dimensions, 6,000 simulations, 7 to 20 replications
of five cases), not repeated with this one: `python -m benchmarks.estimators.highway.gains` does that. "Stored runs" are
6 to 10 runs of each of those cases with this program: proposals were fitted again to the draws of one run, and E[w^2]
was taken over the failures that the others found. "Chains" are Metropolis chains of failures, started from those of the
stored runs. "Fresh draws" are 15,000 to 30,000 from the last proposals of 3 to 6 stored runs of each case, made wider:
E[w^2] of proposals fitted to what came before each final round was taken over their failures. No command repeats these.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class WalkSettings:
    """Gradient walks to the failures of each term (`walks.py`)."""

    candidate_quantile: float = 0.2
    """A term is a main one where it is the least of some base draws under this quantile of the least term ..."""
    candidate_share: float = 0.005
    """... which are at least this share of all base draws: 3 of 600."""
    walkers: int = 72
    """Walks of all main terms together at `usual_budget`, in proportion with less; each has between `min_walkers` and
    `max_walkers`."""
    usual_budget: int = 6000
    min_walkers: int = 6
    max_walkers: int = 24
    """More find nothing more on Highway-v0 (prototype); half of them start where the term is attained late."""
    scouts: int = 2
    """Walks of every other term: the least of 600 draws may hide a term that is far there and near along its
    gradient."""
    max_scouted: int = 12
    """Other terms that are scouted at most, those with the lowest values first; all that ever are the least are,
    however many. A hundred more would eat the budget."""
    start_quantile: float = 0.5
    """Walks start at the lowest values of each half, early and late, of the draws under this quantile."""
    steps: int = 8
    """Steps at most: 6 reach beta = 4.5 (prototype), 8 reach 6."""
    first_step: float = 1.3
    """Length of the first step in standard deviations (prototype)."""
    growth: float = 1.3
    """Factor of the length after a step downhill, and ..."""
    shrinkage: float = 0.4
    """... after one uphill: roughness of f is shorter than that (prototype)."""
    beyond: float = 0.03
    """Standard deviations by which a step aims beyond the threshold along the gradient: rounding must not stop it."""
    budget_share: float = 0.25
    """Share of the budget that walks use at most, gradients at what they may cost."""
    max_distance: float = 7.0
    """Walks end where the half-space of their gradient is further than this from the origin: Phi(-7) = 1e-12."""
    negligible: float = 1e-5
    """A term is left to base draws where Phi(-beta), beta the median of its failing walks, is this share of the largest
    one. The plane of a gradient is a poor guide where terms are curved: of two with a fifth and four fifths of p it was
    3e-4 (`test_curved_terms`)."""


@dataclass(frozen=True, kw_only=True)
class LawSettings:
    """Proposal of one term in the subspace of its gradients (`law.py`, `fitting.py`); shares are relative."""

    rank: int = 8
    """Right singular vectors kept: failures of a term are nearly one half-space, 8 hold its curvature (prototype)."""
    least_singular: float = 0.05
    """Singular vectors under this share of the first are left out: there the term hardly changes, its failures are
    N(0, 1), and what is fitted instead makes heavy weights. In 10 stored runs of each ego E[w^2] of the collisions that
    other runs found falls by a tenth (imitation) and a third (IDM) against 0.1; 0.03 and rank 12 are worse for one."""
    bump_share: float = 0.5
    """Share of the fitted Gaussians."""
    tempered_share: float = 0.3
    """Share of them nearer to the origin and wider, which bounds weights where they are too narrow or, being fitted to
    draws of proposals that lie beyond the likely failures, too far out ..."""
    tempered_mean: float = 0.75
    tempered_variance: float = 1.7
    """... with mean and variance times these. What adds to the variance fills the slab. A mean times 0.85 has 1.1
    times the E[w^2] of the stored runs' collisions; 0.7 has 0.9 times it, but a heavy draw in one of ten series systems
    of half-spaces."""
    end_share: float = 0.12
    """Share of Gaussians around the ends of the walks: a mode that no draw has met yet stays in reach ..."""
    end_mean: float = 0.9
    end_variance: float = 3.0
    """... with the end times the one as mean, and the variance of the nearest fitted Gaussian times the other, at most
    1."""
    guard_share: float = 0.08
    """Share of N(design point, I) for half-spaces of gradients near failures: modes of a term in other directions than
    the one fitted to; where a mode is that half-space, no weight in it exceeds exp(-beta^2 / 2) over its share."""
    max_guards: int = 12
    """Such half-spaces at most, the nearest first."""
    guard_spacing: float = 1.5
    """Least distance between their design points; Gaussians nearer than that are one."""
    max_ends: int = 24
    """Ends kept of a term."""
    max_heavy: int = 12
    """Of these the points of largest weight, once there are points from proposals: a mode of which one draw is known is
    not left to the mixture fitted to all."""
    prior_points: float = 20.0
    """Points that I counts as in the covariance of the ends."""
    shape_points: float = 1.5
    """Effective points for each dimension from which on a covariance is Stein's estimate of theirs. Between "ahead" and
    "behind" of a car collisions have a variance of 0.05 in one direction, which shrinkage towards I made 0.4: 0.67
    times the E[w^2] of collisions of the IDM ego, over chains of 13,000 failures."""
    max_bumps: int = 3
    """Gaussians of a term at most."""
    shape_ess: float = 160.0
    """Weights are raised to a power below 1 until they are worth this many points, for the covariances ..."""
    mean_ess: float = 20.0
    """... and this many, of failures alone, for the means. With 40 E[w^2] is 1.04 to 1.06 times as large over fresh
    draws of `lidar_ttc`, of collisions 1.00 to 1.03. With 40 for the covariances too it was 1.1 times (stored runs):
    collisions lie in a slab (not too far ahead nor behind), whose width was then shrunk to twice what it is."""


@dataclass(frozen=True, kw_only=True)
class RoundSettings:
    """Rounds of draws and the final ones (`rounds.py`, `estimate.py`); shares are of the budget."""

    base: float = 0.1
    """Base draws: 600 of 6,000; with more the budget goes to what hardly fails."""
    max_base: int = 2000
    min_base: int = 100
    common_share: float = 0.1
    """Where this share of the base draws fails, plain Monte Carlo is as good as anything."""
    monte_carlo_batch: int = 10_000
    """Draws of a batch of plain Monte Carlo; with a target c.o.v. they are `target_batch`."""
    size: float = 0.1
    """Draws of an adaptive round."""
    base_share: float = 0.04
    """Share of base draws in every proposal: no weight exceeds 25."""
    share_ess: float = 400.0
    """Weights that the shares of the terms follow are raised to a power below 1 until failures are worth this many
    points: one heavy draw would give its term most of the next round. E[w^2] of the IDM ego's collisions over chains
    of failures is 0.89 times that of untempered weights, of `lidar_ttc` and with `imitation` the same."""
    min_term_share: float = 0.14
    """Least share of a term, since one heavy draw of another would leave it next to nothing; less where there are more
    than five. With 0.17 two terms with 0.5 % of p took a third of the draws."""
    waiting_share: float = 0.35
    """Weight of a term whose threshold is reached while another's is not (prototype)."""
    ready_ess: float = 6.0
    """Effective number of failures at which a term is fitted to failures and no longer to a higher level: waiting for
    50 takes 7 to 9 rounds (prototype)."""
    min_failures: int = 5
    """Failures of a term that its means are fitted to, with tempered weights, where they are worth fewer."""
    level_ess: float = 15.0
    """Effective number of points that covariances are fitted to: under the lowest level that has as many where the
    failures are worth fewer, for these lie in the same slab; with too few failures the means too. Together with
    covariances that are no longer raised by two standard errors E[w^2] over fresh draws is 0.84 and 0.93 times that
    before (collisions), 0.91, 0.85 and 0.85 times (`lidar_ttc`). 20 and 30 are worse for some."""
    gradients: int = 12
    """Gradients of a term for each fit, at points drawn by weight; fewer where terms are many."""
    max_gradients: int = 48
    """Gradients of all terms for each fit."""
    later_weight: float = 1.5
    """Weight of gradients over those of the round before: later ones are at likelier failures."""
    ready_rounds: int = 1
    """Rounds in a row with all terms at the threshold after which the estimate begins, which goes on fitting."""
    final_share: float = 0.52
    """Adaptive rounds end where no more than this share of the budget is left."""
    refit_share: float = 0.03
    """Share kept for the gradients of each fit between the final rounds; what they leave goes to the last round."""
    final_sizes: tuple[float, ...] = (0.22, 0.33, 0.45)
    """Final rounds, as shares of what is left."""
    final_weights: tuple[float, ...] = (0.25, 0.7, 1.0)
    """Weight of a draw of each in p, fixed beforehand so that p stays unbiased. The proposals become better: E[w^2] of
    collisions with the IDM ego is 240, 100 and 42 in the three, of `lidar_ttc` about the same in all."""
    target_batch: int = 500
    """Draws of each further batch where a target c.o.v. is not yet met."""
    max_batches: int = 100
    """Such batches at most."""


@dataclass(frozen=True, kw_only=True)
class DoubtSettings:
    """When an estimate is doubted, and when it is given up."""

    between_factor: float = 1.5
    """Factor of sum c_r^2 (p_r - p)^2, the variance that the rounds show: with 3 rounds it is 2 / 3 of it."""
    min_ess: float = 20.0
    """Effective number of failures of the last round under which its spread is not known."""
    max_point_share: float = 0.25
    """Share of p in one draw that says the same."""
    max_other_share: float = 0.05
    """Share of p in failures of terms that were not pursued from which on there is a warning."""
    fallback_rate: float = 0.001
    """Effective failures for each draw of the last adaptive round under which the mixture is given up. On Highway-v0 a
    good one has 0.005 to 0.009, and at p = 6e-5 subset simulation gains 3 to 8 (prototype): 0.001 gains 17."""
    min_fallback_budget: int = 300
    """Simulations under which subset simulation is not worth it."""


@dataclass(frozen=True, kw_only=True)
class TermSettings:
    """All settings of the search by terms."""

    min_dim: int = 30
    """Dimensions from which it replaces the exploration of two-stage."""
    min_budget: int = 1000
    """Simulations under which there is no room for walks, rounds and an estimate."""
    walks: WalkSettings = WalkSettings()
    law: LawSettings = LawSettings()
    rounds: RoundSettings = RoundSettings()
    doubts: DoubtSettings = DoubtSettings()


DEFAULT_TERM_SETTINGS = TermSettings()
