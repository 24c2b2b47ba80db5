"""Trial: an ego in stored scenarios, and in which of them it fails."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import agents
from rare_envs.problem import DrivingProblem
from rare_envs.study.analysis.recorded_question import open_question
from rare_envs.study.corpus.storage import join_x, read_recorded, read_run
from rare_envs.study.corpus.stored_failure import StoredFailure
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.study.question import Question, build_problem, prepare
from rare_envs.study.video import REPLAY_TOLERANCE, RecordedFailure, count_found

NO_FAILURE = "The run has no failure."
TrialOutcome = Literal["passed", "failed", "error"]


@dataclass(frozen=True, kw_only=True)
class EgoChoice:
    """An ego as options name it, and its interface.

    Example:
        >>> EgoChoice(ego="ppo.zip", observation="lidar")
        EgoChoice(ego='ppo.zip', algo=None, stats=None, observation='lidar', action=None)
    """

    ego: str
    algo: str | None = None
    stats: str | None = None
    observation: str | None = None
    action: str | None = None


@dataclass(frozen=True)
class Trial:
    """An ego in one stored scenario.

    Attributes:
        failure: The scenario.
        outcome: "passed" if f > gamma, "failed" if not, "error" if the ego failed to answer.
        f: Its measure; NaN after an error.
        crash: Kind of its crash, where it failed.
        reason: The error.

    Example:
        >>> stored = StoredFailure("rare_envs/CutIn-v0", {"gamma": 0.0}, {"x": [1.0]}, f=-1.0, log_p0=-9.0)
        >>> trial = Trial(stored, "passed", f=1.5)
        >>> trial.same, trial.to_dict()["outcome"]
        (False, 'passed')
    """

    failure: StoredFailure
    outcome: TrialOutcome
    f: float
    crash: str = ""
    reason: str = ""

    @property
    def same(self) -> bool:
        """Whether f is the one that was recorded."""
        return abs(self.f - self.failure.f) <= REPLAY_TOLERANCE or (math.isnan(self.f) and math.isnan(self.failure.f))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "key": self.failure.key,
            "env_id": self.failure.env_id,
            "outcome": self.outcome,
            "f": self.f if math.isfinite(self.f) else None,
            "gamma": self.failure.gamma,
            "f_recorded": self.failure.f if math.isfinite(self.failure.f) else None,
            "crash": self.crash,
            "crash_recorded": self.failure.crash,
            "ego_recorded": self.failure.ego,
            "reason": self.reason,
        }


def try_ego(
    failures: Sequence[StoredFailure], choice: EgoChoice, folder: Path, trust: bool = False
) -> tuple[list[Trial], float]:
    """Drive an ego through stored scenarios, those of one world side by side.

    Args:
        failures: The scenarios.
        choice: The ego.
        folder: Where they are from, for messages.
        trust: Let the ego's file run code, and code that the scenarios name.

    Returns:
        A trial of each, in their order, and the wall time of all [s].

    Raises:
        BadInput: The ego cannot be used, or a scenario is not one of its world any longer.

    Example:
        >>> from rare_envs.study.corpus.stored_failure import WORLD_FIELDS
        >>> world = {name: getattr(Question(env_id=""), name) for name in WORLD_FIELDS}
        >>> x = {"ego_speed": [20.0], "lead_speed": [5.0], "gap": [10.0]}
        >>> stored = StoredFailure("rare_envs/CarFollowing-v0", world, x, f=-1.0, log_p0=-9.0)
        >>> (trial,), _ = try_ego([stored], EgoChoice(ego="idm"), Path("corpus"))
        >>> trial.outcome, trial.f, trial.crash
        ('failed', -1.0, 'rear_end')
    """
    worlds: dict[str, list[int]] = {}
    for number, failure in enumerate(failures):
        worlds.setdefault(json.dumps(failure.question_values(), sort_keys=True), []).append(number)
    questions = {text: open_question(json.loads(text), folder, trust) for text in worlds}
    start = time.perf_counter()
    with as_bad_input(ValueError, OSError, ImportError), np.errstate():
        ego = agents.load_ego(choice.ego, algo=choice.algo, trust=trust, stats=choice.stats)
        trials: dict[int, Trial] = {}
        for text, numbers in worlds.items():
            problem = _build(questions[text], choice, ego)
            trials |= zip(numbers, _try_world(problem, [failures[k] for k in numbers]), strict=True)
    return [trials[number] for number in range(len(failures))], time.perf_counter() - start


def repeat_run(folder: Path, failures: Sequence[StoredFailure], trust: bool = False) -> tuple[list[Trial], float]:
    """Drive the ego of a run through its failures again; arguments and errors as of `try_ego`.

    Args:
        folder: Of the run.
        failures: Of `read_run`.
        trust: As `try_ego`.
    """
    start = time.perf_counter()
    with as_bad_input(ValueError, OSError):
        question = open_question(read_recorded(folder).get("question"), folder, trust)
        problem = prepare(question).problem
        trials = _try_world(problem, failures)
    return trials, time.perf_counter() - start


def find_for_ego(folder: Path, number: int, ego: str, trust: bool = False) -> RecordedFailure:
    """Return failure `number` of a run, with another ego in its world.

    Raises:
        BadInput: There is no such run or failure, or the ego cannot be used.
    """
    failures = read_run(folder, trust)
    if not 0 <= number < len(failures):
        raise BadInput(f"Expected a failure from 0 to {len(failures) - 1}, got {number}." if failures else NO_FAILURE)
    failure = failures[number]
    problem, x = load_world(failure, EgoChoice(ego=ego), folder, trust)
    return RecordedFailure(
        problem, x, failure.f, failure.log_p0, len(failures), count_found(read_recorded(folder), len(failures))
    )


def load_world(
    failure: StoredFailure, choice: EgoChoice, folder: Path, trust: bool = False
) -> tuple[DrivingProblem, NDArray[np.float64]]:
    """Return the world of a stored failure with another ego in it, and x (d,).

    Raises:
        BadInput: As `try_ego`.
    """
    question = open_question(failure.question_values(), folder, trust)
    with as_bad_input(ValueError, OSError, ImportError), np.errstate():
        ego = agents.load_ego(choice.ego, algo=choice.algo, trust=trust, stats=choice.stats)
        problem = _build(question, choice, ego)
        x = problem.space.validate(join_x([failure], problem.space.names, problem.space.sizes))
    return problem, x[0]


def _build(question: Question, choice: EgoChoice, ego: Any) -> DrivingProblem:
    asked = replace(question, ego=choice.ego, observation=choice.observation, action=choice.action)
    return build_problem(asked, ego)


def _try_world(problem: DrivingProblem, failures: Sequence[StoredFailure]) -> list[Trial]:
    """Return the trials of scenarios of one world."""
    x = problem.space.validate(join_x(failures, problem.space.names, problem.space.sizes))
    f, reasons = problem.attempt(x)
    failed = np.array([k not in reasons and f[k] <= failures[k].gamma for k in range(len(x))])
    kinds = iter(problem.crash_kinds(x[failed]) if failed.any() else ())
    return [
        Trial(failure, "error", math.nan, reason=reasons[k])
        if k in reasons
        else Trial(failure, "failed" if failed[k] else "passed", float(f[k]), next(kinds) if failed[k] else "")
        for k, failure in enumerate(failures)
    ]
