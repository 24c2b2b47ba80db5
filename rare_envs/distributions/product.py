"""Base distributions made of independent blocks, and noise as one of them.

Cross-entropy searches block by block (`samplers.CrossEntropy(family="blocks")`); it finds them in
`ProductDistribution.blocks`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.space import Array, Distribution


@dataclass(frozen=True)
class NoiseDistribution:
    """Independent standard normal variables: noise, which a search over blocks leaves as it is."""

    dim: int

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Independent points, shape (n, d)."""
        return rng.standard_normal((n, self.dim))

    def log_prob(self, x: Array) -> Array:
        """Log density, (n, d) -> (n,)."""
        return np.asarray(-0.5 * (np.einsum("ij,ij->i", x, x) + self.dim * np.log(2.0 * np.pi)))

    def to_standard_normal(self, x: Array) -> Array:
        """The same points."""
        return x

    def from_standard_normal(self, u: Array) -> Array:
        """The same points."""
        return u

    def project(self, x: Array, weights: Array, alpha: float) -> "NoiseDistribution":
        """The same law: a block of cross-entropy that does not move."""
        return self

    def widen(self, factor: float) -> "NoiseDistribution":
        """The same law."""
        return self


@dataclass(frozen=True, eq=False)
class ProductDistribution:
    """Independent blocks side by side."""

    blocks: tuple[Any, ...]
    """Distributions with `dim`, in the order of the columns of x."""

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return sum(block.dim for block in self.blocks)

    @cached_property
    def _ends(self) -> NDArray[np.intp]:
        return np.cumsum([block.dim for block in self.blocks])[:-1]

    @cached_property
    def noise(self) -> NDArray[np.bool_]:
        """Which columns are noise, shape (d,): samplers may leave these as they are."""
        return np.repeat(
            [isinstance(block, NoiseDistribution) for block in self.blocks], [block.dim for block in self.blocks]
        )

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Independent points, shape (n, d)."""
        return np.hstack([block.sample(n, rng) for block in self.blocks])

    def log_prob(self, x: Array) -> Array:
        """Log density, (n, d) -> (n,)."""
        parts = zip(self.blocks, self._parts(x), strict=True)
        return np.asarray(sum(block.log_prob(part) for block, part in parts))

    def to_standard_normal(self, x: Array) -> Array:
        """Map (n, d) -> (n, d), block by block."""
        return self._mapped("to_standard_normal", x)

    def from_standard_normal(self, u: Array) -> Array:
        """Inverse of `to_standard_normal`, (n, d) -> (n, d)."""
        return self._mapped("from_standard_normal", u)

    def _mapped(self, how: str, points: Array) -> Array:
        parts = zip(self.blocks, self._parts(points), strict=True)
        return np.hstack([getattr(block, how)(part) for block, part in parts])

    def _parts(self, points: Array) -> list[Array]:
        return np.split(np.asarray(points), self._ends, axis=1)


def join_independent(*laws: Distribution) -> Distribution:
    """Independent laws as one; their own blocks, if they have some, become its blocks."""
    blocks = [block for law in laws for block in getattr(law, "blocks", (law,))]
    return blocks[0] if len(blocks) == 1 else ProductDistribution(tuple(blocks))
