"""Evaluation of an ego, into a folder or not; an interrupted run is continued, and the size of a run is planned.

A sample of the simulations of a run is done again at its end, in another order and company: f is to be a function of x.
An ego that is random after its first call, keeps a counter that nobody resets, or whose row depends on the other rows
of its batch gives an f that is none, and a p that means nothing; at the first call it shows nothing of that.
"""

from __future__ import annotations

import math
import reprlib
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

import agents
import samplers
from agents.loading import find_ego_kind
from rare_envs.plugins import EgoGone
from rare_envs.problem import DrivingProblem
from rare_envs.study.arguments import (
    BadInput,
    Question,
    RunInterrupted,
    UnwrittenResults,
    as_bad_input,
    describe_stop,
    keep_answer,
    output_folder,
)
from rare_envs.study.episodes import EpisodeTable
from rare_envs.study.failures import CrashKinds, classify_failures, list_all_kinds
from rare_envs.study.question import (
    Study,
    build_problem,
    digest_files,
    find_changed_files,
    note_question,
    open_question,
    prepare,
)
from rare_envs.study.report import Repeatability, Report
from rare_envs.study.run_folder import STUDY
from rare_envs.study.writing import begin_journal, begin_study_file, continue_journal, finish_run, note_resumption
from samplers.estimation import add_ensemble_run, check_base, run_method
from samplers.evaluate import Evaluator, Executor, Simulated, find_changed
from samplers.journal import Journal
from samplers.problem import FloatArray, OnError
from samplers.sample import Status
from samplers.workers import ExecutorError

KEPT_ROWS, COMPANY, ROWS_ALONE = 64, 16, 2
"""Simulations that are done again, how many of them in one batch, and how many also each alone."""


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
    advice = "" if journal else " With --out finished simulations would have been kept."
    evaluator = open_evaluator(study, journal, executor)
    keeper = RowKeeper(study.problem.dim, study.question.gamma)
    with closing(EpisodeTable(folder, study.problem.space)) as table:
        evaluator.watchers += [keeper.keep, table.add]
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
            made = f"{evaluator.n_made:,} simulations made, {evaluator.n_failed:,} of them failed.{advice}"
            known = made if evaluator.n_made else "no simulation made."
            raise RunInterrupted(f"Stopped: no estimate yet, {known}") from None
        report = _report_early(study, evaluator, estimate, time.perf_counter() - start)
        with keep_answer(report):
            estimate, kinds = list_all_kinds(study.problem, estimate, classify_failures(study.problem, estimate))
            report = replace(report, estimate=estimate, kinds=kinds)
            table.write(estimate, kinds.by_scenario)
    with keep_answer(report):
        again = recheck(study, keeper)
    return replace(report, repeatability=again, lost=table.lost)


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
    """Return the problem of a question, in a worker; raise a BadInput if a file is not the one that the driver has."""
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
    arguments, run = study.question.run_arguments, partial(run_method, evaluator, progress=progress)
    with evaluator:
        estimate = run(evaluator, study.method, arguments)
        if study.question.ensemble_run:
            estimate = add_ensemble_run(estimate, evaluator, study.method, arguments, run)
    return estimate


