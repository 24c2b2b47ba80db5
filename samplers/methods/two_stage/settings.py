"""Settings of two-stage: the numbers of its stages, each with its reason.

Users set `TwoStage.n` only. Where no other reason stands beside a number, it was chosen together with the others on the
problems of the benchmark of samplers at 6,000 simulations: some 30 configurations, up to 40 runs each, by which
differences in gain of less than a factor of two cannot be told from chance.
"""


class LINEAR_MODEL:
    """Robust regression of f, and half-spaces beyond its hyperplane (`edges.py`)."""

    ridges = (1.0, 1e-3)  # Ridge penalties; the smaller one is tried where points are enough for ordinary regression
    lad_iterations = 12  # Steps of iteratively reweighted least squares towards least absolute deviations
    lad_smoothing = 1e-3
    """Share of the median deviation added to each before it divides: exact points have no infinite weight."""
    min_left_out = 1e-3  # Least 1 - leverage that divides: a point that alone decides on a slope has leverage 1
    min_left_out_lad = 1e-2  # The same for least absolute deviations: one such point must not hold all the weight
    inlier_sigmas = 3.0  # Standard deviations up to which a point agrees with a hyperplane (Rousseeuw and Leroy: 2.5)
    min_points = 5  # Points that a regression needs
    min_points_per_dim = 1.2  # With `min_points` + so many per dimension the small ridge and outliers can be judged
    trimmed_share = 0.02  # Share of the outcomes left out at either end: f may be capped or wild there
    exact_r2 = 0.999  # R^2 from which f is linear
    boundary_r2 = 0.95
    """R^2 from which the hyperplane, or the planes of a corner, locate the failure boundary. Corners down to 0.8 bought
    nothing: with 0.98 for 0.8 the variance was 0.996 +- 0.05 times as large (67 runs on the 14 limit states with such
    ones), and with 0.95 for 0.98 0.97 +- 0.02 times, on drive_d6 0.92 (20 runs on five)."""
    min_r2 = 0.3
    """R^2 under which a hyperplane is no help; that of pure noise stays below (`test_noise_has_no_hyperplane`). At 0.15
    no run differs, at 0.6 variance 0.97 +- 0.03."""
    agreeing_share = 0.6
    """Share of the points that must agree with a hyperplane: over half, for two regions may have half each."""
    crossing_errors = 2.0  # Standard errors of a prediction by which a half-space begins before the hyperplane
    nearest_share = 0.03
    """Share of the failures that may lie before the edge where no hyperplane locates it: none of 33."""
    min_failures = 8
    """Failures that half-spaces need: `failure_edge` takes a quarter of the mean excess off the least of 8."""
    same_region_share = 0.5  # Failures nearer along the axis than this share of the median are another region's
    widening = 1.3
    """Variance of the Gaussian over that of N(0, 1) beyond the edge: too small a one makes weights unbounded."""


class PIECES:
    """f as the least of linear functions (`edges.py`)."""

    n = 24  # Pieces to start with; on oscillator_d100 10 to 20 of them are left
    iterations = 20  # Regressions of each piece: by then hardly a point changes its piece
    points_per_dim = 2  # A piece starts from so many points per dimension ...
    least_points = 6  # ... and so many more; it is given up with fewer than one per dimension and these.
    first_ridge = 0.3  # Ridge penalty of the first regressions, which rest on few points
    crossing_errors = 4.0
    """Standard deviations of its residuals by which a half-space begins before its plane. With 2 and 3 the intervals
    held p in 90 and 88 % of 60 runs on oscillator_d100, for the slopes leave out some of the direction of a plane; with
    4 in all of them, at the same gain."""
    min_r2 = 0.8
    """R^2 under which f is no least of linear functions. It is 0.93 to 0.98 on oscillator_d100, 0.81 to 0.91 on
    duffing_d60, and negative on screen_d40, where f is the largest of three."""
    highest = 0.1  # Share of the outcomes left out at the upper end: what f is far from failure does not matter


class CORNER:
    """f as the greatest of linear functions (`edges.py`)."""

    n = 6  # Pieces to start with
    starts = 3  # Fits from other points at most, until one explains f ...
    promising_r2 = 0.9  # ... where the first one has this R^2: the corners of screen_d40 had 0.94 and more.
    patience = 4  # Steps of a fit without a gain that end it; with 3, two corners of 16 of common3_d9 were lost
    points_per_dim = 100  # Points of a fit per dimension at most, evenly spaced: more show the same planes
    min_start = -1.0  # Planes nearer than this hold 84 % of N(0, I) or more: the corner is hardly larger without them
    min_turn = 0.1  # Sine of the least angle between a plane and the span of those before it: two at less are one


