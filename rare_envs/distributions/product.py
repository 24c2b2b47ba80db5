"""Independent blocks side by side, and noise as one of them.

Cross-entropy searches block by block (`samplers.CrossEntropy(family="blocks")`); it finds them in
`ProductDistribution.blocks`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.space import DistributionParameter, check_values, name_columns


@dataclass(frozen=True)
class NoiseDistribution:
    """Independent standard normal variables: noise, which a search over blocks leaves as it is.

    Example:
        >>> NoiseDistribution(2).log_prob(np.zeros((1, 2))).round(4).tolist()  # -log(2 pi)
        [-1.8379]
    """

    dim: int
    """Number of variables d."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d)."""
        return rng.standard_normal((n, self.dim))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density, (n, d) -> (n,)."""
        return np.asarray(-0.5 * (np.einsum("ij,ij->i", x, x) + self.dim * np.log(2.0 * np.pi)))

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Return the same points."""
        return x

    from_standard_normal = to_standard_normal

    def pull_back(self, u: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return the same gradients."""
        return gradients

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "NoiseDistribution":
        """Return the same distribution: a block of cross-entropy that does not move."""
        return self

    def widen(self, factor: float) -> "NoiseDistribution":
        """Return the same distribution."""
        return self


def box_of(distribution: Any) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the box of a distribution; of columns of noise, infinite ones.

    Example:
        >>> box_of(NoiseDistribution(1))[0].tolist()
        [-inf]
    """
    if hasattr(distribution, "low"):
        return np.asarray(distribution.low), np.asarray(distribution.high)
    free = np.full(distribution.dim, np.inf)
    return -free, free


def change_parts(parts: Sequence[Any], values: FloatArray) -> list[Any]:
    """Return distributions with other values of their parameters, given one part after the other."""
    counts = [len(part.parameters()) if hasattr(part, "parameters") else 0 for part in parts]
    check_values(values, sum(counts))
    own = np.split(values, np.cumsum(counts)[:-1])
    return [part.with_parameters(each) if n else part for part, each, n in zip(parts, own, counts, strict=True)]


@dataclass(frozen=True, eq=False)
class ProductDistribution:
    """Independent blocks side by side.

    Example:
        >>> both = ProductDistribution((NoiseDistribution(1), NoiseDistribution(2)))
        >>> both.dim, both.noise.tolist()
        (3, [True, True, True])
    """

    blocks: tuple[Any, ...]
    """Distributions with `dim`, in the order of the columns of x."""

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return sum(block.dim for block in self.blocks)

    @cached_property
    def noise(self) -> NDArray[np.bool_]:
        """Mask of the columns that are noise, shape (d,): samplers may leave these as they are."""
        is_noise = [isinstance(block, NoiseDistribution) for block in self.blocks]
        return np.repeat(is_noise, [block.dim for block in self.blocks])

    @property
    def low(self) -> FloatArray:
        """Lower bounds of the box, shape (d,)."""
        return np.concatenate([box_of(block)[0] for block in self.blocks])

    @property
    def high(self) -> FloatArray:
        """Upper bounds of the box, shape (d,)."""
        return np.concatenate([box_of(block)[1] for block in self.blocks])

    @property
    def strata(self) -> tuple[Any, ...]:
        """Strata of the one block that has some, each beside the other blocks; none otherwise."""
        places = [i for i, block in enumerate(self.blocks) if getattr(block, "strata", ())]
        if len(places) != 1:
            return ()
        (i,) = places
        before, behind = self.blocks[:i], self.blocks[i + 1 :]
        return tuple(
            each._replace(base=ProductDistribution((*before, *getattr(each.base, "blocks", (each.base,)), *behind)))
            for each in self.blocks[i].strata
        )

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d)."""
        return np.hstack([block.sample(n, rng) for block in self.blocks])

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density, (n, d) -> (n,)."""
        return np.asarray(sum(block.log_prob(part) for block, part in self._with_parts(x)))

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map to standard normal space block by block, (n, d) -> (n, d)."""
        return np.hstack([block.to_standard_normal(part) for block, part in self._with_parts(x)])

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map from standard normal space block by block, (n, d) -> (n, d)."""
        return np.hstack([block.from_standard_normal(part) for block, part in self._with_parts(u)])

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return the parameters of the blocks that have some, see `DistributionParameter`."""
        names, others = names or name_columns(self.dim), getattr(like, "blocks", ())
        found: list[DistributionParameter] = []
        first = 0
        for i, block in enumerate(self.blocks):
            size: int = block.dim
            if hasattr(block, "parameters"):
                other = others[i] if len(others) == len(self.blocks) else None
                own = block.parameters(names[first : first + size], other)
                found += [each._replace(columns=tuple(first + j for j in each.columns)) for each in own]
            first += size
        return tuple(found)

    def with_parameters(self, values: ArrayLike) -> "ProductDistribution":
        """Return the blocks with other values of their parameters.

        Raises:
            ValueError: There is not one value for each parameter, or a block refuses its values.
        """
        return ProductDistribution(tuple(change_parts(self.blocks, np.asarray(values, dtype=np.float64))))

    def _with_parts(self, points: FloatArray) -> list[tuple[Any, FloatArray]]:
        """Return each block with its columns."""
        ends = np.cumsum([block.dim for block in self.blocks])[:-1]
        return list(zip(self.blocks, np.split(np.asarray(points), ends, axis=1), strict=True))
