"""Evaluator: the one way from what a method requests to what a problem answers; no method knows of it.

    request -> chunks -> journal, or work (here or by a worker) -> journal -> answer

What comes back is checked. Where the problem raises or gives NaN, the rows that fail are found (`samplers.chunks`), and
each simulation is counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from samplers.chunks import NAN_REASON, Attempted, Chunk, Result, isolate, join_results
from samplers.dispatch import Dispatcher
from samplers.executors import Executor
from samplers.journal import Journal, JournalError, digest_points
from samplers.method import Answer, GradientRequest, Request, TermsOffer, TermsRequest, whole_simulations
from samplers.problem import FloatArray, TermGradients, Terms, condition_of, names_of_columns, offers_terms
from samplers.validation import EvaluationError, OnError, check_number, check_whole, describe_point, one_per_row
from samplers.workers import SeededWork

CHUNK_SIZE = 16
"""Rows of a chunk of workers where the problem has no `chunk_size`."""
N_CHECKED = 8
"""Points at which a continued journal calls f again, from the least f of its first chunk to the largest."""
F_TOLERANCE = 1e-3
"""Largest difference of f there, as a share of the largest |f|: products of networks round differently by batch."""


class Fault(NamedTuple):
    """A point without an outcome."""

    x: FloatArray
    """Shape (d,)."""
    reason: str
    """Why, in one line."""


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


@dataclass(frozen=True)
class Work:
    """Computes a chunk, here or in a worker."""

    problem: Any
    """Has `evaluate`, and `terms` and `gradient` if they are asked for. Where it goes on by itself with the rows on
    which it does not fail, it has `attempt(x)` and `attempt_terms(x, gamma)`, which also give the reasons by row."""
    gamma: float
    """Threshold of failure."""
    on_error: OnError
    """Rule for rows that fail: "raise" ends the run; with "failure" and "bound" f and terms are NaN. A row that has an
    outcome and no gradient has NaN there."""
    name: str = "f"
    """Of what fails, for messages."""

    def __call__(self, chunk: Chunk) -> Result:
        """Compute a chunk.

        Raises:
            EvaluationError: A row fails (on_error "raise"), or the problem gives what is not of the right form.
        """
        start, n_retried = time.perf_counter(), 0
        attempt = partial(_ATTEMPTS[chunk.kind], self.problem, self.gamma)
        with np.errstate():  # a problem that sets NumPy's errors sets them for itself
            try:
                found: Any = attempt(chunk)
            except (Exception, SystemExit) as error:  # the problem is the user's: anything may happen in it
                found = error
            if not isinstance(found, Attempted) or found.reasons:
                found, n_retried = isolate(attempt, chunk, found, partial(self.refuse, chunk))
        notes = {**found.notes, "n_retried": n_retried, "seconds": time.perf_counter() - start}
        if chunk.kind == "gradient":
            notes["cost"] = notes.get("cost", 0.0) + float(self.problem.gradient_cost) * len(found.reasons)
        else:
            notes["reasons"] = [found.reasons[row] for row in sorted(found.reasons)]
        return Result(found.table, notes)

    def lose(self, chunk: Chunk, reason: str) -> Result:
        """Return the result of a row that no worker survives.

        Raises:
            EvaluationError: on_error is "raise".
        """
        self.refuse(chunk, 0, reason)
        notes: dict[str, Any] = {"n_retried": 0, "lost": [reason]}
        if chunk.kind == "gradient":
            return Result(np.full((1, 1), np.nan), {**notes, "cost": float(self.problem.gradient_cost)})
        return Result(np.full((1, 1), np.nan), {**notes, "reasons": [reason]})

    def refuse(self, chunk: Chunk, row: int, reason: str, cause: BaseException | None = None) -> None:
        """Raise an EvaluationError for a row of a chunk that has failed for good, if on_error is "raise"."""
        if self.on_error == "raise":
            what = "The gradient" if chunk.kind == "gradient" else self.name
            raise EvaluationError(
                f'{what} failed twice on x = {describe_point(chunk.x[row])}: {reason}; on_error "failure" or "bound" '
                "would count it instead."
            ) from cause


def _attempt_f(problem: Any, gamma: float, chunk: Chunk) -> Attempted:
    x, rowwise = chunk.x.copy(), _find_rowwise(problem, "evaluate", "attempt")  # a copy, on which it may write
    f, reasons = (problem.evaluate(x), {}) if rowwise is None else rowwise(x)
    f = one_per_row(f, len(x))
    return Attempted(f[:, None], _reasons_of_nan(f) | reasons, {})


def _attempt_terms(problem: Any, gamma: float, chunk: Chunk) -> Attempted:
    x, n, rowwise = chunk.x.copy(), len(chunk), _find_rowwise(problem, "terms", "attempt_terms")
    terms, reasons = (problem.terms(x, gamma), {}) if rowwise is None else rowwise(x, gamma)
    f, values, ticks = one_per_row(terms.f, n), np.asarray(terms.values, dtype=np.float64), np.asarray(terms.ticks)
    if values.ndim != 2 or len(values) != n or values.shape[1] == 0 or ticks.shape != values.shape:
        raise EvaluationError(f"Expected values and ticks of shape ({n}, J), got {values.shape} and {ticks.shape}.")
    f = np.where(np.isnan(values).any(axis=1), np.nan, f)
    notes = {"threshold": float(terms.threshold), "names": list(getattr(terms, "names", ()))}
    return Attempted(np.column_stack((f, values, ticks)), _reasons_of_nan(f) | reasons, notes)


def _attempt_gradient(problem: Any, gamma: float, chunk: Chunk) -> Attempted:
    x, term, ticks = (array.copy() for array in chunk.arrays)
    found = problem.gradient(x, term, ticks, gamma)
    values = np.asarray(found.values, dtype=np.float64)
    if values.shape != x.shape:
        raise EvaluationError(f"Expected gradients of shape {x.shape}, got {values.shape}.")
    return Attempted(values, {}, {"cost": float(found.cost)})


def _find_rowwise(problem: Any, whole: str, rowwise: str) -> Callable[..., Any] | None:
    """Return the method that goes on with the other rows, if it computes what the method `whole` does.

    A subclass, a wrapper or an instance that has `whole` of its own is asked by that.
    """
    method = getattr(problem, rowwise, None)
    owner = getattr(method, "__self__", None)
    if owner is None or getattr(getattr(problem, whole, None), "__self__", None) is not owner:
        return None
    definition = next(vars(kind) for kind in type(owner).__mro__ if {whole, rowwise} & set(vars(kind)))
    return method if {whole, rowwise} <= set(definition) else None


def _reasons_of_nan(f: FloatArray) -> dict[int, str]:
    return dict.fromkeys(np.flatnonzero(np.isnan(f)).tolist(), NAN_REASON)


_ATTEMPTS: dict[str, Callable[..., Attempted]] = {
    "f": _attempt_f,
    "terms": _attempt_terms,
    "gradient": _attempt_gradient,
}


class Evaluator:
    """A problem as the source of answers, for the length of a run.

    Points of all replicates are simulated in one batch, and those whose terms are wanted in another. Gradients are
    computed for one replicate after the other, so that what they cost it does not depend on the others.

    Attributes:
        problem: What is evaluated.
        offer: What it can answer beside f; None for f alone.
        faults: Points without an outcome, in the order in which they were asked for.
        lost: Why rows have nothing that no worker survived.
        n_retried: Rows that were simulated again to find those that fail; they are not in `n_sim` of an estimate.
        n_restored: Rows whose results were taken from the journal.
        n_made: Simulations of which f is known, those of a request that is not complete included.
        n_failed: Those of them that failed, or have no outcome.
        workers: Number of workers; 0 without an executor.
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
        """Wrap a problem.

        Args:
            problem: As of `Work`.
            gamma: As of `Work`.
            on_error: As of `Work`.
            journal: Keeps what has been computed, and may have some from before.
            executor: Where chunks are computed; None for here.
            seed: Of the run, for what simulations draw in workers.
            size: Rows of a chunk; None for `chunk_size` of the problem with an executor, and to leave requests whole
                without one.
            name: Of what fails, for messages.
            precision: In which x is simulated: points that differ by less are the same to the journal.

        Raises:
            ValueError: If the problem has gradients and its gradient_cost is no positive number, or a size is none.
        """
        self.problem, self._journal, self._executor, self._seed = problem, journal, executor, seed
        self._work = Work(problem, gamma, on_error, name)
        self._split = find_chunk_size(problem, size)
        self._size = None if size is None and executor is None else self._split
        self._precision, self._n_chunks, self._checked = precision, 0, False
        self._n_terms: int | None = None
        self._dispatcher: Dispatcher | None = None
        self._stack = ExitStack()
        self.offer = _find_offer(problem)
        self.faults, self.lost = list[Fault](), list[str]()
        self.n_retried = self.n_restored = self.n_made = self.n_failed = self.workers = 0
        self.watchers: list[Callable[[Simulated], None]] = []
        self.on_chunk: Callable[[int], None] | None = None

    def __enter__(self) -> Evaluator:
        """Get workers, if there is an executor."""
        if self._executor is not None:
            pool = self._stack.enter_context(self._executor.open(SeededWork(self._work, self._seed)))
            self._dispatcher, self.workers = Dispatcher(pool, self._work.lose), pool.workers
        return self

    def __exit__(self, *error: object) -> None:
        """Let the workers go."""
        self._stack.close()

    @property
    def dim(self) -> int:
        """Number of dimensions of x."""
        return int(self.problem.dim)

    @property
    def base(self) -> Any:
        """Distribution of X."""
        return self.problem.base

    @property
    def given(self) -> str:
        """Condition of p, in words; empty without one."""
        return condition_of(self.problem)

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of the columns of x; empty where the problem has none."""
        return names_of_columns(self.problem)

    @property
    def n_retries(self) -> int:
        """Chunks that were computed again because a worker was lost."""
        return 0 if self._dispatcher is None else self._dispatcher.n_retries

    def respond(self, requests: Sequence[Request]) -> list[Answer]:
        """Return the answers to some requests, in their order; f may still be NaN.

        Raises:
            EvaluationError: A row fails (on_error "raise"), or what the problem gives is not of the right form.
            JournalError: The journal has other points, or f had other values at them than it has now.
        """
        answers: dict[int, Answer] = {}
        points = {i: one for i, one in enumerate(requests) if isinstance(one, np.ndarray)}
        if points:
            f = self._compute(Chunk("f", (np.concatenate(list(points.values())),))).table[:, 0]
            answers.update(zip(points, _split(f, list(points.values())), strict=True))
        wanted = {i: one.x for i, one in enumerate(requests) if isinstance(one, TermsRequest)}
        if wanted:
            terms = self.terms(np.concatenate(list(wanted.values())))
            rows = _split(np.arange(len(terms.f)), list(wanted.values()))
            answers.update((i, select_rows(terms, part)) for i, part in zip(wanted, rows, strict=True))
        for i, one in enumerate(requests):
            if isinstance(one, GradientRequest):
                answers[i] = self.gradient(one.x, one.term, one.ticks)
        return [answers[i] for i in range(len(requests))]

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f of points x (n, d), shape (n,); NaN where there is no outcome."""
        return self._compute(Chunk("f", (np.asarray(x, dtype=np.float64),))).table[:, 0]

    def terms(self, x: FloatArray) -> Terms:
        """Return the terms of points x (n, d); NaN where there is no outcome."""
        table, notes = self._compute(Chunk("terms", (np.asarray(x, dtype=np.float64),)))
        n, n_found = len(table), (table.shape[1] - 1) // 2
        if n_found and self._n_terms not in (None, n_found):
            counts = sorted({n_found, self._n_terms or 0})
            raise EvaluationError(f"Expected the same number of terms in every batch, got {counts}.")
        self._n_terms = n_found or self._n_terms
        if not n_found:  # no row has an outcome
            table = np.full((n, 1 + 2 * (self._n_terms or 1)), np.nan)
        f, values, ticks = np.split(table, [1, 1 + (table.shape[1] - 1) // 2], axis=1)
        threshold, names = notes.get("threshold", self._work.gamma), notes.get("names", ())
        return Terms(f[:, 0], values, np.nan_to_num(ticks).astype(np.int64), threshold, tuple(names))

    def gradient(self, x: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64]) -> TermGradients:
        """Return the gradients of one term of each of the points x (n, d); NaN in rows that have none."""
        table, notes = self._compute(Chunk("gradient", (np.asarray(x, dtype=np.float64), term, ticks)))
        if table.shape[1] != x.shape[1]:  # no row has one
            table = np.full(x.shape, np.nan)
        return TermGradients(table, float(notes["cost"]))

    def _compute(self, request: Chunk) -> Result:
        """Return the result of a request, from the journal as far as that has it."""
        chunks, results = self._restore(request)
        first, self._n_chunks = self._n_chunks, self._n_chunks + len(request.split(self._size))
        left = {number: chunk for number, chunk in enumerate(chunks) if number not in results}
        n_done = sum(len(chunks[number]) for number in results)
        for number, result in self._map(first, left):
            if self._journal is not None:
                n_sim = whole_simulations(result.notes["cost"]) if request.kind == "gradient" else len(chunks[number])
                self._journal.append(self._digest(chunks[number]), result, n_sim)
            results[number] = result
            self._count(chunks[number], result)
            n_done += len(chunks[number])
            if self.on_chunk is not None and request.kind != "gradient":  # whose rows count as what they cost
                self.on_chunk(n_done)
        ordered = [results[number] for number in range(len(chunks))]
        if request.kind != "gradient":
            self._note(request, ordered)
        for result in ordered:
            self.n_retried += int(result.notes["n_retried"])
            self.lost += result.notes.get("lost", [])
        return _join_checked(ordered)

    def _map(self, first: int, chunks: dict[int, Chunk]) -> Iterable[tuple[int, Result]]:
        """Return the results of chunks with their numbers in the request, the first of which has a number in the run.

        Generators of random numbers are keyed by the number in the run.
        """
        if self._dispatcher is None:
            return zip(chunks, map(self._work, chunks.values()), strict=True)
        done = self._dispatcher.run((first + number, chunk) for number, chunk in chunks.items())
        return ((number - first, result) for number, result in done)

    def _restore(self, request: Chunk) -> tuple[list[Chunk], dict[int, Result]]:
        """Return the chunks of a request, and the results of those that the journal has.

        It may have the request whole, or in chunks, where an executor continues what was begun without one or the
        other way around.
        """
        chunks, known = request.split(self._size), dict[int, Result]()
        if self._journal is None or not self._journal.has_others:
            return chunks, known
        for parts in {len(each): each for each in (chunks, [request], request.split(self._split))}.values():
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
            self._check_same_f(chunks[number], result)
            self.n_restored += len(chunks[number])
            self._count(chunks[number], result)
        return chunks, known

    def _digest(self, chunk: Chunk) -> str:
        """Return the name of a chunk in the journal, by its points."""
        x = digest_points(chunk.x.astype(self._precision))
        if chunk.kind == "f":
            return x
        return " ".join((chunk.kind, repr(self._work.gamma), x, *map(digest_points, chunk.arrays[1:])))

    def _count(self, chunk: Chunk, result: Result) -> None:
        if chunk.kind != "gradient":
            f = result.table[:, 0]
            self.n_made += len(f)
            self.n_failed += int((np.isnan(f) | (f <= self._work.gamma)).sum())

    def _note(self, request: Chunk, results: Sequence[Result]) -> None:
        """Note the faults of a request, and tell the watchers."""
        f = np.concatenate([result.table[:, 0] for result in results])
        reasons = [reason for result in results for reason in result.notes["reasons"]]
        self.faults += [Fault(x.copy(), why) for x, why in zip(request.x[np.isnan(f)], reasons, strict=True)]
        if self.watchers:
            parts = [(len(each.table), each.notes.get("seconds", np.nan)) for each in results]
            seconds = np.concatenate([np.full(n, whole / max(n, 1)) for n, whole in parts])
            for watch in self.watchers:
                watch(Simulated(request.x, f, reasons, seconds))

    def _check_same_f(self, chunk: Chunk, result: Result) -> None:
        """Raise a JournalError if f has other values now at some points of the first chunk, the same ones twice."""
        if self._checked or chunk.kind == "gradient":
            return
        self._checked = True
        rows = np.argsort(result.table[:, 0])[np.unique(np.linspace(0, len(chunk) - 1, N_CHECKED).astype(int))]
        f, part = result.table[rows, 0], {0: Chunk("f", (chunk.x[rows],))}
        ((_, again),) = self._map(0, part)
        changed = find_changed(again.table[:, 0], f)
        if not changed.any():
            return
        ((_, third),) = self._map(0, part)
        if np.array_equal(again.table[:, 0], third.table[:, 0], equal_nan=True):
            row = int(np.argmax(changed))
            assert self._journal is not None
            raise JournalError(
                f"f is {again.table[row, 0]:.6g} at a point where {str(self._journal.path)!r} has {f[row]:.6g}: it has "
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


def select_rows(terms: Terms, rows: Any) -> Terms:
    """Return the terms of some of the points."""
    return Terms(terms.f[rows], terms.values[rows], terms.ticks[rows], terms.threshold, terms.names)


def _join_checked(results: Sequence[Result]) -> Result:
    """Return the results of chunks as one; those that know their numbers of terms must agree."""
    widths = {result.table.shape[1] for result in results} - {1}
    if len(widths) > 1:
        counts = sorted((width - 1) // 2 for width in widths)
        raise EvaluationError(f"Expected the same number of terms in every batch, got {counts}.")
    return join_results(results)


def _find_offer(problem: Any) -> TermsOffer | None:
    """Return what a problem can answer beside f."""
    if not offers_terms(problem):
        return None
    known: Any = problem
    gradient: Any = getattr(problem, "gradient", None)  # a property may have to find out whether there is one
    cost = float(known.gradient_cost) if callable(gradient) else None
    if cost is not None:
        check_number("gradient_cost", cost, 0.0, np.inf)
    return TermsOffer(cost, bool(getattr(problem, "terms_with_f", True)))


def _split(rows: Any, parts: Sequence[FloatArray]) -> list[Any]:
    """Return an array of rows split as these parts are long."""
    return np.split(rows, np.cumsum([len(part) for part in parts])[:-1])
