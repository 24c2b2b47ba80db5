"""Settings of the search by terms: the numbers of its stages, each with its reason.

If a measurement is named, E[w^2] is the second moment of the weights of failures, on Highway-v0 with 6,000
simulations: of collisions of two egos, and of `lidar_ttc` where it is named.
"""


class WALKS:
    """Gradient walks to the failures of each term (`walks.py`)."""

    candidate_share = 0.005
    """A term is a main one where it is the least of this share of the base draws: 3 of 600, among the lowest fifth."""
    walkers = 72  # Walks of all main terms together, as far as all can make two steps; for each ...
    most = 24  # ... at most: more find nothing more on Highway-v0.
    scouts = 2  # Walks of every other term: the least of 600 draws may hide one that is near along its gradient
    most_scouted = 12  # Others scouted at most, lowest values first; more eat the budget
    steps = 8  # Steps at most: 6 reach beta = 4.5, 8 reach 6
    first_step = 1.3  # Length of the first step in standard deviations; it grows by this factor with each downhill
    shrinkage = 0.4  # Factor of the length after a step uphill: roughness of f is shorter than that
    budget_share = 0.25  # Share of the budget that walks use at most, gradients at what they may cost
    max_distance = 7.0  # Walks end where the half-space of their gradient is further from the origin: Phi(-7) = 1e-12
    negligible = 1e-5
    """A term is left to base draws where Phi(-beta), beta the median of its failing walks, is this share of the largest
    one. The plane of a gradient is a poor guide where terms are curved: of two with a fifth and four fifths of p it was
    3e-4 (`test_curved_terms`)."""


class LAW:
    """Proposal of one term in the subspace of its gradients (`fitting.py`)."""

    rank = 8  # Right singular vectors kept: failures of a term are nearly one half-space, 8 hold its curvature
    least_singular = 0.05
    """Singular vectors under this share of the first are left out: there the term hardly changes, and what is fitted
    instead makes heavy weights. E[w^2] falls by a tenth (imitation) and a third (IDM) against 0.1; 0.03 and rank 12 are
    worse for one."""
    gradients = 12  # Gradients of a term for each fit, at points drawn by weight; fewer where terms are many
    kept_gradients = 48  # The last ones span the subspace: later ones are at likelier failures
    shares = (0.55, 0.3, 0.15)
    """Of the fitted Gaussians; of the same nearer to the origin and wider, which bound weights where a fit is too
    narrow or too far out; and of N(0.9 z, I) around single points z: a mode of one draw stays in reach, weights in a
    half-space are bounded. In the shape of the fitted ones these leave a heavy draw in one of ten series systems."""
    nearer = (0.75, 1.7)
    """Factors of mean and variance of the second: a mean times 0.85 has 1.1 times the E[w^2]; 0.7 has 0.9 times it, but
    a heavy draw in one of ten series systems of half-spaces."""
    points = 24  # Single points: half of them the heaviest draws at most, the others ends of walks
    most = 3  # Gaussians of a term at most
    many_ess = 160.0
    """Weights are raised to a power until they are worth so many points, for covariances and shares ..."""
    few_ess = 15.0
    """... and so many, of failures alone, for means. Points under the lowest level that is worth as many serve where
    failures are fewer, for these lie in the same slab. With 40 for the means E[w^2] is 1.04 to 1.06 times as large, and
    with 40 for the covariances too 1.1 times: the slab is then shrunk to twice its width."""


class ROUNDS:
    """Rounds of draws and the final ones (`method.py`); shares are of the budget."""

    min_budget = 400  # Simulations under which there is no room for walks, rounds and an estimate
    size = 0.1  # Base draws, 100 to 2,000 of them, and the draws of an adaptive round
    base_share = 0.04  # Share of base draws in every proposal: no weight exceeds 25
    min_term_share = 0.14
    """Least share of a term, since one heavy draw of another would leave it next to nothing; less if there are more
    than five. With 0.17 two terms with 0.5 % of p took a third of the draws."""
    waiting_share = 0.35  # Weight of a term whose failures are known while another's are not
    min_failures = 5  # Failures of a term from which its means are fitted to them alone, and effective ones to know it
    final_share = 0.52  # Adaptive rounds end where no more than this share of the budget is left
    refit_share = 0.03  # Share kept for the gradients of each fit between the final rounds
    final_sizes = (0.22, 0.33, 0.45)  # Final rounds, as shares of what is left
    final_weights = (0.25, 0.7, 1.0)
    """Weight of a draw of each in p, fixed beforehand so that p stays unbiased. The proposals become better: E[w^2] of
    collisions with the IDM ego is 240, 100 and 42 in the three, of `lidar_ttc` about the same in all."""
    target_batch = 500  # Draws of each further batch where a target c.o.v. is not yet met, 100 times at most
    between_factor = 1.5  # Factor of sum c_r^2 (p_r - p)^2, the variance that the rounds show: with 3 it is 2 / 3 of it
    fallback_rate = 0.001
    """Effective failures for each draw of the last adaptive round under which the mixture is given up. On Highway-v0 a
    good one has 0.005 to 0.009, and at p = 6e-5 subset simulation gains 3 to 8: 0.001 gains 17."""
