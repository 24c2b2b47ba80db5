"""SimulatedProblem: the problem of a study as its method sees it, whoever simulates, and with its faults counted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import numpy as np
from numpy.typing import NDArray

from rare_envs.egos.faults import Fault
from rare_envs.egos.wrapped_problem import WrappedProblem
from rare_envs.study.execution.study_work import StudyWork
from rare_envs.study.question import Study
from samplers.execution.executors.base import Executor, WorkerPool
from samplers.execution.executors.chunks import Chunk, Packed
from samplers.execution.executors.packing import unpack_all_terms, unpack_gradients
from samplers.execution.journal import JournalFile
from samplers.execution.journaled_evaluation import JournaledEvaluation
from samplers.problem import FloatArray, TermGradients, Terms


class SimulatedProblem(WrappedProblem):
    """The problem of a study, whose chunks come from a journal, from workers, or are simulated here.

    Attributes:
        faults: Scenarios on which the ego failed twice, by the order of x.
        n_retried: Rows simulated again to find them.
        evaluation: Keeps and computes chunks.
        workers: Number of workers; 0 without an executor.
        row_seconds: Wall time of each simulation of the last batch [s], that of its chunk shared equally, shape (n,).
        n_made: Simulations of which f is known, those of a batch that is not complete included.
        n_failed: Those of them that failed, or have no outcome.
    """

    def __init__(self, study: Study, journal: JournalFile | None = None, pool: WorkerPool | None = None) -> None:
        """Wrap the problem of a study.

        Args:
            study: The study.
            journal: Keeps finished simulations, and has those of an interrupted run.
            pool: Simulates; None to simulate here.
        """
        super().__init__(study.problem)
        self._work = StudyWork(study)
        self._n_terms: int | None = None
        size = study.question.chunk or study.problem.tile
        self.evaluation = JournaledEvaluation(self._work, journal, pool, size)
        self.workers = 0 if pool is None else pool.workers
        self.faults: list[Fault] = []
        self.n_retried = 0
        self.row_seconds = np.empty(0)
        self.n_made = self.n_failed = 0
        self.evaluation.on_result = self._count

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f of scenarios x (n, d), shape (n,); NaN where the ego failed twice."""
        parts = self._evaluate(Chunk("f", (np.asarray(x, dtype=np.float64),)))
        self.row_seconds = _share_seconds(parts)
        for chunk, (f, notes) in parts:
            self._record_faults(chunk, f, notes["reasons"])
        return np.concatenate([f for _, (f, _) in parts])

    def _terms(self, x: FloatArray, gamma: float = 0.0) -> Terms:
        """Return the terms of scenarios x (n, d).

        Raises:
            ValueError: If gamma is not that of the study.
        """
        self._check_gamma(gamma)
        parts = self._evaluate(Chunk("terms", (np.asarray(x, dtype=np.float64),)))
        self.row_seconds = _share_seconds(parts)
        for chunk, (numbers, notes) in parts:
            self._record_faults(chunk, numbers[: len(chunk)], notes["reasons"])
        terms, self._n_terms = unpack_all_terms([(len(chunk), packed) for chunk, packed in parts], self._n_terms)
        return terms

    def _gradient(
        self, x: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64], gamma: float = 0.0
    ) -> TermGradients:
        """Return the gradients of one term of each of the scenarios x (n, d).

        Raises:
            ValueError: If gamma is not that of the study.
        """
        self._check_gamma(gamma)
        parts = self._evaluate(Chunk("gradient", (np.asarray(x, dtype=np.float64), term, ticks)))
        found = [unpack_gradients(*packed, len(chunk)) for chunk, packed in parts]
        return TermGradients(np.concatenate([each.values for each in found]), sum(each.cost for each in found))

    def _evaluate(self, request: Chunk) -> list[tuple[Chunk, Packed]]:
        parts = self.evaluation.evaluate(request)
        self.n_retried += sum(int(notes["n_retried"]) for _, (_, notes) in parts)
        return parts

    def _count(self, chunk: Chunk, packed: Packed) -> None:
        if chunk.kind != "gradient":
            f = packed[0][: len(chunk)]
            self.n_made += len(f)
            self.n_failed += int((np.isnan(f) | (f <= self._work.gamma)).sum())

    def _record_faults(self, chunk: Chunk, f: FloatArray, reasons: list[str]) -> None:
        """Record the scenarios of a chunk without an outcome, with the reasons in their order."""
        lost = chunk.x[np.isnan(f)]
        self.faults += [Fault(row.copy(), reason) for row, reason in zip(lost, reasons, strict=True)]

    def _check_gamma(self, gamma: float) -> None:
        if gamma != self._work.gamma:
            raise ValueError(f"Expected the threshold of the study, {self._work.gamma:g}, got {gamma:g}.")


def _share_seconds(parts: list[tuple[Chunk, Packed]]) -> FloatArray:
    """Return the wall time of each row of some chunks; NaN where it is not known."""
    return np.concatenate(
        [np.full(len(chunk), notes.get("seconds", np.nan) / max(len(chunk), 1)) for chunk, (_, notes) in parts]
    )


@contextmanager
def open_problem(
    study: Study, journal: JournalFile | None = None, executor: Executor | None = None
) -> Iterator[SimulatedProblem]:
    """Yield the problem of a study, with its workers if there is an executor; they are gone at the end of the block."""
    with nullcontext() if executor is None else executor.open(StudyWork(study), study.question.seed) as pool:
        yield SimulatedProblem(study, journal, pool)
