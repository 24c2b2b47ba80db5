"""Two egos in the same scenarios."""

from __future__ import annotations

import contextlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import rare_envs
import samplers
from rare_envs.egos.errors import EgoGone
from rare_envs.study.errors import BadInput, output_folder
from rare_envs.study.evaluate import Question, prepare
from rare_envs.study.run_directory import to_text, write_failures

COMPARISON = "comparison.json"
NOT_ASKED = ("target_cov", "replicates", "on_error")


def compare(question: Question, ego_b: str, progress: bool = False, out: Path | None = None) -> dict[str, Any]:
    """Estimate p_A / p_B, see `samplers.compare`.

    Args:
        question: What is asked of ego A; what is `NOT_ASKED` is not used.
        ego_b: The other ego.
        progress: Show a bar on standard error.
        out: Folder for `COMPARISON` and the scenarios on which one of them fails; is made, if need be.

    Returns:
        What the comparison found (`comparison`) and, JSON-ready, all of it with the question (`json`).

    Raises:
        BadInput: An argument cannot be used, or an ego failed on some x or is gone.
    """
    a, b = prepare(question), prepare(replace(question, ego=ego_b))
    with contextlib.nullcontext() if out is None else output_folder(out):
        try:
            found = samplers.compare(
                a.problem,
                b.problem,
                a.method,
                gamma=question.gamma,
                seed=question.seed,
                max_sim=question.max_sim,
                progress=progress,
            )
        except (ValueError, EgoGone) as error:
            raise BadInput(error) from error
        asked = {key: value for key, value in asdict(question).items() if key not in NOT_ASKED}
        answer = {
            **found.to_dict(),
            "question": {"ego_a": asked.pop("ego"), "ego_b": ego_b, **asked},
            "notes": [f"{name}: {note}" for name, study in (("A", a), ("B", b)) for note in study.problem.notes],
            "version": rare_envs.__version__,
        }
        if out is not None:
            (out / COMPARISON).write_text(to_text(answer) + "\n", encoding="utf-8")
            write_failures(out, a.problem.space, found.either.failures)
    return {"comparison": found, "json": answer}
