"""Evaluator: the one way from what a method requests to what a problem answers; no method knows of it.

    request -> chunks -> journal, or work (here or by a worker) -> journal -> answer

What comes back is checked. If the problem raises or gives NaN, the rows that fail are found, and each simulation is
counted. `samplers.executors` has the workers.
"""

from __future__ import annotations

import math
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import DTypeLike, NDArray

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
    describe_point,
    names_of_columns,
    one_per_row,
    read_numbers,
)

CHUNK_SIZE = 16
"""Rows of a chunk of workers if the problem has no `chunk_size`."""
F_TOLERANCE = 1e-3
"""Largest difference of f there, as a share of the largest |f|: products of networks round differently by batch."""
WASTED_SHARE = 0.1
"""Rows in parts that raise, while those that raise are looked for, as a share of the chunk and of the rows done."""

Index = tuple[int, ...]
"""Number of a chunk in its run; of a row computed by itself, also its number in the chunk. It keys random draws."""


class Result(NamedTuple):
    """What a chunk gives."""

    table: FloatArray
    """A row for each row of the chunk, (n, k): f; f, values and ticks of terms; or a gradient. NaN if there is none;
    k = 1 if no row has any."""
    notes: dict[str, Any]
    """What else is known, JSON-ready: `reasons` of rows without f, in their order (in an attempt: by row), `n_retried`,
    `lost`, `seconds`, `cost` of gradients, `threshold` and `names` of terms."""


def widen_table(table: FloatArray, width: int) -> FloatArray:
    """Return a table (n, k) with `width` columns; what it does not know is NaN."""
    if table.shape[1] == width:
        return table
    return np.pad(table, ((0, 0), (0, width - table.shape[1])), constant_values=np.nan)


def join_results(parts: Sequence[Result]) -> Result:
    """Return the results of parts as one: numbers in notes are added, lists joined, the rest is that of the first."""
    notes: dict[str, Any] = {}
    for name, value in (item for part in parts for item in part.notes.items()):
        adds = name in notes and name not in ("names", "threshold") and isinstance(value, int | float | list)
        notes[name] = notes[name] + value if adds else notes.get(name, value)
    width = max(part.table.shape[1] for part in parts)
    return Result(np.concatenate([widen_table(part.table, width) for part in parts]), notes)


# Rows that fail


def isolate(attempt: Callable[[Request], Result], chunk: Request, fail: Callable[..., None]) -> Result:
    """Return what the rows of a chunk give, those that fail left out; notes have their `reasons` as a dict by row.

    If the attempt at all rows raises, they are attempted in parts until the rows that raise stand alone. The parts
    are as large as lets no more than a tenth of the chunk and of the rows done be in parts that raise: it all takes 1.2
    attempts a row at most, and the fewer calls the fewer rows raise. A row that has given nothing is attempted once
    more; if that gives nothing either, `fail(row, reason, error)` is told, which may raise.

    If an error means that an answer was waited for (its attribute `waits`), attempts are cheaper than errors: then
    parts of the root of the chunk, and each row alone of a part that raises.
    """
    n_retried, lost, unsure = 0, dict[int, str](), dict[int, str]()
    found = list[tuple[NDArray[np.int64], Result]]()
    for second in (False, True):
        again, rows = second, np.array(sorted(unsure), dtype=np.int64) if second else np.arange(len(chunk))
        size, spare = len(rows), WASTED_SHARE * len(rows)
        waited, alone, root = False, 0, math.isqrt(len(chunk))
        while len(rows):
            part = rows[:size]
            n_retried += len(part) if again else 0
            try:
                found.append((part, attempt(chunk if len(part) == len(chunk) else chunk.take(part))))
                spare += WASTED_SHARE * len(part)
                rows, alone = rows[size:], alone - len(part)
            except (Exception, SystemExit) as error:  # the simulation is the user's: anything may happen in it
                if getattr(error, "final", False):  # calling f again cannot help
                    raise
                if again and len(part) == 1:
                    lost[int(part[0])] = reason_of(error)
                    fail(int(part[0]), lost[int(part[0])], error)
                    found.append((part, Result(np.full((1, 1), np.nan), {})))
                    rows, alone = rows[1:], alone - 1
                waited = waited or getattr(error, "waits", False)
                alone = len(part) if waited and 1 < len(part) <= root else alone
                spare -= len(part) if again and len(part) > 1 else 0.0
                again = True
            size = max(1, int(spare / 2)) if not waited else root if alone <= 0 else 1
        if not second:
            unsure = {int(rows[at]): why for rows, each in found for at, why in each.notes.get("reasons", {}).items()}
    whole = join_results([each for _, each in found])
    table = np.empty((len(chunk), whole.table.shape[1]))
    table[np.concatenate([rows for rows, _ in found])] = whole.table  # what came last stands
    again_failed = {row: why for row, why in unsure.items() if np.isnan(table[row, 0])}
    for row in sorted(set(again_failed) - set(lost)):
        fail(row, again_failed[row])
    return Result(table, {**whole.notes, "reasons": {**again_failed, **lost}, "n_retried": n_retried})


