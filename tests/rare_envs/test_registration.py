"""Registered ids."""

import gymnasium as gym

from rare_envs import ENV_IDS
from rare_envs.scenarios.registry import SCENARIOS, kinematics_id, split_version


def test_registered_ids_are_the_scenarios() -> None:
    assert tuple(SCENARIOS) == ENV_IDS
    names = {(scenario.name, split_version(env_id)[1]) for env_id, scenario in SCENARIOS.items()}
    assert len(names) == len(SCENARIOS)
    assert set(SCENARIOS) <= set(gym.registry)


def test_every_id_has_one_with_the_layout_of_highway_env() -> None:
    for env_id in ENV_IDS:
        env = gym.make(kinematics_id(env_id))
        assert env.observation_space.shape == (5, 5)
        assert env.action_space == gym.spaces.Discrete(5)
