"""Settings of two-stage: the numbers of its stages, each with its reason.

Users set `TwoStage.n` only. Where no other reason stands beside a number, it was chosen together with the others on the
problems of the benchmark of samplers at 6,000 simulations: some 30 configurations, up to 40 runs each, by which
differences in gain of less than a factor of two cannot be told from chance.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class LinearModelSettings:
    """Robust regression of f, and half-spaces beyond its hyperplane (`planes.py`)."""

    ridges: tuple[float, float] = (1.0, 1e-3)
    """Ridge penalties; the smaller one is tried where points are enough for ordinary regression."""
    lad_iterations: int = 12
    """Steps of iteratively reweighted least squares towards least absolute deviations."""
    lad_ridge: float = 1e-3
    """Ridge penalty of these steps, the smaller one of `ridges`: it keeps the matrix regular."""
    lad_smoothing: float = 1e-3
    """Share of the median deviation that is added to each before it divides: exact points have no infinite weight."""
    min_left_out: float = 1e-3
    """Least 1 - leverage that a residual is divided by: a point that alone decides on a slope has leverage 1."""
    min_left_out_lad: float = 1e-2
    """The same in the steps towards least absolute deviations, where one such point must not hold all the weight."""
    inlier_sigmas: float = 3.0
    """Deviation up to which a point agrees with a hyperplane, in standard deviations (Rousseeuw and Leroy use 2.5)."""
    min_points: int = 5
    """Points that a regression needs."""
    min_points_per_dim: float = 1.2
    """With `min_points` + this many points per dimension the small ridge and outliers can be judged."""
    trimmed_share: float = 0.02
    """Share of the outcomes left out at either end: f may be capped or wild there."""
    exact_r2: float = 0.999
    """R^2 from which f is linear."""
    boundary_r2: float = 0.95
    """R^2 from which the hyperplane, or the planes of a corner, locate the failure boundary. Corners down to 0.8 bought
    nothing: with 0.98 for 0.8 the variance was 0.996 +- 0.05 times as large (67 runs on the 14 limit states with such
    ones), and with 0.95 for 0.98 0.97 +- 0.02 times, on drive_d6 0.92 (20 runs on five)."""
    min_r2: float = 0.3
    """R^2 under which a hyperplane is no help; that of pure noise stays below (`test_noise_has_no_hyperplane`).
    At 0.15 no run differs, at 0.6 variance 0.97 +- 0.03."""
    agreeing_share: float = 0.6
    """Share of the points that must agree with a hyperplane for it to be more than chance: over half, for two regions
    may have half each."""
    crossing_errors: float = 2.0
    """Standard errors of a prediction by which a half-space begins before the hyperplane."""
    nearest_share: float = 0.03
    """Share of the failures that may lie before the edge, where the hyperplane does not locate it: none of 33 or
    fewer."""
    min_failures: int = 8
    """Failures that half-space proposals need: `failure_edge` takes a quarter of the mean excess off the least of
    eight."""
    same_region_share: float = 0.5
    """Failures nearer than this share of the median distance along the axis are another region's."""
    widening: float = 1.3
    """Variance of the Gaussian over that of N(0, 1) beyond the edge: too small a variance makes weights unbounded, too
    large a one costs a few draws."""


@dataclass(frozen=True, kw_only=True)
class PieceSettings:
    """f as the least of linear functions (`pieces.py`)."""

    n: int = 24
    """Pieces to start with; on oscillator_d100 10 to 20 of them are left."""
    iterations: int = 20
    """Regressions of each piece: by then hardly a point changes its piece."""
    points_per_dim: int = 2
    """A piece starts from so many points per dimension ..."""
    least_points: int = 6
    """... and so many more; it is given up with fewer than one per dimension and these."""
    first_ridge: float = 0.3
    """Ridge penalty of the first regressions, which rest on few points."""
    ridge: float = 1e-3
    """The same of the later ones, the smaller one of `LinearModelSettings.ridges`."""
    crossing_errors: float = 4.0
    """Standard deviations of its residuals by which a half-space begins before its plane. With 2 and 3 the intervals
    held p in 90 and 88 % of 60 runs on oscillator_d100, for the slopes leave out some of the direction of a plane; with
    4 in all of them, at the same gain."""
    min_r2: float = 0.8
    """R^2 under which f is no least of linear functions. It is 0.93 to 0.98 on oscillator_d100, 0.81 to 0.91 on
    duffing_d60, and negative on screen_d40, where f is the largest of three."""
    highest: float = 0.1
    """Share of the outcomes left out at the upper end: what f is far from failure does not matter."""


