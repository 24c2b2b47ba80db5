"""Evaluation of an ego, into a folder or not; an interrupted run is continued, and its size is planned.

A sample of the simulations of a run is done again at its end, in another order and company: f is to be a function of x.
An ego that is random after its first call, keeps a counter that nobody resets, or whose row depends on the other rows
of its batch gives an f that is none, and a p that means nothing; at the first call it shows nothing of that.
"""

from __future__ import annotations

import contextlib
import copy
import math
import os
import pickle
import reprlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

import agents
import samplers
from agents.loading import find_ego_kind, strip_prefixes
from rare_envs.egos.needs import RULE_BASED_EGOS
from rare_envs.egos.policy import PolicyDriver
from rare_envs.egos.wrappers import WrappedPolicy
from rare_envs.plugins import EgoGone, split_settings
from rare_envs.problem import DrivingProblem
from rare_envs.simulation.world import rollout
from rare_envs.study import arguments, writing
from rare_envs.study.arguments import BadInput, Question, RunInterrupted, UnwrittenResults, as_bad_input, output_folder
from rare_envs.study.episodes import EpisodeTable
from rare_envs.study.failures import CrashKinds, classify_failures, drive_by_others
from rare_envs.study.probe import ACTION_ROUNDING
from rare_envs.study.question import (
    Study,
    build_problem,
    digest_files,
    find_changed_files,
    list_risks,
    note_question,
    open_question,
    open_run,
    prepare,
)
from rare_envs.study.report import Repeatability, Report, find_frequency
from rare_envs.study.run_folder import RESULT_FILES, STUDY, LoadedStudy
from samplers.estimation import add_ensemble_run, check_base, run_method
from samplers.evaluate import Evaluator, Executor, Simulated, find_changed
from samplers.journal import Journal
from samplers.problem import FloatArray, OnError
from samplers.workers import ExecutorError

KEPT_ROWS, COMPANY, ROWS_ALONE = 64, 16, 8
"""Simulations that are done again, how many of them in one batch, and how many also each alone."""


