"""Comparison of two egos in the same scenarios."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import samplers
from rare_envs.egos.errors import EgoGone
from rare_envs.files import format_json, replace_text
from rare_envs.study.arguments import Question
from rare_envs.study.errors import BadInput, as_bad_input, output_folder
from rare_envs.study.evaluate import recheck
from rare_envs.study.interruption import FIRST_BATCH, RunInterrupted, describe_stop
from rare_envs.study.question import Study, prepare
from rare_envs.study.repeatability import RowKeeper
from rare_envs.study.writing import check_no_results, write_failures
from rare_envs.version import __version__
from samplers.evaluate import Evaluator

COMPARISON = "comparison.json"
UNUSED_FIELDS = ("target_cov", "replicates", "on_error", "sensitivity")
"""Fields of a question that a comparison does not use."""


class EgoComparison(NamedTuple):
    """Two egos compared.

    Example:
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", gamma=3.0, horizon=3.0, method="mc", max_sim=1000)
        >>> compare_egos(question, "idm").answer["question"]["ego_b"]
        'idm'
    """

    comparison: samplers.Comparison
    """The estimate of p_A / p_B."""
    answer: dict[str, Any]
    """The same with the question, JSON-ready."""


def compare_egos(
    question: Question,
    ego_b: str,
    progress: bool = False,
    out: Path | None = None,
    force: bool = False,
    algo_b: str | None = None,
    stats_b: str | None = None,
) -> EgoComparison:
    """Estimate p_A / p_B, see `samplers.compare`; some simulations of each are done again at the end.

    Args:
        question: The question about ego A, without its `UNUSED_FIELDS`.
        ego_b: The other ego.
        progress: Show a bar on standard error.
        out: Folder for `COMPARISON` and the scenarios on which one of them fails; is made, if need be.
        force: Replace an earlier run or comparison in that folder.
        algo_b: Algorithm of the other ego's `.zip`; recognised from the file when None.
        stats_b: File of its `VecNormalize` statistics; None to look for one beside it.

    Returns:
        The estimate, and all of it with the question.

    Raises:
        BadInput: An argument cannot be used, or an ego failed on some x or is gone.
        RunInterrupted: It was interrupted; the message says what they say.

    Example:
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", gamma=3.0, horizon=3.0, method="mc", max_sim=1000)
        >>> comparison = compare_egos(question, "idm").comparison
        >>> comparison.ratio
        1.0
    """
    if out is not None and not force:
        check_no_results(out, COMPARISON)
    a, b = prepare(question), prepare(replace(question, ego=ego_b, algo=algo_b, stats=stats_b))
    if a.problem.dim != b.problem.dim:  # of the egos that are shipped, human and noisy:EGO
        raise BadInput(
            f"Expected two egos with the same x, got {a.problem.dim} and {b.problem.dim} dimensions, as an ego that is "
            "random has its own in x: estimate each by itself."
        )
    kept = {name: RowKeeper(study.problem.dim, question.gamma) for name, study in (("A", a), ("B", b))}
    with contextlib.nullcontext() if out is None else output_folder(out):
        with as_bad_input(ValueError, EgoGone), _say_what_is_known():
            comparison = samplers.compare(
                _watch(a, kept["A"]),
                _watch(b, kept["B"]),
                a.method,
                gamma=question.gamma,
                seed=question.seed,
                max_sim=question.max_sim,
                progress=progress,
                ensemble_run=question.ensemble_run,
            )
        doubts = _find_doubts({"A": a, "B": b}, kept)
        comparison = replace(comparison, warnings=(*comparison.warnings, *doubts))
        inputs = {key: value for key, value in asdict(question).items() if key not in UNUSED_FIELDS}
        answer = {
            **comparison.to_dict(),
            "question": {"ego_a": inputs.pop("ego"), "ego_b": ego_b, **inputs, "algo_b": algo_b, "stats_b": stats_b},
            "notes": [f"{name}: {note}" for name, study in (("A", a), ("B", b)) for note in study.problem.notes],
            "version": __version__,
        }
        if out is not None:
            replace_text(out / COMPARISON, format_json(answer) + "\n")
            write_failures(out, a.problem.space, comparison.either.failures)
    return EgoComparison(comparison, answer)


def _watch(study: Study, keeper: RowKeeper) -> Evaluator:
    """Return the problem of a study, some of whose simulations are kept."""
    evaluator = Evaluator(study.problem, study.question.gamma, name="The ego")
    evaluator.watchers.append(keeper.keep)
    return evaluator


@contextlib.contextmanager
def _say_what_is_known() -> Iterator[None]:
    """Let an interruption say the probability that one of both fails."""
    try:
        yield
    except samplers.EstimationInterrupted as stopped:
        raise RunInterrupted(describe_stop(stopped.estimate, "P[A or B fails]")) from None
    except KeyboardInterrupt:
        raise RunInterrupted(FIRST_BATCH) from None


def _find_doubts(studies: Mapping[str, Study], kept: Mapping[str, RowKeeper]) -> list[str]:
    """Return which egos, by name, gave other f when some simulations were done again."""
    checks = {name: recheck(study, kept[name]) for name, study in studies.items()}
    return [f"{name}: {check.warning}" for name, check in checks.items() if check is not None and check.warning]
