"""Two egos in the same scenarios."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import rare_envs
import samplers
from rare_envs.study.checks import BadInput
from rare_envs.study.evaluate import Question, prepare


def compare(question: Question, ego_b: str, progress: bool = False) -> dict[str, Any]:
    """Estimate p_A / p_B, see `samplers.compare`.

    Args:
        question: What is asked of ego A; `target_cov`, `replicates` and `on_error` are not used.
        ego_b: The other ego.
        progress: Show a bar on standard error.

    Returns:
        What the comparison found (`comparison`) and, JSON-ready, all of it with the question (`json`).

    Raises:
        BadInput: An argument cannot be used, or an ego failed on some x.
    """
    studies = prepare(question), prepare(replace(question, ego=ego_b))
    try:
        found = samplers.compare(
            studies[0].problem,
            studies[1].problem,
            studies[0].method,
            gamma=question.gamma,
            seed=question.seed,
            max_sim=question.max_sim,
            progress=progress,
        )
    except ValueError as error:
        raise BadInput(error) from error
    asked = {
        key: value for key, value in asdict(question).items() if key not in ("target_cov", "replicates", "on_error")
    }
    named = {"ego_a": asked.pop("ego"), "ego_b": ego_b, **asked}
    return {"comparison": found, "json": {**found.to_dict(), "question": named, "version": rare_envs.__version__}}
