"""Columns of mixtures for tests: of any weights and scales, with intervals that cut some of them."""

import numpy as np

from rare_envs.distributions.quantiles.mixture_quantile import MixtureColumn


def draw_columns(rng: np.random.Generator, n_plain: int, n_log: int, n: int) -> MixtureColumn:
    """Return n rows of one part of components in x and another of components in log x, where there are any."""
    k = n_plain + n_log
    mean, scale = rng.normal(12.0, 6.0, (k, n)), np.exp(rng.normal(0.5, 0.7, (k, n)))
    mean[n_plain:], scale[n_plain:] = rng.normal(2.0, 0.6, (n_log, n)), np.exp(rng.normal(-1.2, 0.5, (n_log, n)))
    low, high = rng.uniform(0.1, 4.0, n), rng.uniform(16.0, 60.0, n)
    parts = [size for size in (n_plain, n_log) if size]
    share = rng.uniform(0.1, 1.0, (len(parts), n))
    edges = (0, *np.cumsum(parts).tolist())
    return MixtureColumn(
        rng.normal(0.0, 2.0, (k, n)), mean, scale, low, high, edges, share / share.sum(axis=0), n_plain
    )