class RowKeeper:
    """Keeps `size` of the scenarios that are simulated, with their f.

    Half of them are a uniform sample, half those with f nearest to the threshold gamma, which decide p: in ordinary
    traffic most scenarios have the largest f there is, whatever the ego does.
    """

    def __init__(self, dim: int, gamma: float, size: int = KEPT_ROWS) -> None:
        self._gamma, self._size, self._seen = gamma, size // 2, 0
        self._sample = self._near = np.empty((0, dim + 1))
        self._rng = np.random.default_rng(0)  # of its own, so that the run draws what it would draw without

    @property
    def x(self) -> FloatArray:
        """Scenarios kept, shape (n, d)."""
        return np.vstack((self._sample, self._near))[:, :-1]

    @property
    def f(self) -> FloatArray:
        """Their f, shape (n,)."""
        return np.concatenate((self._sample[:, -1], self._near[:, -1]))

    def keep(self, seen: Simulated) -> None:
        """Keep some of the scenarios that were simulated."""
        rows = np.column_stack((seen.x, seen.f))[~np.isnan(seen.f)]
        self._keep_sample(rows)
        rows = np.vstack((self._near, rows))
        self._near = rows[np.argsort(np.abs(rows[:, -1] - self._gamma), kind="stable")[: self._size]]

    def _keep_sample(self, rows: FloatArray) -> None:
        """Give each scenario so far the same chance to be in the sample (Vitter's algorithm R)."""
        room = self._size - len(self._sample)
        kept = np.vstack((self._sample, rows[:room]))
        later = np.arange(min(room, len(rows)), len(rows))
        place = (self._rng.random(len(later)) * (self._seen + 1 + later)).astype(np.int64)
        for row, at in zip(later[place < self._size], place[place < self._size], strict=True):
            kept[at] = rows[row]
        self._sample = kept
        self._seen += len(rows)


