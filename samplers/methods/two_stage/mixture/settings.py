"""Settings of the mixtures of two-stage: regression, expectation-maximisation, edges, weights.

Below, "variance x and y" are the variances that runs state with a setting halved and doubled (or moved as far as makes
sense), over those with the default one: geometric means over four problems of the catalogue where it acts, 10 seeds
each, 6,000 simulations (`benchmarks/results/setting_sensitivity.json` has values, problems, standard errors and
coverage). Standard errors are 0.05 to 0.15 where none is given: up to 1.2 a ratio may be chance, all the more as rows
on the same problems share their default runs. Settings of one mechanism were moved together; one of them has the
figures.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class LinearModelSettings:
    """Robust regression of f, and half-spaces beyond its hyperplane (`linear_model.py`)."""

    ridges: tuple[float, float] = (1.0, 1e-3)
    """Ridge penalties; the smaller one is tried where points are enough for ordinary regression.
    Variance 0.94 and 1.00 (both of them moved)."""
    lad_iterations: int = 12
    """Steps of iteratively reweighted least squares towards least absolute deviations. Variance 1.01 and 0.95, with
    the settings from here to `min_left_out_lad`."""
    lad_ridge: float = 1e-3
    """Ridge penalty of these steps, the smaller one of `ridges`: it keeps the matrix regular."""
    lad_smoothing: float = 1e-3
    """Share of the median deviation that is added to each before it divides: exact points have no infinite weight."""
    min_left_out: float = 1e-3
    """Least 1 - leverage that a residual is divided by: a point that alone decides on a slope has leverage 1."""
    min_left_out_lad: float = 1e-2
    """The same in the steps towards least absolute deviations, where one such point must not hold all the weight."""
    inlier_sigmas: float = 3.0
    """Deviation up to which a point agrees with a hyperplane, in standard deviations (Rousseeuw and Leroy use 2.5).
    Variance 1.07 and 1.00, with `agreeing_share` and `trimmed_share`."""
    min_points: int = 5
    """Points that a regression needs. Variance 1.00 and 1.00, hardly a run differs, with `min_points_per_dim` and
    `min_failures`: at 6,000 simulations points are seldom as few."""
    min_points_per_dim: float = 1.2
    """With `min_points` + this many points per dimension the small ridge and outliers can be judged."""
    trimmed_share: float = 0.02
    """Share of the outcomes left out at either end: f may be capped or wild there."""
    exact_r2: float = 0.999
    """R^2 from which f is linear. Variance 0.98 +- 0.02 and 1.03 +- 0.02 for half and twice the distance of both limits
    from 1."""
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
    """Standard errors of a prediction by which a half-space begins before the hyperplane. Variance 1.06 and 1.05, with
    `nearest_share` and `same_region_share`."""
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
    large a one costs a few draws. Variance 1.10 at 1.15 and 0.98 at 1.6."""


@dataclass(frozen=True, kw_only=True)
class PieceSettings:
    """f as the least of linear functions (`least_of_planes.py`)."""

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
    """f as the greatest of linear functions (`greatest_of_planes.py`)."""

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
    """Where proposals with an edge begin (`boundary.py`, and the planes of the regressions)."""

    min_distance: float = 0.5
    """Nearer to the origin than this a half-space holds 31 % of N(0, I): base draws serve as well."""
    slack: float = 0.02
    """By how much a half-space begins before the edge, in standard deviations of N(0, I). Variance 0.85 and 1.20, where
    hyperplanes are the boundary; half of it may be better, if failures before the start stay as rare."""
    mean_excesses: float = 2.0
    """Mean excesses over the quantile, divided by the number of failures, by which an edge is put back. Variance 0.98
    and 1.02, with `share`."""
    min_ess: float = 2.0
    """Least number of failures that they are divided by."""
    radius_share: float = 0.01
    """Share of the failures' weight that may lie within the radius before it is shortened. Variance 0.98 and 1.19, with
    `radius_factor` and `min_radial_shape`: 2.08 on one problem."""
    radius_factor: float = 0.98
    """|u|^2 at that quantile, times this, is where radial draws begin: the least of few lies beyond the edge of
    many."""
    min_radial_shape: float = 0.3
    """Least shape of the Gamma distribution of |u|^2: with less, nearly all draws are at its start."""


@dataclass(frozen=True, kw_only=True)
class SubspaceSettings:
    """Mixtures fitted to weighted points (`subspace_em.py`)."""

    high_dim: int = 40
    """Above this many dimensions a component has one direction of its own: some hundred points do not show more.
    Variance 1.06 +- 0.03 at 20 (1.27 on one problem in 30 dimensions) and 1.05 +- 0.03 at 80 (1.23 in 60)."""
    sizes: tuple[int, ...] = (1, 2, 3, 4, 6, 8)
    """Numbers of components that are tried; `max_worse` of them without a better score end the search."""
    max_worse: int = 2
    """The score of a fit is uneven in their number: after one that is worse, a better one may follow. Variance 1.03 and
    1.15, with `covariance_parameters_per_dim` and `points_per_component`."""
    max_em_iterations: int = 25
    """M-steps at most. Variance 1.02 and 1.09, with `min_relative_gain` and `em_restarts`."""
    min_relative_gain: float = 1e-3
    """Expectation-maximisation ends where a step raises the log likelihood by less than this share of it."""
    em_restarts: int = 3
    """Starts for each number of components; k-means++ draws its centres."""
    min_ess: float = 2.0
    """Points that any component is taken to rest on: the formulae divide by their number."""
    refit_steps: int = 2
    """M-steps between two rounds of draws; the rounds go on from there. Variance 1.00 and 1.07."""
    min_refit_points: int = 5
    """A component with fewer points stays where it is."""
    refit_ess: float = 30.0
    """Effective points that a component is fitted to, as its mean and a shrunk covariance need them ..."""
    refit_ess_per_dim: float = 3.0
    """... or this many per dimension. Where the weights are less even, they are raised to a power less than 1.
    Variance 2.8 (47 on one problem) and 0.92 +- 0.06, with the numbers of points above and below and half or twice the
    step of the power."""
    points_per_refit_ess: float = 3.0
    """Points of a component for each of them: no more is asked of it than a third of its points."""
    power_step: float = 0.1
    """By how much the power falls from trial to trial; the effective number of points grows as it does."""
    max_spread: float = 4.0
    """Largest variance along the one direction in high dimensions; a few points of another region give more.
    Variance 1.01 +- 0.01 and 0.98 +- 0.01, with `max_mean_excess`."""
    standard_errors: float = 2.0
    """By how many of them a variance under 1 is raised: too small a variance makes weights unbounded.
    Variance 1.19 +- 0.18 and 1.03."""
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
    """Search for the best weights of a mixture (`mixture_weights.py`)."""

    updates: int = 60
    """Multiplicative updates: they come within 2 % of the least second moment (`test_weights_are_nearly_the_best`).
    Variance 1.10 and 1.17: what is left is chance."""
    negligible: float = 30.0
    """Points whose weight is e^-30 of the largest one do not matter."""


@dataclass(frozen=True, kw_only=True)
class MixtureSettings:
    """All settings of the mixtures."""

    linear_model: LinearModelSettings = LinearModelSettings()
    pieces: PieceSettings = PieceSettings()
    corner: CornerSettings = CornerSettings()
    edges: EdgeSettings = EdgeSettings()
    subspace: SubspaceSettings = SubspaceSettings()
    weights: MixtureWeightSettings = MixtureWeightSettings()


DEFAULT_MIXTURE_SETTINGS = MixtureSettings()
