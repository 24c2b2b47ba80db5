"""Comparison of two egos in the same scenarios."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import samplers
from rare_envs.files import format_json, replace_text
from rare_envs.plugins import EgoGone
from rare_envs.startup import __version__
from rare_envs.study.arguments import (
    FIRST_BATCH,
    BadInput,
    Question,
    RunInterrupted,
    as_bad_input,
    describe_stop,
    output_folder,
)
from rare_envs.study.evaluate import RowKeeper, recheck
from rare_envs.study.question import prepare
from rare_envs.study.writing import check_no_results, write_failures
from samplers.evaluate import Evaluator

COMPARISON = "comparison.json"
UNUSED_FIELDS = ("target_cov", "replicates", "on_error", "sensitivity")
"""Fields of a question that a comparison does not use."""


class EgoComparison(NamedTuple):
    """Two egos compared."""

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
    studies = {"A": prepare(question), "B": prepare(replace(question, ego=ego_b, algo=algo_b, stats=stats_b))}
    dims = [study.problem.dim for study in studies.values()]
    if dims[0] != dims[1]:  # of the egos that are shipped, human and noisy:EGO
        raise BadInput(
            f"Expected two egos with the same x, got {dims[0]} and {dims[1]} dimensions, as an ego that is "
            "random has its own in x: estimate each by itself."
        )
    kept = {name: RowKeeper(study.problem.dim, question.gamma) for name, study in studies.items()}
    a, b = (Evaluator(study.problem, question.gamma, name="The ego") for study in studies.values())
    a.watchers.append(kept["A"].keep)
    b.watchers.append(kept["B"].keep)
    with contextlib.nullcontext() if out is None else output_folder(out):
        with as_bad_input(ValueError, EgoGone), _say_what_is_known():
            comparison = samplers.compare(
                a,
                b,
                studies["A"].method,
                gamma=question.gamma,
                seed=question.seed,
                max_sim=question.max_sim,
                progress=progress,
                ensemble_run=question.ensemble_run,
            )
        checks = {name: recheck(study, kept[name]) for name, study in studies.items()}
        doubts = [f"{name}: {check.warning}" for name, check in checks.items() if check is not None and check.warning]
        comparison = replace(comparison, warnings=(*comparison.warnings, *doubts))
        inputs = {key: value for key, value in asdict(question).items() if key not in UNUSED_FIELDS}
        answer = {
            **comparison.to_dict(),
            "question": {"ego_a": inputs.pop("ego"), "ego_b": ego_b, **inputs, "algo_b": algo_b, "stats_b": stats_b},
            "notes": [f"{name}: {note}" for name, study in studies.items() for note in study.problem.notes],
            "version": __version__,
        }
        if out is not None:
            replace_text(out / COMPARISON, format_json(answer) + "\n")
            write_failures(out, studies["A"].problem.space, comparison.either.failures)
    return EgoComparison(comparison, answer)


@contextlib.contextmanager
def _say_what_is_known() -> Iterator[None]:
    """Let an interruption say the probability that one of both fails."""
    try:
        yield
    except samplers.EstimationInterrupted as stopped:
        raise RunInterrupted(describe_stop(stopped.estimate, "P[A or B fails]")) from None
    except KeyboardInterrupt:
        raise RunInterrupted(FIRST_BATCH) from None
