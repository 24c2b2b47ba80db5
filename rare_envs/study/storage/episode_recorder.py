"""EpisodeRecorder: a problem all of whose simulations are kept for the table of a run."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rare_envs.distributions.space import ScenarioSpace
from rare_envs.egos.wrapped_problem import WrappedProblem
from rare_envs.study.execution.simulated_problem import SimulatedProblem
from rare_envs.study.run_folder import EPISODES
from rare_envs.study.storage.episode_file import EpisodeBatch, EpisodeDraft, write_episodes
from samplers.problem import FloatArray, Terms
from samplers.result import Estimate


class EpisodeRecorder(WrappedProblem):
    """A problem around another one, whose simulations go into a table; see `samplers.Problem`.

    The table is no part of the answer: where it cannot be written, the run goes on without it.

    Args:
        problem: The problem, which knows the ego's faults and how long its simulations took.
        folder: Of the run.
        space: Of x.

    Attributes:
        lost: Why there is no table; "" as long as all is well.
    """

    def __init__(self, problem: SimulatedProblem, folder: Path, space: ScenarioSpace) -> None:
        super().__init__(problem)
        self._simulated, self._folder = problem, folder
        self._draft: EpisodeDraft | None = None
        self.lost = ""
        try:
            self._draft = EpisodeDraft(folder, space)
        except OSError as error:
            self._give_up(error)

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f of the problem: (n, d) -> (n,)."""
        n_before = len(self._simulated.faults)
        f = self._simulated.evaluate(x)
        self._record(x, f, n_before)
        return f

    def _terms(self, x: FloatArray, gamma: float = 0.0) -> Terms:
        n_before = len(self._simulated.faults)
        assert self._simulated.terms is not None
        terms: Terms = self._simulated.terms(x, gamma)
        self._record(x, terms.f, n_before)
        return terms

    def _record(self, x: FloatArray, f: FloatArray, n_before: int) -> None:
        """Keep simulations x (n, d) with their f (n,); faults from number `n_before` on are theirs."""
        if self._draft is None:
            return
        errors: list[str | None] = [None] * len(f)
        reasons = [fault.reason for fault in self._simulated.faults[n_before:]]
        for row, reason in zip(np.flatnonzero(np.isnan(f)), reasons, strict=False):
            errors[row] = reason
        try:
            self._draft.add(EpisodeBatch(x, f, errors, self._simulated.row_seconds))
        except OSError as error:
            self._give_up(error)

    def write(self, estimate: Estimate, crashes: Mapping[str, str]) -> None:
        """Write the table of a run that is done; see `write_episodes`."""
        if self._draft is None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)  # somebody may have removed it
            write_episodes(self._folder / EPISODES, self._draft, estimate, crashes)
        except OSError as error:
            self._give_up(error)

    def close(self) -> None:
        """Drop the draft: after an interruption the journal has what is needed to make it again."""
        if self._draft is not None:
            with contextlib.suppress(OSError):
                self._draft.close()
            self._draft = None

    def _give_up(self, error: OSError) -> None:
        """Go on without a table."""
        self.lost = f"{EPISODES} could not be written: {error.strerror or error}"
        self.close()