@dataclass(frozen=True, kw_only=True)
class CornerSettings:
    """f as the greatest of linear functions (`pieces.py`)."""

    n: int = 6
    """Pieces to start with."""
    starts: int = 3
    """Fits from other points at most, until one explains f ..."""
    promising_r2: float = 0.9
    """... where the first one has this R^2: the corners of screen_d40 had 0.94 and more."""
    patience: int = 4
    """Steps of a fit without a gain that end it; with 3, two corners of 16 of common3_d9 were lost."""
    points_per_dim: int = 100
    """Points of a fit per dimension at most, evenly spaced: more take time, and show the same planes."""
    min_start: float = -1.0
    """Planes nearer than this hold 84 % of N(0, I) or more: the corner is hardly larger without them."""
    min_turn: float = 0.1
    """Sine of the least angle between a plane and the span of those before it: two at less are one."""


@dataclass(frozen=True, kw_only=True)
class EdgeSettings:
    """Where proposals with an edge begin (`mixture.py`, and the planes of the regressions)."""

    min_distance: float = 0.5
    """Nearer to the origin than this a half-space holds 31 % of N(0, I): base draws serve as well."""
    slack: float = 0.02
    """By how much a half-space begins before the edge, in standard deviations of N(0, I)."""
    mean_excesses: float = 2.0
    """Mean excesses over the quantile, divided by the number of failures, by which an edge is put back."""
    min_ess: float = 2.0
    """Least number of failures that they are divided by."""
    radius_share: float = 0.01
    """Share of the failures' weight that may lie within the radius before it is shortened."""
    radius_factor: float = 0.98
    """|u|^2 at that quantile, times this, is where radial draws begin: the least of few lies beyond the edge of
    many."""
    min_radial_shape: float = 0.3
    """Least shape of the Gamma distribution of |u|^2: with less, nearly all draws are at its start."""


@dataclass(frozen=True, kw_only=True)
class SubspaceSettings:
    """Mixtures fitted to weighted points (`mixture.py`)."""

    high_dim: int = 40
    """Above this many dimensions a component has one direction of its own: some hundred points do not show more."""
    sizes: tuple[int, ...] = (1, 2, 3, 4, 6, 8)
    """Numbers of components that are tried; `max_worse` of them without a better score end the search."""
    max_worse: int = 2
    """The score of a fit is uneven in their number: after one that is worse, a better one may follow."""
    max_em_iterations: int = 25
    """M-steps at most."""
    min_relative_gain: float = 1e-3
    """Expectation-maximisation ends where a step raises the log likelihood by less than this share of it."""
    em_restarts: int = 3
    """Starts for each number of components; k-means++ draws its centres."""
    min_ess: float = 2.0
    """Points that any component is taken to rest on: the formulae divide by their number."""
    refit_steps: int = 2
    """M-steps between two rounds of draws; the rounds go on from there."""
    min_refit_points: int = 5
    """A component with fewer points stays where it is."""
    refit_ess: float = 30.0
    """Effective points that a component is fitted to, as its mean and a shrunk covariance need them ..."""
    refit_ess_per_dim: float = 3.0
    """... or this many per dimension. Where the weights are less even, they are raised to a power less than 1."""
    points_per_refit_ess: float = 3.0
    """Points of a component for each of them: no more is asked of it than a third of its points."""
    power_step: float = 0.1
    """By how much the power falls from trial to trial; the effective number of points grows as it does."""
    max_spread: float = 4.0
    """Largest variance along the one direction in high dimensions; a few points of another region give more."""
    standard_errors: float = 2.0
    """By how many of them a variance under 1 is raised: too small a variance makes weights unbounded."""
    max_mean_excess: float = 0.5
    """Share of a mean that is taken off as noise at most: of few points in hundreds of dimensions noise is all there
    is."""
    covariance_parameters_per_dim: float = 2.0
    """Parameters of a covariance that BIC counts at most, per dimension: with all d (d + 1) / 2 of them some dozens of
    points would never have a second component."""
    min_bic_ess: float = 3.0
    """Least number of points that BIC takes: log(n) would fall under 1 with fewer."""
    points_per_component: float = 4.0
    """Effective points for each component at least."""


