"""Settings of the search by terms: the numbers of its stages, each with its reason."""


class WALKS:
    """Gradient walks to the failures of each term (`walks.py`)."""

    candidate_quantile = 0.2
    """A term is a main one where it is the least of some base draws under this quantile of it ..."""
    candidate_share = 0.005  # ... which are at least this share of all base draws: 3 of 600.
    usual_budget = 6000
    walkers = 72  # Walks of all main terms together at the usual budget, in proportion with less ...
    min_walkers = 6  # ... and for each between these two
    max_walkers = 24  # More find nothing more on Highway-v0; half of them start where the term is attained late
    scouts = 2  # Walks of every other term: the least of 600 draws may hide one that is near along its gradient
    max_scouted = 12
    """Others scouted at most, lowest values first, but all that ever are the least; more eat the budget."""
    start_quantile = 0.5
    """Walks start at the lowest values of each half, early and late, of the draws under this quantile."""
    steps = 8  # Steps at most: 6 reach beta = 4.5, 8 reach 6
    first_step = 1.3  # Length of the first step in standard deviations
    growth = 1.3  # Factor of the length after a step downhill, and ...
    shrinkage = 0.4  # ... after one uphill: roughness of f is shorter than that.
    beyond = 0.03  # Standard deviations by which a step aims beyond the threshold: rounding must not stop it
    budget_share = 0.25  # Share of the budget that walks use at most, gradients at what they may cost
    max_distance = 7.0  # Walks end where the half-space of their gradient is further from the origin: Phi(-7) = 1e-12
    negligible = 1e-5
    """A term is left to base draws where Phi(-beta), beta the median of its failing walks, is this share of the largest
    one. The plane of a gradient is a poor guide where terms are curved: of two with a fifth and four fifths of p it was
    3e-4 (`test_curved_terms`)."""


class LAW:
    """Proposal of one term in the subspace of its gradients (`fitting.py`); shares are relative."""

    rank = 8  # Right singular vectors kept: failures of a term are nearly one half-space, 8 hold its curvature
    least_singular = 0.05
    """Singular vectors under this share of the first are left out: there the term hardly changes, its failures are N(0,
    1), and what is fitted instead makes heavy weights. In 10 stored runs of each ego E[w^2] of the collisions that
    other runs found falls by a tenth (imitation) and a third (IDM) against 0.1; 0.03 and rank 12 are worse for one."""
    bump_share = 0.5  # Share of the fitted Gaussians
    tempered_share = 0.3
    """Share of them nearer to the origin and wider, which bounds weights where they are too narrow or, being fitted to
    draws of proposals that lie beyond the likely failures, too far out ..."""
    tempered_mean = 0.75
    tempered_variance = 1.7
    """... with mean and variance times these. What adds to the variance fills the slab. A mean times 0.85 has 1.1 times
    the E[w^2] of the stored runs' collisions; 0.7 has 0.9 times it, but a heavy draw in one of ten series systems of
    half-spaces."""
    end_share = 0.12
    """Share of Gaussians around the ends of the walks: a mode that no draw has met yet stays in reach ..."""
    end_mean = 0.9
    end_variance = 3.0
    """... with the end times the one as mean, and the variance of the nearest fitted Gaussian times the other, at most
    1."""
    guard_share = 0.08
    """Share of N(design point, I) for half-spaces of gradients near failures: modes in other directions. Where a mode
    is that half-space, no weight in it exceeds exp(-beta^2 / 2) over its share."""
    max_guards = 12  # Such half-spaces at most, the nearest first
    guard_spacing = 1.5  # Least distance between their design points; Gaussians nearer than that are one
    max_ends = 24  # Ends kept of a term
    max_heavy = 12  # Of these the heaviest points, once there are some from proposals: a mode of one draw is not lost
    prior_points = 20.0  # Points that I counts as in the covariance of the ends
    shape_points = 1.5
    """Effective points for each dimension from which on a covariance is Stein's estimate of theirs. Between "ahead" and
    "behind" of a car collisions have a variance of 0.05 in one direction, which shrinkage towards I made 0.4: 0.67
    times the E[w^2] of collisions of the IDM ego, over chains of 13,000 failures."""
    max_bumps = 3  # Gaussians of a term at most
    shape_ess = 160.0  # Weights are raised to a power until they are worth so many points, for the covariances ...
    mean_ess = 20.0
    """... and this many, of failures alone, for the means. With 40 E[w^2] is 1.04 to 1.06 times as large over fresh
    draws of `lidar_ttc`, of collisions 1.00 to 1.03. With 40 for the covariances too it was 1.1 times (stored runs):
    collisions lie in a slab (not too far ahead nor behind), whose width was then shrunk to twice what it is."""


