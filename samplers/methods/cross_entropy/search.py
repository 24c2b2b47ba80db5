"""Iterates of the cross-entropy search, and the choice among them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from samplers.importance.search import Round, round_record
from samplers.methods.cross_entropy.blocks import Product
from samplers.problem import FloatArray
from samplers.trace import Level


class Iterate(NamedTuple):
    """One proposal of the search, with the results of its draws."""

    proposal: Product
    quantile: float
    """The rho-quantile of f under the proposal."""
    level: float
    """gamma_k: the quantile, but not less than gamma."""
    record: Level


def make_iterate(drawn: Round, proposal: Product, level: float, rho: float, log_weights: FloatArray) -> Iterate:
    """Return the iterate that one round of draws describes.

    Args:
        drawn: The draws.
        proposal: theta_k, where they are from.
        level: gamma_k.
        rho: Elite fraction.
        log_weights: log(p0 / p_theta) of the draws with f <= gamma_k, shape (k,).
    """
    n = len(drawn.f)
    rank = int(np.ceil(rho * n)) - 1
    quantile = float(np.partition(drawn.f, rank)[rank])
    return Iterate(proposal, quantile, level, round_record(level, n, log_weights))


def best_iterate(iterates: Sequence[Iterate], choice: str) -> Iterate | None:
    """Return the iterate to sample from; None if there is none.

    The one with the lowest rho-quantile, with choice "cov" not counted below gamma; among equals that with the
    smallest c.o.v.
    """

    def rank(iterate: Iterate) -> tuple[float, float]:
        return (iterate.quantile if choice == "quantile" else iterate.level, iterate.record.cov)

    return min(iterates, key=rank, default=None)