@dataclass(frozen=True, kw_only=True)
class MixtureWeightSettings:
    """Search for the best weights of a mixture (`mixture.py`)."""

    updates: int = 60
    """Multiplicative updates: they come within 2 % of the least second moment (`test_weights_are_nearly_the_best`)."""
    negligible: float = 30.0
    """Points whose weight is e^-30 of the largest one do not matter."""


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
    """Proposal of one term in the subspace of its gradients (`fitting.py`, `fitting.py`); shares are relative."""

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


def _initial_shares() -> dict[str, float]:
    return {
        "base": 0.1,
        "wide": 0.05,
        "radial": 0.1,
        "gaussian": 0.5,
        "linear": 0.5,
        "corner": 0.3,
        "explored": 0.2,
        "tempered": 0.25,
        "spread": 0.2,
        "directional": 0.1,
    }


@dataclass(frozen=True, kw_only=True)
class ExplorationSettings:
    """Draws of the exploration (`exploration.py`); their numbers hold for `usual_budget` simulations."""

    usual_budget: int = 6000
    """Up to here sizes grow in proportion to the budget, above with its square root; the rest of the budget is
    for refinement and estimate."""
    base: int = 500
    """Base draws; five levels of a tenth each reach 1e-5 from there."""
    wide: tuple[tuple[float, int], ...] = ((1.5, 120), (2.2, 120), (3.0, 80))
    """Wide draws: (s, number). At s = 3 a half-space at beta = 4.5 is hit by one draw in 15."""
    deep_scale: float = 3.3
    """Where the levels went so far that wide draws should have a larger s than this, there are ..."""
    deep_draws: int = 80
    """... so many more, with that s."""
    depth_ratio: float = 1.45
    """Distance of the levels' end, beta, over s: one draw in 14 is beyond a half-space there."""
    level: int = 250
    """Points of each level of subset simulation; `least_level` where the budget is small."""
    least_level: int = 100
    level_fraction: float = 0.1
    """Conditional probability of a level (Au and Beck 2001)."""
    common_failures: int = 5
    """Failures among the base draws from which on no level is begun, and the second round counts in p: chains start
    from these failures, and one round shows how to describe what is so common."""
    points_per_seed: int = 3
    """Points of a level for each of its seeds at least: chains take two steps or more."""
    initial_scale: float = 0.6
    """First step of the chains of subset simulation, as in `AdaptiveSubsetSimulation`."""
    level_acceptance: float = 0.44
    """Acceptance that it is adapted to (Papaioannou, Betz, Zwirglmaier and Straub, 2015)."""
    max_levels: int = 30
    """Levels at most; the share of the budget ends the descent first unless f ties."""
    starts: int = 24
    """Chains from wide failures at most; `least_starts` where the budget is small."""
    least_starts: int = 10
    level_starts: int = 24
    """The same for failures of subset simulation; they take the place of wide failures that are missing."""
    least_level_starts: int = 6
    bisections: int = 3
    """Steps of a wide failure towards the origin: the edge of the region is then known to an eighth of the way."""
    chain_cost: int = 25
    """Simulations that a chain needs at most before it is sorted: bisection, two walks, points half way."""
    descent_share: float = 0.45
    """Share of the budget after which no further level is begun."""
    share: float = 0.65
    """Share of the budget for the whole exploration."""


