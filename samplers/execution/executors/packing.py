"""Packing: terms and gradients as numbers and notes, for a journal or from a worker; terms of parts joined."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from samplers.errors import EvaluationError, one_per_row
from samplers.execution.executors.chunks import Packed
from samplers.method import whole_simulations
from samplers.problem import FloatArray, TermGradients, Terms


def pack_terms(terms: Terms, notes: dict[str, Any], n_known: int | None = None) -> Packed:
    """Return terms as numbers, and further notes on them.

    Args:
        terms: Of a chunk.
        notes: On what they cost.
        n_known: Number of terms; 0 where no row had any, so that their number is not known. None for that of the terms.
    """
    numbers = np.concatenate([terms.f, np.ravel(terms.values), np.ravel(terms.ticks)])
    n_terms = terms.values.shape[1] if n_known is None else n_known
    own = {"threshold": float(terms.threshold), "names": list(terms.names), "n_sim": len(terms.f), "n_terms": n_terms}
    return numbers, notes | own


def unpack_terms(numbers: FloatArray, notes: dict[str, Any], n: int) -> Terms:
    """Return the terms of n points from numbers and notes."""
    f, values, ticks = np.split(numbers, [n, n + (len(numbers) - n) // 2])
    return Terms(
        f,
        values.reshape(n, -1),
        ticks.reshape(n, -1).astype(np.int64),
        float(notes["threshold"]),
        tuple(notes["names"]),
    )


def pack_gradients(gradients: TermGradients, notes: dict[str, Any]) -> Packed:
    """Return gradients as numbers, and further notes on them."""
    cost = float(gradients.cost)
    return np.ravel(gradients.values), notes | {"cost": cost, "n_sim": whole_simulations(cost)}


def unpack_gradients(numbers: FloatArray, notes: dict[str, Any], n: int) -> TermGradients:
    """Return the gradients at n points from numbers and notes."""
    return TermGradients(numbers.reshape(n, -1), float(notes["cost"]))


def unpack_all_terms(parts: Sequence[tuple[int, Packed]], n_known: int | None) -> tuple[Terms, int | None]:
    """Return the terms of several chunks as those of one, and their number.

    Args:
        parts: Rows and result of each chunk.
        n_known: Number of terms in earlier requests; None before the first.

    Raises:
        EvaluationError: If they have different numbers of terms.
    """
    counts = {int(notes["n_terms"]) for _, (_, notes) in parts} | {n_known or 0}
    counts.discard(0)
    if len(counts) > 1:
        raise EvaluationError(f"Expected the same number of terms in every batch, got {sorted(counts)}.")
    n_terms = counts.pop() if counts else None
    missing = [not notes["n_terms"] for _, (_, notes) in parts]
    unpacked = [unpack_terms(*packed, n) for n, packed in parts]
    threshold = next((one.threshold for one, no in zip(unpacked, missing, strict=True) if not no), None)
    whole = [
        make_missing_terms(len(one.f), n_terms or 1, one.threshold if threshold is None else threshold) if no else one
        for one, no in zip(unpacked, missing, strict=True)
    ]
    return join_terms(whole), n_terms


def make_missing_terms(n: int, n_terms: int, threshold: float) -> Terms:
    """Return the terms of n points that have none."""
    return Terms(np.full(n, np.nan), np.full((n, n_terms), np.nan), np.zeros((n, n_terms), dtype=np.int64), threshold)


def select_rows(terms: Terms, rows: Any) -> Terms:
    """Return the terms of some of the points."""
    return Terms(terms.f[rows], terms.values[rows], terms.ticks[rows], terms.threshold, terms.names)


def join_terms(parts: Sequence[Terms]) -> Terms:
    """Return the terms of several batches, one or more, as those of one."""
    f, values, ticks = (
        np.concatenate(arrays) for arrays in zip(*((t.f, t.values, t.ticks) for t in parts), strict=True)
    )
    return Terms(f, values, ticks, parts[0].threshold, next((part.names for part in parts if part.names), ()))


def check_terms(terms: Any, n: int) -> Terms:
    """Return what a problem gave as terms of n points as arrays of the right types; NaN among them is no outcome."""
    f, values = one_per_row(terms.f, n), np.asarray(terms.values, dtype=np.float64)
    ticks = np.asarray(terms.ticks, dtype=np.int64)
    if values.ndim != 2 or len(values) != n or values.shape[1] == 0 or ticks.shape != values.shape:
        raise EvaluationError(f"Expected values and ticks of shape ({n}, J), got {values.shape} and {ticks.shape}.")
    f = np.where(np.isnan(values).any(axis=1), np.nan, f)
    return Terms(f, values, ticks, float(terms.threshold), tuple(getattr(terms, "names", ())))
