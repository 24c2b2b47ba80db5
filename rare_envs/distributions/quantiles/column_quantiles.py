"""Quantiles of a column of a mixture, by compiled code where numba is at hand, else by NumPy: the same bits."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from rare_envs.arrays import FloatArray
from rare_envs.distributions.quantiles import mixture_quantile
from rare_envs.distributions.quantiles.mixture_quantile import MixtureColumn

Quantiles: TypeAlias = tuple[FloatArray, NDArray[np.bool_]]
"""Of n rows, and which of these fit into plain numbers."""


def find_quantiles(column: MixtureColumn, u: FloatArray) -> Quantiles:
    """Return what `mixture_quantile.search_quantiles` does, to the bit, by compiled code where this process has numba.

    numba is not imported for it, which takes as long as the quantiles of a hundred small calls: compiled simulations
    import it.
    """
    compiled = _find_compiled() if "numba" in sys.modules else None
    return (compiled or mixture_quantile.search_quantiles)(column, u)


@cache
def _find_compiled() -> Callable[[MixtureColumn, FloatArray], Quantiles] | None:
    """Return the compiled function; None where numba does not work, or SciPy's functions are others to it."""
    try:
        from rare_envs.distributions.quantiles.compiled_quantile import search_by_rows as compiled

        same = all(map(np.array_equal, compiled(*_sample()), mixture_quantile.search_quantiles(*_sample())))
    except Exception:  # a compiler may raise anything, and is not needed
        return None
    return compiled if same else None


def _sample() -> tuple[MixtureColumn, FloatArray]:
    """Return a column in which every function is called on either side of its cases, and points for it."""
    rng, n = np.random.default_rng(0), 64
    log_weights, mean = rng.normal(0.0, 3.0, (4, n)), rng.normal(0.0, 6.0, (4, n))
    scale, share = np.exp(rng.normal(0.0, 1.0, (4, 1))), np.array([[0.4], [0.6]])
    mean[2:] = 1.0 + mean[2:] / 10.0
    column = MixtureColumn(log_weights, mean, scale, np.full(n, 0.5), np.full(n, 30.0), (0, 2, 4), share, n_plain=2)
    return column, rng.normal(0.0, 4.0, n)
