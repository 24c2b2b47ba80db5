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
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np

from samplers.distributions.conversion import as_distribution, can_convert
from samplers.methods.cross_entropy.beta_block import PAPERS_BOX, BetaBlock
from samplers.methods.cross_entropy.gaussian_blocks import MappedBlock, NormalBlock
from samplers.problem import FloatArray, Inputs
from samplers.proposals.gaussian import Gaussian


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


@dataclass(frozen=True, eq=False)
class Product:
    """Independent blocks of consecutive coordinates: a base distribution, or a proposal of the search.

    As a base distribution it announces its blocks to `CrossEntropy(family="blocks")`.

    Args:
        blocks: In the order of the coordinates; a distribution of SciPy or OpenTURNS (`as_distribution`) becomes a
            `MappedBlock`.

    Raises:
        ValueError: If there is no block, or one is not as described.

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
        blocks = (MappedBlock(as_distribution(b)) if can_convert(b) else b for b in self.blocks)
        object.__setattr__(self, "blocks", tuple(blocks))
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
        raise ValueError(
            f"CrossEntropy: the blocks of {type(inputs.base).__name__} are not its distribution: mend `blocks`, or "
            'take family="gaussian", which works with any.'
        )
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