def recheck(study: Study, kept: RowKeeper) -> Repeatability | None:
    """Simulate the kept scenarios again: in another order and in small batches, and a few each alone.

    None where ego and measure are rules of this package, which keep nothing; where the ego says that its answers vary;
    and where it is gone, which must not cost the answer.
    """
    problem = study.problem
    rules = isinstance(problem.ego, str) and problem.ego in ("idm", "human") and ":" not in study.question.measure
    if problem.needs.varies or rules:
        return None
    x, f = kept.x, kept.f
    order = np.random.default_rng(1).permutation(len(f))
    batches = [order[first : first + COMPANY] for first in range(0, len(order), COMPANY)]
    batches += [order[row : row + 1] for row in range(min(ROWS_ALONE, len(order)))]
    if not batches:
        return Repeatability(0, 0, 0.0)
    evaluator = Evaluator(problem, on_error="failure")
    try:
        again = np.concatenate([evaluator.evaluate(x[rows]) for rows in batches])
    except (EgoGone, ValueError):
        return None
    before = f[np.concatenate(batches)]
    changed = find_changed(again, before)
    apart = np.nan_to_num(np.abs(again[changed] - before[changed]), nan=np.inf)
    return Repeatability(len(again), int(changed.sum()), float(apart.max(initial=0.0)))


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
        with closing(begin_journal(folder, study.question, force)) as journal:
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
        rare_envs.study.arguments.BadInput: There is no unfinished run in 'runs/nowhere': the folder does not exist. Of a run that was stopped before its first simulations, give the command again.
    """  # noqa: E501 (the example shows a whole message)
    journal, question = continue_journal(folder, mend)
    with closing(journal):
        question = replace(open_question(asdict(question), folder, trust), core=question.core, device=question.device)
        if ego is not None and {find_ego_kind(ego), find_ego_kind(question.ego)} != {"remote"}:
            raise BadInput(f"Expected --ego for one whose address has changed only; the run has {question.ego!r}.")
        question = replace(question, ego=ego or question.ego, on_error=on_error or question.on_error)
        changed = find_changed_files(journal.head.get("files") or {}, digest_files(question))
        if changed:
            raise BadInput(
                f"{', '.join(changed)} has changed since the run in {str(folder)!r} was begun, and its simulations "
                "are of what it was before. Begin anew with --force."
            )
        study = prepare(question)
        if question.chunk is None and executor is not None:  # it is continued in the batches in which it was begun
            study = replace(study, question=replace(question, chunk=study.problem.tile))
        note_resumption(folder, journal.earlier_seconds)
        return _run(folder, study, journal, progress, executor)


def _run(folder: Path, study: Study, journal: Journal, progress: bool, executor: Executor | None = None) -> Report:
    """Run a study into its folder; whatever stops it says what is kept."""
    target, earlier = folder.absolute(), journal.earlier_seconds  # an ego may change the working directory

    def kept(report: Report | None = None) -> str:
        return _describe_kept(journal, folder, study.question.trust, report)

    try:
        report = run(study, progress, journal, executor, target)
        report = replace(report, seconds=report.seconds + earlier, earlier_seconds=earlier)
        with keep_answer(report):
            finish_run(target, report)
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


def _describe_kept(journal: Journal, folder: Path, trust: bool, report: Report | None) -> str:
    """Return the number of simulations kept and the command that continues the run, behind a space."""
    if not journal.has_simulations or not journal.flush():
        return ""
    count = f"{journal.n:,} simulations"
    if report is not None and report.estimate.status is not Status.STOPPED:
        n, further = report.estimate.n_sim, report.estimate.ensemble_run
        n_further = journal.n - n if further is None else further.n_sim
        if n_further > 0:
            count = f"{n:,} simulations and a further {n_further:,} under the mixture of the refits"
    return f" {count} are kept; go on with: rare-envs resume {shlex.quote(str(folder))}{' --trust' if trust else ''}"


def plan_from_result(recorded: Mapping[str, Any], target_cov: float) -> tuple[samplers.PlannedRun, ...]:
    """Return what the method of a run, and plain Monte Carlo, need."""
    p, cov, n_sim, seconds = (_read_number(recorded, name) for name in ("p", "cov", "n_sim", "seconds"))
    described = recorded.get("method")
    name = described.get("name") if isinstance(described, Mapping) else None
    with as_bad_input(ValueError):
        method = samplers.get_method(name if isinstance(name, str) else reprlib.repr(name))
        final = _read_number(recorded, "final_draws") if recorded.get("final_draws") is not None else None
        if final is not None and final > n_sim:
            raise ValueError(f"The result of the run says {final:g} final draws of {n_sim:g} simulations.")
        pilot = samplers.Pilot(
            method=method.name,
            p=p,
            cov=cov,
            n_sim=int(n_sim),
            final_draws=int(final) if final is not None and method.stops_at_target else None,
            seconds=seconds,
        )
        return samplers.plan_runs(pilot, target_cov)


def plan_by_pilots(
    question: Question, methods: Sequence[str], target_cov: float, progress: bool = False
) -> tuple[samplers.PlannedRun, ...]:
    """Run a pilot by each method, and return what each needs; plain Monte Carlo last."""
    found: dict[str, samplers.PlannedRun] = {}
    with as_bad_input(ValueError):
        for name in methods:  # all of them before the first pilot, which may take hours
            samplers.get_method(name)
    study = prepare(replace(question, method=methods[0], ensemble_run=False))
    for name in methods:
        with as_bad_input(ValueError):
            method = samplers.get_method(name)
            asked = replace(study, question=replace(study.question, method=name), method=method)
            report = run(asked, progress)
            for planned in samplers.plan_runs(report.estimate.pilot(report.seconds), target_cov):
                if planned.method != "mc" or planned.method not in found:
                    found[planned.method] = planned
    last = found.pop("mc")
    return (*found.values(), last)


def format_seconds(seconds: float) -> str:
    """Return a time in a unit of its size."""
    for size, unit in ((120.0, "s"), (7200.0, "min")):
        if seconds < size:
            return f"{max(1, math.ceil(seconds / {'s': 1, 'min': 60}[unit]))} {unit}"
    return f"{seconds / 3600:,.0f} h"


def _read_number(recorded: Mapping[str, Any], name: str) -> float:
    """Return a number of at least 0."""
    value = recorded.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value >= 0):
        why = " (the run found no failure)" if name == "cov" and value is None else ""
        raise BadInput(f"Expected a number {name} in the result of the run, got {reprlib.repr(value)}{why}.")
    return float(value)