class ROUNDS:
    """Rounds of draws and the final ones (`search.py`); shares are of the budget."""

    min_budget = 400  # Simulations under which there is no room for walks, rounds and an estimate
    common_share = 0.1  # Where this share of the base draws fails, plain Monte Carlo is as good as anything
    monte_carlo_batch = 10_000  # Base draws of a batch of plain Monte Carlo
    base = 0.1  # Base draws: 600 of 6,000; with more the budget goes to what hardly fails
    max_base = 2000
    min_base = 100
    size = 0.1  # Draws of an adaptive round
    base_share = 0.04  # Share of base draws in every proposal: no weight exceeds 25
    share_ess = 400.0
    """Weights that the shares of the terms follow are raised to a power below 1 until failures are worth this many
    points: one heavy draw would give its term most of the next round. E[w^2] of the IDM ego's collisions over chains of
    failures is 0.89 times that of untempered weights, of `lidar_ttc` and with `imitation` the same."""
    min_term_share = 0.14
    """Least share of a term, since one heavy draw of another would leave it next to nothing; less where there are more
    than five. With 0.17 two terms with 0.5 % of p took a third of the draws."""
    waiting_share = 0.35  # Weight of a term whose threshold is reached while another's is not
    ready_ess = 6.0
    """Effective failures at which a term is fitted to failures alone: waiting for 50 takes 7 to 9 rounds."""
    min_failures = 5
    """Failures of a term that its means are fitted to, with tempered weights, where they are worth fewer."""
    level_ess = 15.0
    """Effective number of points that covariances are fitted to: under the lowest level that has as many where the
    failures are worth fewer, for these lie in the same slab; with too few failures the means too. Together with
    covariances that are no longer raised by two standard errors E[w^2] over fresh draws is 0.84 and 0.93 times that
    before (collisions), 0.91, 0.85 and 0.85 times (`lidar_ttc`). 20 and 30 are worse for some."""
    gradients = 12  # Gradients of a term for each fit, at points drawn by weight; fewer where terms are many
    max_gradients = 48  # Gradients of all terms for each fit
    later_weight = 1.5  # Weight of gradients over those of the round before: later ones are at likelier failures
    ready_rounds = 1  # Rounds in a row with all terms at the threshold after which the estimate begins
    final_share = 0.52  # Adaptive rounds end where no more than this share of the budget is left
    refit_share = 0.03
    """Share kept for the gradients of each fit between the final rounds; the last round has what is left."""
    final_sizes = (0.22, 0.33, 0.45)  # Final rounds, as shares of what is left
    final_weights = (0.25, 0.7, 1.0)
    """Weight of a draw of each in p, fixed beforehand so that p stays unbiased. The proposals become better: E[w^2] of
    collisions with the IDM ego is 240, 100 and 42 in the three, of `lidar_ttc` about the same in all."""
    target_batch = 500  # Draws of each further batch where a target c.o.v. is not yet met.
    max_target_batches = 100  # Such batches at most, where max_sim does not say


class DOUBTS:
    """When an estimate is doubted, and when it is given up."""

    between_factor = 1.5  # Factor of sum c_r^2 (p_r - p)^2, the variance that the rounds show: with 3 it is 2 / 3 of it
    min_ess = 20.0  # Effective number of failures of the last round under which its spread is not known
    max_point_share = 0.25  # Share of the last round that one draw may carry
    max_other_share = 0.05  # Share of p in failures of terms that were not pursued from which on there is a warning
    min_fallback_budget = 300  # Simulations under which subset simulation is not worth it
    fallback_rate = 0.001
    """Effective failures for each draw of the last adaptive round under which the mixture is given up. On Highway-v0 a
    good one has 0.005 to 0.009, and at p = 6e-5 subset simulation gains 3 to 8: 0.001 gains 17."""
