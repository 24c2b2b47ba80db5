"""Base distributions made of independent blocks, and noise as one of them.

Cross-entropy searches block by block (`samplers.CrossEntropy(family="blocks")`); it finds them in
`ProductDistribution.blocks`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import (
    Distribution,
    DistributionParameter,
    HasParameters,
    check_values,
    number_columns,
)


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

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Return the same points."""
        return u

    def pull_back(self, u: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return the same gradients."""
        return gradients

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "NoiseDistribution":
        """Return the same distribution: a block of cross-entropy that does not move."""
        return self

    def widen(self, factor: float) -> "NoiseDistribution":
        """Return the same distribution."""
        return self


@runtime_checkable
class BlockDistribution(Distribution, Protocol):
    """A distribution that announces independent blocks and noise, as cross-entropy and two-stage look for them.

    Example:
        >>> isinstance(ProductDistribution((NoiseDistribution(1),)), BlockDistribution)
        True
        >>> isinstance(NoiseDistribution(1), BlockDistribution)
        False
    """

    @property
    def blocks(self) -> Sequence[Any]:
        """Distributions with `dim`, in the order of the columns of x."""

    @property
    def noise(self) -> NDArray[np.bool_]:
        """Mask of the columns of x that are noise, shape (d,): samplers may leave these as they are."""


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
    def _ends(self) -> NDArray[np.intp]:
        return np.cumsum([block.dim for block in self.blocks])[:-1]

    @cached_property
    def noise(self) -> NDArray[np.bool_]:
        """Mask of the columns that are noise, shape (d,): samplers may leave these as they are."""
        is_noise = [isinstance(block, NoiseDistribution) for block in self.blocks]
        return np.repeat(is_noise, [block.dim for block in self.blocks])

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
        """Return the parameters of the blocks that have some, see `HasParameters`."""
        names, found = names or number_columns(self.dim), list[DistributionParameter]()
        others = getattr(like, "blocks", ())
        others = others if len(others) == len(self.blocks) else (None,) * len(self.blocks)
        first = 0
        for block, other in zip(self.blocks, others, strict=True):
            size: int = block.dim
            if isinstance(block, HasParameters):
                own = block.parameters(names[first : first + size], other)
                found += [each._replace(columns=tuple(first + j for j in each.columns)) for each in own]
            first += size
        return tuple(found)

    def with_parameters(self, values: ArrayLike) -> "ProductDistribution":
        """Return the blocks with other values of their parameters.

        Raises:
            ValueError: There is not one value for each parameter, or a block refuses its values.
        """
        counts = [len(block.parameters()) if isinstance(block, HasParameters) else 0 for block in self.blocks]
        given = np.asarray(values, dtype=np.float64)
        check_values(given, sum(counts))
        parts = np.split(given, np.cumsum(counts)[:-1])
        blocks = zip(self.blocks, parts, counts, strict=True)
        return ProductDistribution(tuple(block.with_parameters(own) if n else block for block, own, n in blocks))

    def _with_parts(self, points: FloatArray) -> list[tuple[Any, FloatArray]]:
        """Return each block with its columns."""
        return list(zip(self.blocks, self._split(points), strict=True))

    def _split(self, points: FloatArray) -> list[FloatArray]:
        return np.split(np.asarray(points), self._ends, axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedProduct(FittedDistribution):
    """Independent blocks of which one is fitted to events: its refits, with the other blocks as they are.

    `join_independent` makes it. Events, frequency, checks and record are those of the fitted block.

    Example:
        >>> from rare_envs.distributions import EventCounts, TruncatedGaussianMixture
        >>> fit, refit = (TruncatedGaussianMixture([1.0], [[m]], [[[1.0]]], [-9.0], [9.0]) for m in (0.0, 0.3))
        >>> fitted = FittedDistribution(
        ...     distribution=fit, refits=(fit, refit), events=EventCounts(used=(40,), clusters=12), family="1 component"
        ... )
        >>> joined = join_independent(fitted, NoiseDistribution(2))
        >>> type(joined).__name__, joined.dim, [each.dim for each in joined.refits], joined.fitted_to
        ('FittedProduct', 3, [3, 3], '40 events of 12 scenes')
    """

    parts: tuple[Distribution, ...]
    """The independent distributions, of which one is fitted."""

    @property
    def blocks(self) -> Sequence[Any]:
        """Distributions with `dim`, in the order of the columns of x."""
        return cast(BlockDistribution, self.distribution).blocks

    @property
    def noise(self) -> NDArray[np.bool_]:
        """Which columns are noise, shape (d,): samplers may leave these as they are."""
        return cast(BlockDistribution, self.distribution).noise

    @property
    def fitted_part(self) -> FittedDistribution:
        """The one that is fitted."""
        return next(each for each in self.parts if isinstance(each, FittedDistribution))

    @property
    def refit_families(self) -> tuple[int, ...]:
        """Number of the coordinates of each refit of the fitted one."""
        return self.fitted_part.refit_families

    def ensemble(self) -> Distribution:
        """Return the blocks with the ensemble of the fitted one in its place."""
        return _join_with(self.parts, self.fitted_part.ensemble())

    def sibling(self, name: str) -> Distribution:
        """Return the blocks with another base distribution in place of the fitted one."""
        return _join_with(self.parts, self.fitted_part.sibling(name))


def join_independent(*distributions: Distribution) -> Distribution:
    """Return independent distributions side by side as one; their own blocks, if they have some, become its blocks.

    If exactly one of them is fitted to events, so is the whole, see `FittedProduct`. With several fitted ones it is
    not: their refits do not belong together.

    Example:
        >>> join_independent(NoiseDistribution(3), NoiseDistribution(2)).dim
        5
    """
    fitted = [each for each in distributions if isinstance(each, FittedDistribution)]
    if len(distributions) == 1:
        return distributions[0]
    if len(fitted) != 1:
        return _join(distributions)
    (own,) = fitted
    return FittedProduct(
        distribution=_join_with(distributions, own.distribution),
        refits=tuple(_join_with(distributions, refit) for refit in own.refits),
        events=own.events,
        family=own.family,
        frequency=own.frequency,
        checks=own.checks,
        record=own.record,
        parts=distributions,
    )


def _join_with(distributions: Sequence[Distribution], replacement: Distribution) -> Distribution:
    """Return distributions as one with another in place of the fitted one."""
    return join_independent(*(replacement if isinstance(each, FittedDistribution) else each for each in distributions))


def _join(distributions: Sequence[Distribution]) -> Distribution:
    blocks: list[Any] = []
    for each in distributions:
        plain = each.distribution if isinstance(each, FittedDistribution) else each
        blocks += plain.blocks if isinstance(plain, BlockDistribution) else (plain,)
    return ProductDistribution(tuple(blocks))
