"""Blocks of coordinates, each with the family of distributions that cross-entropy searches, and their product.

Equation 2 of O'Kelly et al. (2018) separates by block: the Kullback-Leibler projection of a distribution on
a product of families is the product of the projections of its marginals. A block is one factor of the
base distribution; its family limits how far a search may move it.

References:
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing
    via rare-event simulation", NeurIPS 2018.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from samplers.methods.cross_entropy.beta_block import PAPERS_BOX, BetaBlock
from samplers.methods.cross_entropy.gaussian_mixture_em import fit_mixture_towards
from samplers.methods.cross_entropy.kl_projection import project_mean
from samplers.problem import FloatArray, Inputs
from samplers.proposals.gaussian import Gaussian, weighted_moments
from samplers.proposals.mixture import GaussianMixture
from samplers.proposals.shrinkage import shrink_towards_present


@runtime_checkable
class Block(Protocol):
    """A distribution of b coordinates with the family in which it may be moved."""

    @property
    def dim(self) -> int:
        """Number of coordinates b."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, b)."""

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, b), shape (n,)."""

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x ~ the block of the base distribution, shape (n, b), to u ~ N(0, I)."""

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "Block":
        """Return the projection of alpha Q + (1 - alpha) P on the family (equation 2).

        P is the block's present distribution; Q the points x (n, b) with weights (n,) that add up to 1.
        """

    def widen(self, factor: float) -> "Block":
        """Return a block whose present distribution has about `factor` times the standard deviations."""


@runtime_checkable
class AnnouncesBlocks(Protocol):
    """A base distribution made of independent blocks."""

    @property
    def blocks(self) -> Sequence[object]:
        """The blocks, in the order of the coordinates: `Block`, `BetaParameters` or `NormalParameters`."""


@runtime_checkable
class BetaParameters(Protocol):
    """Independent coordinates low + (high - low) Beta(alpha, beta), described by a class of another package."""

    alpha: FloatArray
    beta: FloatArray
    low: FloatArray
    high: FloatArray


@runtime_checkable
class HasBox(Protocol):
    """Parameters of a Beta block that also bound its family, see `BetaBlock`."""

    box: tuple[float, float]


@runtime_checkable
class NormalParameters(Protocol):
    """A Normal, described by a class of another package."""

    mean: FloatArray
    covariance: FloatArray


@runtime_checkable
class HasRadius(Protocol):
    """Parameters of a Normal block that also bound its mean, see `NormalBlock`."""

    radius: float


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


@dataclass(frozen=True, eq=False)
class Product:
    """Independent blocks of consecutive coordinates: a base distribution, or a proposal of the search.

    As a base distribution it announces its blocks to `CrossEntropy(family="blocks")`.

    Args:
        blocks: In the order of the coordinates.

    Raises:
        ValueError: If there is no block.

    Example:
        >>> import numpy as np
        >>> from samplers.proposals import Gaussian
        >>> gap = BetaBlock(alpha=2.0, beta=2.0, low=1.0, high=40.0)
        >>> base = Product((gap, NormalBlock(Gaussian.standard(3))))
        >>> base.dim, base.sample(5, np.random.default_rng(0)).shape
        (4, (5, 4))
        >>> base.from_standard_normal(np.zeros((1, 4)))
        array([[20.5,  0. ,  0. ,  0. ]])
    """

    blocks: tuple[Block, ...]

    def __post_init__(self) -> None:
        """Make a tuple of the blocks."""
        object.__setattr__(self, "blocks", tuple(self.blocks))
        if not self.blocks:
            raise ValueError("Product: expected at least one block.")

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return sum(block.dim for block in self.blocks)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return np.hstack([block.sample(n, rng) for block in self.blocks])

    def log_probs(self, x: FloatArray, /) -> FloatArray:
        """Log density of each block at x (n, d), shape (blocks, n)."""
        return np.stack([block.log_prob(part) for block, part in zip(self.blocks, self._parts(x), strict=True)])

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""
        return np.asarray(self.log_probs(x).sum(axis=0))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x ~ this distribution, shape (n, d), to u ~ N(0, I), shape (n, d)."""
        return np.hstack([b.to_standard_normal(part) for b, part in zip(self.blocks, self._parts(x), strict=True)])

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        return np.hstack([b.from_standard_normal(part) for b, part in zip(self.blocks, self._parts(u), strict=True)])

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "Product":
        """Return the projection of alpha Q + (1 - alpha) P, block by block (equation 2).

        Args:
            x: Points, shape (n, d).
            weights: Their weights for each block, rows that add up to 1, shape (blocks, n).
            alpha: Step size.
        """
        parts = zip(self.blocks, self._parts(x), weights, strict=True)
        return Product(tuple(block.project(part, w, alpha) for block, part, w in parts))

    def widen(self, factor: float) -> "Product":
        """Return independent blocks with standard deviations multiplied by about `factor`."""
        return Product(tuple(block.widen(factor) for block in self.blocks))

    @cached_property
    def _ends(self) -> list[int]:
        """Column at which each block but the last ends."""
        return [int(end) for end in np.cumsum([block.dim for block in self.blocks])[:-1]]

    def _parts(self, x: FloatArray) -> list[FloatArray]:
        """Split the columns of x (n, d) by block."""
        return np.split(x, self._ends, axis=1)


def announced_blocks(inputs: Inputs) -> Product:
    """Return the base distribution of some inputs as the product of the blocks that it announces.

    `inputs.base.blocks` holds one entry per block, in the order of the coordinates: a `Block`, or
    any object with the attributes alpha, beta, low and high (and box, if that is not the paper's),
    or with mean and covariance (and radius, if the mean is to stay in a box).

    Raises:
        ValueError: If there are no blocks, one is not as described, or their product is not the base distribution.
    """
    if not isinstance(inputs.base, AnnouncesBlocks):
        raise ValueError(
            f'CrossEntropy: family "blocks" needs a base distribution with an attribute blocks, as Product has; '
            f'{type(inputs.base).__name__} has none. The family "gaussian" works with any.'
        )
    product = Product(tuple(_as_block(entry) for entry in inputs.base.blocks))
    trial = product.sample(4, np.random.default_rng(0))
    if product.dim != inputs.dim or not np.allclose(product.log_prob(trial), inputs.base.log_prob(trial)):
        raise ValueError(f"CrossEntropy: the blocks of {type(inputs.base).__name__} are not its distribution.")
    return product


def _as_block(entry: object) -> Block:
    """Return the block that an entry describes."""
    if isinstance(entry, Block):
        return entry
    if isinstance(entry, BetaParameters):
        box = entry.box if isinstance(entry, HasBox) else PAPERS_BOX
        return BetaBlock(alpha=entry.alpha, beta=entry.beta, low=entry.low, high=entry.high, box=box)
    if isinstance(entry, NormalParameters):
        radius = entry.radius if isinstance(entry, HasRadius) else math.inf
        return NormalBlock(Gaussian.from_covariance(entry.mean, entry.covariance), radius)
    raise ValueError(
        "CrossEntropy: expected a block with alpha, beta, low and high or with mean and covariance, "
        f"got {type(entry).__name__}."
    )
