"""Journal: the finished simulations of a run, so that one that was interrupted can be continued.

The journal lies in the run's folder until the run is done; `samplers.execution.journal` has its form and its promises.
Here it gets the question of the run, digests of the files that the question names, and what is known of faults.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from agents.loading import strip_prefixes
from rare_envs.egos.faults import Fault, FaultTolerant
from rare_envs.egos.wrapped_problem import WrappedProblem
from rare_envs.study.errors import BadInput
from rare_envs.study.question import Question, read_question
from rare_envs.version import __version__
from samplers.execution.journal import JournalFile, JournalRecord, digest_points
from samplers.execution.journaled_evaluation import (
    FirstCheck,
    JournaledEvaluation,
    Packed,
    digest_request,
    keep_answer,
    pack_gradients,
    pack_terms,
    unpack_gradients,
    unpack_terms,
)
from samplers.execution.record_file import JournalError
from samplers.execution.responder import join_terms
from samplers.problem import FloatArray, TermGradients, Terms

_T = TypeVar("_T")

JOURNAL = "journal.bin"
"""Name of the file in the folder of a run."""


def begin_journal(folder: Path, question: Question, force: bool = False) -> JournalFile:
    """Return the journal of a new run.

    Args:
        folder: Of the run.
        question: What it is about.
        force: Replace the journal of an unfinished run.

    Raises:
        BadInput: There is an unfinished run, somebody else is writing it, or nothing can be written.
    """
    path = folder / JOURNAL
    head = {"version": __version__, "question": asdict(question), "files": digest_files(question)}
    try:
        return JournalFile.create(path, head, replace=force)
    except JournalError as error:
        if "already" not in str(error):
            raise BadInput(error) from error
        raise BadInput(
            f"There is an unfinished run in {str(folder)!r}: go on with it by rare-envs resume {folder}, or replace it "
            "by --force."
        ) from error
    except OSError as error:
        raise BadInput(f"Cannot write to the folder {str(folder)!r}: {error.strerror}.") from error


def continue_journal(folder: Path, mend: bool = False) -> tuple[JournalFile, Question]:
    """Return the journal of an unfinished run, and its question.

    Args:
        folder: Of the run.
        mend: Of a damaged journal, keep what stands before the damage.

    Raises:
        BadInput: There is none to continue, or one of another version of this program; it is damaged, or in use.
    """
    path = folder / JOURNAL
    try:
        journal = JournalFile.open(path, mend)
    except FileNotFoundError as error:
        raise BadInput(f"There is no unfinished run in {str(folder)!r}: it has no {JOURNAL}.") from error
    except OSError as error:
        raise BadInput(f"Cannot take up {str(path)!r}: {error.strerror}.") from error
    except JournalError as error:
        hint = f" What stands before the damage is kept by rare-envs resume {folder} --mend."
        raise BadInput(f"{error}{hint if 'damaged' in str(error) else ''}") from error
    try:
        return journal, _read_question(journal)
    except BadInput as error:
        journal.close()
        raise BadInput(f"Cannot take up {str(path)!r}: {error}") from error


def _read_question(journal: JournalFile) -> Question:
    version = journal.head.get("version")
    if version != __version__:
        raise BadInput(f"it was begun by version {version}, this is {__version__}.")
    return read_question(journal.head.get("question"))


def check_same_files(journal: JournalFile, question: Question) -> None:
    """Raise a BadInput if a file that the question names has changed since the run was begun."""
    before, now = journal.head.get("files") or {}, digest_files(question)
    changed = sorted(name for name in before if name in now and now[name] != before[name])
    if changed:
        raise BadInput(
            f"{', '.join(changed)} has changed since the run in {str(journal.path.parent)!r} was begun, and its "
            "simulations are of what it was before. Begin anew with --force."
        )


def digest_files(question: Question) -> dict[str, str]:
    """Return the BLAKE2b digests of the files that a question names, by path; modules are found, not imported.

    Example:
        >>> digest_files(Question(env_id="rare_envs/CutIn-v0"))
        {}
    """
    bases = [name.strip() for name in (question.also_under or "").split(",")]
    names = [strip_prefixes(question.ego), question.base, question.drivers, question.measure, *bases]
    paths = {path for name in names if name for path in _find_files(name)}
    return {str(path): hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() for path in sorted(paths)}


def _find_files(name: str) -> list[Path]:
    """Return the file that an option names, or that of its module: a.zip, noisy:a.zip, module:function."""
    parts = name.split(":")
    modules = [Path(f"{part.replace('.', '/')}{end}") for part in parts[:-1] for end in (".py", "/__init__.py")]
    try:
        files = [path for path in (Path(name), *map(Path, parts), *modules) if path.is_file()]
    except (OSError, ValueError):  # too long a name, or with a null byte
        return []
    found = [] if files else [origin for part in parts[:-1] if (origin := _find_module(part)) is not None]
    return files or [path for path in map(Path, found) if path.is_file()]


def _find_module(name: str) -> str | None:
    """Return the file of a module; not of one in a package, since looking for it would import the package."""
    if not name.isidentifier():
        return None
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    return None if spec is None else spec.origin


class JournaledProblem(WrappedProblem):
    """A problem whose finished simulations are kept; see `samplers.Problem`."""

    def __init__(self, problem: FaultTolerant, journal: JournalFile, tile: int, on_error: str) -> None:
        """Wrap a problem.

        Args:
            problem: The problem.
            journal: Keeps what has been simulated.
            tile: Simulations at once. Those of a tile are finished together.
            on_error: The rule of the problem for scenarios on which the ego fails.
        """
        super().__init__(problem)
        self._journal, self._tile = journal, tile
        again = FaultTolerant(problem.problem, on_error)
        self._check = FirstCheck(journal, again.evaluate)
        self._journaled = JournaledEvaluation(journal, self._simulate, self._restore, self._check)

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f from the journal, or simulate: (n, d) -> (n,)."""
        # scenarios are simulated in single precision
        return np.concatenate(
            [self._journaled.evaluate(tile, digest_points(tile.astype(np.float32))) for tile in self._split(x)]
        )

    def _split(self, x: FloatArray) -> list[FloatArray]:
        return [x[first : first + self._tile] for first in range(0, max(len(x), 1), self._tile)]

    def _terms(self, x: FloatArray, gamma: float = 0.0) -> Terms:
        """Return the terms of scenarios x (n, d) from the journal, or simulate."""
        return join_terms([self._kept_terms(tile, gamma) for tile in self._split(x)])

    def _kept_terms(self, x: FloatArray, gamma: float) -> Terms:
        def compute() -> Packed:
            terms, notes = self._note(lambda: self.problem.terms(x, gamma))
            return pack_terms(terms, notes)

        def restore(known: JournalRecord) -> None:
            f = unpack_terms(known.f, known.notes, len(x)).f
            self._check(x, f)
            self._restore_faults(x[np.isnan(f)], known.notes)

        asked = digest_request("terms", x.astype(np.float32), np.array(gamma))
        return unpack_terms(*keep_answer(self._journal, asked, compute, restore), len(x))

    def _gradient(
        self, x: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64], gamma: float = 0.0
    ) -> TermGradients:
        """Return the gradients of one term of each of the scenarios x (n, d) from the journal, or differentiate."""

        def compute() -> Packed:
            gradients, notes = self._note(lambda: self.problem.gradient(x, term, ticks, gamma))
            return pack_gradients(gradients, notes)

        def restore(known: JournalRecord) -> None:
            self._restore_faults(x[:0], known.notes)

        asked = digest_request("gradient", x.astype(np.float32), term, ticks, np.array(gamma))
        return unpack_gradients(*keep_answer(self._journal, asked, compute, restore), len(x))

    def _simulate(self, x: FloatArray) -> tuple[FloatArray, dict[str, Any]]:
        return self._note(lambda: self.problem.evaluate(x))

    def _restore(self, x: FloatArray, known: JournalRecord) -> None:
        self._restore_faults(x[np.isnan(known.f)], known.notes)

    def _note(self, simulate: Callable[[], _T]) -> tuple[_T, dict[str, Any]]:
        """Return what was simulated, and notes on the faults that were met."""
        before, retried = len(self.problem.faults), self.problem.n_retried
        found = simulate()
        reasons = [fault.reason for fault in self.problem.faults[before:]]
        return found, {"reasons": reasons, "n_retried": self.problem.n_retried - retried}

    def _restore_faults(self, lost: FloatArray, notes: dict[str, Any]) -> None:
        """Take up the faults on scenarios (k, d) without an outcome from notes."""
        self.problem.faults += [Fault(row.copy(), reason) for row, reason in zip(lost, notes["reasons"], strict=True)]
        self.problem.n_retried += notes["n_retried"]
