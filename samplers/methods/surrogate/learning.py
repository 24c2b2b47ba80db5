"""Learning: the points that the surrogate is fitted to, a first design and then batches where it is in doubt."""

import numpy as np
from scipy.special import ndtri

from samplers.methods.surrogate.kriging import Kriging
from samplers.methods.surrogate.pool import Pool
from samplers.methods.surrogate.settings import LearningSettings
from samplers.problem import FloatArray
from samplers.statistics.weights import normalise_weights


def design_size(budget: int, dim: int, settings: LearningSettings) -> int:
    """Return the number of points of the first design, a multiple of the number of its scales."""
    size = min(int(settings.design_share * budget), settings.design_least + settings.design_per_dim * dim)
    return max(size // len(settings.scales), 1) * len(settings.scales)


def learning_size(budget: int, settings: LearningSettings) -> int:
    """Return the number of simulations for learning at most, the first design included."""
    return min(int(settings.share * budget), settings.most)


def draw_design(n: int, dim: int, scales: tuple[float, ...], rng: np.random.Generator) -> FloatArray:
    """Return n points, an equal number of each N(0, s^2 I), as Latin hypercubes, in the order of the scales s."""
    each = n // len(scales)
    from scipy.stats import qmc  # takes a second to import

    cubes = [ndtri(qmc.LatinHypercube(dim, rng=rng).random(each)) for _ in scales]
    return np.concatenate([scale * cube for scale, cube in zip(scales, cubes, strict=True)])


def choose_batch(
    kriging: Kriging, pool: Pool, n: int, settings: LearningSettings, rng: np.random.Generator
) -> FloatArray:
    """Choose the next n points to learn from, shape (n, d).

    Candidates are drawn from the pool in proportion to phi sqrt(P[fail] P[safe]). Of these, one after the other, the
    most doubtful one is taken (least |mean| / sd, the U of Echard, Gayton and Lemaire 2011), and the variances of all
    are reduced by what its outcome will tell, which needs no outcome: the points of a batch lie apart. The others are
    drawn at random, where a surrogate that is not believed leaves both open.
    """
    weights = normalise_weights(pool.log_doubt)
    n_candidates = min(settings.candidates * n, int(np.count_nonzero(weights)))
    among = np.unique(rng.choice(len(pool.u), n_candidates, p=weights))
    if len(among) < n:  # nearly all weight lies on few draws
        among = np.argsort(pool.log_doubt)[-settings.candidates * n :]
    u, mean = pool.u[among], pool.prediction.mean[among]
    covariance, noise = kriging.covariance(u), kriging.noise
    chosen = list[int]()
    n_random = int(settings.random_share * n)
    for _ in range(min(n - n_random, len(among))):
        doubt = -np.abs(mean) / np.sqrt(np.maximum(np.diag(covariance), 0.0) + noise + 1e-12)
        doubt[chosen] = -np.inf
        best = int(doubt.argmax())
        chosen.append(best)
        column = covariance[:, best]
        covariance = covariance - np.outer(column, column) / (column[best] + noise + 1e-12)
    keys = pool.log_open + rng.gumbel(size=len(pool.u))  # the largest: draws without replacement
    keys[among[chosen]] = -np.inf
    return np.concatenate([u[chosen], pool.u[np.argsort(-keys, kind="stable")[:n_random]]])