class EDGES:
    """Where proposals with an edge begin (`mixture.py`, and the planes of the regressions)."""

    min_distance = 0.5  # Nearer to the origin than this a half-space holds 31 % of N(0, I): base draws serve as well
    slack = 0.02  # By how much a half-space begins before the edge, in standard deviations of N(0, I)
    mean_excesses = 2.0  # Mean excesses over the quantile, over the number of failures, by which an edge is put back
    min_ess = 2.0  # Least number of failures that they are divided by
    radius_share = 0.01  # Share of the failures' weight that may lie within the radius before it is shortened
    radius_factor = 0.98
    """|u|^2 there, times this, is where radial draws begin: the least of few lies beyond the edge of many."""
    min_radial_shape = 0.3
    """Least shape of the Gamma distribution of |u|^2: with less, nearly all draws are at its start."""


class SUBSPACE:
    """Mixtures fitted to weighted points (`mixture.py`)."""

    high_dim = 40  # Above so many dimensions a component has one direction of its own: some hundred points show no more
    sizes = (1, 2, 3, 4, 6, 8)  # Numbers of components tried; `max_worse` of them without a better score end the search
    max_worse = 2  # The score of a fit is uneven in their number: after one that is worse, a better one may follow
    max_em_iterations = 25  # M-steps at most
    min_relative_gain = 1e-3  # EM ends where a step raises the log likelihood by less than this share of it
    em_restarts = 3  # Starts for each number of components; k-means++ draws its centres
    min_ess = 2.0  # Points that any component is taken to rest on: the formulae divide by their number
    refit_steps = 2  # M-steps between two rounds of draws; the rounds go on from there
    min_refit_points = 5  # A component with fewer points stays where it is
    refit_ess = 30.0
    """Effective points that a component is fitted to, as its mean and a shrunk covariance need them ..."""
    refit_ess_per_dim = 3.0
    """... or so many per dimension; where weights are less even, they are raised to a power under 1."""
    points_per_refit_ess = 3.0
    """Points of a component for each of them: no more is asked of it than a third of its points."""
    power_step = 0.1  # By how much the power falls from trial to trial; the effective number of points grows as it does
    max_spread = 4.0  # Largest variance along the one direction in high dimensions; points of another region give more
    standard_errors = 2.0  # So many of them raise a variance under 1: too small a variance makes weights unbounded
    max_mean_excess = 0.5
    """Share of a mean taken off as noise at most: of few points in hundreds of dimensions it is all noise."""
    covariance_parameters_per_dim = 2.0
    """Parameters of a covariance that BIC counts at most, per dimension: with all d (d + 1) / 2 of them some dozens of
    points would never have a second component."""
    min_bic_ess = 3.0  # Least number of points that BIC takes: log(n) would fall under 1 with fewer
    points_per_component = 4.0  # Effective points for each component at least


class EXPLORATION:
    """Draws of the exploration (`exploration.py`); their numbers hold for `usual_budget` simulations."""

    usual_budget = 6000  # Up to here sizes grow in proportion to the budget, above with its square root
    base = 500  # Base draws; five levels of a tenth each reach 1e-5 from there
    wide = ((1.5, 120), (2.2, 120), (3.0, 80))
    """(s, number); at s = 3 a half-space at beta = 4.5 is hit by one draw in 15."""
    deep_scale = 3.3  # Where the levels went so far that wide draws should have a larger s, there are ...
    deep_draws = 80  # ... so many more, with that s.
    depth_ratio = 1.45  # Distance of the levels' end, beta, over s: one draw in 14 is beyond a half-space there
    level = 250  # Points of each level of subset simulation; `least_level` where the budget is small
    least_level = 100
    level_fraction = 0.1  # Conditional probability of a level (Au and Beck 2001)
    common_failures = 5
    """Failures among the base draws from which on no level is begun, and the second round counts in p: chains start
    from these failures, and one round shows how to describe what is so common."""
    points_per_seed = 3  # Points of a level for each of its seeds at least: chains take two steps or more
    initial_scale = 0.6  # First step of the chains of subset simulation, as in `AdaptiveSubsetSimulation`
    level_acceptance = 0.44  # Acceptance that it is adapted to (Papaioannou, Betz, Zwirglmaier and Straub, 2015)
    max_levels = 30  # Levels at most; the share of the budget ends the descent first unless f ties
    starts = 24  # Chains from wide failures at most; `least_starts` where the budget is small
    least_starts = 10
    level_starts = 24  # The same for failures of subset simulation; they replace wide failures that are missing
    least_level_starts = 6
    bisections = 3  # Steps of a wide failure towards the origin: its edge is then known to an eighth of the way
    chain_cost = 25  # Simulations that a chain needs at most before it is sorted: bisection, two walks, points half way
    descent_share = 0.45  # Share of the budget after which no further level is begun
    share = 0.65  # Share of the budget for the whole exploration


