"""Chunks: rows of a request that are computed together, wherever that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.validation import check_whole

Packed = tuple[FloatArray, dict[str, Any]]
"""A result as numbers (k,) and notes on them, JSON-ready: what a journal keeps and what a worker sends."""
Index = tuple[int, ...]
"""Number of a chunk in its run; of a row that is computed alone, also its number in the chunk. It keys random draws."""
CHUNK_SIZE = 16
"""Rows of a chunk where the problem has no `chunk_size`."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """Rows of a request.

    Example:
        >>> import numpy as np
        >>> chunk = Chunk("f", (np.arange(5.0)[:, None],))
        >>> [len(part) for part in chunk.split(2)]
        [2, 2, 1]
    """

    kind: str
    """What is asked for: "f", "terms" or "gradient"."""
    arrays: tuple[NDArray[Any], ...]
    """x (n, d); of gradients also the numbers and the ticks of terms, (n,) each."""

    @property
    def x(self) -> FloatArray:
        """Points, shape (n, d)."""
        return self.arrays[0]

    def __len__(self) -> int:
        return len(self.arrays[0])

    def split(self, size: int | None) -> list[Chunk]:
        """Return chunks of `size` rows, the last one of what is left; itself for None."""
        if size is None or len(self) <= size:
            return [self]
        return [
            Chunk(self.kind, tuple(array[first : first + size] for array in self.arrays))
            for first in range(0, len(self), size)
        ]


@runtime_checkable
class HasChunkSize(Protocol):
    """A problem that says how many rows are to be simulated together.

    It must not depend on the number of workers: products of networks round differently by batch, so that another size
    gives other bits.
    """

    @property
    def chunk_size(self) -> int | None:
        """Rows of a chunk, 1 or more; None for the default."""


def find_chunk_size(problem: object, size: int | None = None) -> int:
    """Return a size, or that of the problem, or `CHUNK_SIZE`.

    Raises:
        ValueError: If it is no whole number of at least 1.

    Example:
        >>> import samplers
        >>> find_chunk_size(samplers.FunctionProblem(lambda x: x[0], dim=2, vectorized=False))
        1
    """
    if size is None and isinstance(problem, HasChunkSize):
        size = problem.chunk_size
    if size is None:
        size = CHUNK_SIZE if getattr(problem, "vectorized", True) else 1  # of a `FunctionProblem`
    check_whole("chunk_size", size, 1)
    return int(size)


def join_notes(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return notes on several chunks as those of one: numbers are added, lists joined, the rest is that of the first.

    Example:
        >>> join_notes([{"n_retried": 2, "lost": ["late"]}, {"n_retried": 1}])
        {'n_retried': 3, 'lost': ['late']}
    """
    notes: dict[str, Any] = {}
    for part in parts:
        for name, value in part.items():
            more = name in notes and isinstance(value, int | float | list)
            notes[name] = notes[name] + value if more else notes.get(name, value)
    return notes
