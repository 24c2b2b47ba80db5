"""HighwayEnv's training scripts run on our environments, and policies trained on its own are evaluated in ours."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import agents
import rare_envs
from examples.highway_env_scripts import LAYOUT, train

FEW: dict[str, Any] = {
    "dqn": {"learning_starts": 4, "policy_kwargs": {"net_arch": [8]}},
    "ppo": {"n_steps": 4, "batch_size": 24, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "env_id"),
    [("dqn", "highway-fast-v0"), ("ppo", "rare_envs/CutIn-v0")],  # DQN on ours is in docs/highway_env.md
)
def test_the_scripts_train_policies_that_drive_here(algo: str, env_id: str, tmp_path: Path) -> None:
    model = train(algo, env_id, 12, **FEW[algo])
    assert model.num_timesteps >= 12
    model.save(tmp_path / "ego.zip")
    for ours in ("rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0"):
        problem = rare_envs.DrivingProblem(ours, ego=agents.load_ego(tmp_path / "ego.zip"), base="highway", **LAYOUT)
        x = problem.base.sample(2, np.random.default_rng(0))
        again = rare_envs.DrivingProblem(ours, ego=model, base="highway", **LAYOUT)
        np.testing.assert_array_equal(problem.evaluate(x), again.evaluate(x))
