"""Blocks whose family is Gaussian: in the units of x, or in standard normal space for any other distribution."""

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from samplers.distributions.independent import SizedDistribution
from samplers.methods.cross_entropy.gaussian_mixture_em import fit_mixture_towards
from samplers.methods.cross_entropy.kl_projection import project_mean
from samplers.problem import FloatArray
from samplers.proposals.gaussian import Gaussian, weighted_moments
from samplers.proposals.mixture import GaussianMixture
from samplers.proposals.shrinkage import shrink_towards_present

BlockT = TypeVar("BlockT", bound="_FromGaussian")


@dataclass(frozen=True, eq=False)
class _FromGaussian:
    """Common part of the blocks that are Gaussian in the base distribution."""

    gaussian: Gaussian
    """N(mean, L L')."""

    @property
    def dim(self) -> int:
        """Number of coordinates b."""
        return self.gaussian.dim

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, b)."""
        return self.gaussian.sample(n, rng)

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, b), shape (n,)."""
        return self.gaussian.log_prob(x)

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Return L^-1 (x - mean)."""
        return self.gaussian.to_standard_normal(x)

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Return mean + L u."""
        return self.gaussian.from_standard_normal(u)

    def widen(self: BlockT, factor: float) -> BlockT:
        """Return the block with `factor` times the standard deviations."""
        return replace(self, gaussian=self.gaussian.widen(factor))


@dataclass(frozen=True, eq=False)
class NormalBlock(_FromGaussian):
    """A Normal with fixed covariance whose mean may move in a box |mean - centre|_inf <= radius.

    Args:
        gaussian: The present Gaussian; in the base distribution the one to start from.
        radius: In the units of x (0.01 in the paper); inf for no box, 0 for a block that stays.
        centre: Centre of the box; None takes the mean of `gaussian`.

    Example:
        >>> import numpy as np
        >>> from samplers.proposals import Gaussian
        >>> block = NormalBlock(Gaussian.standard(2), radius=0.5)
        >>> elite = np.array([[3.0, 0.1], [1.0, 0.1]])
        >>> block.project(elite, np.array([0.5, 0.5]), alpha=1.0).gaussian.mean
        array([0.5, 0.1])
    """

    radius: float = math.inf
    centre: FloatArray | None = None

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "NormalBlock":
        """Return the projection of alpha Q + (1 - alpha) P in the box, see `project_mean`."""
        centre = self.gaussian.mean if self.centre is None else self.centre
        target = alpha * (weights @ x) + (1 - alpha) * self.gaussian.mean
        mean = project_mean(target, centre, self.gaussian.cholesky, self.radius)
        return replace(self, gaussian=Gaussian(mean, self.gaussian.cholesky), centre=centre)


@dataclass(frozen=True, eq=False)
class GaussianBlock(_FromGaussian):
    """A Gaussian whose mean and covariance may move: E[x] and E[x x'] are matched.

    The covariance is drawn towards the present one, see `shrink_towards_present`.

    Example:
        Ten points in one place have no covariance; the present one counts as three points.

        >>> import numpy as np
        >>> from samplers.proposals import Gaussian
        >>> elite = np.tile([2.0, 1.0], (10, 1))
        >>> block = GaussianBlock(Gaussian.standard(2)).project(elite, np.full(10, 0.1), alpha=1.0)
        >>> block.gaussian.mean, block.gaussian.covariance.diagonal().round(3)
        (array([2., 1.]), array([0.231, 0.231]))
    """

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "GaussianBlock":
        """Return the projection of alpha Q + (1 - alpha) P, its covariance pulled back."""
        target = weighted_moments(x, weights).mix_with(self.gaussian.moments, alpha)
        return GaussianBlock(shrink_towards_present(target, self.gaussian, 1 / float(weights @ weights)))


@dataclass(frozen=True, eq=False)
class MappedBlock:
    """Any distribution, whose image in standard normal space is a Gaussian with mean and covariance that may move.

    With u the image of x, p its density in the base distribution and q that of the Gaussian, the density of a proposal
    is p(x) q(u) / phi(u).

    Args:
        distribution: Its distribution in the base, such as a `ScipyDistribution`.
        image: The present Gaussian of u; None for N(0, I), that of the base.

    Example:
        >>> import numpy as np
        >>> from scipy import stats
        >>> from samplers.distributions import as_distribution
        >>> block = MappedBlock(as_distribution(stats.expon()))
        >>> moved = block.project(np.full((10, 1), 8.0), np.full(10, 0.1), alpha=1.0)
        >>> bool(moved.log_prob(np.array([[8.0]]))[0] > block.log_prob(np.array([[8.0]]))[0])
        True
    """

    distribution: SizedDistribution
    image: GaussianBlock | None = None

    @property
    def dim(self) -> int:
        """Number of coordinates b."""
        return self.distribution.dim

    @property
    def _image(self) -> GaussianBlock:
        return GaussianBlock(Gaussian.standard(self.dim)) if self.image is None else self.image

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, b)."""
        return self.distribution.from_standard_normal(self._image.sample(n, rng))

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, b), shape (n,)."""
        log_p = self.distribution.log_prob(x)
        if self.image is None:
            return log_p
        found = np.full(len(x), -np.inf)
        inside = np.isfinite(log_p)
        u = self.to_standard_normal(x[inside])
        found[inside] = log_p[inside] + self.image.log_prob(u) - Gaussian.standard(self.dim).log_prob(u)
        return found

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x ~ the distribution of the base, shape (n, b), to u ~ N(0, I)."""
        return self.distribution.to_standard_normal(x)

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        return self.distribution.from_standard_normal(u)

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "MappedBlock":
        """Return the projection of alpha Q + (1 - alpha) P, whose divergences are those of the images."""
        return replace(self, image=self._image.project(self.to_standard_normal(x), weights, alpha))

    def widen(self, factor: float) -> "MappedBlock":
        """Return the block whose image has `factor` times the standard deviations."""
        return replace(self, image=self._image.widen(factor))


@dataclass(frozen=True, eq=False)
class MixtureBlock(_FromGaussian):
    """A mixture of k Gaussians, moved by expectation-maximisation, see `fit_mixture_towards`.

    Args:
        gaussian: The Gaussian of the base distribution.
        k: Number of components at most.
        mixture: The present mixture; None stands for `gaussian`.

    Example:
        >>> import numpy as np
        >>> from samplers.proposals import Gaussian
        >>> elite = np.repeat([[4.0, 0.0], [-4.0, 0.0]], 100, axis=0)
        >>> block = MixtureBlock(Gaussian.standard(2), k=2).project(elite, np.full(200, 1 / 200), alpha=1.0)
        >>> sorted(float(component.mean[0].round(2)) for component in block.mixture.components)
        [-4.0, 4.0]
    """

    k: int
    mixture: GaussianMixture | None = None

    @property
    def _mixture(self) -> GaussianMixture:
        return GaussianMixture(np.ones(1), (self.gaussian,)) if self.mixture is None else self.mixture

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, b)."""
        return self._mixture.sample(n, rng)

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, b), shape (n,)."""
        return self._mixture.log_prob(x)

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "MixtureBlock":
        """Return a mixture nearer to alpha Q + (1 - alpha) P."""
        return replace(self, mixture=fit_mixture_towards(self._mixture, self.k, x, weights, alpha))

    def widen(self, factor: float) -> "MixtureBlock":
        """Return the block with `factor` times the standard deviations of every component."""
        return replace(self, mixture=self._mixture.widen(factor))