@dataclass(frozen=True, kw_only=True)
class LineSettings:
    """Lines of descent (`exploration.py`); numbers of simulations hold for `ExplorationSettings.usual_budget`."""

    n: int = 24
    """Lines. Half of them arrive, as a rule. With 30 the exploration costs 60 to 110 simulations more, and the c.o.v.
    was no smaller on four problems (20 seeds each)."""
    root_share: float = 0.1
    """Share of the base draws that lines start from: higher up they cost more and lead to the same regions."""
    initial_step: float = 0.35
    """First step."""
    acceptance: float = 0.3
    """Share of fresh steps that shall be taken ..."""
    adaptation: float = 0.5
    """... and change of the log step per unit of it."""
    step_range: tuple[float, float] = (0.03, 1.0)
    """Least and largest step."""
    most_tries: int = 3
    """Tries at once of each line where others have arrived, so that the batches do not become small."""
    steps: int = 300
    """Lines that go on, times steps taken, at most: where failures are far off, few lines that arrive are better than
    many that do not."""
    limit: int = 600
    """Simulations after which all lines end."""
    most_arrived: float = 0.6
    """Share of the lines that has arrived when the others are given `patience` times the median time of arrival."""
    patience: float = 2.0
    first_look: int = 450
    """Simulations after which lines are given up if less than `few_arrived` of them have arrived."""
    few_arrived: float = 0.15
    starts: int = 4
    """Lines of each region from which chains start."""
    many_regions: int = 6
    """In more than `SubspaceSettings.high_dim` dimensions lines in so many regions mean a shell or a ring: chains would
    not relax there, and none are run."""


@dataclass(frozen=True, kw_only=True)
class TermsAloneSettings:
    """Searches on single terms of f (`terms_alone.py`)."""

    lines: int = 4
    """Lines of descent, and starts of chains, of each term, as of each region."""
    line_share: float = 0.15
    """Share of what the exploration leaves for lines on terms that were the least somewhere, and failed nowhere."""
    scout_share: float = 0.1
    """The same for terms that were the least nowhere."""
    usual_cost: int = 180
    """Simulations for the lines of a term; of more terms than that allows, some are left out."""
    chain_share: float = 0.15
    """Share of what the exploration leaves for the chains from the ends of the lines."""
    least_density: float = 1e-5
    """Failures that are less likely than the likeliest ones by this factor start no chains: they matter too little."""


@dataclass(frozen=True, kw_only=True)
class RegionSettings:
    """Chains inside the failure region, and how regions are separated (`regions.py`)."""

    initial_step: float = 0.5
    """pCN step before any adaptation."""
    steps: tuple[int, int] = (5, 6)
    """Steps of the chains before and after they are sorted into regions."""
    steps_high_dim: tuple[int, int] = (8, 8)
    """The same above `SubspaceSettings.high_dim` dimensions, where a wide failure has further to go."""
    chain_acceptance: float = 0.35
    """Acceptance that the step is adapted to; Papaioannou, Betz, Zwirglmaier and Straub, 2015, adapt to 0.44."""
    adaptation: float = 0.7
    """Change of the log step per unit of acceptance in the first step; it falls with the root of their number."""
    min_step: float = 0.02
    """Least pCN step."""
    across_factors: tuple[float, float] = (1.1, 0.75)
    """Factors of the step across the given direction after a failing proposal and after another one: in balance at an
    acceptance of ln(1 / 0.75) / ln(1.1 / 0.75) = 0.75, for across the direction fresh draws are nearly always right."""
    min_across: float = 0.05
    """Least step across the given direction."""
    along_factors: tuple[float, float] = (1.05, 0.9)
    """The same along the given direction: in balance at 0.68."""
    many_regions: int = 8
    """Number of regions from which failure may be something like a shell."""
    scattered_share: float = 0.25
    """Where this share of the points is in none of `many_regions` regions, it is."""
    few_points: int = 8
    """So many points or fewer are all compared with each other at once, not region by region."""
    max_regions: int = 16
    """Regions that are separated at most."""
    chains_per_region: tuple[int, int] = (8, 24)
    """Chains of each region at least, in few dimensions and in many."""
    points_per_dim: float = 2.5
    """Points of each region per dimension, within `chains_per_region`: as a covariance and a regression need them."""
    max_replicated: int = 60
    """Chains that are added to reach it at most, over all regions."""
    probes: int = 30
    """Points beside failing ones that show whether f is noisy."""
    probe_distance: float = 1e-6
    """How far beside, in standard deviations: no f of a simulation changes over it, save at jumps or by noise."""
    noisy_share: float = 0.9
    """Where less than this share of the probes fail, f is noisy."""
    late_steps: int = 2
    """Of the steps before sorting, the last ones whose proposals describe f around a region."""
    late_steps_high_dim: int = 4
    """The same above `SubspaceSettings.high_dim` dimensions."""
    direction_r2: float = 0.5
    """From this R^2 on, chains follow the direction in which f falls, else that of their mean."""
    mean_steps: int = 3
    """Last steps of the chains that this mean is of."""
    min_points_per_dim: int = 3
    """With fewer points per dimension around the only region, points of subset simulation join them."""
    lower_share: float = 0.7
    """Share of the points of subset simulation that do, those with the lowest f."""


