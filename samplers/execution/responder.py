"""Responder: answers what methods request of a problem: f, terms and gradients."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from samplers.errors import OnError
from samplers.execution.executors.chunks import Chunk, Packed
from samplers.execution.executors.packing import select_rows, unpack_all_terms, unpack_gradients
from samplers.execution.executors.problem_work import ProblemWork
from samplers.execution.journaled_evaluation import JournaledEvaluation
from samplers.method import Answer, GradientRequest, Request, TermsOffer, TermsRequest
from samplers.problem import FloatArray, Problem, TermGradients, Terms, offers_terms
from samplers.validation import check_number


class Responder:
    """A problem as the source of answers.

    Points of all replicates are simulated in one batch, and those whose terms are wanted in another. Gradients are
    computed for one replicate after the other, so that what they cost it does not depend on the others.

    Args:
        problem: Has `evaluate`; what else it has makes the offer.
        gamma: Threshold of failure.
        on_error: Rule for rows on which f, terms or a gradient raises. With "failure" and "bound" a row without terms
            has f = NaN, and one without a gradient has NaN there.
        evaluation: Computes chunks; None to compute requests whole and here.

    Raises:
        ValueError: If the problem has gradients and its gradient_cost is no positive number.

    Attributes:
        offer: What the problem can answer beside f; None for f alone.
        n_retried: Rows that were simulated again to find those that raise.
        lost: Why rows have no outcome that no worker survived.
    """

    def __init__(
        self,
        problem: Problem,
        gamma: float,
        on_error: OnError = "raise",
        evaluation: JournaledEvaluation | None = None,
    ) -> None:
        self._evaluation = evaluation or JournaledEvaluation(ProblemWork(problem, gamma, on_error))
        self._n_terms: int | None = None
        self.n_retried = 0
        self.lost: list[str] = []
        self.offer: TermsOffer | None = None
        if offers_terms(problem):
            gradient = getattr(problem, "gradient", None)  # a property may have to find out whether there is one
            cost = _read_cost(problem) if callable(gradient) else None
            if cost is not None:
                check_number("gradient_cost", cost, 0.0, np.inf)
            self.offer = TermsOffer(cost, bool(getattr(problem, "terms_with_f", True)))

    def respond(self, requests: Sequence[Request]) -> list[Answer]:
        """Return the answers to some requests, in their order; f may still be NaN.

        Raises:
            EvaluationError: If f, terms or a gradient raises (on_error "raise") or is not of the right form.
        """
        answers: dict[int, Answer] = {}
        points = {i: one for i, one in enumerate(requests) if isinstance(one, np.ndarray)}
        if points:
            parts = self._evaluate(Chunk("f", (np.concatenate(list(points.values())),)))
            f = np.concatenate([numbers for _, (numbers, _) in parts])
            answers.update(zip(points, _split(f, list(points.values())), strict=True))
        wanted = {i: one.x for i, one in enumerate(requests) if isinstance(one, TermsRequest)}
        if wanted:
            terms = self._terms(np.concatenate(list(wanted.values())))
            rows = _split(np.arange(len(terms.f)), list(wanted.values()))
            answers.update((i, select_rows(terms, part)) for i, part in zip(wanted, rows, strict=True))
        for i, one in enumerate(requests):
            if isinstance(one, GradientRequest):
                answers[i] = self._gradients(one)
        return [answers[i] for i in range(len(requests))]

    def _evaluate(self, request: Chunk) -> list[tuple[Chunk, Packed]]:
        """Return chunks with their results, and count what they cost."""
        parts = self._evaluation.evaluate(request)
        for _, (_, notes) in parts:
            self.n_retried += int(notes["n_retried"])
            self.lost += notes.get("lost", [])
        return parts

    def _terms(self, x: FloatArray) -> Terms:
        parts = [(len(chunk), packed) for chunk, packed in self._evaluate(Chunk("terms", (x,)))]
        terms, self._n_terms = unpack_all_terms(parts, self._n_terms)
        return terms

    def _gradients(self, request: GradientRequest) -> TermGradients:
        parts = [
            unpack_gradients(*packed, len(chunk))
            for chunk, packed in self._evaluate(Chunk("gradient", (request.x, request.term, request.ticks)))
        ]
        return TermGradients(np.concatenate([part.values for part in parts]), sum(part.cost for part in parts))


def _read_cost(problem: Any) -> float:
    """Return the cost of a gradient that a problem states."""
    return float(problem.gradient_cost)


def hide_missing(terms: Terms, f: FloatArray) -> Terms:
    """Return the terms with f as methods see it; points without an outcome, f = -inf, fail in every term."""
    values = np.where(np.isneginf(f)[:, None], -np.inf, terms.values)
    return Terms(f, values, terms.ticks, terms.threshold, terms.names)


def _split(rows: Any, parts: Sequence[FloatArray]) -> list[Any]:
    """Return an array of rows split as these parts are long."""
    return np.split(rows, np.cumsum([len(part) for part in parts])[:-1])
