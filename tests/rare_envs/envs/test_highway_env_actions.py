"""HighwayEnv's description of our actions: the spaces agree, and each index is the acceleration that is driven."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from highway_env.envs.common.action import ContinuousAction, DiscreteAction, DiscreteMetaAction

import rare_envs
from rare_envs.control.actions import ACTIONS
from rare_envs.envs.highway_env_actions import IndexedAccelerations, describe_actions

KINDS = {"continuous": ContinuousAction, "discrete": DiscreteAction, "meta": DiscreteMetaAction}


@pytest.mark.parametrize("kind", ACTIONS)
def test_each_kind_has_the_space_of_the_environment(kind: str) -> None:
    env = gym.make(rare_envs.ENV_IDS[0], action=kind).unwrapped
    described = env.action_type  # type: ignore[attr-defined]
    assert isinstance(described, KINDS[kind])
    assert described.space() == env.action_space
    assert type(described).__name__ == type(describe_actions(env, kind)).__name__


def test_an_index_is_the_acceleration_that_its_label_says() -> None:
    env = gym.make("rare_envs/CutIn-v0", action="discrete").unwrapped
    for label, index in IndexedAccelerations(env).actions_indexes.items():
        env.reset(seed=0, options={"ego_speed": 20.0, "cut_in_gap": 60.0})
        described = env.action_type  # type: ignore[attr-defined]
        described.act(index)
        said, before = described.controlled_vehicle.action, env.vehicle.speed  # type: ignore[attr-defined]
        assert f"{said['acceleration']:+.0f} m/s^2" == label and said["steering"] == 0.0
        env.step(np.int64(index))
        gained = env.vehicle.speed - before  # type: ignore[attr-defined]
        assert gained == pytest.approx(0.1 * said["acceleration"], abs=1e-4)
    assert described.get_available_actions() == list(range(5))