def run(
    study: Study,
    progress: bool | Callable[[samplers.run.Progress], None] = False,
    journal: Journal | None = None,
    executor: Executor | None = None,
    folder: Path | None = None,
) -> Report:
    """Answer a question.

    Args:
        study: From `prepare`.
        progress: True for a bar on standard error, or a function, as in `samplers.estimate`.
        journal: Keeps finished simulations, and has those of an interrupted run.
        executor: Where simulations are made, such as `samplers.executors.LocalProcesses(2)`; None for here. The answer
            does not depend on it, see `chunk` of `Question`.
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
    start, study = time.perf_counter(), settle_chunk(study, executor is not None and journal is None)
    advice = "" if journal else " With --out finished simulations would have been kept."
    question = study.question
    if question.max_rate is not None:
        with as_bad_input(ValueError):
            find_frequency(study)
    evaluator = make_evaluator(study, journal, executor)
    keeper = RowKeeper(study.question.gamma)

    def report_on(estimate: samplers.Estimate) -> Report:
        kinds, faults = CrashKinds(unknown="the run was interrupted"), tuple(evaluator.faults)
        return Report(study, estimate, time.perf_counter() - start, faults, kinds, evaluator.n_retried)

    with contextlib.closing(EpisodeTable(folder, study.problem.space)) as table:
        evaluator.watchers += [keeper.keep, table.add]
        try:
            check_base(study.problem)
            wanted, run = study.question.run_arguments, partial(run_method, evaluator, progress=progress)
            with evaluator:
                estimate = run(evaluator, study.method, wanted)
                if study.question.ensemble_run:
                    estimate = add_ensemble_run(estimate, evaluator, study.method, wanted, run)
            report = report_on(estimate)
        except EgoGone as error:
            raise BadInput(f"{error}{advice}") from error
        except (ValueError, ExecutorError) as error:
            raise BadInput(error) from error
        except samplers.EstimationInterrupted as stopped:
            known = f"{arguments.describe_stop(stopped.estimate)}{advice}"
            raise RunInterrupted(known, report_on(stopped.estimate)) from None
        except KeyboardInterrupt:
            made = f"{evaluator.n_made:,} simulations made, {evaluator.n_failed:,} of them failed.{advice}"
            known = made if evaluator.n_made else "no simulation made."
            raise RunInterrupted(f"Stopped: no estimate yet, {known}") from None
        with arguments.keep_answer(report):
            estimate, kinds = classify_failures(study.problem, report.estimate)
            kinds = drive_by_others(study, estimate, kinds)
            report = replace(report, estimate=estimate, kinds=kinds)
            table.write(estimate, kinds.by_scenario)
    with arguments.keep_answer(report):
        return replace(report, repeatability=recheck(study, keeper), lost=table.lost)


def make_evaluator(study: Study, journal: Journal | None, executor: Executor | None) -> Evaluator:
    """Return what simulates the scenarios of a study."""
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
        precision=np.float32,  # in which scenarios are simulated
    )


def settle_chunk(study: Study, chunked: bool) -> Study:
    """Return a study whose question says how many simulations workers make at once, if it is made in such batches."""
    if not chunked or study.question.chunk is not None:
        return study
    return replace(study, question=replace(study.question, chunk=study.problem.chunk_size))


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


class RowKeeper:
    """Keeps `KEPT_ROWS` of the scenarios that are simulated, with their f."""

    def __init__(self, gamma: float) -> None:
        self._gamma = gamma
        self._kept: list[FloatArray] = []
        self._rng = np.random.default_rng(0)  # of its own, so that the run draws what it would draw without

    @property
    def rows(self) -> tuple[FloatArray, FloatArray]:
        """The scenarios x (n, d) and their f (n,)."""
        rows = np.vstack(self._kept)
        return rows[:, 2:], rows[:, 1]

    def keep(self, seen: Simulated) -> None:
        """Keep some of the scenarios that were simulated: those of the least rank, at random or by distance."""
        known = ~np.isnan(seen.f)
        ranks = (self._rng.random(len(known)), np.abs(seen.f - self._gamma))
        new = [np.column_stack((rank, seen.f, seen.x))[known] for rank in ranks]
        both = [np.vstack(pair) for pair in zip(self._kept, new, strict=True)] if self._kept else new
        self._kept = [rows[np.argsort(rows[:, 0], kind="stable")[: KEPT_ROWS // 2]] for rows in both]


def recheck(study: Study, kept: RowKeeper) -> Repeatability | None:
    """Simulate the kept scenarios again: in another order and in small batches, and a few each alone."""
    problem = study.problem
    given = problem.world.policies or ":" in study.question.measure + (study.question.drivers or "")
    rules = isinstance(problem.ego, str) and problem.ego in RULE_BASED_EGOS
    if problem.needs.varies or (rules and not given):  # no code but our own, which repeats
        return None
    x, f = kept.rows
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
    n_elsewhere = count_other_answers(study, x[:COMPANY])
    return Repeatability(len(again), int(changed.sum()), float(apart.max(initial=0.0)), n_elsewhere)


N_PROCESSES, N_ASKED, ASKED_EVERY = 2, 8, 10
"""Other processes, one after the other, queries of one episode that are made again in each, and ticks between them."""
ELSEWHERE_TIMEOUT = 60.0
"""How long that process may take [s]."""
_ELSEWHERE = """
import importlib, os, pickle, sys
answer = os.dup(1)
os.dup2(2, 1)
here, sys.path[:], module, name, settings, queries = pickle.load(sys.stdin.buffer)
os.chdir(here)
ego = getattr(importlib.import_module(module), name)(**settings)
if not hasattr(ego, "predict"):
    from rare_envs.egos.needs import wrap_callable
    ego = wrap_callable(ego)
found = [ego.predict(seen, state=None, episode_start=start, deterministic=True)[0] for seen, start in queries]
with os.fdopen(answer, "wb") as file:
    pickle.dump(found, file)
    file.flush()
    os._exit(0)
"""
"""Program of that process, which imports nothing slow, and nothing from the working directory but the ego's module."""


class _Recorder:
    """A policy that keeps some of its queries without a memory, and its answers."""

    def __init__(self, policy: Any) -> None:
        self.policy, self.calls, self.kept = policy, 0, list[tuple[Any, ...]]()

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, **how: Any) -> Any:
        """Answer as the policy does."""
        seen = copy.deepcopy(observation)
        action, after = self.policy.predict(observation, state=state, episode_start=episode_start, **how)
        if state is None and self.calls % ASKED_EVERY == 0 and len(self.kept) < N_ASKED:
            self.kept.append((seen, episode_start, np.array(action)))
        self.calls += 1
        return action, after


