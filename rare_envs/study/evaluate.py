"""Evaluation of an ego: a question is answered, into a folder or not, and an interrupted run is continued."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

import agents
import samplers
from agents.loading import find_ego_kind
from rare_envs.egos.errors import EgoGone
from rare_envs.problem import DrivingProblem
from rare_envs.study.arguments import Question
from rare_envs.study.episodes import EpisodeTable
from rare_envs.study.errors import BadInput, output_folder
from rare_envs.study.interruption import (
    NOT_KEPT,
    RunInterrupted,
    describe_early_stop,
    describe_kept,
    describe_stop,
    keep_answer,
)
from rare_envs.study.journal import (
    JOURNAL,
    begin_journal,
    check_same_files,
    continue_journal,
    digest_files,
    find_changed_files,
)
from rare_envs.study.modes import CrashKinds, classify_failures, list_all_kinds
from rare_envs.study.question import Study, build_problem, prepare
from rare_envs.study.recorded_question import note_question, open_question
from rare_envs.study.repeatability import Repeatability, RowKeeper, check_repeatability
from rare_envs.study.report import Report
from rare_envs.study.run_folder import STUDY
from rare_envs.study.writing import (
    begin_study_file,
    check_no_results,
    finish_study_file,
    note_resumption,
    remove_drafts,
    remove_results,
    write_run,
)
from samplers.estimation import check_base, simulate
from samplers.evaluate import Evaluator
from samplers.executors import Executor
from samplers.journal import Journal
from samplers.validation import OnError
from samplers.workers import ExecutorError


class UnwrittenResults(BadInput):
    """A run is done, but its results could not be written."""

    def __init__(self, message: str, report: Report) -> None:
        super().__init__(message)
        self.report = report
        """The answer."""


def run(
    study: Study,
    progress: bool | Callable[[samplers.Progress], None] = False,
    journal: Journal | None = None,
    executor: Executor | None = None,
    folder: Path | None = None,
) -> Report:
    """Answer a question.

    Args:
        study: From `prepare`.
        progress: True for a bar on standard error, or a function, as in `samplers.estimate`.
        journal: Keeps finished simulations, and has those of an interrupted run.
        executor: Where simulations are made, such as `samplers.LocalProcesses(2)`; None for here. The answer does not
            depend on it, see `chunk` of `Question`.
        folder: Gets the table of all simulations; None for no table.

    Returns:
        The report.

    Raises:
        BadInput: The ego failed on some x, or is gone; or the executor cannot work.
        RunInterrupted: It was interrupted; this has the answer from the simulations made so far.

    Example:
        How often does the rule-based ego come within 3 s of a collision in the first 3 s?

        >>> from rare_envs.study.question import Question
        >>> question = Question(
        ...     env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=1000
        ... )
        >>> report = run(prepare(question))
        >>> report.estimate.p, report.estimate.n_sim
        (0.021, 1000)
    """
    start, study = time.perf_counter(), settle_chunk(study, executor)
    advice = "" if journal else NOT_KEPT
    evaluator = open_evaluator(study, journal, executor)
    table = None if folder is None else EpisodeTable(folder, study.problem.space)
    keeper = RowKeeper(study.problem.dim, study.question.gamma)
    evaluator.watchers += [keeper.keep, *([] if table is None else [table.add])]
    with ExitStack() as stack:
        if table is not None:
            stack.callback(table.close)
        try:
            estimate = _estimate(study, evaluator, progress)
        except EgoGone as error:
            raise BadInput(f"{error}{advice}") from error
        except (ValueError, ExecutorError) as error:
            raise BadInput(error) from error
        except samplers.EstimationInterrupted as stopped:
            report = _report_early(study, evaluator, stopped.estimate, time.perf_counter() - start)
            raise RunInterrupted(f"{describe_stop(report.estimate)}{advice}", report) from None
        except KeyboardInterrupt:
            known = describe_early_stop(evaluator.n_made, evaluator.n_failed)
            raise RunInterrupted(f"{known}{advice if evaluator.n_made else ''}") from None
        report = _report_early(study, evaluator, estimate, time.perf_counter() - start)
        with keep_answer(report):
            kinds = classify_failures(study.problem, estimate)
            estimate, kinds = list_all_kinds(study.problem, estimate, kinds)
            report = replace(report, estimate=estimate, kinds=kinds)
            if table is not None:
                table.write(estimate, kinds.by_scenario)
    with keep_answer(report):
        again = recheck(study, keeper)
    return replace(report, repeatability=again, lost="" if table is None else table.lost)


def _report_early(study: Study, evaluator: Evaluator, estimate: samplers.Estimate, seconds: float) -> Report:
    """Return the report of an estimate whose failures were not driven again."""
    kinds = CrashKinds(unknown="the run was interrupted")
    return Report(study, estimate, seconds, tuple(evaluator.faults), kinds, evaluator.n_retried)


def settle_chunk(study: Study, executor: Executor | None) -> Study:
    """Return a study whose question says how many simulations workers make at once, if there are any."""
    if executor is None or study.question.chunk is not None:
        return study
    return replace(study, question=replace(study.question, chunk=study.problem.chunk_size))


def open_evaluator(study: Study, journal: Journal | None = None, executor: Executor | None = None) -> Evaluator:
    """Return the evaluator of a study; scenarios are simulated in single precision."""
    question, problem = study.question, study.problem
    return Evaluator(
        problem if study.ego_was_given else SentProblem(problem, question),
        question.gamma,
        cast(OnError, question.on_error),
        journal=journal,
        executor=executor,
        seed=question.seed,
        size=question.chunk or problem.tile,
        name="The ego",
        precision=np.float32,
    )


class SentProblem:
    """The problem of a study, which workers load for themselves from its question."""

    def __init__(self, problem: DrivingProblem, question: Question) -> None:
        self._problem, self._question, self._files = problem, question, digest_files(question)

    def __getattr__(self, name: str) -> Any:
        """Return what the problem has."""
        return getattr(self._problem, name)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what is sent."""
        return _load_problem, (self._question, self._files)