@dataclass(frozen=True, kw_only=True)
class SlopeSettings:
    """Gradients of f by finite differences (`slopes.py`)."""

    min_dim: int = 15
    """Dimensions from which on they are sought: with fewer, chains show as much."""
    share: float = 0.22
    """Share of what the exploration leaves for them at most: 17 gradients in 40 dimensions at 6,000 simulations."""
    high_dim_share: float = 0.3
    """The same above `SubspaceSettings.high_dim` dimensions, where a component has one direction without slopes, and
    where the regions are pieces of something like a shell."""
    least: int = 4
    """Gradients that two directions can be told from many with."""
    most: int = 20
    """Gradients at most. With 12, one of the three directions of screen_d40 was not found in one run of 24."""
    step: float = 0.05
    """Of a finite difference, in standard deviations: over it f bends little, and rounding does not matter."""
    few: float = 0.65
    """The directions are few where the gradients are worth so many equal directions, over those that as many random
    gradients would be worth. On the shell sphere_d20 1, on series6_d25 0.55, on oscillator_d100 0.4."""
    explained: float = 0.99
    """Share of the squares of new gradients in directions known before, from which on no more gradients are made."""
    least_part: float = 0.005
    """Share of the gradients' squares that a direction must hold: noise of f bends gradients less."""
    most_axes: int = 12
    """Directions at most. With 8, the c.o.v. of duffing_d60 was 0.21 for 0.15 (24 runs each)."""


