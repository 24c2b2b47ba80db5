"""Evaluator: the one way from what a method requests to what a problem answers; no method knows of it.

    request -> chunks -> journal, or work (here or by a worker) -> journal -> answer

What comes back is checked. Where the problem raises or gives NaN, the rows that fail are found (`samplers.workers`),
and each simulation is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from samplers.executors import Executor, Here, Pool
from samplers.journal import Journal, JournalError, digest_points
from samplers.method import Answer, Request, TermsOffer, whole_simulations
from samplers.problem import (
    EvaluationError,
    FloatArray,
    OnError,
    TermGradients,
    Terms,
    check_number,
    check_whole,
    condition_of,
    names_of_columns,
)
from samplers.workers import Result, Work, join_results, widen_table

CHUNK_SIZE = 16
"""Rows of a chunk of workers where the problem has no `chunk_size`."""
N_CHECKED = 8
"""Points at which a continued journal calls f again, from the least f of its first chunk to the largest."""
F_TOLERANCE = 1e-3
"""Largest difference of f there, as a share of the largest |f|: products of networks round differently by batch."""


class Fault(NamedTuple):
    """A point x (d,) without an outcome, and why, in one line."""

    x: FloatArray
    reason: str


class Simulated(NamedTuple):
    """Points that were simulated for one request."""

    x: FloatArray
    """Shape (n, d)."""
    f: FloatArray
    """Shape (n,); NaN where there is no outcome."""
    reasons: list[str]
    """Why there is none, in their order."""
    seconds: FloatArray
    """Wall time of each [s], that of its chunk shared equally, shape (n,)."""


class Evaluator:
    """A problem as the source of answers, for the length of a run.

    Points of all replicates are simulated in one batch, and those whose terms are wanted in another. Gradients are
    computed for one replicate after the other, so that what they cost it does not depend on the others.

    Attributes:
        problem: What is evaluated, with its `dim`, `base`, `given` and `column_names`.
        offer: What it can answer beside f; None for f alone.
        pool: The workers; this process without an executor.
        faults: Points without an outcome, in the order in which they were asked for.
        lost: Why rows have nothing that no worker survived.
        n_retried: Rows that were simulated again to find those that fail; they are not in `n_sim` of an estimate.
        n_restored: Rows whose results were taken from the journal.
        n_made, n_failed: Simulations of which f is known, also of a request that is not complete; those that failed.
        watchers: Each is called with what was simulated, request by request.
        on_chunk: Called with the number of rows of a request that are done, after every chunk.

    Example:
        >>> import samplers
        >>> def f(x):
        ...     if (x > 1).any():
        ...         raise ArithmeticError("off the map")
        ...     return x[:, 0]
        >>> with Evaluator(samplers.FunctionProblem(f, dim=1), on_error="failure") as evaluator:
        ...     print(evaluator.evaluate(np.array([[0.0], [2.0], [1.0], [0.5]])))
        [0.  nan 1.  0.5]
        >>> evaluator.faults, evaluator.n_retried
        ([Fault(x=array([2.]), reason='ArithmeticError: off the map')], 6)
    """

    def __init__(
        self,
        problem: Any,
        gamma: float = 0.0,
        on_error: OnError = "raise",
        *,
        journal: Journal | None = None,
        executor: Executor | None = None,
        seed: int = 0,
        size: int | None = None,
        name: str = "f",
        precision: DTypeLike = np.float64,
    ) -> None:
        """Wrap a problem; `gamma`, `on_error` and `name` are those of `Work`.

        The journal keeps what has been computed, and may have some from before. Chunks, of `size` rows, are computed by
        the executor, if any, and what simulations draw there follows from the seed; without a size they have the
        problem's `chunk_size` with an executor, and are whole requests without. Points that differ by less than the
        precision, in which x is simulated, are the same to the journal.
        """
        self.problem, self._journal, self._executor = problem, journal, executor
        self.dim, self.base = int(problem.dim), problem.base
        self.given, self.column_names = condition_of(problem), names_of_columns(problem)
        self._gamma, self._work = gamma, Work(problem, gamma, on_error, name, None if executor is None else seed)
        self._split = find_chunk_size(problem, size)
        self._size = None if size is None and executor is None else self._split
        self._precision, self._n_chunks, self._checked = precision, 0, False
        self._widths: set[int] = set()  # of tables of terms
        self.pool: Here | Pool = Here(self._work)
        self._stack = ExitStack()
        self.offer = _find_offer(problem)
        self.faults, self.lost = list[Fault](), list[str]()
        self.n_retried = self.n_restored = self.n_made = self.n_failed = 0
        self.watchers: list[Callable[[Simulated], None]] = []
        self.on_chunk: Callable[[int], None] | None = None

    def __enter__(self) -> Evaluator:
        """Get workers, if there is an executor."""
        if self._executor is not None:
            self.pool = self._stack.enter_context(self._executor.open(self._work))
        return self

    def __exit__(self, *error: object) -> None:
        """Let the workers go."""
        self._stack.close()

    def respond(self, requests: Sequence[Request]) -> list[Answer]:
        """Return the answers to some requests, in their order; f may still be NaN."""
        answers: dict[int, Answer] = {}
        for kind in ("f", "terms"):
            mine = [i for i, one in enumerate(requests) if one.kind == kind]
            if mine:
                table, notes = self._compute(Request(kind, (np.concatenate([requests[i].x for i in mine]),)))
                parts = np.split(table, np.cumsum([len(requests[i]) for i in mine])[:-1])
                for i, part in zip(mine, parts, strict=True):
                    answers[i] = part[:, 0] if kind == "f" else self._read_terms(part, notes)
        for i, one in enumerate(requests):
            if one.kind == "gradient":
                table, notes = self._compute(one)
                answers[i] = TermGradients(table, float(notes["cost"]))
        return [answers[i] for i in range(len(requests))]

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f of points x (n, d), shape (n,); NaN where there is no outcome."""
        return self._compute(Request("f", (x,))).table[:, 0]

    def _read_terms(self, table: FloatArray, notes: dict[str, Any]) -> Terms:
        f, values, ticks = np.split(table, [1, 1 + (table.shape[1] - 1) // 2], axis=1)
        threshold, names = notes.get("threshold", self._gamma), notes.get("names", ())
        return Terms(f[:, 0], values, np.nan_to_num(ticks).astype(np.int64), threshold, tuple(names))

    def _compute(self, request: Request) -> Result:
        """Return the result of a request, as far as it goes from the journal; NaN where rows have none."""
        request = Request(request.kind, (np.asarray(request.x, dtype=np.float64), *request.arrays[1:]))
        chunks, results = self._restore(request)
        first, self._n_chunks = self._n_chunks, self._n_chunks + len(request.split(self._size))
        left = ((first + number, chunk) for number, chunk in enumerate(chunks) if number not in results)
        n_done = sum(len(chunks[number]) for number in results)
        for number_in_run, result in self.pool.run(left):
            number = number_in_run - first
            if self._journal is not None:
                cost = whole_simulations(result.notes["cost"]) if request.kind == "gradient" else len(chunks[number])
                self._journal.append(self._digest(chunks[number]), result, cost)
            results[number] = result
            n_done += len(chunks[number])
            if request.kind != "gradient":  # whose rows count as what they cost
                self._count(result)
                if self.on_chunk is not None:
                    self.on_chunk(n_done)
        return self._conclude(request, [results[number] for number in range(len(chunks))])

    def _restore(self, request: Request) -> tuple[list[Request], dict[int, Result]]:
        """Return the chunks of a request, and the results of those that the journal has.

        It may have the request whole, or in chunks, where an executor continues what was begun without one or the
        other way around.
        """
        chunks, known = request.split(self._size), dict[int, Result]()
        if self._journal is None or not self._journal.has_others:
            return chunks, known
        for parts in (chunks, [request], request.split(self._split)):
            found = {number: self._journal.find(self._digest(chunk)) for number, chunk in enumerate(parts)}
            known = {number: result for number, result in found.items() if result is not None}
            if known:
                chunks = parts
                break
        if len(known) < len(chunks) and self._journal.has_others:
            raise JournalError(
                f"After {self.n_restored:,} simulations this run asks for other points than "
                f"{str(self._journal.path)!r} has: arguments, base distribution or libraries have changed since it was "
                "begun. Remove the file to begin anew."
            )
        for number, result in known.items():
            self.n_restored += len(chunks[number])
            if request.kind != "gradient":
                self._check_same_f(self._journal, chunks[number], result.table[:, 0])
                self._count(result)
        return chunks, known

    def _digest(self, chunk: Request) -> str:
        """Return the name of a chunk in the journal, by its points."""
        x = digest_points(chunk.x.astype(self._precision))
        if chunk.kind == "f":
            return x
        return " ".join((chunk.kind, repr(self._gamma), x, *map(digest_points, chunk.arrays[1:])))

    def _count(self, result: Result) -> None:
        f = result.table[:, 0]
        self.n_made += len(f)
        self.n_failed += int((np.isnan(f) | (f <= self._gamma)).sum())

    def _conclude(self, request: Request, results: list[Result]) -> Result:
        """Return the results of a request as one; note its faults and what it took, and tell the watchers."""
        table, notes = join_results(results)
        self.n_retried += int(notes["n_retried"])
        self.lost += notes.get("lost", [])
        if request.kind == "gradient":
            return Result(widen_table(table, self.dim), notes)
        f, reasons = table[:, 0], notes["reasons"]
        if request.kind == "terms":
            self._widths |= {result.table.shape[1] for result in results} - {1}  # no row has any
            if len(self._widths) > 1:
                counts = sorted((width - 1) // 2 for width in self._widths)
                raise EvaluationError(f"Expected the same number of terms in every batch, got {counts}.")
            table = widen_table(table, max(self._widths, default=3))
        self.faults += [Fault(x.copy(), why) for x, why in zip(request.x[np.isnan(f)], reasons, strict=True)]
        if self.watchers:
            parts = [(len(each.table), each.notes.get("seconds", np.nan)) for each in results]
            seconds = np.concatenate([np.full(n, total / max(n, 1)) for n, total in parts])
            for watch in self.watchers:
                watch(Simulated(request.x, f, reasons, seconds))
        return Result(table, notes)

    def _check_same_f(self, journal: Journal, chunk: Request, known: FloatArray) -> None:
        """Raise a JournalError if f has other values now at some points of the first chunk, the same ones twice."""
        if self._checked:
            return
        self._checked = True
        rows = np.argsort(known)[np.unique(np.linspace(0, len(chunk) - 1, N_CHECKED).astype(int))]
        f, part = known[rows], Request("f", (chunk.x[rows],))
        ((_, again),) = self.pool.run([(0, part)])
        changed = find_changed(again.table[:, 0], f)
        if not changed.any():
            return
        ((_, third),) = self.pool.run([(0, part)])
        if np.array_equal(again.table[:, 0], third.table[:, 0], equal_nan=True):
            row = int(np.argmax(changed))
            raise JournalError(
                f"f is {again.table[row, 0]:.6g} at a point where {str(journal.path)!r} has {f[row]:.6g}: it has "
                "changed since the journal was begun. Remove the file to begin anew."
            )


def find_chunk_size(problem: object, size: int | None = None) -> int:
    """Return how many rows are computed together: a size, that of the problem, or `CHUNK_SIZE`.

    It must not depend on the number of workers: products of networks round differently by batch.
    """
    if size is None:
        size = getattr(problem, "chunk_size", None)  # anybody's problem
    if size is None:
        size = CHUNK_SIZE if getattr(problem, "vectorized", True) else 1  # of a `FunctionProblem`
    check_whole("chunk_size", size, 1)
    return int(size)


def find_changed(again: FloatArray, f: FloatArray) -> NDArray[np.bool_]:
    """Return where f, simulated again, is another, shape (n,): beyond `F_TOLERANCE` of the largest |f|."""
    room = F_TOLERANCE * float(np.abs(f[np.isfinite(f)]).max(initial=0.0))
    return ~np.isclose(again, f, rtol=0.0, atol=room, equal_nan=True)


def _find_offer(problem: Any) -> TermsOffer | None:
    """Return what a problem can answer beside f."""
    if not callable(getattr(problem, "terms", None)):  # a user's object
        return None
    cost = None
    if callable(getattr(problem, "gradient", None)):  # a property may have to find out whether there is one
        check_number("gradient_cost", problem.gradient_cost, 0.0, np.inf)
        cost = float(problem.gradient_cost)
    return TermsOffer(cost, bool(getattr(problem, "terms_with_f", True)))