class LINES:
    """Lines of descent (`exploration.py`); numbers of simulations hold for `EXPLORATION.usual_budget`."""

    n = 24
    """Lines. Half of them arrive, as a rule. With 30 the exploration costs 60 to 110 simulations more, and the c.o.v.
    was no smaller on four problems (20 seeds each)."""
    root_share = 0.1  # Share of the base draws that lines start from: higher up they cost more and lead no further
    initial_step = 0.35  # First step
    acceptance = 0.3  # Share of fresh steps that shall be taken ...
    adaptation = 0.5  # ... and change of the log step per unit of it.
    step_range = (0.03, 1.0)  # Least and largest step
    most_tries = 3  # Tries at once of each line where others have arrived, so that the batches do not become small
    steps = 300  # Lines that go on, times steps taken, at most: where failures are far off, few that arrive are better
    limit = 600  # Simulations after which all lines end
    most_arrived = 0.6  # Share of the lines that has arrived when the others have `patience` times the median time
    patience = 2.0
    first_look = 450  # Simulations after which lines are given up if less than `few_arrived` of them have arrived
    few_arrived = 0.15
    starts = 4  # Lines of each region from which chains start
    many_regions = 6
    """In more than `SUBSPACE.high_dim` dimensions lines in so many regions mean a shell or a ring: chains would not
    relax there, and none are run."""


class TERMS_ALONE:
    """Searches on single terms of f (`terms_alone.py`)."""

    lines = 4  # Lines of descent, and starts of chains, of each term, as of each region
    line_share = 0.15  # Share of what is left for lines on terms that were the least somewhere, and failed nowhere
    scout_share = 0.1  # The same for terms that were the least nowhere
    usual_cost = 180  # Simulations for the lines of a term; of more terms than that allows, some are left out
    chain_share = 0.15  # Share of what the exploration leaves for the chains from the ends of the lines
    least_density = 1e-5
    """Failures less likely than the likeliest ones by this factor start no chains: they matter too little."""


class REGIONS:
    """Chains inside the failure region, and how regions are separated (`regions.py`)."""

    initial_step = 0.5  # pCN step before any adaptation
    steps = (5, 6)  # Steps of the chains before and after they are sorted into regions
    steps_high_dim = (8, 8)  # The same above `SUBSPACE.high_dim` dimensions, where a wide failure has further to go
    chain_acceptance = 0.35  # Acceptance that the step is adapted to; Papaioannou and others, 2015, adapt to 0.44
    adaptation = 0.7  # Change of the log step per unit of acceptance in the first step; it falls with their root
    min_step = 0.02  # Least pCN step
    across_factors = (1.1, 0.75)
    """Factors of the step across the given direction after a failing proposal and after another one: in balance at an
    acceptance of ln(1 / 0.75) / ln(1.1 / 0.75) = 0.75, for across the direction fresh draws are nearly always right."""
    min_across = 0.05  # Least step across the given direction
    along_factors = (1.05, 0.9)  # The same along the given direction: in balance at 0.68
    many_regions = 8  # Number of regions from which failure may be something like a shell
    scattered_share = 0.25  # Where this share of the points is in none of `many_regions` regions, it is
    few_points = 8  # So many points or fewer are all compared with each other at once, not region by region
    max_regions = 16  # Regions that are separated at most
    chains_per_region = (8, 24)  # Chains of each region at least, in few dimensions and in many
    points_per_dim = 2.5  # Points of a region per dimension, within these: a covariance and a regression need them
    max_replicated = 60  # Chains that are added to reach it at most, over all regions
    probes = 30  # Points beside failing ones that show whether f is noisy
    probe_distance = 1e-6
    """How far beside, in standard deviations: no f of a simulation changes over it, save at jumps or by noise."""
    noisy_share = 0.9  # Where less than this share of the probes fail, f is noisy
    late_steps = 2  # Of the steps before sorting, the last ones whose proposals describe f around a region
    late_steps_high_dim = 4  # The same above `SUBSPACE.high_dim` dimensions
    direction_r2 = 0.5  # From this R^2 on, chains follow the direction in which f falls, else that of their mean
    mean_steps = 3  # Last steps of the chains that this mean is of
    min_points_per_dim = 3
    """With fewer points per dimension around the only region, points of subset simulation join them."""
    lower_share = 0.7  # Share of the points of subset simulation that do, those with the lowest f