def count_other_answers(study: Study, x: FloatArray) -> int | None:
    """Return how many answers of an ego `module:function`, driving x, are others in other processes; None: unknown."""
    name, driver = strip_prefixes(study.question.ego), study.problem.driver
    if study.ego_was_given or find_ego_kind(name) != "function" or not isinstance(driver, PolicyDriver):
        return 0
    recorder = _Recorder(driver.policy.policy if isinstance(driver.policy, WrappedPolicy) else driver.policy)
    policy = replace(driver.policy, policy=recorder) if isinstance(driver.policy, WrappedPolicy) else recorder
    try:
        rollout(study.problem.world, replace(driver, policy=policy), torch.from_numpy(x).float())
        queries, (name, settings) = [(seen, start) for seen, start, _ in recorder.kept], split_settings(name)
        module = name.partition(":")[0]
        top = Path(str(sys.modules[module.partition(".")[0]].__file__))
        places = [str(top.parents[top.name == "__init__.py"]), *sys.path]
        message = pickle.dumps((os.getcwd(), places, *name.split(":"), settings, queries))
        own = np.concatenate([action.reshape(len(action), -1) for _, _, action in recorder.kept])
        apart = np.abs([_ask_elsewhere(message) - own for _ in range(N_PROCESSES)])
    except (Exception, EgoGone):  # it does not answer there at all
        return None
    return int((apart.max(axis=(0, 2)) > ACTION_ROUNDING).sum())


def _ask_elsewhere(message: bytes) -> FloatArray:
    """Return the answers to all queries of a message in another process, one row each."""
    program = [sys.executable, "-c", _ELSEWHERE]
    how: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "cwd": os.path.abspath(os.sep)}
    done = subprocess.run(program, input=message, timeout=ELSEWHERE_TIMEOUT, check=True, **how)
    return np.concatenate([np.reshape(action, (len(action), -1)).astype(float) for action in pickle.loads(done.stdout)])


def run_into(
    folder: Path,
    study: Study,
    progress: bool = False,
    force: bool = False,
    executor: Executor | None = None,
    whole: Mapping[str, Any] | None = None,
) -> Report:
    """Answer a question and write the answer; finished simulations are kept if the run is interrupted.

    Args:
        folder: Is made, if need be.
        study: From `rare_envs.study.prepare`.
        progress: Show a bar on standard error.
        force: Replace a run that the folder has, finished or not.
        executor: As in `run`.
        whole: Name and arguments of the command of which it is a part: go on with the simulations of the same question
            that the folder has, and keep all of them at the end. An ego that is an object starts again.

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
        ['answer.png', 'crash.png', 'episodes.parquet', 'failures.csv', 'failures.png', 'result.json', 'study.json']
    """
    study = settle_chunk(study, executor is not None or bool((whole or {}).get("chunked")))
    whole = None if study.ego_was_given else whole
    begin = partial(writing.begin_journal, folder, study.question, force, whole=whole)
    with output_folder(folder, *RESULT_FILES), contextlib.closing(begin()) as journal:
        if journal.has_simulations:
            study = use_batches_of(journal, study)
            writing.note_resumption(folder, journal.earlier_seconds)
        else:
            writing.begin_study_file(folder, study, (whole or {}).get("scenarios"))
        with _keeping(folder, study, journal, bool(whole)) as target:
            return _finish(target, run(study, progress, journal, executor, target), journal, keep=bool(whole))


def use_batches_of(journal: Journal | None, study: Study) -> Study:
    """Return a study in the batches in which its journal was begun."""
    if journal is None:
        return study
    return replace(study, question=replace(study.question, chunk=journal.head["question"]["chunk"]))


def resume(
    folder: Path,
    ego: str | None = None,
    on_error: str | None = None,
    trust: bool = False,
    progress: bool = False,
    executor: Executor | None = None,
) -> Report:
    """Continue an interrupted run; the answer is that of an undisturbed one."""
    journal, question = writing.continue_journal(folder)
    with contextlib.closing(journal), output_folder(folder, *RESULT_FILES):
        part_of = (journal.head.get("whole") or {}).get("command", "")
        if ego is not None and {find_ego_kind(ego), find_ego_kind(question.ego)} != {"remote"}:
            raise BadInput(f"Expected --ego for one whose address has changed only; the run has {question.ego!r}.")
        given = {name: value for name, value in (("ego", ego), ("on_error", on_error)) if value}
        given |= {"core": question.core, "device": question.device}
        question = open_question(asdict(question), folder, trust, **given)
        changed = find_changed_files(journal.head.get("files") or {}, digest_files(question))
        if changed:
            raise BadInput(
                f"{', '.join(changed)} has changed since the run in {str(folder)!r} was begun, and its simulations "
                "are of what it was before. Start again with --force."
            )
        study = prepare(question)
        writing.note_on_error(journal, question.on_error)
        writing.note_resumption(folder, journal.earlier_seconds)
        if ego is not None and list(list_risks(question)) == ["ego"]:
            note_question(study.question)  # the address is the reader's own
        with _keeping(folder, study, journal) as target:
            return _finish(target, run(study, progress, journal, executor, target), journal, keep=bool(part_of))


