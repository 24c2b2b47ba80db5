"""A plan of a retraining from the folders of runs: what it takes from them, and what it refuses."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rare_envs.study import Question, prepare, run_into
from rare_envs.study.corpus import plan_retraining, read_run
from rare_envs.study.errors import BadInput
from training import train_ego

ENV = "rare_envs/CarFollowing-v0"


def make_run(folder: Path, base: str, **more: Any) -> Path:
    question = Question(env_id=ENV, base=base, method="mc", max_sim=500, horizon=4.0, core="torch", **more)
    run_into(folder, prepare(question))
    return folder


@pytest.fixture(scope="module")
def ego(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("egos")
    return str(train_ego(ENV, "a2c", 16, num_envs=8, out=folder / "ego.zip", progress=False))


def test_a_plan_has_the_failures_of_all_runs_and_the_ego_of_the_last(ego: str, risky: str, tmp_path: Path) -> None:
    first = make_run(tmp_path / "first", risky, ego="idm", observation="features")
    second = make_run(tmp_path / "second", risky, ego=ego, seed=5)
    plan = plan_retraining([first, second], 0.3)
    assert (plan.env_id, plan.algo, plan.next_seed, plan.retraining.share) == (ENV, "a2c", 6, 0.3)
    assert (plan.world["base"], plan.world["horizon"], plan.retraining.ego) == (risky, 4.0, Path(ego))
    stored = [*read_run(first), *read_run(second)]
    assert len(stored) > 4
    x = [np.concatenate([one.x[name] for name in ("ego_speed", "lead_speed", "gap")]) for one in stored]
    assert np.array_equal(plan.retraining.failures, x)


@pytest.mark.slow
def test_runs_that_do_not_go_together_are_refused(ego: str, risky: str, safe: str, tmp_path: Path) -> None:
    own = shutil.copy(ego, tmp_path / "own.zip")
    first, other = make_run(tmp_path / "first", risky, ego=str(own)), make_run(tmp_path / "other", safe)
    with pytest.raises(BadInput, match=r"Expected runs of one environment with the same options, got base = .*safe"):
        plan_retraining([other, first], 0.3)
    with pytest.raises(BadInput, match="There is no failure in"):
        plan_retraining([other], 0.3)
    with pytest.raises(BadInput, match=r"saved \(.zip\) in .*, got 'idm'"):
        plan_retraining([make_run(tmp_path / "rule", risky)], 0.3)
    own.unlink()
    with pytest.raises(BadInput, match="No ego at"):
        plan_retraining([first], 0.3)
