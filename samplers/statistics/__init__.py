"""Statistics: intervals, importance weights, thresholds, sums over clusters."""

from samplers.statistics.intervals import (
    binomial_cov,
    clopper_pearson,
    gain_over_monte_carlo,
    log_normal_interval,
    zero_hit_bound,
)
from samplers.statistics.thresholds import next_level
from samplers.statistics.weights import effective_sample_size, normalise_weights

__all__ = [
    "binomial_cov",
    "clopper_pearson",
    "effective_sample_size",
    "gain_over_monte_carlo",
    "log_normal_interval",
    "next_level",
    "normalise_weights",
    "zero_hit_bound",
]
