"""Comparison of two egos in the same draws of one scenario: by crashes and by their severity.

The run estimates P[A or B crashes]. Its failures are driven again by both egos for delta-v, injuries and kinds of
crash, which are other sums over the same draws.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import samplers
from rare_envs.files import format_json, replace_text
from rare_envs.plugins import EgoGone, one_line
from rare_envs.problem import DrivingProblem
from rare_envs.startup import __version__
from rare_envs.study import arguments, text, writing
from rare_envs.study.arguments import BadInput, Question, RunInterrupted, as_bad_input
from rare_envs.study.evaluate import RowKeeper, make_evaluator, recheck, settle_chunk, use_batches_of
from rare_envs.study.failures import MAX_REPLAYED, VARIES, measure_severity
from rare_envs.study.question import Study, note_question, open_question, prepare, split_question
from rare_envs.study.report import explain_other_events
from rare_envs.study.run_folder import BLOCKS, COMPARISON, FAILURES, SIDES
from rare_envs.traffic.crash import CRASH_KINDS, NONE, OTHERS
from samplers.comparison import Comparison
from samplers.evaluate import Evaluator, Executor
from samplers.problem import FloatArray
from samplers.workers import ExecutorError

UNUSED_FIELDS = ("target_cov", "replicates", "on_error", "sensitivity", "max_p", "max_rate")
"""Fields of a question that a comparison does not use."""
INJURIES = "serious_injuries"
"""Name of injuries of MAIS 3 or more."""
DELTA_V = {f"delta_v_above_{v}": float(v) for v in (2, 5, 10)}
"""Names of crashes with a larger delta-v [m/s]."""


class Severity(NamedTuple):
    """What the crashes of a comparison are like; nothing but the reason where that is not known."""

    outcomes: Mapping[str, Comparison]
    """Serious injuries, and crashes with a larger delta-v, by `INJURIES` and `DELTA_V`."""
    kinds: Mapping[str, tuple[float, float]]
    """P[A ends in a crash of a kind], and P[it does and B does not crash], by kind, the most frequent first."""
    unknown: str = ""
    """Why it is not known."""


class ComparedEgos(NamedTuple):
    """Two egos compared in a scenario."""

    found: Comparison
    severity: Severity
    answer: dict[str, Any]
    """Values for JSON."""


def weigh_crashes(found: Comparison, problems: Sequence[DrivingProblem]) -> Severity:
    """Drive the failures of A or B again by both egos, and compare how severe their crashes are."""
    if any(problem.varies for problem in problems):
        return Severity({}, {}, VARIES)
    known: dict[bytes, tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = {}

    def drive(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return how often a point counts, delta-v, injuries and kind of both egos, shape (k,) and (2, k)."""
        step = math.ceil(len(x) / MAX_REPLAYED) or 1  # of very many some, evenly spaced, stand for all
        if (key := x.tobytes()) not in known:
            counts, (delta_v, injuries, kinds) = np.zeros(len(x)), np.zeros((3, 2, len(x)))
            counts[::step] = step
            for side, problem in enumerate(problems):
                crash = problem.crashes(x[::step])
                delta_v[side, ::step], injuries[side, ::step] = measure_severity(crash, False)
                kinds[side, ::step] = crash.kind.numpy()
            known[key] = counts, delta_v, injuries, kinds
        return known[key]

    def count(x: FloatArray, above: float) -> FloatArray:
        counts, delta_v, *_ = drive(x)
        return counts * (delta_v > above)

    def injure(x: FloatArray) -> FloatArray:
        counts, _, injuries, _ = drive(x)
        return counts * injuries

    try:
        outcomes = {INJURIES: found.weigh(injure)}
        outcomes |= {name: found.weigh(partial(count, above=above)) for name, above in DELTA_V.items()}
        sample = found.either.sample
        assert sample is not None  # or there would be no comparison
        counts, _, _, (kinds, of_b) = drive(sample.x)
    except (Exception, SystemExit, EgoGone) as error:  # the egos are the user's, and need not do again what they did
        return Severity({}, {}, one_line(error))
    weights, shares = counts * sample.weights[sample.f <= found.either.gamma], dict[str, tuple[float, float]]()
    avoids = np.isin(of_b, (NONE, OTHERS))
    for kind in set(np.unique(kinds).astype(int).tolist()) - {NONE, OTHERS}:
        mine = weights * (kinds == kind)
        shares[CRASH_KINDS[kind]] = float(mine.sum()), float(mine @ avoids)
    return Severity(outcomes, dict(sorted(shares.items(), key=lambda share: -share[1][0])))


def compare_egos(
    question: Question,
    ego_b: str,
    progress: bool = False,
    out: Path | None = None,
    force: bool = False,
    algo_b: str | None = None,
    stats_b: str | None = None,
    executor: Executor | None = None,
    whole: Mapping[str, Any] | None = None,
) -> ComparedEgos:
    """Estimate p_A / p_B, see `samplers.compare`; some simulations of each are done again at the end.

    A part of a sum, whose name and arguments are `whole`, is continued, and keeps its journals.
    """
    if out is not None and not force and whole is None:
        writing.check_no_results(out, COMPARISON)
    questions = {"A": question, "B": replace(question, ego=ego_b, algo=algo_b, stats=stats_b)}
    studies = {name: prepare(each) for name, each in questions.items()}
    return _compare(studies, progress, out, force, executor, whole)