class SLOPES:
    """Gradients of f by finite differences (`exploration.py`)."""

    min_dim = 15  # Dimensions from which on they are sought: with fewer, chains show as much
    share = 0.22  # Share of what is left for them at most: 17 gradients in 40 dimensions at 6,000 simulations
    high_dim_share = 0.3
    """The same above `SUBSPACE.high_dim` dimensions, where a component has one direction without slopes, and where the
    regions are pieces of something like a shell."""
    least = 4  # Gradients that two directions can be told from many with
    most = 20  # Gradients at most. With 12, one direction of three of screen_d40 was not found in one run of 24.
    step = 0.05  # Of a finite difference, in standard deviations: f bends little over it, and rounding is nothing
    few = 0.65
    """The directions are few where the gradients are worth so many equal directions, over those that as many random
    gradients would be worth. On the shell sphere_d20 1, on series6_d25 0.55, on oscillator_d100 0.4."""
    explained = 0.99  # Share of the squares of new gradients in known directions from which on no more are made
    least_part = 0.005  # Share of the gradients' squares that a direction must hold: noise of f bends gradients less
    most_axes = 12  # Directions at most. With 8, the c.o.v. of duffing_d60 was 0.21 for 0.15 (24 runs each).


class REFINEMENT:
    """Rounds of draws, and the shares of the components in a proposal (`refinement.py`)."""

    round_shares = (0.09, 0.12, 0.14)  # Share of what is left that each round draws; the rest is for the estimate
    counted_from = 2
    """Rounds that do not count in p, the first ones: their proposals may not describe the failures yet. The draws of
    the third were worth 0.8 to 1.6 times as much as as many of the last ones, on four problems (30 runs each)."""
    further_shares = (0.14, 0.14)  # The same of further rounds, while the last one is worth less than `good_rate`
    good_rate = 0.1  # Independent failures for each draw of a round with which its proposal describes the failures
    base_share = 0.05  # Least share of base draws: no weight exceeds 20
    noisy_base_share = 0.1  # The same where f is noisy
    tempered_share = 0.1
    """Least share of tempered Gaussians, dealt out among the regions by the roots of their shares of the failures. The
    best weights for the failures met so far may leave a region hardly any: without this the variance of a draw was 1.2
    times as large on common3_d9 and banana_d8, and 2.1 times on loads_d7 (20 runs each)."""
    extra_tempered_share = 0.2
    """How much more of them, times the share of the draws from sharp components that did not fail; not where the
    regions are pieces of a shell, for the spread component is wider."""
    noisy_tempered_share = 0.5
    """Least share of tempered Gaussians where f is noisy; q^(1/2) phi^(1/2) is the best proposal then."""
    region_share = 0.5
    """Share of the draws of a round that is dealt out evenly among the regions. Weights of a region's first draws can
    be so uneven that it seems to have no mass: it must not be lost by that."""
    final_region_share = 0.2  # The same for the estimate
    radial_share = 0.05
    """Least share of radial components in few dimensions, and wherever the regions are no more than pieces of a shell:
    they reach failures beside the regions, of which one draw would outweigh all others. In 160 runs of `CutIn-v0` with
    its base `us101-15-offsets` 0, 2, 5 and 10 % had gains of 135, 219, 320 and 242."""
    radial_dim = 20
    """Few dimensions. In 25 (series6, 60 runs) it took the coverage from 93 to 87 % and the gain from 48 to 5."""
    spread_share = 0.4
    """Share of the component that is as wide as the failures in the span of the slopes, where the regions are pieces of
    a shell, or while draws are worth less than `good_rate`: there the failures form a ring, and Gaussians fitted to
    some of them leave gaps. Without it the second moment on oscillator_d100 was 800 to 2,000 times p^2, with it 40 to
    70, and 26 with the half-spaces of the pieces of f; with 0.15 of it these gave 150."""
    explored_share = 0.01  # Share that components from the exploration keep until the last round
    min_share = 0.004  # Components with less of the draws are left out
    wide_scale = 1.5  # Standard deviation of the wide component
    tempering = (0.5,)  # Powers t of q^t phi^(1 - t)
    noisy_tempering = (0.5, 0.25)  # The same where f is noisy
    gaussians_per_region = 3  # Gaussians fitted to the chains of a region at most: it has some dozens of them
    noisy_gaussians = 8  # The same where f is noisy: all of it is one region then
    points_per_chain = 2.0  # Independent points that a chain is worth
    min_refit_failures = 6  # Failures, all in all, from which on Gaussians and half-spaces are fitted again
    min_radial_failures = 20  # Failures that a radial component needs
    min_log_ratio = 1.0  # A draw belongs to the region whose Gaussian is densest there, if it is e times phi or more
    probit_scale = 1.702
    """Log odds over the argument of Phi that is next to them: noise is near normal, and the logistic curve has far
    heavier tails (Camilli, "Origin of the scaling constant d = 1.7 in item response theory", 1994)."""
    logistic_penalty = 100.0  # Inverse strength of the penalty (C of scikit-learn): hardly any
    logistic_iterations = 2000  # More than the noisy problems of the catalogue need; scikit-learn warns of too few
    quadratic_dim = 20  # Up to here the log odds of failure are quadratic in u, not linear: 231 coefficients at most


