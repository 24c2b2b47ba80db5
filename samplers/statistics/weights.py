"""Weights: normalisation and effective sample size of importance weights, given as logarithms."""

import numpy as np

from samplers.problem import FloatArray
from samplers.proposals.log_sums import log_sum_exp


def normalise_weights(log_weights: FloatArray) -> FloatArray:
    """Return weights proportional to exp(log_weights) (n,) that add up to 1.

    Example:
        >>> normalise_weights(np.log([1.0, 3.0]))
        array([0.25, 0.75])
    """
    return np.asarray(np.exp(log_weights - log_sum_exp(log_weights)))


def effective_sample_size(log_weights: FloatArray) -> float:
    """Return Kish's (sum w)^2 / sum w^2 of weights given as logarithms (n,); 0 for none.

    Example:
        >>> print(f"{effective_sample_size(np.log([1.0, 1.0, 2.0])):.3f}")  # 16 / 6
        2.667
    """
    if log_weights.size == 0:
        return 0.0
    return float(np.exp(2 * log_sum_exp(log_weights) - log_sum_exp(2 * log_weights)))


def largest_weight_share(log_weights: FloatArray) -> float:
    """Return the largest weight as a share of their sum; 0 for none."""
    return float(normalise_weights(log_weights).max()) if log_weights.size else 0.0


def effective_number(terms: FloatArray) -> float:
    """Return the effective number of terms (n,), (sum t)^2 / sum t^2; 0 where all are 0."""
    total, squares = float(terms.sum()), float((terms**2).sum())
    return total**2 / squares if squares > 0 else 0.0