def reason_of(error: BaseException) -> str:
    """Return what went wrong, in one line."""
    words = " ".join(str(error).split())
    if isinstance(error, ValueError) and words:  # most say what is wrong by themselves
        return words
    return f"{type(error).__name__}: {words}" if words and not isinstance(error, SystemExit) else repr(error)


# What a chunk is computed by


@dataclass(frozen=True)
class Work:
    """Computes a chunk, here or in a worker, by `evaluate`, `terms` or `gradient` of a problem.

    A problem that goes on by itself with the rows on which it does not fail has `attempt(x)` and `attempt_terms(x,
    gamma)`, which also give the reasons by row. A row that fails ends the run where on_error is "raise"; else its f and
    terms are NaN. `name` is that of f in messages. With a seed, what simulations draw follows from it and the index of
    their chunk (`seed_generators`).
    """

    problem: Any
    gamma: float
    on_error: OnError
    name: str = "f"
    seed: int | None = None

    def __call__(self, chunk: Request, index: Index = ()) -> Result:
        """Compute a chunk; raise an EvaluationError for a row that fails ("raise") and for results of a wrong form."""
        start, torch_was_known = time.perf_counter(), "torch" in sys.modules
        compute = partial(isolate, partial(_attempt, self.problem, self.gamma), chunk, partial(self._refuse, chunk))
        with seed_generators(self.seed, index):
            found = compute()
        if not torch_was_known and "torch" in sys.modules and self.seed is not None:  # its generator was not seeded
            with seed_generators(self.seed, index):
                found = compute()
        notes = dict(found.notes)
        reasons = notes.pop("reasons")
        if chunk.kind == "gradient":
            notes["cost"] = notes.get("cost", 0.0) + float(self.problem.gradient_cost) * len(reasons)
        else:
            notes["reasons"] = [reasons[row] for row in sorted(reasons)]
        return Result(found.table, {**notes, "seconds": time.perf_counter() - start})

    def lose(self, chunk: Request, reason: str) -> Result:
        """Return the result of a row that no worker survives; an EvaluationError where on_error is "raise"."""
        self._refuse(chunk, 0, reason)
        about = {"cost": float(self.problem.gradient_cost)} if chunk.kind == "gradient" else {"reasons": [reason]}
        return Result(np.full((1, 1), np.nan), {"n_retried": 0, "lost": [reason], **about})

    def _refuse(self, chunk: Request, row: int, reason: str, cause: BaseException | None = None) -> None:
        """Raise an EvaluationError for a row of a chunk that has failed for good, if on_error is "raise"."""
        if self.on_error == "raise":
            what = "The gradient" if chunk.kind == "gradient" else self.name
            raise EvaluationError(
                f'{what} failed twice on x = {describe_point(chunk.x[row])}: {reason}; on_error "failure" or "bound" '
                "would count it instead."
            ) from cause


