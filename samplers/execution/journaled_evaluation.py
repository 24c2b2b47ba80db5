"""Journaled evaluation: f, terms and gradients that are kept in a journal, and taken from it when a run continues."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.errors import one_per_row
from samplers.execution.arguments import choose_seed
from samplers.execution.fault_isolation import FaultIsolation
from samplers.execution.journal import JournalFile, JournalRecord, digest_points
from samplers.execution.record_file import JournalError
from samplers.method import whole_simulations
from samplers.problem import FloatArray, Inputs, TermGradients, Terms

N_CHECKED = 8
"""Points at which a continued journal calls f again, from the least f of its first batch to the largest."""
F_TOLERANCE = 1e-3
"""Largest difference of f there, as a share of the largest |f|: products of networks round differently by batch."""
Simulate = Callable[[FloatArray], tuple[FloatArray, dict[str, Any]]]
"""From x (n, d) to f (n,) and notes on it, JSON-ready."""


class FirstCheck:
    """A check of the first outcomes taken from a journal: whether f is what it was.

    Args:
        journal: Has the outcomes.
        recheck: f at points simulated before, at most `N_CHECKED`; called once, and once more if its values differ, to
            tell an f that was changed from one that is random. These simulations are not counted.
    """

    def __init__(self, journal: JournalFile, recheck: Callable[[FloatArray], ArrayLike]) -> None:
        self._journal, self._recheck, self._done = journal, recheck, False

    def __call__(self, x: FloatArray, f: FloatArray) -> None:
        """Check f (n,) at x (n, d); later calls do nothing.

        Raises:
            JournalError: f had other values at them than it has now.
        """
        if not self._done:
            self._done = True
            check_same_f(self._journal, self._recheck, x, f)


class JournaledEvaluation:
    """f whose finished simulations are kept in a journal.

    Args:
        journal: Keeps what has been simulated, and may have some from before.
        simulate: Makes simulations.
        restore: Takes x and the record of simulations from before.
        check: Takes x and f of simulations from before.
    """

    def __init__(
        self,
        journal: JournalFile,
        simulate: Simulate,
        restore: Callable[[FloatArray, JournalRecord], None],
        check: FirstCheck,
    ) -> None:
        self._journal, self._simulate, self._restore, self._check = journal, simulate, restore, check

    def evaluate(self, x: FloatArray, points: str | None = None) -> FloatArray:
        """Return f (n,) of x (n, d) from the journal, or simulate.

        Args:
            x: Points, shape (n, d).
            points: Their digest, if it is not that of x in double precision.

        Raises:
            JournalError: The journal has other points, or f had other values at them than it has now.
        """

        def restore(known: JournalRecord) -> None:
            self._check(x, known.f)
            self._restore(x, known)

        points = digest_points(x) if points is None else points
        return keep_answer(self._journal, points, lambda: self._simulate(x), restore)[0]


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
    isolation: FaultIsolation, journal: JournalFile, check: FirstCheck
) -> Callable[[FloatArray], FloatArray]:
    """Return f with isolated faults whose finished simulations are kept."""

    def simulate(x: FloatArray) -> tuple[FloatArray, dict[str, int]]:
        before = isolation.n_retried
        f = one_per_row(isolation.evaluate(x), len(x))
        return f, {"n_retried": isolation.n_retried - before}

    def restore(x: FloatArray, known: JournalRecord) -> None:
        isolation.n_retried += int(known.notes.get("n_retried", 0))

    return JournaledEvaluation(journal, simulate, restore, check).evaluate


Packed = tuple[FloatArray, dict[str, Any]]
"""An answer as numbers (k,) and notes, JSON-ready."""


def keep_answer(
    journal: JournalFile, points: str, compute: Callable[[], Packed], restore: Callable[[JournalRecord], None]
) -> Packed:
    """Return an answer from the journal, or compute and keep it.

    Args:
        journal: Of the run.
        points: What was asked for, see `digest_points` and `digest_request`.
        compute: Computes the answer.
        restore: Takes the record of an answer from before.

    Raises:
        JournalError: The journal has the answer to something else.
    """
    known = journal.read_next()
    if known is None:
        numbers, notes = compute()
        journal.append(JournalRecord(points, numbers, notes))
        return numbers, notes
    if known.points != points:
        raise JournalError(
            f"After {journal.n - known.n_sim:,} simulations this run asks for other points than {str(journal.path)!r} "
            "has: arguments, base distribution or libraries have changed since it was begun. Remove the file to begin "
            "anew."
        )
    restore(known)
    return known.f, known.notes


def digest_request(kind: str, *arrays: NDArray[Any]) -> str:
    """Return the digest of what is asked for: its kind, points and, of gradients, terms and ticks."""
    return kind + " ".join(digest_points(array) for array in arrays)


def pack_terms(terms: Terms, notes: dict[str, Any]) -> Packed:
    """Return terms as numbers, and further notes on them."""
    numbers = np.concatenate([terms.f, np.ravel(terms.values), np.ravel(terms.ticks)])
    own = {"threshold": float(terms.threshold), "names": list(terms.names), "n_sim": len(terms.f)}
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
