"""Kept draws: of any number of plain draws as many as fit into a fixed memory, for curves and shares of failures."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.sample import Sample

MOST_DRAWS = 2**20
"""Draws whose f is kept at most, 8 MiB."""
MOST_FAILING_BYTES = 2**26
"""Bytes of failing points that are kept at most, or `LEAST_FAILING` points if these take more."""
LEAST_FAILING = 10_000


class EvenlySpaced:
    """Rows 0, s, 2 s, ... of a stream; s is 1 and doubles where more than `most` would be kept.

    Which rows are kept depends on their number alone, so that independent draws stay independent and unselected.

    Args:
        most: Rows kept at most.
        shape: Of a row.

    Attributes:
        stride: s.
        n: Rows seen.

    Example:
        >>> rows = EvenlySpaced(4)
        >>> for batch in np.split(np.arange(12.0), 3):
        ...     rows.add(batch)
        >>> rows.values.tolist(), rows.stride
        ([0.0, 4.0, 8.0], 4)
    """

    def __init__(self, most: int, shape: tuple[int, ...] = ()) -> None:
        self.stride, self.n = 1, 0
        self._most, self._kept = most, 0
        self._parts: list[NDArray[Any]] = [np.empty((0, *shape))]

    @property
    def values(self) -> NDArray[Any]:
        """Rows kept, shape (k, ...)."""
        self._parts = [np.concatenate(self._parts)]
        return self._parts[0]

    def add(self, rows: NDArray[Any]) -> None:
        """See more rows (n, ...)."""
        new = rows[-self.n % self.stride :: self.stride]
        self._parts.append(new if self.stride == 1 else new.copy())  # a view would keep the whole batch
        self._kept += len(new)
        self.n += len(rows)
        while self._kept > self._most:
            self._parts = [self.values[::2].copy()]
            self._kept, self.stride = len(self._parts[0]), 2 * self.stride


class KeptDraws:
    """Independent draws of equal weight: all of them while they are few, evenly spaced ones when they are many.

    Args:
        gamma: Threshold of failure.
        dim: Number of dimensions of x.

    Example:
        >>> draws = KeptDraws(gamma=0.0, dim=1)
        >>> draws.add(np.array([[3.0], [5.0]]), np.array([1.0, -1.0]))
        1
        >>> draws.to_sample().weights.tolist(), draws.to_sample().x.tolist()
        ([0.5, 0.5], [[5.0]])
    """

    def __init__(self, gamma: float, dim: int, most: int = MOST_DRAWS, most_failing: int | None = None) -> None:
        self._gamma, self._n_missing = gamma, 0
        room = max(MOST_FAILING_BYTES // (8 * max(dim, 1)), LEAST_FAILING) if most_failing is None else most_failing
        self._f, self._x, self._f_failing = EvenlySpaced(most), EvenlySpaced(room, (dim,)), EvenlySpaced(room)

    def add(self, x: FloatArray, f: FloatArray) -> int:
        """Add draws x (n, d) with outcomes f (n,); return how many of them fail."""
        fails = f <= self._gamma
        self._f.add(f)
        self._x.add(x[fails])
        self._f_failing.add(f[fails])
        self._n_missing += int(np.isneginf(f[fails]).sum())
        return int(fails.sum())

    @property
    def no_outcome_share(self) -> float:
        """Share of the failing draws that have no outcome."""
        return self._n_missing / self._x.n if self._x.n else 0.0

    def to_sample(self) -> Sample:
        """Return the draws as a sample; where some were left out, those kept stand for them.

        The weights of the failing ones add up to their share of all draws, so that p is exact; the error of p at other
        thresholds is that of the draws kept, as the weights and their number tell.
        """
        n, f, x = self._f.n, self._f.values, self._x.values
        if self._f.stride == 1 and self._x.stride == 1:
            return Sample.of_equal_draws(f, x)
        failing, safe, hits = self._f_failing.values, f[f > self._gamma], self._x.n
        weights = [np.full(k, m / (n * k)) for m, k in ((hits, len(failing)), (n - hits, len(safe))) if k]
        k = len(failing) + len(safe)
        return Sample(
            f=np.concatenate([failing, safe]),
            weights=np.concatenate(weights),
            units=np.arange(k, dtype=np.int64),
            n_units=k,
            x=x,
        )
