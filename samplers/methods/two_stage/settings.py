"""Settings of two-stage: each has its paper, or its reason and the measurement that chose it.

Users set `TwoStage.n` only. If nothing else stands beside a number, it was chosen together with the others on the
problems of the benchmark of samplers at 6,000 simulations: some 30 configurations, up to 40 runs each, by which
differences in gain of less than a factor of two cannot be told from chance.
"""

from typing import ClassVar

HIGH_DIM = 40
"""Above so many dimensions a Gaussian has one direction of its own: some hundred points show no more."""


class BUDGET:
    """What a run is worth doing with."""

    usual = 6000  # Simulations that the sizes of the exploration hold for; they grow in proportion, above with the root
    least = 400  # With fewer simulations an exploration is not worth its draws
    sufficient = 1500  # With fewer, one of two like regions is missed in 3 to 30 % of runs, without any sign
    common_share = 0.1  # Where this share of the base draws fails, plain Monte Carlo is as good as anything


class EXPLORATION:
    """Draws of the exploration (`exploration.py`) at the usual budget."""

    base = 500  # Base draws; five levels of a tenth each reach 1e-5 from there
    wide = ((1.5, 400), (2.2, 80), (3.0, 60), (4.2, 60))
    """(s, number). At s = 3 a half-space at beta = 4.5 is hit by one draw in 15, at s = 4.2 one at beta = 6 by one in
    13; at s = 1.5 the ball of pit_d5, which f does not announce, is hit 1.6 times as often as by base draws. With 120,
    120 and 80 of the first three, 7 of 20 runs missed it, with 400 of the first 7 of 60, with 600 10 of 180 at 9 +- 2.6
    % less gain, and a third less on CutIn-v0 with its base `highway`."""
    level = 250  # Points of each level of subset simulation
    level_fraction = 0.1  # Conditional probability of a level (Au and Beck 2001)
    level_acceptance = 0.44  # Acceptance that its chains are adapted to (Papaioannou, Betz, Zwirglmaier, Straub 2015)
    level_share = 0.45  # Share of the budget after which no further level is begun
    common_failures = 5
    """Failures among the base draws from which on no level is begun, and the second round counts in p: chains start
    from these failures, and one round shows how to describe what is so common."""
    starts = 24  # Chains from wide failures at most; as many more from failures of the lines and the levels
    share = 0.65  # Share of the budget for the whole exploration


class LINES:
    """Lines of descent (`exploration.py`) at the usual budget."""

    n = 24  # Lines; half of them arrive, as a rule. With 30 no c.o.v. was smaller on four problems (20 seeds each)
    acceptance = 0.3  # Share of fresh steps that shall be taken
    limit = 400  # Simulations after which all lines end; with 1,200 too few chains are left for rare failures
    many_regions = 6
    """In more than `HIGH_DIM` dimensions lines in so many regions mean a shell or a ring: chains would not relax
    there, and none are run."""


class REGIONS:
    """Chains inside the failure region, and how regions are separated (`regions.py`)."""

    steps = 12  # Steps of the chains
    steps_high_dim = 16  # The same above `HIGH_DIM` dimensions, where a wide failure has further to go
    noisy_share = 0.9  # Where less than this share of points right beside failing ones fail, f is noisy
    most = 16  # Regions that are separated at most
    many = 8  # Number of regions from which on failure may be something like a shell


class SLOPES:
    """Gradients of f by finite differences (`exploration.py`)."""

    min_dims = ((1, 15), (4, 10))
    """(regions, dimensions) from which on they are sought: with fewer, chains show as much. Many regions have few
    chains each: with the second pair 4 of 60 runs on rare_d14 were off by more than 4 of their errors, else 17."""
    shares = (0.22, 0.3)
    """Share of what is left for them at most: 17 gradients in 40 dimensions. The second one above `HIGH_DIM`
    dimensions, and if the regions are pieces of something like a shell."""
    most = 20  # Gradients at most. With 12, one direction of three of screen_d40 was not found in one run of 24
    few = 0.65
    """The directions are few where the gradients are worth so many equal directions, over those that as many random
    gradients would be worth. On the shell sphere_d20 1, on series6_d25 0.55, on oscillator_d100 0.4."""
    most_axes = 12  # Directions at most. With 8, the c.o.v. of duffing_d60 was 0.21 for 0.15 (24 runs each)


class FIT:
    """Gaussians fitted to weighted points (`mixture.py`)."""

    sizes = (1, 2, 3, 4, 6, 8)  # Numbers of components tried; two of them without a better score end the search
    ess = (30.0, 3.0)
    """Effective points that a component is moved to, as its mean and a shrunk covariance need them, at least and per
    dimension; where weights are less even, they are raised to a power under 1."""
    standard_errors = 2.0  # So many of them raise a variance under 1: too small a variance makes weights unbounded


