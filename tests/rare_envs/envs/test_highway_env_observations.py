"""HighwayEnv's description of our observations: the space, and the observation of this moment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from highway_env.envs.common.observation import KinematicObservation

from rare_envs.envs.highway_env_observations import EpisodeObservation, describe_observation


@pytest.mark.parametrize("kind", ["features", "lidar", "kinematics", "camera+lidar"])
def test_it_observes_what_a_step_returns(kind: str) -> None:
    env: Any = gym.make("rare_envs/CutIn-v0", observation=kind).unwrapped
    with pytest.raises(RuntimeError, match=r"Expected reset\(\) before observe"):
        env.observation_type.observe()
    env.reset(seed=0, options={"cut_in_gap": 60.0})
    observed, *_ = env.step(np.float32([0.2, 0.0]))
    described = env.observation_type
    assert described.space() is env.observation_space
    for _ in range(2):
        again = described.observe()
        assert env.observation_space.contains(again)
        parts = (
            zip(observed.values(), again.values(), strict=True) if isinstance(observed, dict) else [(observed, again)]
        )
        for one, other in parts:
            np.testing.assert_array_equal(one, other)
    assert described.observer_vehicle is env.vehicle


def test_kinematics_has_highway_envs_settings() -> None:
    described = describe_observation(None, "kinematics")
    assert isinstance(described, KinematicObservation) and isinstance(described, EpisodeObservation)
    theirs = gym.make("highway-fast-v0").unwrapped.observation_type  # type: ignore[attr-defined]
    for setting in ("features", "vehicles_count", "absolute", "normalize", "order", "see_behind"):
        assert getattr(described, setting) == getattr(theirs, setting)
    assert not isinstance(describe_observation(None, "lidar"), KinematicObservation)
