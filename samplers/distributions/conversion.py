"""Conversion of what users have, distributions of SciPy and of OpenTURNS, to base distributions."""

from __future__ import annotations

from typing import Any

from samplers.distributions.independent import IndependentDistributions
from samplers.distributions.openturns_distribution import OpenTurnsDistribution, is_openturns_distribution
from samplers.distributions.scipy_distributions import (
    ScipyDistribution,
    ScipyMultivariateNormal,
    is_scipy_distribution,
    is_scipy_normal,
)

METHODS_OF_A_BASE = ("sample", "log_prob", "to_standard_normal", "from_standard_normal")


def as_distribution(base: Any, dim: int | None = None) -> Any:
    """Return a base distribution (`samplers.Distribution`) for one of SciPy or OpenTURNS, or for a list of them.

    Args:
        base: A frozen distribution of `scipy.stats` (one coordinate, or k with parameters of shape (k,)), its
            `multivariate_normal`, a distribution or copula of OpenTURNS, or a list of these, one behind the other and
            independent. What is a base distribution already is returned as it is.
        dim: Number of dimensions wanted: a distribution of one coordinate is then repeated. None takes what base has.

    Raises:
        ValueError: If base is none of these, is not continuous, or has another number of dimensions.

    Example:
        >>> import numpy as np
        >>> from scipy import stats
        >>> base = as_distribution([stats.lognorm(0.5), stats.multivariate_normal([1.0, 2.0])])
        >>> base.from_standard_normal(np.zeros((1, 3)))
        array([[1., 1., 2.]])
        >>> as_distribution(stats.poisson(3.0))
        Traceback (most recent call last):
            ...
        ValueError: Expected a continuous distribution, got the discrete poisson of scipy.stats.
    """
    found = _convert(base)
    own = getattr(found, "dim", None)  # a user's distribution need not have it
    if dim is None or own is None or own == dim:
        return found
    if own == 1:
        return IndependentDistributions((found,) * dim)
    raise ValueError(f"Expected a base distribution of {dim} dimensions, got {own}.")


def can_convert(base: object) -> bool:
    """Return whether `as_distribution` knows how to convert a single distribution."""
    return is_scipy_normal(base) or is_scipy_distribution(base) or is_openturns_distribution(base)


def _convert(base: Any) -> Any:
    if is_scipy_normal(base):
        return ScipyMultivariateNormal(base)
    if is_scipy_distribution(base):
        return ScipyDistribution(base)
    if is_openturns_distribution(base):
        return OpenTurnsDistribution(base)
    if isinstance(base, list | tuple) and base:
        return IndependentDistributions(tuple(as_distribution(part) for part in base))
    # of a user's class
    if isinstance(base, type) or not all(callable(getattr(base, name, None)) for name in METHODS_OF_A_BASE):
        raise ValueError(
            f"Expected a frozen distribution of scipy.stats such as norm(0, 1), one of OpenTURNS, a list of them, "
            f"or an object with {', '.join(METHODS_OF_A_BASE)}; got {base!r}."
        )
    return base
