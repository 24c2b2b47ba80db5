"""Simultaneous intervals: pointwise intervals of several sums over units, at the level at which all hold together.

References:
    Montiel Olea and Plagborg-Moller, "Simultaneous confidence bands: theory, implementation, and an
    application to SVARs", Journal of Applied Econometrics 34, 2019 (the sup-t band).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from samplers.problem import FloatArray
from samplers.statistics.cluster_sums import UnitSums, interval_of_count, interval_of_sum

EIGENVALUE_ROUNDING = 1e-10
"""Eigenvalues of a G x G correlation up to G times this are rounding: its trace is G."""
BAND_DRAWS = 10_000
"""Draws of the largest deviation; its 95 % quantile is then good to about 1 %."""
BAND_STREAM = 2**31
"""Spawn key of the generator for these draws; the runs have 0, 1, 2, ..."""


def simultaneous_intervals(
    sums: UnitSums, use: NDArray[np.intp], p: FloatArray, cov: FloatArray, confidence: float, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return pointwise intervals of p at one level, at which they should hold together; 0 to 1 where they are not used.

    Args:
        sums: Over units, at G thresholds.
        use: Indices of the thresholds that count.
        p: Probabilities, shape (G,).
        cov: Their coefficients of variation, shape (G,).
        confidence: Nominal coverage of all.
        seed: Of the run.

    Returns:
        Lower and upper ends, shape (G,) each.
    """
    level = simultaneous_level(sums.correlation[np.ix_(use, use)], confidence, band_generator(seed))
    low, high = np.zeros(len(p)), np.ones(len(p))
    for i in use:
        if sums.is_count[i]:
            low[i], high[i] = interval_of_count(float(sums.p[i]), sums.n_units, level)
        else:
            low[i], high[i] = interval_of_sum(float(p[i]), float(cov[i]), float(sums.ess[i]), sums.independent, level)
    return low, high


def band_generator(seed: int) -> np.random.Generator:
    """Return the generator of the draws for a band of a run with this seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(BAND_STREAM,)))


def simultaneous_level(correlation: NDArray[np.float64], confidence: float, rng: np.random.Generator) -> float:
    """Return the level of pointwise intervals that together hold with probability `confidence`.

    Args:
        correlation: Of the estimates, shape (G, G); rows of zeros for those that do not vary.
        confidence: Nominal coverage of all.
        rng: Generator of the draws.
    """
    values, vectors = np.linalg.eigh(correlation)
    some = values > EIGENVALUE_ROUNDING * max(len(values), 1)
    if np.count_nonzero(some) <= 1:
        return confidence
    roots = vectors[:, some] * np.sqrt(values[some])
    largest = np.abs(rng.standard_normal((BAND_DRAWS, roots.shape[1])) @ roots.T).max(axis=1)
    level = 1 - 2 * float(ndtr(-np.quantile(largest, confidence)))
    return max(level, confidence)
