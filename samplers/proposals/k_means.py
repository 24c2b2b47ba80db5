"""k-means: clusters of weighted points, for the first responsibilities of expectation-maximisation.

References:
    Arthur and Vassilvitskii, "k-means++: the advantages of careful seeding", SODA 2007.
    Lloyd, "Least squares quantization in PCM", IEEE Transactions on Information Theory 28, 1982.
"""

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray

LLOYD_STEPS = 4
"""Times at most that k-means moves its centres; it only has to give expectation-maximisation a start."""


def choose_centres(x: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
    """Return at most k of the points x (n, d) as centres (k, d), drawn far from one another (k-means++).

    Each is drawn with a probability proportional to weight times squared distance from those before. There are fewer
    where the points with a weight have fewer distinct places.
    """
    odds, chosen, nearest = weights, list[int](), np.full(len(x), np.inf)
    while len(chosen) < k and odds.sum() > 0:
        chosen.append(int(rng.choice(len(x), p=odds / odds.sum())))
        nearest = np.minimum(nearest, ((x - x[chosen[-1]]) ** 2).sum(axis=1))
        odds = weights * nearest
    return np.asarray(x[chosen])


def k_means(x: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return clusters (n,) of weighted points x (n, d), numbered from 0: k-means++, then Lloyd's steps.

    Two centres that differ by a rounding error may give one cluster, and one without points.

    Args:
        x: Points.
        weights: Shape (n,).
        k: Clusters at most.
        rng: Source of randomness.

    Example:
        >>> x = np.array([[0.0], [0.1], [9.0], [9.1], [9.2]])
        >>> labels = k_means(x, np.ones(5), 2, np.random.default_rng(0))
        >>> (labels == labels[4]).tolist()
        [False, False, True, True, True]
    """
    centres = choose_centres(x, weights, k, rng)
    if len(centres) == 1:
        return np.zeros(len(x), dtype=np.int64)
    mean = x.mean(axis=0)
    x, centres = x - mean, centres - mean  # distances lose fewer digits near the origin
    labels = _nearest(x, centres)
    for _ in range(LLOYD_STEPS):
        moved = _means(x, weights, labels, centres)
        if (moved == centres).all():
            break
        before, labels, centres = labels, _nearest(x, moved), moved
        if (labels == before).all():
            break
    return labels


def _nearest(x: FloatArray, centres: FloatArray) -> NDArray[np.int64]:
    """Return the nearest of the centres (k, d) to each of the points x (n, d), the first of several."""
    return np.asarray((np.einsum("ij,ij->i", centres, centres) - 2.0 * (x @ centres.T)).argmin(axis=1))


def _means(x: FloatArray, weights: FloatArray, labels: NDArray[np.int64], centres: FloatArray) -> FloatArray:
    """Return the means of the clusters (k, d); one without points moves to the point furthest from its own centre."""
    k = len(centres)
    mass = np.bincount(labels, weights=weights, minlength=k).astype(np.float64)
    sums = np.stack([np.bincount(labels, weights=row, minlength=k) for row in x.T * weights], axis=1).astype(np.float64)
    if not mass.all():
        _fill_empty(x, weights, labels, centres, sums, mass)
    means = sums * (1 / np.where(mass > 0, mass, 1.0))[:, None]
    return means if mass.all() else np.where(mass[:, None] > 0, means, means[mass.argmax()])


def _fill_empty(
    x: FloatArray,
    weights: FloatArray,
    labels: NDArray[np.int64],
    centres: FloatArray,
    sums: FloatArray,
    mass: FloatArray,
) -> None:
    """Give clusters without points one each in `sums` (k, d) and `mass` (k,): those furthest from their own centres."""
    distance = ((x - centres[labels]) ** 2).sum(axis=1)
    if distance.max() == 0:  # there are more clusters than places
        return
    for cluster, point in zip(np.flatnonzero(mass == 0), np.argsort(-distance, kind="stable"), strict=False):
        share = x[point] * weights[point]
        sums[labels[point]] -= share
        mass[labels[point]] -= weights[point]
        sums[cluster], mass[cluster] = share, weights[point]
