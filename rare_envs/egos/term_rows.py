"""Terms and gradients of scenarios row by row, some without an outcome, as a table of numbers and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Table = NDArray[np.float64]
"""A row of numbers for each scenario, shape (n, k)."""


class TermRows(NamedTuple):
    """f of n scenarios and their J terms; has what a method reads of `samplers.Terms`."""

    f: NDArray[np.float64]
    """Shape (n,), NaN in rows without an outcome."""
    values: NDArray[np.float64]
    """Shape (n, J), likewise."""
    ticks: NDArray[np.int64]
    """Shape (n, J)."""
    threshold: float
    """Terms fail at or below it."""
    names: tuple[str, ...]
    """Of the J terms."""


class GradientRows(NamedTuple):
    """Gradients of n scenarios; has what `samplers.TermGradients` has."""

    values: NDArray[np.float64]
    """Shape (n, d), NaN in rows that have none."""
    cost: float
    """Simulations that they took, all rows together."""


def tabulate_terms(terms: Any) -> Table:
    """Return f, values and ticks of terms as a table, shape (n, 1 + 2 J)."""
    return np.column_stack((terms.f, terms.values, terms.ticks)).astype(np.float64)


def read_terms(table: Table, threshold: float, names: Sequence[str]) -> TermRows:
    """Return the terms of a table that `join_tables` gave.

    Example:
        >>> read_terms(np.array([[2.0, 2.0, 5.0, 7.0, 9.0], [np.nan] * 5]), 0.0, ("left", "right")).values
        array([[ 2.,  5.],
               [nan, nan]])
    """
    if table.shape[1] == 1:  # no row has an outcome: of how many terms is not known
        table = np.full((len(table), 3), np.nan)
    f, values, ticks = np.split(table, [1, 1 + (table.shape[1] - 1) // 2], axis=1)
    return TermRows(f[:, 0].copy(), values.copy(), np.nan_to_num(ticks).astype(np.int64), threshold, tuple(names))


def join_tables(parts: Sequence[Table]) -> Table:
    """Return tables as one; rows without an outcome, NaN alone, may be shorter than the others.

    Example:
        >>> join_tables([np.array([[1.0, 2.0]]), np.array([[np.nan]])])
        array([[ 1.,  2.],
               [nan, nan]])
    """
    width = max(part.shape[1] for part in parts)
    return np.concatenate([widen_rows(part, width) for part in parts])


def overwrite_rows(table: Table, rows: NDArray[np.int64], other: Table) -> Table:
    """Return a table with some of its rows replaced."""
    width = max(table.shape[1], other.shape[1])
    table = widen_rows(table, width)
    table[rows] = widen_rows(other, width)
    return table


def widen_rows(table: Table, width: int) -> Table:
    """Return a copy with columns of NaN behind its own."""
    return np.pad(table, ((0, 0), (0, width - table.shape[1])), constant_values=np.nan)
