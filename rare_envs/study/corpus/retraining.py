"""Retraining of the ego of a run with the failures of this run and of others, as the folders of the runs tell it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.loading import find_ego_kind
from agents.sb3.saved_ego import load_saved_ego
from rare_envs.make import set_up
from rare_envs.study.analysis.recorded_question import open_question
from rare_envs.study.corpus.storage import join_x, read_recorded, read_run
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.study.question import Question
from training import Retraining

TRAINED_FIELDS = ("base", "drivers", "observation", "action", "horizon", "noise", "weather", "collisions")
"""Fields of a `Question` that are keyword arguments of the environment to train in."""


@dataclass(frozen=True)
class RetrainingPlan:
    """Arguments of `training.train_ego` that runs tell."""

    env_id: str
    algo: str
    """Algorithm of the ego."""
    world: Mapping[str, Any]
    """Keyword arguments of the environment, `TRAINED_FIELDS`."""
    retraining: Retraining
    next_seed: int
    """Least seed above those of the runs, for an estimate that shares no draw with them."""


def plan_retraining(folders: Sequence[Path], share: float, trust: bool = False) -> RetrainingPlan:
    """Return how to train the ego of the last of some runs on with the failures of all.

    Args:
        folders: Of `rare-envs estimate --out`, of one environment with the same options.
        share: Share of episodes that begin in a failure.
        trust: Trust the code that a run from elsewhere names.

    Raises:
        BadInput: There is no such run, the runs differ in more than ego and seed, there is no failure, or the ego is no
            `.zip` that can be trained on.
    """
    questions = [open_question(read_recorded(folder).get("question"), folder, trust) for folder in folders]
    failures = [failure for folder in folders for failure in read_run(folder, trust)]
    last = questions[-1]
    for folder, question in zip(folders, questions, strict=True):
        _check_same(question, last, folder, folders[-1])
    if not failures:
        raise BadInput(f"There is no failure in {', '.join(repr(str(folder)) for folder in folders)} to train with.")
    if find_ego_kind(last.ego) != "zip":
        raise BadInput(
            f"Expected a run of an ego that train-ego has saved (.zip) in {str(folders[-1])!r}, got {last.ego!r}."
        )
    world = {name: getattr(last, name) for name in TRAINED_FIELDS}
    world |= {"observation": last.observation or "features", "action": last.action or "continuous"}
    with as_bad_input(ValueError, OSError):
        saved = load_saved_ego(Path(last.ego), last.algo, trust, last.stats)
        if saved.statistics is not None:
            raise ValueError(
                f"Cannot train {last.ego!r} on: it was trained behind VecNormalize, which train-ego has not."
            )
        _, space = set_up(last.env_id, **world)
        retraining = Retraining(Path(last.ego), join_x(failures, space.names, space.sizes), share)
    return RetrainingPlan(last.env_id, saved.algorithm, world, retraining, 1 + max(each.seed for each in questions))


def _check_same(question: Question, last: Question, folder: Path, last_folder: Path) -> None:
    """Raise a BadInput if two runs are not of one environment with the same options."""
    for name in ("env_id", *TRAINED_FIELDS):
        one, other = getattr(question, name), getattr(last, name)  # fields by their names
        if one != other:
            raise BadInput(
                f"Expected runs of one environment with the same options, got {name} = {one!r} in {str(folder)!r} and "
                f"{other!r} in {str(last_folder)!r}."
            )