def _finish(target: Path, report: Report, journal: Journal, keep: bool = False) -> Report:
    """Write a report, with the time of a run that it continues, and remove the journal unless it is to be kept."""
    earlier = journal.earlier_seconds
    report = replace(report, seconds=report.seconds + earlier, earlier_seconds=earlier)
    with arguments.keep_answer(report):
        writing.finish_run(target, report)
    if report.lost:
        raise UnwrittenResults(f"{report.lost}.", report)
    if not keep:
        journal.remove()
    return report


@contextlib.contextmanager
def _keeping(folder: Path, study: Study, journal: Journal, part: bool = False) -> Iterator[Path]:
    """Yield a folder's absolute path, as an ego may change the working one; whatever stops a run says what is kept."""
    target = folder.absolute()

    def kept(report: Report | None = None) -> str:
        n_kept = journal.flush()
        if not n_kept:
            return ""
        count = f"{n_kept:,} simulations"
        if report is not None and report.estimate.status is not samplers.Status.STOPPED:
            n, further = report.estimate.n_sim, report.estimate.ensemble_run
            n_further = n_kept - n if further is None else min(further.n_sim, n_kept - n)
            if n_further > 0:
                count = f"{n:,} simulations and a further {n_further:,} under the mixture of the refits"
        again = writing.advise_resume(folder.parent if part else folder, study.question.trust)
        return f" {count} are kept; go on with: {again}"

    try:
        yield target
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


def plan_from_result(
    study: LoadedStudy, target_cov: float, trust: bool = False
) -> tuple[samplers.analysis.PlannedRun, ...]:
    """Return what the method of a finished run, whose code waits for trust, and plain Monte Carlo need."""
    recorded, asked = study.result, study.result.get("question")
    described = recorded.get("method")
    name = described.get("name") if isinstance(described, Mapping) else None
    if ":" in str(name) or (isinstance(asked, Mapping) and ":" in str(asked.get("method"))):
        name = open_run(study, trust).method
    p, cov, n_sim, seconds = (_read_number(recorded, each) for each in ("p", "cov", "n_sim", "seconds"))
    with as_bad_input(ValueError):
        method = arguments.find_method(name if isinstance(name, str) else reprlib.repr(name))
        final = None if recorded.get("final_draws") is None else int(_read_number(recorded, "final_draws"))
        if final is not None and final > n_sim:
            raise ValueError(f"The result says {final} final draws of {n_sim:g} simulations.")
        kept = final if method.stops_at_target else None
        pilot = samplers.analysis.Pilot(
            method=method.name, p=p, cov=cov, n_sim=int(n_sim), final_draws=kept, seconds=seconds
        )
        return samplers.plan(pilot, target_cov)


def plan_by_pilots(
    question: Question, methods: Sequence[str], target_cov: float, progress: bool = False
) -> tuple[samplers.analysis.PlannedRun, ...]:
    """Run a pilot by each method, and return what each needs; plain Monte Carlo last."""
    found: dict[str, samplers.analysis.PlannedRun] = {}
    with as_bad_input(ValueError):
        chosen = {name: arguments.find_method(name) for name in methods}  # before a pilot, which may take hours
    study = prepare(replace(question, method=methods[0], ensemble_run=False))
    for name, method in chosen.items():
        with as_bad_input(ValueError):
            report = run(replace(study, question=replace(study.question, method=name), method=method), progress)
            planned = samplers.plan(report.estimate.pilot(report.seconds), target_cov)
            found |= {each.method: each for each in planned if each.method not in found}
    return tuple(sorted(found.values(), key=lambda each: each.method == "mc"))


def _read_number(recorded: Mapping[str, Any], name: str) -> float:
    """Return a number of at least 0."""
    value = recorded.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value >= 0):
        why = " (the run found no failure)" if name == "cov" and value is None else ""
        raise BadInput(f"Expected a number {name} in the result of the run, got {reprlib.repr(value)}{why}.")
    return float(value)
