"""StudyWork: f, terms and gradients of a study, with the scenarios found on which its ego fails."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import agents
from rare_envs.egos.errors import EgoFault
from rare_envs.egos.faults import FaultTolerant, format_x
from rare_envs.study.errors import BadInput
from rare_envs.study.journal import digest_files, find_changed_files
from rare_envs.study.question import Study, build_problem
from samplers.execution.executors.chunks import Chunk, Packed
from samplers.execution.executors.packing import pack_gradients, pack_terms
from samplers.execution.executors.problem_work import join_parts, make_lost
from samplers.execution.journal import digest_points, digest_request


class StudyWork:
    """What is done with a chunk of scenarios, see `samplers.execution.executors.base.Work`.

    Workers load what the question names, each for itself; an ego that was given as an object is sent to them.

    Attributes:
        problem: That of the study.
        gamma: Threshold of f.

    Example:
        >>> import numpy as np
        >>> from rare_envs.study.question import Question, prepare
        >>> from samplers.execution.executors.chunks import Chunk
        >>> work = StudyWork(prepare(Question(env_id="rare_envs/CarFollowing-v0")))
        >>> f, notes = work(Chunk("f", (np.array([[20.0, 15.0, 30.0]]),)))
        >>> f.round(2), notes["reasons"], notes["n_retried"]
        (array([6.]), [], 0)
    """

    def __init__(self, study: Study) -> None:
        """Take what the study has loaded."""
        self.problem, self.gamma = study.problem, study.question.gamma
        self._on_error = study.question.on_error
        self._question = None if study.ego_was_given else study.question
        self._files = digest_files(study.question)

    def __call__(self, chunk: Chunk) -> Packed:
        """Simulate a chunk.

        Raises:
            EgoFault: If the ego failed twice on a row and on_error is "raise".
            EgoGone: If the ego cannot be queried any more.
        """
        tolerant, start = FaultTolerant(self.problem, self._on_error), time.perf_counter()
        if chunk.kind == "f":
            return tolerant.evaluate(chunk.x), _note(tolerant, start)
        if chunk.kind == "terms":
            assert tolerant.terms is not None
            return pack_terms(tolerant.terms(chunk.x, self.gamma), _note(tolerant, start))
        assert tolerant.gradient is not None
        gradients = tolerant.gradient(*chunk.arrays, self.gamma)
        return pack_gradients(gradients, _note(tolerant, start))

    def digest(self, chunk: Chunk) -> str:
        """Return the name of a chunk in the journal; scenarios are simulated in single precision."""
        single = chunk.x.astype(np.float32)
        if chunk.kind == "f":
            return digest_points(single)
        return digest_request(chunk.kind, single, *chunk.arrays[1:], np.array(self.gamma))

    def join(self, parts: list[tuple[Chunk, Packed]]) -> Packed:
        """Return the result of a chunk from those of its rows."""
        return join_parts(parts)

    def lose(self, chunk: Chunk, reason: str) -> Packed:
        """Return the result of a row that no worker survives: a fault, or no gradient.

        Raises:
            EgoFault: on_error is "raise".
        """
        if self._on_error == "raise":
            raise EgoFault(f"The ego failed on x = {format_x(chunk.x[0])}, whichever worker drove it: {reason}")
        reasons = [] if chunk.kind == "gradient" else [reason]
        return make_lost(chunk, {"reasons": reasons, "n_retried": 0}, self.gamma, self.problem)

    def __getstate__(self) -> dict[str, Any]:
        """Return what is sent: the question in the place of the problem, if that can be made from it."""
        return {**self.__dict__, "problem": None if self._question else self.problem}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Load what the question names.

        Raises:
            BadInput: A file that it names is not the one that the driver has.
            ValueError: Something cannot be loaded.
        """
        self.__dict__ = state
        question = self._question
        if question is None:
            return
        changed = find_changed_files(self._files, digest_files(question))
        if changed:
            raise BadInput(f"{', '.join(changed)} is not here, or not the file with which the run was begun")
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        self.problem = build_problem(question, ego)


def _note(tolerant: FaultTolerant, start: float) -> dict[str, Any]:
    """Return notes on the faults that were met, and on the time since the start."""
    reasons = [fault.reason for fault in tolerant.faults]
    return {"reasons": reasons, "n_retried": tolerant.n_retried, "seconds": time.perf_counter() - start}
