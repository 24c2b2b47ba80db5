"""Reward of an ego: its terms by hand."""

import gymnasium as gym
import numpy as np
import pytest


def test_reward_by_hand() -> None:
    env = gym.make("rare_envs/CarFollowing-v0")
    env.reset(options={"x": [20.0, 15.0, 14.5]})
    _, reward, _, _, info = env.step(np.array([0.5, 0.0]))
    # after the tick: speed 20.25, gap 14.5 - 0.5 = 14, closing at 5.25
    terms = {
        "progress": 20.25 / 21.72,
        "comfort": -0.1 * 0.5**2,
        "lane": 0.0,
        "risk": -(1.0 - (14.0 / 5.25) / 4.0),
        "headway": -0.5 * (1.0 - 14.0 / 22.25),
        "collision": 0.0,
    }
    assert info["reward_terms"] == pytest.approx(terms, abs=1e-6)
    assert reward == pytest.approx(sum(terms.values()), abs=1e-6)
    env.reset(options={"x": [20.0, 15.0, 1.0]})
    for _ in range(3):
        _, _, terminated, _, info = env.step(np.array([1.0, 0.0]))
    assert terminated
    assert info["reward_terms"]["collision"] == -30.0