def _load_problem(question: Question, files: dict[str, str]) -> DrivingProblem:
    """Return the problem of a question.

    Raises:
        BadInput: A file that it names is not the one that the driver has.
        ValueError: Something cannot be loaded.
    """
    changed = find_changed_files(files, digest_files(question))
    if changed:
        raise BadInput(f"{', '.join(changed)} is not here, or not the file with which the run was begun")
    ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
    return build_problem(question, ego)


def _estimate(
    study: Study, evaluator: Evaluator, progress: bool | Callable[[samplers.Progress], None]
) -> samplers.Estimate:
    """Run the method of a study, and the further run under the refits."""
    check_base(study.problem)
    question = study.question
    with evaluator:
        return simulate(evaluator, study.method, question.run_arguments, progress, ensemble_run=question.ensemble_run)


def recheck(study: Study, keeper: RowKeeper) -> Repeatability | None:
    """Simulate a sample again.

    None where ego and measure are rules of this package, which keep nothing; where the ego says that its answers vary;
    and where it is gone, which must not cost the answer.
    """
    rules = study.problem.ego in ("idm", "human") if isinstance(study.problem.ego, str) else False
    if study.problem.needs.varies or (rules and ":" not in study.question.measure):
        return None
    try:
        return check_repeatability(study.problem, keeper)
    except (EgoGone, ValueError):
        return None


def run_into(
    folder: Path, study: Study, progress: bool = False, force: bool = False, executor: Executor | None = None
) -> Report:
    """Answer a question and write the answer; finished simulations are kept if the run is interrupted.

    Args:
        folder: Is made, if need be.
        study: From `rare_envs.study.prepare`.
        progress: Show a bar on standard error.
        force: Replace a run that the folder has, finished or not.
        executor: As in `run`.

    Returns:
        The report.

    Raises:
        BadInput: See `run`; or the folder cannot be used, or has a run.
        UnwrittenResults: The run is done, but its results cannot be written.
        RunInterrupted: It was interrupted; the message says how to continue.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from rare_envs.study.question import Question
        >>> question = Question(
        ...     env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=1000
        ... )
        >>> with TemporaryDirectory() as folder:
        ...     report = run_into(Path(folder), prepare(question))
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['episodes.parquet', 'failures.csv', 'plot.png', 'result.json', 'study.json']
    """
    study = settle_chunk(study, executor)
    with output_folder(folder):
        if not force and not (folder / JOURNAL).exists():
            check_no_results(folder)
        with closing(begin_journal(folder, study.question, force)) as journal:
            remove_results(folder)
            begin_study_file(folder, study)
            note_question(study.question)
            return _run(folder, study, journal, progress, executor)


