"""Registered ids."""

import subprocess
import sys

import gymnasium as gym
import pytest

from rare_envs import ENV_IDS
from rare_envs.scenarios.registry import SCENARIOS, split_version


def test_registered_ids_are_the_scenarios() -> None:
    assert tuple(SCENARIOS) == ENV_IDS
    names = {(scenario.name, split_version(env_id)[1]) for env_id, scenario in SCENARIOS.items()}
    assert len(names) == len(SCENARIOS)
    assert set(SCENARIOS) <= set(gym.registry)


@pytest.mark.slow
def test_entries_say_their_version_and_no_version_of_the_package_is_called_out_of_date() -> None:
    """In a process of its own, with the warnings of a user's script: pytest has filters of its own."""
    assert {gym.registry[env_id].version for env_id in ("rare_envs/CutIn-v0", "rare_envs/CutIn-v1")} == {0, 1}
    script = (
        "import gymnasium as gym, rare_envs\n"
        "for env_id in ('rare_envs/CutIn-v0', 'rare_envs/CutIn-kinematics-v0', 'CartPole-v0'):\n"
        "    print(gym.make(env_id).spec.id)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["rare_envs/CutIn-v0", "rare_envs/CutIn-kinematics-v0", "CartPole-v0"]
    assert "CartPole-v0 is out of date" in done.stderr
    assert "rare_envs/" not in done.stderr