def resume_comparison(
    folder: Path, questions: Mapping[str, Question], trust: bool = False, executor: Executor | None = None
) -> ComparedEgos:
    """Continue an interrupted comparison of two questions; the answer is that of an undisturbed one."""
    opened = {
        name: open_question(asdict(each), folder, trust, core=each.core, device=each.device)
        for name, each in questions.items()
    }
    return _compare({name: prepare(each) for name, each in opened.items()}, True, folder, False, executor)


def _compare(
    studies: dict[str, Study],
    progress: bool,
    out: Path | None,
    force: bool,
    executor: Executor | None,
    whole: Mapping[str, Any] | None = None,
) -> ComparedEgos:
    """Compare the egos A and B of two studies of the same scenarios."""
    studies = {name: settle_chunk(study, executor is not None) for name, study in studies.items()}
    dims = [study.problem.dim for study in studies.values()]
    if dims[0] != dims[1]:  # of the egos that are shipped, human and noisy:EGO
        raise BadInput(
            f"Expected two egos with the same x, got {dims[0]} and {dims[1]} dimensions, as an ego that is "
            "random has its own in x: estimate each by itself."
        )
    question = studies["A"].question
    questions = {name: study.question for name, study in studies.items()}
    with (
        writing.journals_of(
            whole or {"command": "compare"}, out, questions, force, COMPARISON, FAILURES, BLOCKS
        ) as journals,
        contextlib.ExitStack() as stack,
    ):
        kept, evaluators = dict[str, RowKeeper](), dict[str, Evaluator]()
        for name, journal in zip([*studies], journals, strict=True):
            studies[name] = use_batches_of(journal, studies[name])
            evaluators[name] = make_evaluator(studies[name], journal, executor)
            kept[name] = RowKeeper(question.gamma)
            evaluators[name].watchers.append(kept[name].keep)
        try:
            with as_bad_input(ValueError, EgoGone, ExecutorError):
                for evaluator in evaluators.values():
                    stack.enter_context(evaluator)
                asked = question.run_arguments
                found = samplers.compare(
                    evaluators["A"],
                    evaluators["B"],
                    studies["A"].method,
                    asked.gamma,
                    asked.seed,
                    asked.max_sim,
                    asked.confidence,
                    progress,
                    ensemble_run=question.ensemble_run,
                )
        except samplers.EstimationInterrupted as stopped:
            raise RunInterrupted(arguments.describe_stop(stopped.estimate, "P[A or B fails]")) from None
        except KeyboardInterrupt:
            raise RunInterrupted(arguments.FIRST_BATCH) from None
        checks = {name: recheck(study, kept[name]) for name, study in studies.items()}
        doubts = [f"{name}: {check.warning}" for name, check in checks.items() if check is not None and check.warning]
        found = replace(found, warnings=(*found.warnings, *doubts))
        crashes = not explain_other_events(question)
        severity = weigh_crashes(found, [each.problem for each in studies.values()]) if crashes else Severity({}, {})
        pair = ComparedEgos(found, severity, _describe_pair(found, severity, studies))
        if out is not None:
            for recorded in split_question(pair.answer["question"]):
                note_question(arguments.read_question(recorded))
            with writing.unwritten_results(out, pair):
                replace_text(out / COMPARISON, format_json(pair.answer) + "\n")
                failures, space = found.either.failures, studies["A"].problem.space
                f = np.where(np.isfinite(found.f), found.f, np.nan)
                writing.write_failures(out, space, failures, others=dict(zip(SIDES, f, strict=True)))
    return pair


def _describe_pair(found: Comparison, severity: Severity, studies: Mapping[str, Study]) -> dict[str, Any]:
    """Return a comparison, what was asked and the verdict on its limit, as plain values for JSON."""
    a, b = (study.question for study in studies.values())
    inputs = {key: value for key, value in asdict(a).items() if key not in UNUSED_FIELDS}
    verdict = None if a.max_ratio is None else found.meets(a.max_ratio, a.assume_traffic)
    notes = [f"{name}: {note}" for name, study in studies.items() for note in study.problem.notes]
    notes += [f"severity is not known: {severity.unknown}"] if severity.unknown else []
    return {
        **found.to_dict(),
        "severity": {name: list_numbers(each) for name, each in severity.outcomes.items()},
        "kinds_of_a": list_kinds(severity.kinds, "p"),
        "question": {"ego_a": inputs.pop("ego"), "ego_b": b.ego, **inputs, "algo_b": b.algo, "stats_b": b.stats},
        "gate": None if verdict is None else verdict.to_dict(),
        "notes": notes,
        "text": [
            *text.describe_comparison(found, a, b.ego, severity.kinds),
            *(f"note: {note}" for note in notes),
        ],
        "version": __version__,
    }


def list_numbers(found: Comparison) -> dict[str, Any]:
    """Return a comparison as plain values, without the estimate behind it."""
    return {name: value for name, value in found.to_dict().items() if name not in ("either", "warnings", "n_sim")}


def list_kinds(kinds: Mapping[str, tuple[float, float]], name: str) -> dict[str, dict[str, float]]:
    """Return kinds of crash of A as plain values: how often, and the share of them that B avoids."""
    return {kind: {name: all_, "avoided_by_b": avoided / all_} for kind, (all_, avoided) in kinds.items() if all_ > 0}