def resume(
    folder: Path,
    ego: str | None = None,
    on_error: str | None = None,
    trust: bool = False,
    progress: bool = False,
    mend: bool = False,
    executor: Executor | None = None,
) -> Report:
    """Continue an interrupted run; the answer is that of an undisturbed one.

    Args:
        folder: Of the run.
        ego: Address of an ego in another program, if it has changed.
        on_error: What to count scenarios as on which the ego fails, if that has changed.
        trust: Let the ego's file run code, as the run was allowed to, and code that a run from elsewhere names.
        progress: Show a bar on standard error.
        mend: Of a damaged journal, keep the simulations before the damage.
        executor: As in `run`; it need not be that with which the run was begun. It gets the chunks in which that was
            begun, so that the answer is the same to the bit.

    Raises:
        BadInput: There is no unfinished run, or it cannot be continued: its journal is damaged or in use, or a file
            that it names has changed.
        UnwrittenResults: The run is done, but its results cannot be written.
        RunInterrupted: It was interrupted again.

    Example:
        >>> resume(Path("runs/nowhere"))
        Traceback (most recent call last):
            ...
        rare_envs.study.errors.BadInput: There is no unfinished run in 'runs/nowhere': the folder does not exist. Of a run that was stopped before its first simulations, give the command again.
    """  # noqa: E501 (the example shows a whole message)
    journal, question = continue_journal(folder, mend)
    with closing(journal):
        question = replace(open_question(asdict(question), folder, trust), core=question.core, device=question.device)
        if ego is not None and {find_ego_kind(ego), find_ego_kind(question.ego)} != {"remote"}:
            raise BadInput(f"Expected --ego for one whose address has changed only; the run has {question.ego!r}.")
        question = replace(question, ego=ego or question.ego, on_error=on_error or question.on_error)
        check_same_files(journal, question)
        remove_drafts(folder)
        study = prepare(question)
        if question.chunk is None and executor is not None:  # it is continued in the batches in which it was begun
            study = replace(study, question=replace(question, chunk=study.problem.tile))
        note_resumption(folder, journal.earlier_seconds)
        return _run(folder, study, journal, progress, executor)


def _run(folder: Path, study: Study, journal: Journal, progress: bool, executor: Executor | None = None) -> Report:
    target, earlier = folder.absolute(), journal.earlier_seconds  # an ego may change the working directory

    def kept(report: Report | None = None) -> str:
        return describe_kept(journal, folder, study.question.trust, report)

    try:
        report = run(study, progress, journal, executor, target)
        report = replace(report, seconds=report.seconds + earlier, earlier_seconds=earlier)
        with keep_answer(report):
            _write(target, report)
    except UnwrittenResults as error:
        raise UnwrittenResults(f"{error}{kept(error.report)}", error.report) from error
    except BadInput as error:
        if journal.has_simulations:
            raise BadInput(f"{error}{kept()}") from error
        journal.remove()
        (target / STUDY).unlink(missing_ok=True)
        raise
    except KeyboardInterrupt as error:
        known = error if isinstance(error, RunInterrupted) else RunInterrupted("Stopped.")
        raise RunInterrupted(f"{known}{kept(known.report)}", known.report) from None
    journal.remove()
    return report


def _write(folder: Path, report: Report) -> None:
    """Write the results; a folder that somebody has removed is made again."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_run(folder, report)
        finish_study_file(folder, report.study, report.seconds)
    except OSError as error:
        raise UnwrittenResults(
            f"Cannot write the results to {str(folder)!r}: {error.strerror or error}.", report
        ) from error