def _attempt(problem: Any, gamma: float, chunk: Request) -> Result:
    """Return what a problem gives for a chunk, with the reasons by row where it gives nothing; it may write on x."""
    x, *about = (array.copy() for array in chunk.arrays)
    n, notes, reasons = len(x), dict[str, Any](), dict[int, str]()
    if chunk.kind == "gradient":
        found = problem.gradient(x, *about, gamma)
        table = read_numbers(found.values, f"gradients of shape {x.shape}")
        if table.shape != x.shape:
            raise EvaluationError(f"Expected gradients of shape {x.shape}, got {table.shape}.")
        return Result(table, {"cost": float(found.cost), "reasons": {}})
    whole, by_row, more = ("terms", "attempt_terms", (gamma,)) if chunk.kind == "terms" else ("evaluate", "attempt", ())
    if _have_same_owner(problem, whole, by_row):
        found, reasons = getattr(problem, by_row)(x, *more)  # foreign methods, by name
    else:
        found = getattr(problem, whole)(x, *more)
    if chunk.kind == "f":
        f = one_per_row(found, n)
        table = f[:, None]
    else:
        f, values = one_per_row(found.f, n), read_numbers(found.values, f"terms of shape ({n}, J)")
        ticks = np.asarray(found.ticks)
        if values.ndim != 2 or len(values) != n or values.shape[1] == 0 or ticks.shape != values.shape:
            raise EvaluationError(f"Expected values and ticks of shape ({n}, J), got {values.shape} and {ticks.shape}.")
        f = np.where(np.isnan(values).any(axis=1), np.nan, f)
        table = np.column_stack((f, values, ticks))
        notes = {"threshold": float(found.threshold), "names": list(getattr(found, "names", ()))}
    reasons = dict.fromkeys(np.flatnonzero(np.isnan(f)).tolist(), "f is NaN") | reasons
    return Result(table, {**notes, "reasons": reasons})


def _have_same_owner(problem: Any, whole: str, by_row: str) -> bool:
    """Return whether the method that goes on with the other rows computes what the method `whole` does.

    A subclass, a wrapper or an instance that has `whole` of its own is asked by that.
    """
    owner = getattr(getattr(problem, by_row, None), "__self__", None)
    if owner is None or getattr(getattr(problem, whole, None), "__self__", None) is not owner:
        return False
    definition = next(vars(kind) for kind in type(owner).__mro__ if {whole, by_row} & set(vars(kind)))
    return {whole, by_row} <= set(definition)


@contextmanager
def seed_generators(seed: int | None, index: Index) -> Iterator[None]:
    """Let the global generators begin anew for a block, by the seed of the run, if any, and a chunk's index.

    NumPy's handling of errors is that of before at its end: a problem that sets it sets it for itself.

    A simulation is to draw nothing itself. One that does (a policy that samples its actions) draws the same again when
    its chunk is computed again, on whichever worker, as long as it uses the generators of `random`, `numpy.random` or,
    on the CPU, torch.
    """
    if seed is None:
        with np.errstate():
            yield
        return
    state = int(np.random.SeedSequence(seed, spawn_key=index).generate_state(1)[0])
    torch: Any = sys.modules.get("torch")  # not imported for this
    before = random.getstate(), np.random.get_state(), None if torch is None else torch.random.get_rng_state()  # noqa: NPY002
    random.seed(state)
    np.random.seed(state)  # noqa: NPY002  (the global generator, which foreign code uses)
    if torch is not None:
        torch.random.default_generator.manual_seed(state)
    try:
        with np.errstate():
            yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        if torch is not None:
            torch.random.set_rng_state(before[2])


