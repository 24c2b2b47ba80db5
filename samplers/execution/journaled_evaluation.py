"""Journaled evaluation: f, terms and gradients that are kept in a journal, and taken from it when a run continues."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.errors import OnError, one_per_row
from samplers.execution.arguments import choose_seed
from samplers.execution.fault_isolation import FaultIsolation
from samplers.execution.journal import JournalFile, JournalRecord, digest_points
from samplers.execution.record_file import JournalError
from samplers.problem import FloatArray, Inputs, Problem, TermGradients, Terms

N_CHECKED = 8
"""Points at which a continued journal calls f again, from the least f of its first batch to the largest."""
F_TOLERANCE = 1e-3
"""Largest difference of f there, as a share of the largest |f|: products of networks round differently by batch."""
Simulate = Callable[[FloatArray], tuple[FloatArray, dict[str, Any]]]
"""From x (n, d) to f (n,) and notes on it, JSON-ready."""


class JournaledEvaluation:
    """f whose finished simulations are kept in a journal.

    Args:
        journal: Keeps what has been simulated, and may have some from before.
        simulate: Makes simulations.
        restore: Takes x and the record of simulations from before.
        recheck: f at points simulated before, at most `N_CHECKED`, to see that f is what it was; called once, and
            once more if its values differ, to tell an f that was changed from one that is random. These simulations are
            not counted.
    """

    def __init__(
        self,
        journal: JournalFile,
        simulate: Simulate,
        restore: Callable[[FloatArray, JournalRecord], None],
        recheck: Callable[[FloatArray], ArrayLike],
    ) -> None:
        self._journal, self._simulate, self._restore, self._recheck = journal, simulate, restore, recheck
        self._checked = False

    def evaluate(self, x: FloatArray, points: str | None = None) -> FloatArray:
        """Return f (n,) of x (n, d) from the journal, or simulate.

        Args:
            x: Points, shape (n, d).
            points: Their digest, if it is not that of x in double precision.

        Raises:
            JournalError: The journal has other points, or f had other values at them than it has now.
        """
        points = digest_points(x) if points is None else points
        known = self._journal.read_next()
        if known is None:
            f, notes = self._simulate(x)
            self._journal.append(JournalRecord(points, f, notes))
            return f
        if known.points != points or len(known.f) != len(x):
            raise JournalError(
                f"After {self._journal.n - len(known.f):,} simulations this run asks for other points than "
                f"{str(self._journal.path)!r} has: arguments, base distribution or libraries have changed since it was "
                "begun. Remove the file to begin anew."
            )
        if not self._checked:
            self._checked = True
            check_same_f(self._journal, self._recheck, x, known.f)
        self._restore(x, known)
        return known.f


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
    new = not file.exists() or file.stat().st_size == 0
    begun = {"dim": int(problem.dim), "seed": choose_seed(seed)}
    journal = JournalFile.create(file, begun) if new else JournalFile.open(file)
    with contextlib.closing(journal):
        for name, wanted in (("dim", begun["dim"]), ("seed", seed)):
            had = journal.head.get(name)
            if not isinstance(had, int) or wanted not in (None, had):
                raise JournalError(f"{str(path)!r} was begun with {name} {had!r}, and this run has {wanted!r}.")
        yield journal


def keep_simulations(
    isolation: FaultIsolation, problem: Problem, on_error: OnError, journal: JournalFile
) -> Callable[[FloatArray], FloatArray]:
    """Return f with isolated faults whose finished simulations are kept."""

    def simulate(x: FloatArray) -> tuple[FloatArray, dict[str, int]]:
        before = isolation.n_retried
        f = one_per_row(isolation.evaluate(x), len(x))
        return f, {"n_retried": isolation.n_retried - before}

    def restore(x: FloatArray, known: JournalRecord) -> None:
        isolation.n_retried += int(known.notes.get("n_retried", 0))

    return JournaledEvaluation(journal, simulate, restore, FaultIsolation(problem.evaluate, on_error).evaluate).evaluate


Packed = tuple[FloatArray, dict[str, Any]]
"""An answer as numbers (k,) and notes, JSON-ready."""


def keep_answer(journal: JournalFile | None, points: str, compute: Callable[[], Packed]) -> Packed:
    """Return an answer from the journal, or compute and keep it; without a journal compute it.

    Args:
        journal: Of the run.
        points: What was asked for, see `digest_request`.
        compute: Computes the answer.

    Raises:
        JournalError: The journal has the answer to something else.
    """
    known = None if journal is None else journal.read_next()
    if known is None:
        numbers, notes = compute()
        if journal is not None:
            journal.append(JournalRecord(points, numbers, notes))
        return numbers, notes
    if known.points != points:
        assert journal is not None
        raise JournalError(
            f"This run asks for other terms than {str(journal.path)!r} has: arguments, base distribution or libraries "
            "have changed since it was begun. Remove the file to begin anew."
        )
    return known.f, known.notes


def digest_request(kind: str, *arrays: NDArray[Any]) -> str:
    """Return the digest of what is asked for: its kind, points and, of gradients, terms and ticks."""
    return kind + " ".join(digest_points(array) for array in arrays)


def pack_terms(terms: Terms, n_retried: int) -> Packed:
    """Return terms, and the rows that were simulated again for them, as numbers and notes."""
    numbers = np.concatenate([terms.f, terms.values.ravel(), terms.ticks.ravel()])
    return numbers, {"threshold": terms.threshold, "names": list(terms.names), "n_retried": n_retried}


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


def pack_gradients(gradients: TermGradients, n_retried: int) -> Packed:
    """Return gradients, and the rows that were computed again for them, as numbers and notes."""
    return gradients.values.ravel(), {"cost": gradients.cost, "n_retried": n_retried}


def unpack_gradients(numbers: FloatArray, notes: dict[str, Any], n: int) -> TermGradients:
    """Return the gradients at n points from numbers and notes."""
    return TermGradients(numbers.reshape(n, -1), float(notes["cost"]))