class FALLBACK:
    """When a proposal is given up for subset simulation (`method.py`)."""

    min_fallback_budget = 300  # Simulations under which subset simulation is not worth it
    early_rates = (0.005, 0.006)
    """What each draw of the first rounds must be worth, in independent failures. Less cannot be told from chance; with
    0.008 and more, proposals are given up that are several times better by the third round."""
    sloped_rate = 0.25
    """Share of these rates that is enough where components lie in the span of slopes: their draws leave few places out,
    so that the weights met are about as uneven as all of them."""
    relative_rate = 0.04
    """The same for the last round, times the levels: subset simulation has an independent failure for each 100 levels
    simulations, and the weights that were met are about four times flatter than all of them."""
    max_typical = 30.0
    """How many times p a typical point of most regions may weigh as a draw: 1 to 3 is usual, 17 was seen to do. From
    `REFINEMENT.good_rate` on it does not apply."""


class DIAGNOSTICS:
    """When an estimate is doubted (`stratified.py`)."""

    false_alarm = 1e-3  # Probability with which a check of the base draws warns of a right estimate
    max_deviation = 4.0
    """Standard errors between rounds and estimate; a normal distribution exceeds it once in 16,000 runs."""
    min_rounds_ess = 30.0  # Independent failures that the rounds must be worth to be compared
    min_final_rate = 0.025
    """Independent failures for each final draw; with less, there may be heavier weights than any met."""
    max_point_share = 0.25  # Share of p that a typical point of a region may stand for as a draw
    max_unseen_share = 0.3  # Share of p that may be in regions that were not found


class TWO_STAGE:
    """All settings of a run."""

    min_exploration_budget = 400  # With fewer simulations an exploration is not worth its draws
    sufficient_budget = 1500  # With fewer, one of two like regions is missed in 3 to 30 % of runs, without any sign
    common_share = 0.1  # Where this share of the base draws fails, plain Monte Carlo is as good as anything
    monte_carlo_batch = 10_000  # Base draws of a batch of plain Monte Carlo
    target_batches = 10  # With a target c.o.v., a batch of the estimate is the budget divided by this ...
    min_target_batch = 100  # ... but at least so many draws.
    max_batches = 100  # Batches after which a target c.o.v. is given up where max_sim does not say.
    min_stratum_draws = 10
    """Of components with fewer draws the second moment stands in for the variance: a handful has none."""
    draws_per_control = 30
    """Draws of a round for each kind of component from which on weights are calibrated: slopes of fewer bias."""


INITIAL_SHARES = {
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
"""Shares of the kinds where nothing is known yet; of those present, in proportion. What a kind is worth, on ten
problems of the catalogue with 4 seeds each: without it the stated variance (median) is 131 times as large on sphere_d20
(radial), 15 times on two_d30 and 4 times on three_d6 and steps_d6 (linear). On twelve others with 2 seeds it is 1.6
times as large without `corner`, 20 times on corner_d5. Without `explored` 5 of 40 intervals miss p, with it none.
Without `tempered` the variance is a quarter smaller: they are for noise, and for regions that are badly described.
`wide` buys nothing over all (1.02 +- 0.05, 168 runs on 48 limit states): it guards the coverage on loads_d7 and
crossing_d6."""
