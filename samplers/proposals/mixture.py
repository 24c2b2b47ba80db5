"""Mixtures of distributions, and of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from samplers.problem import FloatArray
from samplers.proposals.gaussian import Gaussian
from samplers.proposals.log_sums import log_sum_exp


class SupportsLogProb(Protocol):
    """A distribution whose density is known."""

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""


class ProposalDistribution(SupportsLogProb, Protocol):
    """A distribution that can be drawn from and whose density is known; all that importance sampling needs.

    Example:
        >>> import numpy as np
        >>> from samplers.proposals.gaussian import TiltedNormal
        >>> proposal: ProposalDistribution = TiltedNormal(np.array([3.0]))
        >>> proposal.sample(5, np.random.default_rng(0)).shape
        (5, 1)
    """

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of distributions.

    Example:
        >>> import numpy as np
        >>> from samplers.proposals.gaussian import Gaussian
        >>> left, right = (Gaussian(np.array([mean]), np.eye(1)) for mean in (-4.0, 4.0))
        >>> mixture = Mixture(np.array([0.25, 0.75]), [left, right])
        >>> bool(0.2 < (mixture.sample(1000, np.random.default_rng(0)) < 0).mean() < 0.3)
        True
        >>> np.exp(mixture.log_prob(np.array([[4.0]]))).round(3)  # 0.75 / sqrt(2 pi)
        array([0.299])
    """

    weights: FloatArray
    """Shape (k,), adding up to 1."""
    components: Sequence[ProposalDistribution]
    """k of them."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        counts = rng.multinomial(n, self.weights)
        parts = [c.sample(int(k), rng) for c, k in zip(self.components, counts, strict=True)]
        return rng.permutation(np.concatenate(parts))

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""
        return np.asarray(log_sum_exp(self.log_terms(u), axis=0))

    def log_terms(self, u: FloatArray) -> FloatArray:
        """Return log(weight_j q_j) of the components at u (n, d), shape (k, n)."""
        return np.stack([np.log(w) + c.log_prob(u) for w, c in zip(self.weights, self.components, strict=True)])


@dataclass(frozen=True, eq=False)
class GaussianMixture(Mixture):
    """A mixture of Gaussians.

    Example:
        >>> import numpy as np
        >>> from samplers.proposals.gaussian import Gaussian
        >>> mixture = GaussianMixture(np.ones(1), [Gaussian.standard(2)])
        >>> mixture.widen(1.5).components[0].covariance.diagonal()
        array([2.25, 2.25])
    """

    components: Sequence[Gaussian]

    def widen(self, factor: float) -> GaussianMixture:
        """Return the same with the standard deviations of all components multiplied by factor."""
        return GaussianMixture(self.weights, [component.widen(factor) for component in self.components])
