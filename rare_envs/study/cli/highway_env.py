"""Estimates in HighwayEnv's own environments, by the options of `estimate` that they have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rare_envs.study.errors import BadInput, as_bad_input, output_folder

if TYPE_CHECKING:
    from rare_envs.study.question import Question
    from samplers import Estimate, Executor

OPTIONS = frozenset(
    "env ego algo stats trust method measure gamma seed max_sim target_cov replicates on_error noise horizon chunk "
    "workers executor address time_limit memory_limit config out force as_json".split()
)
"""Parameters of the command that HighwayEnv's environments have; the others are of the batched simulation."""
ESTIMATE_FILE = "estimate.safetensors"
"""File in the folder of `--out`; `samplers.Estimate.load` reads it."""
HELD = "HighwayEnv's environment as it is: what it holds fixed is held; rare_envs.highway_env_problem varies it too"
"""Condition of p."""


def estimate_highway_env(
    question: Question, typed: set[str], out: Path | None, force: bool, executor: Executor | None
) -> dict[str, Any]:
    """Estimate how often an ego crashes in one of HighwayEnv's environments, as that environment draws its traffic.

    Args:
        question: With an id of HighwayEnv.
        typed: Parameters of the command that were given.
        out: Folder for the estimate, or None.
        force: Replace an earlier one there.
        executor: Where to simulate; None for this process.

    Returns:
        The answer, JSON-ready, with the text of the estimate as "text", and whether a warning casts doubt on the number
        as "doubtful".

    Raises:
        BadInput: An option does not go with such an environment, the ego does not fit, or the folder cannot be used.
        RunInterrupted: It was interrupted; this has the answer of those made.
    """
    import agents
    import rare_envs
    import samplers
    from rare_envs.study.execution.interruption import FIRST_BATCH, RunInterrupted, describe_stop

    refused = sorted(typed - OPTIONS)
    if refused:
        raise BadInput(
            f"{question.env_id!r} is an environment of HighwayEnv, which has no --{refused[0].replace('_', '-')}; "
            f"expected {', '.join(rare_envs.ENV_IDS)} with it."
        )
    file = None if out is None else out / ESTIMATE_FILE
    if file is not None and file.exists() and not force:
        raise BadInput(f"There is a finished run in {str(out)!r} ({ESTIMATE_FILE}): replace it by --force.")
    with as_bad_input(ValueError, OSError, TypeError):
        samplers.get_method(question.method)
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        settings: dict[str, Any] = {} if question.horizon is None else {"horizon": question.horizon}
        problem = rare_envs.highway_env_problem(
            question.env_id, ego, measure=question.measure, noise=question.noise, fixed="highway_env", **settings
        )
        try:
            with problem:
                result = samplers.estimate(
                    problem,
                    question.method,
                    progress=True,
                    executor=executor,
                    **_read_arguments(question),
                )
        except samplers.EstimationInterrupted as stopped:
            known = _describe(question, problem, stopped.estimate)
            raise RunInterrupted(describe_stop(stopped.estimate), known) from None
        except KeyboardInterrupt:
            raise RunInterrupted(FIRST_BATCH) from None
    if file is not None:
        with output_folder(file.parent):
            result.save(file)
    return _describe(question, problem, result)


def _read_arguments(question: Question) -> dict[str, Any]:
    """Return the arguments of `samplers.estimate` that a question has."""
    names = ("gamma", "seed", "max_sim", "target_cov", "replicates", "on_error")
    return {name: getattr(question.run_arguments, name) for name in names}


def _describe(question: Question, problem: Any, result: Estimate) -> dict[str, Any]:
    """Return the answer, JSON-ready."""
    from rare_envs.study.report import has_exact_bound

    shown = result
    if has_exact_bound(result):  # the warning that nothing failed casts no doubt on the upper end
        shown = replace(result, warnings=(), remarks=(*result.warnings, *result.remarks))
    lines = [f"{question.env_id}, ego {question.ego}", str(shown), f"  given {HELD}"]
    likeliest = {}
    if len(result.failures):
        likeliest = {name: _as_plain(value) for name, value in problem.space.named(result.failures.x[0]).items()}
        lines.append(f"  most likely failure: {', '.join(f'{name} {value}' for name, value in likeliest.items())}")
    about = {"env_id": question.env_id, "ego": question.ego, "given": HELD, "most_likely": likeliest}
    return {**result.to_dict(), **about, "doubtful": bool(shown.warnings), "text": "\n".join(lines)}


def _as_plain(value: Any) -> Any:
    """Return a number, or a list of such, with three decimals."""
    import numpy as np

    return np.round(value, 3).tolist()
