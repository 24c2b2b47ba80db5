"""Responder: answers what methods request of a problem, f, terms and gradients, and isolates rows that raise."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from samplers.errors import EvaluationError, OnError, one_per_row
from samplers.execution.fault_isolation import Evaluate, FaultIsolation
from samplers.execution.journal import JournalFile, JournalRecord
from samplers.execution.journaled_evaluation import (
    FirstCheck,
    Packed,
    digest_request,
    keep_answer,
    keep_simulations,
    pack_gradients,
    pack_terms,
    unpack_gradients,
    unpack_terms,
)
from samplers.method import Answer, GradientRequest, Request, TermsOffer, TermsRequest
from samplers.problem import FloatArray, Problem, TermGradients, Terms, offers_terms
from samplers.validation import check_number

_T = TypeVar("_T")


class Responder:
    """A problem as the source of answers.

    Points of all replicates are simulated in one batch, and those whose terms are wanted in another. Gradients are
    computed for one replicate after the other, so that what they cost it does not depend on the others.

    Args:
        problem: Has `evaluate`; what else it has makes the offer.
        gamma: Threshold of failure.
        on_error: Rule for rows on which f, terms or a gradient raises. With "failure" and "bound" a row without terms
            has f = NaN, and one without a gradient has NaN there.
        isolation: Counts the rows that are simulated again; None for one of its own.
        journal: Keeps answers, and may have some from before; None keeps nothing.

    Raises:
        ValueError: If the problem has gradients and its gradient_cost is no positive number.

    Attributes:
        offer: What the problem can answer beside f; None for f alone.
    """

    def __init__(
        self,
        problem: Problem,
        gamma: float,
        on_error: OnError = "raise",
        isolation: FaultIsolation | None = None,
        journal: JournalFile | None = None,
    ) -> None:
        self._problem: Any = problem
        self._gamma, self._journal = gamma, journal
        self._isolation = isolation or FaultIsolation(problem.evaluate, on_error)
        self._evaluate: Evaluate = self._isolation.evaluate
        if journal is not None:
            self._check = FirstCheck(journal, FaultIsolation(problem.evaluate, on_error).evaluate)
            self._evaluate = keep_simulations(self._isolation, journal, self._check)
        self._n_terms: int | None = None
        self._gradient: Any = None
        self.offer: TermsOffer | None = None
        if offers_terms(problem):
            self._gradient = getattr(problem, "gradient", None)  # a property may have to find out whether there is one
            cost = _read_cost(problem) if callable(self._gradient) else None
            if cost is not None:
                check_number("gradient_cost", cost, 0.0, np.inf)
            self.offer = TermsOffer(cost)

    @property
    def n_retried(self) -> int:
        """Rows that were simulated again to find those that raise."""
        return self._isolation.n_retried

    def respond(self, requests: Sequence[Request]) -> list[Answer]:
        """Return the answers to some requests, in their order; f may still be NaN.

        Raises:
            EvaluationError: If f, terms or a gradient raises (on_error "raise") or is not of the right form.
        """
        answers: dict[int, Answer] = {}
        points = {i: one for i, one in enumerate(requests) if isinstance(one, np.ndarray)}
        if points:
            x = np.concatenate(list(points.values()))
            answers.update(
                zip(points, _split(one_per_row(self._evaluate(x), len(x)), list(points.values())), strict=True)
            )
        wanted = {i: one.x for i, one in enumerate(requests) if isinstance(one, TermsRequest)}
        if wanted:
            x = np.concatenate(list(wanted.values()))
            terms = self._kept_terms(x)
            self._n_terms = terms.values.shape[1]
            rows = _split(np.arange(len(terms.f)), list(wanted.values()))
            answers.update((i, select_rows(terms, part)) for i, part in zip(wanted, rows, strict=True))
        for i, one in enumerate(requests):
            if isinstance(one, GradientRequest):
                answers[i] = self._kept_gradients(one)
        return [answers[i] for i in range(len(requests))]

    def _kept_terms(self, x: FloatArray) -> Terms:
        """Return terms from the journal, or simulate."""

        def compute() -> Packed:
            return pack_terms(*self._note(lambda: self._terms(x)))

        def restore(known: JournalRecord) -> None:
            self._check(x, unpack_terms(known.f, known.notes, len(x)).f)
            self._isolation.n_retried += int(known.notes["n_retried"])

        if self._journal is None:
            return self._terms(x)
        return unpack_terms(*keep_answer(self._journal, digest_request("terms", x), compute, restore), len(x))

    def _kept_gradients(self, request: GradientRequest) -> TermGradients:
        """Return gradients from the journal, or differentiate."""

        def compute() -> Packed:
            return pack_gradients(*self._note(lambda: self._gradients(request)))

        def restore(known: JournalRecord) -> None:
            self._isolation.n_retried += int(known.notes["n_retried"])

        if self._journal is None:
            return self._gradients(request)
        asked = digest_request("gradient", request.x, request.term, request.ticks)
        return unpack_gradients(*keep_answer(self._journal, asked, compute, restore), len(request.x))

    def _note(self, compute: Callable[[], _T]) -> tuple[_T, dict[str, int]]:
        """Return a result, and a note on how many rows were simulated again for it."""
        before = self.n_retried
        return compute(), {"n_retried": self.n_retried - before}

    def _terms(self, x: FloatArray) -> Terms:
        """Return the terms of points x (n, d), f = NaN in rows without an outcome."""

        def call(rows: Any) -> Terms:
            return _check_terms(self._problem.terms(x[rows], self._gamma), len(rows))

        attempted = self._isolation.attempt(call, x, "terms")
        # a problem that isolates failing rows itself may not know how many terms a batch has of which all rows failed
        parts = [(rows, None if part is None or np.isnan(part.f).all() else part) for rows, part in attempted]
        known = [part for _, part in parts if part is not None]
        counts = {part.values.shape[1] for part in known} | ({self._n_terms} if self._n_terms else set())
        if len(counts) > 1:
            raise EvaluationError(f"Expected the same number of terms in every batch, got {sorted(counts)}.")
        self._n_terms = counts.pop() if counts else None
        missing = _without_outcome(self._n_terms or 1, known[0].threshold if known else self._gamma)
        return join_terms([select_rows(missing, 0 * rows) if part is None else part for rows, part in parts])

    def _gradients(self, request: GradientRequest) -> TermGradients:
        """Return gradients, NaN in rows on which they raise; such a row costs what a row costs at most."""
        assert self.offer is not None and self.offer.gradient_cost is not None
        x = request.x

        def call(rows: Any) -> TermGradients:
            got = self._gradient(x[rows], request.term[rows], request.ticks[rows], self._gamma)
            values = np.asarray(got.values, dtype=np.float64)
            if values.shape != (len(rows), x.shape[1]):
                raise EvaluationError(f"Expected gradients of shape {(len(rows), x.shape[1])}, got {values.shape}.")
            return TermGradients(values, float(got.cost))

        missing = TermGradients(np.full((1, x.shape[1]), np.nan), self.offer.gradient_cost)
        parts = [part or missing for _, part in self._isolation.attempt(call, x, "The gradient")]
        return TermGradients(np.concatenate([part.values for part in parts]), sum(part.cost for part in parts))


def _read_cost(problem: Any) -> float:
    """Return the cost of a gradient that a problem states."""
    return float(problem.gradient_cost)


def select_rows(terms: Terms, rows: Any) -> Terms:
    """Return the terms of some of the points."""
    return Terms(terms.f[rows], terms.values[rows], terms.ticks[rows], terms.threshold, terms.names)


def join_terms(parts: Sequence[Terms]) -> Terms:
    """Return the terms of several batches, one or more, as those of one."""
    f, values, ticks = (
        np.concatenate(arrays) for arrays in zip(*((t.f, t.values, t.ticks) for t in parts), strict=True)
    )
    return Terms(f, values, ticks, parts[0].threshold, next((part.names for part in parts if part.names), ()))


def hide_missing(terms: Terms, f: FloatArray) -> Terms:
    """Return the terms with f as methods see it; points without an outcome, f = -inf, fail in every term."""
    values = np.where(np.isneginf(f)[:, None], -np.inf, terms.values)
    return Terms(f, values, terms.ticks, terms.threshold, terms.names)


def _without_outcome(n_terms: int, threshold: float) -> Terms:
    """Return the terms of one point that has none."""
    return Terms(np.array([np.nan]), np.full((1, n_terms), np.nan), np.zeros((1, n_terms), dtype=np.int64), threshold)


def _check_terms(terms: Any, n: int) -> Terms:
    """Return what a problem gave as terms of n points as arrays of the right types; NaN among them is no outcome."""
    f, values = one_per_row(terms.f, n), np.asarray(terms.values, dtype=np.float64)
    ticks = np.asarray(terms.ticks, dtype=np.int64)
    if values.ndim != 2 or len(values) != n or values.shape[1] == 0 or ticks.shape != values.shape:
        raise EvaluationError(f"Expected values and ticks of shape ({n}, J), got {values.shape} and {ticks.shape}.")
    f = np.where(np.isnan(values).any(axis=1), np.nan, f)
    return Terms(f, values, ticks, float(terms.threshold), tuple(getattr(terms, "names", ())))


def _split(rows: Any, parts: Sequence[FloatArray]) -> list[Any]:
    """Return an array of rows split as these parts are long."""
    return np.split(rows, np.cumsum([len(part) for part in parts])[:-1])