@dataclass(frozen=True, kw_only=True)
class RefinementSettings:
    """Rounds of draws, and the shares of the components in a proposal (`refinement.py`)."""

    round_shares: tuple[float, ...] = (0.09, 0.12, 0.14)
    """Share of what the exploration leaves that each round draws; the rest is for the estimate."""
    counted_from: int = 2
    """Rounds that do not count in p, the first ones: their proposals may not describe the failures yet. The draws of
    the third were worth 0.8 to 1.6 times as much as as many of the last ones, on four problems (30 runs each)."""
    further_shares: tuple[float, ...] = (0.14, 0.14)
    """The same of further rounds, while the last one is worth less than `good_rate`."""
    good_rate: float = 0.1
    """Independent failures for each draw of a round with which its proposal describes the failures."""
    base_share: float = 0.05
    """Least share of base draws: no weight exceeds 20."""
    noisy_base_share: float = 0.1
    """The same where f is noisy."""
    tempered_share: float = 0.1
    """Least share of tempered Gaussians, dealt out among the regions by the roots of their shares of the failures. The
    best weights for the failures met so far may leave a region hardly any: without this the variance of a draw was 1.2
    times as large on common3_d9 and banana_d8, and 2.1 times on loads_d7 (20 runs each)."""
    extra_tempered_share: float = 0.2
    """How much more of them, times the share of the draws from sharp components that did not fail; not where the
    regions are pieces of a shell, for the spread component is wider."""
    noisy_tempered_share: float = 0.5
    """Least share of tempered Gaussians where f is noisy; q^(1/2) phi^(1/2) is then the best proposal."""
    region_share: float = 0.5
    """Share of the draws of a round that is dealt out evenly among the regions. Weights of a region's first draws can
    be so uneven that it seems to have no mass: it must not be lost by that."""
    final_region_share: float = 0.2
    """The same for the estimate."""
    radial_share: float = 0.05
    """Least share of radial components in few dimensions, and wherever the regions are no more than pieces of a shell:
    they reach failures beside the regions, of which one draw would outweigh all others. In 160 runs of `CutIn-v0` with
    its base `us101-15-offsets` 0, 2, 5 and 10 % had gains of 135, 219, 320 and 242."""
    radial_dim: int = 20
    """Few dimensions. In 25 (series6, 60 runs) it took the coverage from 93 to 87 % and the gain from 48 to 5."""
    spread_share: float = 0.4
    """Share of the component that is as wide as the failures in the span of the slopes, where the regions are pieces of
    a shell, or while draws are worth less than `good_rate`: there the failures form a ring, and Gaussians fitted to
    some of them leave gaps. Without it the second moment on oscillator_d100 was 800 to 2,000 times p^2, with it 40 to
    70, and 26 with the half-spaces of the pieces of f; with 0.15 of it these gave 150."""
    explored_share: float = 0.01
    """Share that components from the exploration keep until the last round."""
    min_share: float = 0.004
    """Components with less of the draws are left out."""
    initial_shares: dict[str, float] = field(default_factory=_initial_shares)
    """Shares of the kinds where nothing is known yet; of those present, in proportion.

    What a kind is worth, on ten problems of the catalogue with 4 seeds each: without it the stated variance (median) is
    131 times as large on sphere_d20 (radial), 15 times on two_d30 and 4 times on three_d6 and steps_d6 (linear). On
    twelve others with 2 seeds it is 1.6 times as large without `corner`, 20 times on corner_d5. Without `explored` 5 of
    40 intervals miss p, with it none. Without `tempered` the variance is a quarter smaller: they are for noise, and for
    regions that are badly described. `wide` buys nothing over all (1.02 +- 0.05, 168 runs on 48 limit
    states): it guards the coverage on loads_d7 and crossing_d6."""
    wide_scale: float = 1.5
    """Standard deviation of the wide component."""
    tempering: tuple[float, ...] = (0.5,)
    """Powers t of q^t phi^(1 - t)."""
    noisy_tempering: tuple[float, ...] = (0.5, 0.25)
    """The same where f is noisy."""
    gaussians_per_region: int = 3
    """Gaussians fitted to the chains of a region at most: it has some dozens of them."""
    noisy_gaussians: int = 8
    """The same where f is noisy: all of it is one region then."""
    points_per_chain: float = 2.0
    """Independent points that a chain is worth."""
    min_refit_failures: int = 6
    """Failures, all in all, from which on Gaussians and half-spaces are fitted again."""
    min_radial_failures: int = 20
    """Failures that a radial component needs."""
    min_log_ratio: float = 1.0
    """A draw belongs to the region whose Gaussian has the largest density there, if that is e times phi or more."""
    probit_scale: float = 1.702
    """Log odds over the argument of Phi that is next to them: noise is near normal, and the logistic curve has far
    heavier tails (Camilli, "Origin of the scaling constant d = 1.7 in item response theory", 1994)."""
    logistic_penalty: float = 100.0
    """Inverse strength of the penalty (C of scikit-learn): hardly any."""
    logistic_iterations: int = 2000
    """More than the noisy problems of the catalogue need; scikit-learn warns where it is too few."""
    quadratic_dim: int = 20
    """Dimension up to which the log odds of failure are quadratic in u, not linear: 231 coefficients at most."""


