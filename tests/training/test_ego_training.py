"""Training teaches: the ego of the demo's recipe, trained for a quarter as long, against acting at random."""

from pathlib import Path

import numpy as np
import pytest

import agents
import rare_envs
from examples.demo import ENV_ID, random_collision_rate
from rare_envs.threads import use_one_thread
from training import train_ego

FACTOR = 20.0
"""After 100,000 steps; the demo's 400,000 reach several thousand."""


@use_one_thread()
def test_a_trained_ego_collides_far_less_than_a_random_policy(tmp_path: Path) -> None:
    path = train_ego(ENV_ID, steps=100_000, seed=0, out=tmp_path / "ego.zip", progress=False)
    problem = rare_envs.DrivingProblem(ENV_ID, ego=agents.load_ego(str(path)))
    x = problem.base.sample(4_000, np.random.default_rng(1))
    collisions = int((problem.evaluate(x) <= 0.0).sum())
    # three standard errors of the count above what was seen
    assert (collisions + 3.0 * max(collisions, 1) ** 0.5) / len(x) < random_collision_rate() / FACTOR


def test_an_unknown_environment_leaves_no_folder_behind(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="did you mean 'rare_envs/CutIn-v1'"):
        train_ego("CutIn", steps=1, out=tmp_path / "new" / "ego.zip")
    assert not (tmp_path / "new").exists()
