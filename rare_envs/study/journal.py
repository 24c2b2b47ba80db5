"""Journal: the finished simulations of a run, so that one that was interrupted can be continued.

The journal lies in the run's folder until the run is done. Methods draw by their seed alone: a continued run draws the
same scenarios in the same order, takes their outcomes from the journal for as long as it has any, and so ends with the
estimate of an undisturbed run.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.egos.faults import Fault, FaultTolerant
from rare_envs.study.errors import BadInput
from rare_envs.version import __version__
from samplers.problem import FloatArray

JOURNAL = "journal.npy"
"""Arrays one behind the other: the question, then for each batch x, f, and what is known of faults."""


class JournalError(ValueError):
    """The journal cannot be written, or belongs to another run."""

    final = True
    """Simulating again would not help."""


class JournalEntry(NamedTuple):
    """Finished simulations."""

    x: NDArray[np.float32]
    """Scenarios, in the precision in which they are simulated, shape (n, d)."""
    f: FloatArray
    """Outcomes, shape (n,), NaN where the ego failed twice."""
    reasons: list[str]
    """Reasons of these failures, in their order."""
    n_retried: int
    """Simulations that were repeated to find them."""


class Journal:
    """Finished simulations of a run, in their order, in a file.

    Attributes:
        question: The question of the run.
        n: Simulations that have been read or written so far.
    """

    def __init__(self, folder: Path, question: dict[str, Any] | None = None) -> None:
        """Begin a journal, or continue one.

        Args:
            folder: Of the run.
            question: Of a new run, JSON-ready; None continues an unfinished one.

        Raises:
            BadInput: There is a journal already, or none to continue, or one of another version of this program.
        """
        self._path, self.n = folder / JOURNAL, 0
        self._file: IO[bytes] | None = None
        if question is not None:
            if self._path.exists():
                raise BadInput(
                    f"There is an unfinished run in {str(folder)!r}: go on with it by rare-envs resume {folder}, or "
                    f"remove {str(self._path)!r}."
                )
            self.question = question
            return
        try:
            self._file = self._path.open("r+b")
            self.question = self._read_question()
        except FileNotFoundError as error:
            raise BadInput(f"There is no unfinished run in {str(folder)!r}: it has no {JOURNAL}.") from error
        except (OSError, ValueError, EOFError, KeyError, TypeError) as error:
            self.close()
            raise BadInput(f"Cannot take up {str(self._path)!r}: {error}") from error

    def _read_question(self) -> dict[str, Any]:
        head = self._read_json()
        if head["version"] != __version__:
            raise ValueError(f"it was begun by version {head['version']}, this is {__version__}.")
        return dict(head["question"])

    def read_next(self, x: FloatArray) -> JournalEntry | None:
        """Return the entry of the next batch; None at the end of the journal.

        Raises:
            JournalError: If the entry is of another batch.
        """
        batch = self._read()
        if batch is not None and not np.array_equal(batch.x, x.astype(np.float32)):
            raise JournalError(
                f"After {self.n:,} simulations this run asks for other scenarios than {str(self._path)!r} has: ego, "
                "drivers, libraries or this program have changed since it was begun. Remove the file and begin anew."
            )
        self.n += 0 if batch is None else len(batch.f)
        return batch

    def append(self, batch: JournalEntry) -> None:
        """Write finished simulations.

        Raises:
            JournalError: They cannot be written.
        """
        try:
            if self._file is None:
                self._file = self._path.open("xb")
                self._write(_json({"question": self.question, "version": __version__}))
            notes = {"reasons": batch.reasons, "n_retried": batch.n_retried}
            self._write(batch.x, batch.f, _json(notes))
            self._file.flush()
        except OSError as error:
            raise JournalError(f"Cannot write {str(self._path)!r}: {error}") from error
        self.n += len(batch.f)

    def close(self) -> None:
        """Leave the journal for later."""
        if self._file is not None:
            self._file.close()

    def remove(self) -> None:
        """Remove the journal of a run that is done."""
        self.close()
        self._path.unlink(missing_ok=True)

    def _read(self) -> JournalEntry | None:
        """Return the next entry; None at the end, where an incomplete entry is removed."""
        if self._file is None:
            return None
        whole = self._file.tell()
        try:
            x, f = (np.lib.format.read_array(self._file, allow_pickle=False) for _ in range(2))
            notes = self._read_json()
            return JournalEntry(x, f, notes["reasons"], notes["n_retried"])
        except (ValueError, EOFError):
            self._file.seek(whole)
            self._file.truncate()
            return None

    def _read_json(self) -> dict[str, Any]:
        assert self._file is not None
        notes: dict[str, Any] = json.loads(np.lib.format.read_array(self._file, allow_pickle=False).tobytes())
        return notes

    def _write(self, *arrays: NDArray[Any]) -> None:
        assert self._file is not None
        for array in arrays:
            np.lib.format.write_array(self._file, np.ascontiguousarray(array), allow_pickle=False)


def _json(value: dict[str, Any]) -> NDArray[np.uint8]:
    return np.frombuffer(json.dumps(value).encode(), np.uint8)


class JournaledProblem:
    """A problem whose finished simulations are kept; see `samplers.Problem`."""

    def __init__(self, problem: FaultTolerant, journal: Journal, tile: int) -> None:
        """Wrap a problem.

        Args:
            problem: The problem.
            journal: Keeps what has been simulated.
            tile: Simulations at once. Those of a tile are finished together.
        """
        self.problem, self.journal, self._tile = problem, journal, tile

    @property
    def dim(self) -> int:
        """Number of scenario parameters."""
        return self.problem.dim

    @property
    def base(self) -> Any:
        """Distribution of x in ordinary traffic."""
        return self.problem.base

    @property
    def given(self) -> str:
        """Condition of p, from the problem."""
        return self.problem.given

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f from the journal, or simulate: (n, d) -> (n,)."""
        tiles = [x[first : first + self._tile] for first in range(0, max(len(x), 1), self._tile)]
        return np.concatenate([self._evaluate_tile(tile) for tile in tiles])

    def _evaluate_tile(self, x: FloatArray) -> FloatArray:
        known, problem = self.journal.read_next(x), self.problem
        if known is not None:
            lost = x[np.isnan(known.f)]
            problem.faults += [Fault(row.copy(), reason) for row, reason in zip(lost, known.reasons, strict=True)]
            problem.n_retried += known.n_retried
            return known.f
        before, retried = len(problem.faults), problem.n_retried
        f = problem.evaluate(x)
        reasons = [fault.reason for fault in problem.faults[before:]]
        self.journal.append(JournalEntry(x.astype(np.float32), f, reasons, problem.n_retried - retried))
        return f
