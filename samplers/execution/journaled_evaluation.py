"""Journaled evaluation: chunks that are kept in a journal, and taken from it when a run continues."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.execution.arguments import choose_seed
from samplers.execution.executors.base import Work, WorkerPool
from samplers.execution.executors.chunks import Chunk, Packed
from samplers.execution.executors.dispatch import Dispatcher
from samplers.execution.journal import JournalFile, JournalRecord
from samplers.execution.record_file import JournalError, NothingRecorded
from samplers.problem import FloatArray, Inputs

N_CHECKED = 8
"""Points at which a continued journal calls f again, from the least f of its first batch to the largest."""
F_TOLERANCE = 1e-3
"""Largest difference of f there, as a share of the largest |f|: products of networks round differently by batch."""


class JournaledEvaluation:
    """Requests that are split in chunks, whose results are taken from a journal, or computed and kept there.

    A chunk is written as soon as it is done. Chunks of a request are done in any order, and requests in theirs, so that
    a run that is continued finds the chunks of its first requests, and of the last one those that were done.

    Args:
        work: Computes a chunk.
        journal: Keeps what has been computed, and may have some from before; None keeps nothing.
        pool: Computes chunks; None to compute them here.
        size: Rows of a chunk; None to leave requests whole.

    Attributes:
        n_restored: Rows whose results were taken from the journal.
        on_chunk: Called with the number of rows of the request that are done, after every chunk.
        on_result: Called with every chunk and its result, as soon as it is known.
    """

    def __init__(
        self, work: Work, journal: JournalFile | None = None, pool: WorkerPool | None = None, size: int | None = None
    ) -> None:
        self._work, self._journal, self._size = work, journal, size
        self._dispatcher = None if pool is None else Dispatcher(pool, work)
        self._n_chunks = 0
        self._checked = False
        self.n_restored = 0
        self.on_chunk: Callable[[int], None] | None = None
        self.on_result: Callable[[Chunk, Packed], None] | None = None

    @property
    def n_retries(self) -> int:
        """Chunks that were computed again because a worker was lost."""
        return 0 if self._dispatcher is None else self._dispatcher.n_retries

    def evaluate(self, request: Chunk) -> list[tuple[Chunk, Packed]]:
        """Return the chunks of a request with their results, in order.

        Raises:
            JournalError: The journal has other points, or f had other values at them than it has now.
        """
        chunks = request.split(self._size)
        first, self._n_chunks = self._n_chunks, self._n_chunks + len(chunks)
        whole, known = self._restore(request, chunks)
        if whole is not None:
            return [(request, self._take(request, whole))]
        results = {number: self._take(chunks[number], record) for number, record in known.items()}
        n_done = sum(len(chunks[number]) for number in known)

        def done(number: int, packed: Packed) -> None:
            nonlocal n_done
            results[number - first] = packed
            n_done += len(chunks[number - first])
            if self._journal is not None:
                digest = self._work.digest(chunks[number - first])
                self._journal.append(JournalRecord(digest, packed[0], packed[1]))
            self._tell(chunks[number - first], packed)
            changed()

        def changed() -> None:
            if self.on_chunk is not None and request.kind != "gradient":  # whose rows count as what they cost
                self.on_chunk(n_done)

        left = [(first + number, chunk) for number, chunk in enumerate(chunks) if number not in results]
        if self._dispatcher is not None:
            self._dispatcher.run(left, done, changed)
        else:
            for number, chunk in left:
                done(number, self._work(chunk))
        return [(chunk, results[number]) for number, chunk in enumerate(chunks)]

    def _restore(self, request: Chunk, chunks: list[Chunk]) -> tuple[JournalRecord | None, dict[int, JournalRecord]]:
        """Return the record of the whole request, and those of chunks by their numbers.

        There is one of the whole request where an executor continues what was begun without one.
        """
        known = dict[int, JournalRecord]()
        if self._journal is None:
            return None, known
        waiting: dict[str, list[int]] = {}
        for number, chunk in reversed(list(enumerate(chunks))):
            waiting.setdefault(self._work.digest(chunk), []).append(number)
        while len(known) < len(chunks) and (record := self._journal.read_next()) is not None:
            numbers = waiting.get(record.points)
            if not numbers and not known and len(chunks) > 1 and record.points == self._work.digest(request):
                return record, {}
            if not numbers or (request.kind == "f" and len(record.f) != len(chunks[numbers[-1]])):
                raise JournalError(
                    f"After {self._journal.n - record.n_sim:,} simulations this run asks for other points than "
                    f"{str(self._journal.path)!r} has: arguments, base distribution or libraries have changed since it "
                    "was begun. Remove the file to begin anew."
                )
            known[numbers.pop()] = record
        return None, dict(sorted(known.items()))

    def _take(self, chunk: Chunk, record: JournalRecord) -> Packed:
        """Return the result in a record; f of the first one is compared with what it is now."""
        if not self._checked and chunk.kind in ("f", "terms"):
            self._checked = True
            assert self._journal is not None
            check_same_f(self._journal, self._compute_f, chunk.x, record.f[: len(chunk)])
        self.n_restored += len(chunk)
        self._tell(chunk, (record.f, record.notes))
        return record.f, record.notes

    def _tell(self, chunk: Chunk, packed: Packed) -> None:
        if self.on_result is not None:
            self.on_result(chunk, packed)

    def _compute_f(self, x: FloatArray) -> FloatArray:
        """Return f of a few points, which are not kept."""
        found: list[FloatArray] = []
        chunk = Chunk("f", (x,))
        if self._dispatcher is None:
            return self._work(chunk)[0]
        self._dispatcher.run([(0, chunk)], lambda number, packed: found.append(packed[0]), lambda: None)
        return found[0]


def find_changed(again: FloatArray, f: FloatArray) -> NDArray[np.bool_]:
    """Return where f, simulated again, is another, shape (n,): beyond `F_TOLERANCE` of the largest |f|.

    Example:
        >>> find_changed(np.array([1.0, 6.02, np.inf]), np.array([1.004, 6.0, np.inf]))
        array([False,  True, False])
    """
    room = F_TOLERANCE * float(np.abs(f[np.isfinite(f)]).max(initial=0.0))
    return ~np.isclose(again, f, rtol=0.0, atol=room, equal_nan=True)


def check_same_f(
    journal: JournalFile, recheck: Callable[[FloatArray], ArrayLike], x: FloatArray, f: FloatArray
) -> None:
    """Raise a JournalError if f has other values now at some of x (n, d), the same ones twice."""
    rows = np.argsort(f)[np.unique(np.linspace(0, len(f) - 1, N_CHECKED).astype(int))]
    x, f = x[rows], f[rows]
    again = np.asarray(recheck(x), dtype=np.float64)
    changed = find_changed(again, f)
    if changed.any() and np.array_equal(again, np.asarray(recheck(x)), equal_nan=True):
        row = int(np.argmax(changed))
        raise JournalError(
            f"f is {again[row]:.6g} at a point where {str(journal.path)!r} has {f[row]:.6g}: it has changed "
            "since the journal was begun. Remove the file to begin anew."
        )


@contextlib.contextmanager
def open_journal(path: str | PathLike[str] | None, problem: Inputs, seed: int | None) -> Iterator[JournalFile | None]:
    """Yield the journal at a path, begun or continued, and close it; None for no path.

    Raises:
        JournalError: It was begun with another dimension or seed.
        OSError: It cannot be read or written.
    """
    if path is None:
        yield None
        return
    file = Path(path)
    begun = {"dim": int(problem.dim), "seed": choose_seed(seed)}
    try:
        journal = JournalFile.open(file)
    except (FileNotFoundError, NothingRecorded):
        journal = JournalFile.create(file, begun)
    with contextlib.closing(journal):
        for name, wanted in (("dim", begun["dim"]), ("seed", seed)):
            had = journal.head.get(name)
            if not isinstance(had, int) or wanted not in (None, had):
                raise JournalError(f"{str(path)!r} was begun with {name} {had!r}, and this run has {wanted!r}.")
        yield journal
