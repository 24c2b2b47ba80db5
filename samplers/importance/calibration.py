"""Calibration: weights of draws from a mixture, changed so that its components keep their known mass.

Draws u_i of q = sum_k a_k q_k, a fixed number n_k = n a_k from each component (a stratum), estimate the mass of each
component, which is 1, by the mean of h_ij = q_j(u_i) / q(u_i). How far these means are off tells how far p-hat =
mean(y), y = weight times indicator of failure, is off: they are control variates,

    p = mean(y) - b . (mean(h) - 1),    b = (H'H + r n I)^-1 H'y,    H_i = h_i less the mean of h in its stratum

b minimises the variance within the strata. p is linear in y, so that it is also the mean of y with calibrated weights,

    p = mean(c y),    c_i = 1 - n H_i . (H'H + r n I)^-1 (mean(h) - 1)

c knows nothing of y, and so serves any threshold and any other base distribution too. That b is estimated from the same
draws biases p by the order of 1 / n, where its standard error is of the order of 1 / sqrt(n).

References:
    Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000 (components as control variates).
    Deville and Särndal, "Calibration estimators in survey sampling", JASA 87, 1992 (regression as weights).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray

RIDGE = 0.1
"""r: a control whose variance within the strata is well below this explains little, and few draws would decide b."""
LEAST_FACTOR = 0.1
"""Least c of a draw: where one would have less, all go only part of the way from 1. One run in 20 has such draws."""


class Calibration(NamedTuple):
    """Calibrated weights of n draws, as factors of their own weights."""

    factors: FloatArray
    """c, shape (n,)."""
    controls: FloatArray
    """H, shape (n, m); m = 0 where the weights stay as they are."""
    slopes: FloatArray
    """S with b = S'y, shape (n, m)."""
    strata: NDArray[np.int64]
    """Of each draw, shape (n,)."""

    def residuals(self, y: FloatArray) -> FloatArray:
        """Return y (n,) less what the controls explain of how it deviates from its mean in each stratum, shape (n,).

        The variance of p is that of these in place of y. Each deviation is divided by 1 less the leverage of its draw,
        as in the jackknife, for a regression follows the draws that it is fitted to.
        """
        if self.controls.shape[1] == 0:
            return y
        mean = _stratum_means(y[:, None], self.strata)[:, 0]
        leverage = (self.controls * self.slopes).sum(axis=1)  # below 1 by the ridge
        return np.asarray(mean + (y - mean - self.controls @ (self.slopes.T @ y)) / (1 - leverage))


def calibrate(ratios: FloatArray, strata: NDArray[np.int64], draws_per_control: int) -> Calibration:
    """Return calibrated weights of draws from a mixture q.

    Args:
        ratios: h, densities of mass 1 over q at each draw, shape (n, m): its components, or mixtures of some of them.
        strata: The component that each draw is from, shape (n,).
        draws_per_control: Weights of fewer draws for each control stay as they are.

    Example:
        P[u > 2.1] = 0.01786 by 500 draws of N(2, 1) and 500 of N(0, 1) given u > 2, a hundred times:

        >>> from scipy.special import ndtr, ndtri
        >>> rng, p = np.random.default_rng(0), []
        >>> for _ in range(100):
        ...     u = np.concatenate([2 + rng.standard_normal(500), -ndtri(ndtr(-2) * rng.random(500))])
        ...     h = np.stack([np.exp(2 * u - 2), (u > 2) / ndtr(-2)], axis=1)  # over the density of N(0, 1) ...
        ...     weights = 2 / h.sum(axis=1)
        ...     c = calibrate(h * weights[:, None], np.repeat([0, 1], 500), 30).factors  # ... and of the mixture
        ...     p.append([(weights * (u > 2.1)).mean(), (c * weights * (u > 2.1)).mean()])
        >>> np.mean(p, axis=0).round(4), np.std(p, axis=0).round(5)
        (array([0.0179, 0.0179]), array([0.00042, 0.00036]))
    """
    n, m = ratios.shape
    if n < draws_per_control * m:
        none = np.empty((n, 0))
        return Calibration(np.ones(n), none, none, strata)
    controls = ratios - _stratum_means(ratios, strata)
    normal = controls.T @ controls + RIDGE * n * np.eye(m)
    slopes = np.linalg.solve(normal, controls.T).T
    change = n * (slopes @ (ratios.mean(axis=0) - 1))
    part = min(1.0, (1 - LEAST_FACTOR) / max(float(change.max()), 1.0 - LEAST_FACTOR))
    return Calibration(1 - part * change, controls, part * slopes, strata)


def _stratum_means(values: FloatArray, strata: NDArray[np.int64]) -> FloatArray:
    """Return the mean of values (n, m) over the stratum of each draw, shape (n, m)."""
    counts = np.maximum(np.bincount(strata), 1)
    sums = np.stack([np.bincount(strata, weights=column) for column in values.T], axis=1)
    return np.asarray((sums / counts[:, None])[strata])
