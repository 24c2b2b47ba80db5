"""IndependentDistributions: distributions of consecutive coordinates, side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class SizedDistribution(Protocol):
    """A base distribution that knows its number of coordinates."""

    @property
    def dim(self) -> int:
        """Number of coordinates."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x of this distribution, shape (n, d), to u ~ N(0, I)."""

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""


@dataclass(frozen=True, eq=False)
class IndependentDistributions:
    """The product of distributions, each of some consecutive coordinates.

    Args:
        parts: In the order of the coordinates.

    Example:
        >>> import numpy as np
        >>> from scipy import stats
        >>> from samplers.distributions import ScipyDistribution
        >>> base = IndependentDistributions((ScipyDistribution(stats.norm(5, 1)), ScipyDistribution(stats.uniform())))
        >>> base.from_standard_normal(np.zeros((1, 2)))
        array([[5. , 0.5]])
    """

    parts: tuple[SizedDistribution, ...]

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return sum(part.dim for part in self.parts)

    @cached_property
    def _ends(self) -> list[int]:
        return [int(end) for end in np.cumsum([part.dim for part in self.parts])[:-1]]

    def _apply(self, maps: Iterable[Callable[[FloatArray], Any]], x: FloatArray) -> list[FloatArray]:
        """Return what the map of each part gives for its columns of x (n, d)."""
        return [one(part) for one, part in zip(maps, np.split(x, self._ends, axis=1), strict=True)]

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return np.hstack([part.sample(n, rng) for part in self.parts])

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""
        return np.asarray(np.sum(self._apply((part.log_prob for part in self.parts), x), axis=0))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x of this distribution, shape (n, d), to u ~ N(0, I)."""
        return np.hstack(self._apply((part.to_standard_normal for part in self.parts), x))

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        return np.hstack(self._apply((part.from_standard_normal for part in self.parts), u))

    def __repr__(self) -> str:
        """Return one line."""
        return f"<IndependentDistributions of {len(self.parts)} parts in {self.dim} dimensions>"