class Pool:
    """What computes chunks: this process, one after the other; `samplers.executors` has pools of others.

    Attributes:
        workers: Their number; 0 if there is no executor.
        n_retries: Chunks and rows that were computed again because a worker was lost.
    """

    def __init__(self, work: Work, workers: int = 0) -> None:
        self._work, self.workers, self.n_retries = work, workers, 0

    def run(self, chunks: Iterable[tuple[int, Request]]) -> Iterator[tuple[int, Result]]:
        """Yield the results of chunks with their numbers in the run, in any order; what the work raises is raised."""
        return ((number, self._work(chunk, (number,))) for number, chunk in chunks)


@runtime_checkable
class Executor(Protocol):
    """Settings from which workers are made for a run.

    Example:
        >>> import samplers
        >>> isinstance(samplers.executors.LocalProcesses(workers=2), samplers.executors.Executor)
        True
    """

    def open(self, work: Work) -> AbstractContextManager[Pool]:
        """Return workers for a run, which are gone at the end of the block; a ValueError if work cannot be sent."""


# The way of a request


class Fault(NamedTuple):
    """A point x (d,) without an outcome, and why, in one line."""

    x: FloatArray
    reason: str


class Simulated(NamedTuple):
    """Points that were simulated for one request."""

    x: FloatArray
    """Shape (n, d)."""
    f: FloatArray
    """Shape (n,); NaN if there is no outcome."""
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
        self.given, self.column_names = str(getattr(problem, "given", "")), names_of_columns(problem)
        self.plain_draws = int(getattr(problem, "plain_draws", 0))
        self._gamma, self._work = gamma, Work(problem, gamma, on_error, name, None if executor is None else seed)
        self._split = find_chunk_size(problem, size)
        self._size = None if size is None and executor is None else self._split
        self._precision, self._n_chunks, self._checked = precision, 0, False
        self._widths: set[int] = set()  # of tables of terms
        self.pool = Pool(self._work)
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
                threshold, names = notes.get("threshold", self._gamma), tuple(notes.get("names", ()))
                for i, part in zip(mine, parts, strict=True):
                    f, values, ticks = np.split(part, [1, 1 + (part.shape[1] - 1) // 2], axis=1)
                    at = np.nan_to_num(ticks).astype(np.int64)
                    answers[i] = f[:, 0] if kind == "f" else Terms(f[:, 0], values, at, threshold, names)
        for i, one in enumerate(requests):
            if one.kind == "gradient":
                table, notes = self._compute(one)
                answers[i] = TermGradients(table, float(notes["cost"]))
        return [answers[i] for i in range(len(requests))]

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f of points x (n, d), shape (n,); NaN if there is no outcome."""
        return self._compute(Request("f", (x,))).table[:, 0]

    def _compute(self, request: Request) -> Result:
        """Return the result of a request, as far as it goes from the journal; NaN if rows have none."""
        request = Request(request.kind, (np.asarray(request.x, dtype=np.float64), *request.arrays[1:]))
        chunks, results = self._restore(request)
        first, self._n_chunks = self._n_chunks, self._n_chunks + len(request.split(self._size))
        left = ((first + number, chunk) for number, chunk in enumerate(chunks) if number not in results)
        n_done = sum(len(chunks[number]) for number in results)
        for number_in_run, result in self.pool.run(left):
            number = number_in_run - first
            if self._journal is not None:
                cost = whole_simulations(result.notes["cost"]) if request.kind == "gradient" else len(chunks[number])
                self._journal.append(self._digest(chunks[number]), *result, cost)
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
            known = {number: Result(*result) for number, result in found.items() if result is not None}
            if known:
                chunks = parts
                break
        if len(known) < len(chunks) and self._journal.has_others:
            raise JournalError(
                f"After {self.n_restored:,} simulations this run asks for other points than "
                f"{str(self._journal.path)!r} has: arguments, base distribution or libraries have changed since it was "
                "started. Remove the file to start again."
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
        rows = np.argsort(known)[np.unique(np.linspace(0, len(chunk) - 1, 8).astype(int))]
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
                "changed since the journal was started. Remove the file to start again."
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
