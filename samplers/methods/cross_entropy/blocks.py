"""Blocks of coordinates, each with the family in which cross-entropy moves its law, and their product.

Equation 2 of O'Kelly et al. (2018) separates by block: the Kullback-Leibler projection of a law on
a product of families is the product of the projections of its marginals. A block is a law of the
base distribution and knows how far a search may take it.

References:
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing
    via rare-event simulation", NeurIPS 2018.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypeVar, cast

import numpy as np

from samplers.methods.cross_entropy.beta_block import PAPERS_BOX, BetaBlock
from samplers.methods.cross_entropy.gaussian_mixture_em import fit_mixture_towards
from samplers.methods.cross_entropy.kl_projection import project_mean
from samplers.problem import FloatArray, Inputs
from samplers.proposals.gaussian import Gaussian, weighted_moments
from samplers.proposals.mixture import GaussianMixture
from samplers.proposals.shrinkage import shrink_towards_present


class Block(Protocol):
    """A law of b coordinates and the family in which it may be moved."""

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

        P is the block's present law; Q the points x (n, b) with weights (n,) that add up to 1.
        """

    def widen(self, factor: float) -> "Block":
        """Return a block whose present law has about `factor` times the standard deviations."""


BlockT = TypeVar("BlockT", bound="_FromGaussian")


@dataclass(frozen=True, eq=False)
class _FromGaussian:
    """What blocks share whose law in the base distribution is a Gaussian."""

    law: Gaussian

    @property
    def dim(self) -> int:
        """Number of coordinates b."""
        return self.law.dim

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, b)."""
        return self.law.sample(n, rng)

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, b), shape (n,)."""
        return self.law.log_prob(x)

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Return L^-1 (x - mean)."""
        return self.law.to_standard_normal(x)

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Return mean + L u."""
        return self.law.from_standard_normal(u)

    def widen(self: BlockT, factor: float) -> BlockT:
        """Return the block with `factor` times the standard deviations."""
        return replace(self, law=self.law.widen(factor))


@dataclass(frozen=True, eq=False)
class NormalBlock(_FromGaussian):
    """A Normal with fixed covariance whose mean may move in a box |mean - centre|_inf <= radius.

    Args:
        law: The law at present; in the base distribution the one to start from.
        radius: In the units of x (0.01 in the paper); inf for no box, 0 for a block that stays.
        centre: Centre of the box; None takes the mean of `law`.
    """

    radius: float = math.inf
    centre: FloatArray | None = None

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "NormalBlock":
        """Return the projection of alpha Q + (1 - alpha) P in the box, see `project_mean`."""
        centre = self.law.mean if self.centre is None else self.centre
        target = alpha * (weights @ x) + (1 - alpha) * self.law.mean
        mean = project_mean(target, centre, self.law.cholesky, self.radius)
        return replace(self, law=Gaussian(mean, self.law.cholesky), centre=centre)


@dataclass(frozen=True, eq=False)
class GaussianBlock(_FromGaussian):
    """A Gaussian whose mean and covariance may move: E[x] and E[x x'] are matched.

    The covariance is drawn towards the present one, see `shrink_towards_present`.
    """

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "GaussianBlock":
        """Return the projection of alpha Q + (1 - alpha) P, its covariance pulled back."""
        target = weighted_moments(x, weights).mix_with(self.law.moments, alpha)
        return GaussianBlock(shrink_towards_present(target, self.law, 1 / float(weights @ weights)))


@dataclass(frozen=True, eq=False)
class MixtureBlock(_FromGaussian):
    """A mixture of k Gaussians, moved by expectation-maximisation, see `fit_mixture_towards`.

    Args:
        law: The Gaussian of the base distribution.
        k: Number of components at most.
        mixture: The law at present; None stands for `law`.
    """

    k: int
    mixture: GaussianMixture | None = None

    @property
    def _mixture(self) -> GaussianMixture:
        return GaussianMixture(np.ones(1), (self.law,)) if self.mixture is None else self.mixture

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
        """Map x ~ this law, shape (n, d), to u ~ N(0, I), shape (n, d)."""
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
        """Where each block but the last ends."""
        return [int(end) for end in np.cumsum([block.dim for block in self.blocks])[:-1]]

    def _parts(self, x: FloatArray) -> list[FloatArray]:
        """Split the columns of x (n, d) by block."""
        return np.split(x, self._ends, axis=1)


def announced_blocks(inputs: Inputs) -> Product:
    """Return the base law of some inputs as the product of the blocks that it announces.

    `inputs.base.blocks` holds one entry per block, in the order of the coordinates: a `Block`, or
    any object with the attributes alpha, beta, low and high (and box, if that is not the paper's),
    or with mean and covariance (and radius, if the mean is to stay in a box).

    Raises:
        ValueError: If there are no blocks, one is not as described, or they are not the base law.
    """
    entries = getattr(inputs.base, "blocks", None)
    if entries is None:
        raise ValueError(
            f'CrossEntropy: family "blocks" needs a base distribution with an attribute blocks, as Product has; '
            f'{type(inputs.base).__name__} has none. The family "gaussian" works with any.'
        )
    product = Product(tuple(_as_block(entry) for entry in entries))
    trial = product.sample(4, np.random.default_rng(0))
    if product.dim != inputs.dim or not np.allclose(product.log_prob(trial), inputs.base.log_prob(trial)):
        raise ValueError(f"CrossEntropy: the blocks of {type(inputs.base).__name__} are not its law.")
    return product


def _as_block(entry: Any) -> Block:
    """Return the block that an entry describes."""
    if hasattr(entry, "project"):
        return cast(Block, entry)
    if all(hasattr(entry, name) for name in ("alpha", "beta", "low", "high")):
        box = getattr(entry, "box", PAPERS_BOX)
        return BetaBlock(alpha=entry.alpha, beta=entry.beta, low=entry.low, high=entry.high, box=box)
    if hasattr(entry, "mean") and hasattr(entry, "covariance"):
        return NormalBlock(Gaussian.from_covariance(entry.mean, entry.covariance), getattr(entry, "radius", math.inf))
    raise ValueError(
        "CrossEntropy: expected a block with alpha, beta, low and high or with mean and covariance, "
        f"got {type(entry).__name__}."
    )
