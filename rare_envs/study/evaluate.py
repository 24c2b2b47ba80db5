"""Evaluation of an ego: a question is answered, into a folder or not, and an interrupted run is continued."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

import samplers
from agents.loading import find_ego_kind
from rare_envs.egos.errors import EgoGone
from rare_envs.egos.faults import FaultTolerant
from rare_envs.study.crash_kinds import classify_failures
from rare_envs.study.errors import BadInput, output_folder
from rare_envs.study.journal import Journal, JournaledProblem
from rare_envs.study.question import Question, Study, prepare
from rare_envs.study.report import Report
from rare_envs.study.run_directory import write_run


def run(
    study: Study,
    progress: bool | Callable[[samplers.Progress], None] = False,
    journal: Journal | None = None,
) -> Report:
    """Answer a question.

    Args:
        study: From `prepare`.
        progress: True for a bar on standard error, or a function, as in `samplers.estimate`.
        journal: Keeps finished simulations, and has those of an interrupted run.

    Returns:
        The report.

    Raises:
        BadInput: The ego failed on some x, or is gone.

    Example:
        How often does the rule-based ego come within 3 s of a collision in the first 3 s?

        >>> question = Question(
        ...     env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=1000
        ... )
        >>> report = run(prepare(question))
        >>> report.estimate.p, report.estimate.n_sim
        (0.021, 1000)
    """
    question, start = study.question, time.perf_counter()
    problem = FaultTolerant(study.problem, question.on_error)
    try:
        estimate = samplers.estimate(
            problem if journal is None else JournaledProblem(problem, journal, study.problem.tile),
            study.method,
            **asdict(question.run_arguments),
            progress=progress,
            ensemble_run=question.ensemble_run,
        )
    except EgoGone as error:
        raise BadInput(
            f"{error}{'' if journal else ' With --out finished simulations would have been kept.'}"
        ) from error
    except ValueError as error:
        raise BadInput(error) from error
    seconds = time.perf_counter() - start
    kinds = classify_failures(study.problem, estimate)
    return Report(study, estimate, seconds, tuple(problem.faults), kinds, problem.n_retried)


def run_into(folder: Path, study: Study, progress: bool = False) -> Report:
    """Answer a question and write the answer; finished simulations are kept if the run is interrupted.

    Args:
        folder: Is made, if need be; files of an earlier run in it are replaced.
        study: From `rare_envs.study.prepare`.
        progress: Show a bar on standard error.

    Returns:
        The report.

    Raises:
        BadInput: See `run`; or the folder cannot be used, or has an unfinished run.
        KeyboardInterrupt: It was stopped; the message says how to continue.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> question = Question(
        ...     env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=1000
        ... )
        >>> with TemporaryDirectory() as folder:
        ...     report = run_into(Path(folder), prepare(question))
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['failures.csv', 'plot.png', 'result.json']
    """
    with output_folder(folder), closing(Journal(folder, asdict(study.question))) as journal:
        return _run(folder, study, journal, progress)


def resume(
    folder: Path, ego: str | None = None, on_error: str | None = None, trust: bool = False, progress: bool = False
) -> Report:
    """Continue an interrupted run; the answer is that of an undisturbed one.

    Args:
        folder: Of the run.
        ego: Address of an ego in another program, if it has changed.
        on_error: What to count scenarios as on which the ego fails, if that has changed.
        trust: Let the ego's file run code, as the run was allowed to.
        progress: Show a bar on standard error.

    Raises:
        BadInput: There is no unfinished run, it cannot be continued, or it is interrupted again.

    Example:
        >>> resume(Path("runs/nowhere"))
        Traceback (most recent call last):
            ...
        rare_envs.study.errors.BadInput: There is no unfinished run in 'runs/nowhere': it has no journal.npy.
    """
    with closing(Journal(folder)) as journal:
        try:
            question = Question(**{**journal.question, "trust": trust})
        except TypeError as error:
            raise BadInput(f"Cannot take up the run in {str(folder)!r}: {error}") from error
        if ego is not None and {find_ego_kind(ego), find_ego_kind(question.ego)} != {"remote"}:
            raise BadInput(f"Expected --ego for one whose address has changed only; the run has {question.ego!r}.")
        question = replace(question, ego=ego or question.ego, on_error=on_error or question.on_error)
        return _run(folder, prepare(question), journal, progress)


def _run(folder: Path, study: Study, journal: Journal, progress: bool) -> Report:
    try:
        report = run(study, progress, journal)
        write_run(folder, report)
    except BadInput as error:
        raise BadInput(f"{error}{_resume_hint(journal, folder)}") from error
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"Stopped.{_resume_hint(journal, folder)}") from None
    journal.remove()
    return report


def _resume_hint(journal: Journal, folder: Path) -> str:
    """Return the number of simulations kept and the command that continues the run."""
    if not journal.n:
        return ""
    return f" {journal.n:,} simulations are kept; go on with: rare-envs resume {folder}"
