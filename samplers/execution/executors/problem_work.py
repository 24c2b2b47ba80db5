"""ProblemWork: f, terms and gradients of a problem, with rows isolated that raise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from samplers.errors import EvaluationError, OnError, describe_row, one_per_row
from samplers.execution.executors.chunks import Chunk, Packed, join_notes
from samplers.execution.executors.packing import (
    check_terms,
    join_terms,
    make_missing_terms,
    pack_gradients,
    pack_terms,
    select_rows,
    unpack_all_terms,
)
from samplers.execution.fault_isolation import FaultIsolation, RowNumbers
from samplers.execution.journal import digest_points, digest_request
from samplers.method import whole_simulations
from samplers.problem import TermGradients, Terms


@dataclass(frozen=True)
class ProblemWork:
    """Work that computes what a problem has.

    Rows on which it raises have f = NaN with on_error "failure" and "bound"; a row without terms likewise, and one
    without a gradient has NaN there.

    Example:
        >>> import samplers
        >>> work = ProblemWork(samplers.FunctionProblem(lambda x: x[:, 0], dim=1), 0.0, "raise")
        >>> work(Chunk("f", (np.array([[2.0], [3.0]]),)))
        (array([2., 3.]), {'n_retried': 0})
    """

    problem: Any
    """Has `evaluate`, and `terms` and `gradient` if they are asked for."""
    gamma: float
    """Threshold of failure."""
    on_error: OnError
    """Rule for rows on which it raises."""

    def __call__(self, chunk: Chunk) -> Packed:
        """Compute a chunk.

        Raises:
            EvaluationError: If the problem raises (on_error "raise"), or gives what is not of the right form.
        """
        isolation = FaultIsolation(self.problem.evaluate, self.on_error)
        if chunk.kind == "f":
            f = one_per_row(isolation.evaluate(chunk.x), len(chunk))
            return f, {"n_retried": isolation.n_retried}
        return (
            self._compute_terms(chunk, isolation)
            if chunk.kind == "terms"
            else self._compute_gradients(chunk, isolation)
        )

    def digest(self, chunk: Chunk) -> str:
        """Return the name of a chunk in a journal."""
        return digest_points(chunk.x) if chunk.kind == "f" else digest_request(chunk.kind, *chunk.arrays)

    def join(self, parts: list[tuple[Chunk, Packed]]) -> Packed:
        """Return the result of a chunk from those of its parts."""
        return join_parts(parts)

    def lose(self, chunk: Chunk, reason: str) -> Packed:
        """Return the result of a row that no worker survives.

        Raises:
            EvaluationError: on_error is "raise".
        """
        if self.on_error == "raise":
            raise EvaluationError(f"{chunk.kind} has no outcome for {describe_row(chunk.x, 0)}; {reason}")
        return make_lost(chunk, {"n_retried": 0, "lost": [reason]}, self.gamma, self.problem)

    def _compute_terms(self, chunk: Chunk, isolation: FaultIsolation) -> Packed:
        x = chunk.x

        def call(rows: RowNumbers) -> Terms:
            return check_terms(self.problem.terms(x[rows], self.gamma), len(rows))

        attempted = isolation.attempt(call, x, "terms")
        # a problem that isolates failing rows itself may not know how many terms a batch has of which all rows failed
        parts = [(rows, None if part is None or np.isnan(part.f).all() else part) for rows, part in attempted]
        known = [part for _, part in parts if part is not None]
        counts = {part.values.shape[1] for part in known}
        if len(counts) > 1:
            raise EvaluationError(f"Expected the same number of terms in every batch, got {sorted(counts)}.")
        n_terms = counts.pop() if counts else 0
        missing = make_missing_terms(1, n_terms or 1, known[0].threshold if known else self.gamma)
        terms = join_terms([select_rows(missing, 0 * rows) if part is None else part for rows, part in parts])
        return pack_terms(terms, {"n_retried": isolation.n_retried}, n_terms)

    def _compute_gradients(self, chunk: Chunk, isolation: FaultIsolation) -> Packed:
        """Return gradients, NaN in rows on which they raise; such a row costs what a row costs at most."""
        x, term, ticks = chunk.arrays

        def call(rows: RowNumbers) -> TermGradients:
            got = self.problem.gradient(x[rows], term[rows], ticks[rows], self.gamma)
            values = np.asarray(got.values, dtype=np.float64)
            if values.shape != (len(rows), x.shape[1]):
                raise EvaluationError(f"Expected gradients of shape {(len(rows), x.shape[1])}, got {values.shape}.")
            return TermGradients(values, float(got.cost))

        missing = make_missing_gradient(chunk, self.problem)
        parts = [part or missing for _, part in isolation.attempt(call, x, "The gradient")]
        whole = TermGradients(np.concatenate([part.values for part in parts]), sum(part.cost for part in parts))
        return pack_gradients(whole, {"n_retried": isolation.n_retried})


def join_parts(parts: list[tuple[Chunk, Packed]]) -> Packed:
    """Return the result of a chunk from those of its parts; numbers in their notes are added, lists joined."""
    kind, notes = parts[0][0].kind, join_notes([packed[1] for _, packed in parts])
    if kind == "gradient":
        notes["n_sim"] = whole_simulations(notes["cost"])
    if kind != "terms":
        return np.concatenate([packed[0] for _, packed in parts]), notes
    terms, n_known = unpack_all_terms([(len(part), packed) for part, packed in parts], None)
    return pack_terms(terms, notes, n_known or 0)


def make_lost(chunk: Chunk, notes: dict[str, Any], gamma: float, problem: Any) -> Packed:
    """Return the result of a row without an outcome, with notes on it."""
    if chunk.kind == "f":
        return np.array([np.nan]), notes
    if chunk.kind == "terms":
        return pack_terms(make_missing_terms(1, 1, gamma), notes, 0)
    return pack_gradients(make_missing_gradient(chunk, problem), notes)


def make_missing_gradient(chunk: Chunk, problem: Any) -> TermGradients:
    """Return the gradient of a row that has none, at the cost that a row has at most."""
    return TermGradients(np.full((1, chunk.x.shape[1]), np.nan), float(problem.gradient_cost))
