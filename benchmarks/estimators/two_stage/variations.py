"""Variations of two-stage's settings: what is halved and doubled, and on which problems.

Of limits near 1 it is the distance from 1; where neither makes sense, the nearest that does.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

PLANES = ("convex_d2", "corner_d5", "three_d6", "two_d60")
"""Bounded by hyperplanes, or nearly; one region and several."""
MANY_DIMENSIONS = ("two_d30", "two_d60", "lin_d100", "four_d100")
CURVED = ("convex_d2", "sphere_d20", "concave_d2", "corner_d5")
"""Not described by one hyperplane."""


@dataclass(frozen=True)
class Variation:
    """Settings that are changed together, down and up, and where."""

    problems: tuple[str, ...]
    values: Mapping[str, tuple[Any, Any]]
    """By the path of a setting in `MixtureSettings`."""


VARIATIONS = {
    "ridges": Variation(PLANES, {"linear_model.ridges": ((0.5, 5e-4), (2.0, 2e-3))}),
    "least absolute deviations": Variation(
        PLANES,
        {
            "linear_model.lad_iterations": (6, 24),
            "linear_model.lad_ridge": (5e-4, 2e-3),
            "linear_model.lad_smoothing": (5e-4, 2e-3),
            "linear_model.min_left_out": (5e-4, 2e-3),
            "linear_model.min_left_out_lad": (5e-3, 2e-2),
        },
    ),
    "inliers": Variation(
        PLANES,
        {
            "linear_model.inlier_sigmas": (1.5, 6.0),
            "linear_model.agreeing_share": (0.55, 0.8),
            "linear_model.trimmed_share": (0.01, 0.04),
        },
    ),
    "points of a regression": Variation(
        PLANES,
        {
            "linear_model.min_points": (3, 10),
            "linear_model.min_points_per_dim": (0.6, 2.4),
            "linear_model.min_failures": (4, 16),
        },
    ),
    "limits of R^2": Variation(
        PLANES, {"linear_model.exact_r2": (0.9995, 0.998), "linear_model.boundary_r2": (0.975, 0.9)}
    ),
    "least R^2": Variation(PLANES, {"linear_model.min_r2": (0.15, 0.6)}),
    "start of a hyperplane": Variation(
        PLANES,
        {
            "linear_model.crossing_errors": (1.0, 4.0),
            "linear_model.nearest_share": (0.015, 0.06),
            "linear_model.same_region_share": (0.25, 0.75),
        },
    ),
    "widening": Variation(PLANES, {"linear_model.widening": (1.15, 1.6)}),
    "slack": Variation(PLANES, {"edges.slack": (0.01, 0.04)}),
    "edge": Variation(CURVED, {"edges.mean_excesses": (1.0, 4.0), "edges.share": (0.01, 0.04)}),
    "radius": Variation(
        CURVED,
        {
            "edges.radius_share": (0.005, 0.02),
            "edges.radius_factor": (0.99, 0.96),
            "edges.min_radial_shape": (0.15, 0.6),
        },
    ),
    "high_dim": Variation(MANY_DIMENSIONS, {"subspace.high_dim": (20, 80)}),
    "numbers of components": Variation(
        CURVED,
        {
            "subspace.max_worse": (1, 4),
            "subspace.covariance_parameters_per_dim": (1.0, 4.0),
            "subspace.points_per_component": (2.0, 8.0),
        },
    ),
    "EM": Variation(
        CURVED,
        {
            "subspace.max_em_iterations": (12, 50),
            "subspace.min_relative_gain": (2e-3, 5e-4),
            "subspace.em_restarts": (1, 6),
        },
    ),
    "refit_steps": Variation(CURVED, {"subspace.refit_steps": (1, 4)}),
    "points of a refit": Variation(
        CURVED,
        {
            "subspace.min_refit_points": (3, 10),
            "subspace.refit_ess": (15.0, 60.0),
            "subspace.refit_ess_per_dim": (1.5, 6.0),
            "subspace.points_per_refit_ess": (1.5, 6.0),
            "subspace.power_step": (0.05, 0.2),
        },
    ),
    "limits in high dimensions": Variation(
        MANY_DIMENSIONS, {"subspace.max_spread": (2.0, 8.0), "subspace.max_mean_excess": (0.25, 0.9)}
    ),
    "standard_errors": Variation(CURVED, {"subspace.standard_errors": (1.0, 4.0)}),
    "updates": Variation(CURVED, {"weights.updates": (30, 120)}),
}
"""By name."""