@dataclass(frozen=True, kw_only=True)
class FallbackSettings:
    """When a proposal is given up for subset simulation (`stages.py`)."""

    min_fallback_budget: int = 300
    """Simulations under which subset simulation is not worth it."""
    early_rates: tuple[float, ...] = (0.005, 0.006)
    """What each draw of the first rounds must be worth, in independent failures. Less cannot be told from chance; with
    0.008 and more, proposals are given up that are several times better by the third round."""
    sloped_rate: float = 0.25
    """Share of these rates that is enough where components lie in the span of slopes: their draws leave few places
    out, so that the weights met are about as uneven as all of them."""
    relative_rate: float = 0.04
    """The same for the last round, times the levels: subset simulation has an independent failure for each 100 levels
    simulations, and the weights that were met are about four times flatter than all of them."""
    max_typical: float = 30.0
    """How many times p a typical point of most regions may weigh as a draw: 1 to 3 is usual, 17 was seen to do.
    From `RefinementSettings.good_rate` on it does not apply."""
    chain_points: float = 30.0
    """Points of a level at p0 = 0.1 for one that is independent: (1 - p0) / p0, and correlation along the chains."""
    level_share: float = 0.9
    """Share of a level that is simulated; its seeds, p0 = 0.1 of it, are not simulated again."""
    min_levels: int = 2
    """Levels to plan for at least."""
    min_points: int = 10
    """Points of a level at least."""


@dataclass(frozen=True, kw_only=True)
class DiagnosticSettings:
    """When an estimate is doubted (`stratified.py`)."""

    false_alarm: float = 1e-3
    """Probability with which a check of the base draws warns of a right estimate."""
    max_deviation: float = 4.0
    """Standard errors between the rounds and the estimate; a normal distribution exceeds it once in 16,000 runs."""
    min_rounds_ess: float = 30.0
    """Independent failures that the rounds must be worth to be compared."""
    min_final_rate: float = 0.025
    """Independent failures for each final draw; with less, there may be heavier weights than any met."""
    max_point_share: float = 0.25
    """Share of p that a typical point of a region may stand for as a draw."""
    max_unseen_share: float = 0.3
    """Share of p that may be in regions that were not found."""


@dataclass(frozen=True, kw_only=True)
class TwoStageSettings:
    """All settings of a run."""

    min_exploration_budget: int = 400
    """With fewer simulations an exploration is not worth its draws."""
    sufficient_budget: int = 1500
    """With fewer, one of two like regions is missed in 3 to 30 % of runs, without any sign."""
    common_share: float = 0.1
    """Where this share of the base draws fails, plain Monte Carlo is as good as anything."""
    monte_carlo_batch: int = 10_000
    """Base draws of a batch of plain Monte Carlo."""
    target_batches: int = 10
    """With a target c.o.v., a batch of the estimate is the budget divided by this ..."""
    min_target_batch: int = 100
    """... but at least so many draws."""
    max_batches: int = 100
    """Batches after which a target c.o.v. is given up where max_sim does not say."""
    min_stratum_draws: int = 10
    """Of components with fewer draws the second moment stands in for the variance: that of a handful is worth
    nothing."""
    draws_per_control: int = 30
    """Draws of a round for each kind of component from which on their weights are calibrated: with fewer the bias by
    estimated slopes would count."""


EXPLORATION = ExplorationSettings()
LINES = LineSettings()
TERMS_ALONE = TermsAloneSettings()
REGIONS = RegionSettings()
SLOPES = SlopeSettings()
REFINEMENT = RefinementSettings()
FALLBACK = FallbackSettings()
DIAGNOSTICS = DiagnosticSettings()
TWO_STAGE = TwoStageSettings()
LINEAR_MODEL = LinearModelSettings()
PIECES = PieceSettings()
CORNER = CornerSettings()
EDGES = EdgeSettings()
SUBSPACE = SubspaceSettings()
WEIGHTS = MixtureWeightSettings()
WALKS = WalkSettings()
LAW = LawSettings()
ROUNDS = RoundSettings()
DOUBTS = DoubtSettings()
TERMS = TermSettings()