class PROPOSAL:
    """Rounds of draws, and the shares of the components in a proposal (`refinement.py`)."""

    round_shares = (0.09, 0.12, 0.14)  # Share of what is left that each round draws; the rest is for the estimate
    further_shares = (0.14, 0.14)  # The same of further rounds, while a region is badly described
    described = 0.1
    """Effective failures over failures of a round in a region, of which it has 10 or more, from which on the region is
    described. As a warning of the final draws it says nothing: 64 of 1,240 right runs had less, 1 of 22 wrong ones."""
    good_rate = 0.1  # Independent failures for each draw of a round with which its proposal describes the failures
    base_share = (0.05, 0.1)  # Least share of base draws: no weight exceeds 20; the second one where f is noisy
    tempered_share = (0.1, 0.5)
    """Least share of tempered Gaussians, dealt out among the regions by the roots of their shares of the failures: the
    best weights for the failures met so far may leave a region hardly any. Without this the variance of a draw was 1.2
    times as large on common3_d9 and banana_d8, and 2.1 times on loads_d7 (20 runs each). The second where f is noisy:
    q^(1/2) phi^(1/2) is the best proposal then."""
    region_share = (0.5, 0.2)
    """Share of the draws that is dealt out evenly among the regions, in the rounds and in the estimate: weights of a
    region's first draws can be so uneven that it seems to have no mass."""
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
    70."""
    initial_shares: ClassVar[dict[str, float]] = {
        "base": 0.1,
        "radial": 0.1,
        "gaussian": 0.5,
        "linear": 0.5,
        "explored": 0.2,
        "tempered": 0.25,
        "spread": 0.2,
        "directional": 0.1,
    }
    """Shares of the kinds if nothing is known yet; of those present, in proportion. Without a kind the stated
    variance (median) is 131 times as large on sphere_d20 (radial), 15 times on two_d30 and 4 times on three_d6 and
    steps_d6 (linear), 20 times on corner_d5 (corners, linear too), 20 times on cones_d13 (explored) and 4 times on
    sector_d6 (directional)."""


class FALLBACK:
    """When a proposal is given up for subset simulation (`method.py`)."""

    early_rates = (0.005, 0.006)
    """What each draw of the first rounds must be worth, in independent failures. Less cannot be told from chance; with
    0.008 and more, proposals are given up that are several times better by the third round."""
    late_rate = 0.04
    """The same for later rounds, times the levels: subset simulation has an independent failure for each 100 levels
    simulations, and the weights that were met are about four times flatter than all of them."""
    max_typical = 30.0
    """How many times p a typical point of most regions may weigh as a draw: 1 to 3 is usual, 17 was seen to do. From
    `PROPOSAL.good_rate` on it does not apply."""


class DOUBT:
    """When an estimate is doubted (`stratified.py`)."""

    false_alarm = 1e-3  # Probability with which a check of the base draws warns of a right estimate
    max_deviation = 4.0
    """Standard errors between rounds and estimate; a normal distribution exceeds it once in 16,000 runs."""
    max_point_share = 0.25  # Share of p that a typical point of a region may stand for as a draw
    max_unseen_share = 0.3
    """Share of p that may be in regions that were not found from which a remark says so, no warning: the interval holds
    it. At 1,500 simulations 50 of 455 right runs had the remark, 14 of 44 that were off by more than 4 errors."""


class PLANES:
    """Half-spaces and corners from regression of f around a region (`edges.py`)."""

    inlier_sigmas = 3.0  # Standard deviations up to which a point agrees with its piece (Rousseeuw and Leroy: 2.5)
    agreeing_share = 0.6  # Share of the points that must agree: over half, for two regions may have half each
    exact_r2 = 0.999  # R^2 from which f is what the pieces say
    boundary_r2 = 0.95
    """R^2 from which pieces locate the failure boundary. Corners down to 0.8 bought nothing: with 0.98 for 0.8 the
    variance was 0.996 +- 0.05 times as large, and with 0.95 for 0.98 0.97 +- 0.02 times."""
    min_r2 = 0.3  # R^2 under which a hyperplane is no help: at 0.15 no run differs, at 0.6 variance 0.97 +- 0.03
    crossing_errors = 2.0  # Standard errors of a prediction by which a half-space begins before its plane
    nearest_share = 0.03  # Share of the failures that may lie before the edge where no plane locates it: none of 33
    min_failures = 8  # Failures that half-spaces need: `failure_edge` takes a quarter of the mean excess off 8 of them
    pieces = 6  # Pieces of a corner to start with
    min_start = -1.0  # Planes nearer than this hold 84 % of N(0, I) or more: the corner is hardly larger without them
    min_distance = 0.5  # Nearer to the origin than this a half-space holds 31 % of N(0, I): base draws serve as well
