"""Compiled rollouts of policies against the torch simulation: the same collisions, and f to rounding."""

import functools
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import rare_envs
from rare_envs.control.actions import DISCRETE_ACTIONS

SCENARIOS = ("CarFollowing-v0", "CutIn-v0", "CutIn-v1", "HardBrake-v0")


class Choices(gym.ActionWrapper):
    """The environment with discrete actions."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gym.spaces.Discrete(len(DISCRETE_ACTIONS))

    def action(self, action):
        return DISCRETE_ACTIONS[action]


@functools.cache
def model(env_id: str, kind: str = "ppo"):
    """An untrained policy with outputs as large as those of a trained one."""
    env = gym.make(f"rare_envs/{env_id}")
    given: dict = {"device": "cpu", "seed": 0}
    if kind == "ppo":
        made = PPO("MlpPolicy", env, **given)
    elif kind == "a2c relu 32":
        made = A2C("MlpPolicy", env, policy_kwargs={"net_arch": [32], "activation_fn": torch.nn.ReLU}, **given)
    elif kind == "rescaled":
        env = gym.wrappers.RescaleAction(env, np.float32([-2, -1]), np.float32([4, 3]))
        made = PPO("MlpPolicy", env, **given)
    elif kind == "normalised":
        wrapped = VecNormalize(DummyVecEnv([lambda: env]))
        wrapped.obs_rms.mean[:], wrapped.obs_rms.var[:] = 0.3, 0.5
        made = PPO("MlpPolicy", wrapped, **given)
    elif kind == "ppo choices":
        made = PPO("MlpPolicy", Choices(env), **given)
    else:
        made = DQN("MlpPolicy", Choices(env), buffer_size=1, **given)
    with torch.no_grad():
        net = made.policy.q_net.q_net[-1] if kind == "dqn" else made.policy.action_net
        net.weight.mul_(3.0 if kind == "dqn" else 30.0)
        if "choices" not in kind and kind != "dqn":
            net.weight[1].mul_(0.02)  # a steady hand
    return made


def problems(ego, env_id="CutIn-v0", **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of rescaled actions
        return [
            rare_envs.DrivingProblem(f"rare_envs/{env_id}", ego=ego, core=core, **kwargs) for core in ("auto", "torch")
        ]


def points(problem, n):
    """Half of ordinary traffic, half anywhere in the physical box."""
    rng, space = np.random.default_rng(11), problem.space
    anywhere = np.array(space.low) + (np.array(space.high) - np.array(space.low)) * rng.random((n // 2, space.dim))
    return np.concatenate([problem.base.sample(n - n // 2, rng), anywhere])


def compare(compiled, reference, n, choices=False):
    """Same collisions, f to rounding; a choice between actions of nearly equal score may fall otherwise for a tick.

    Rounding of the network moves actions by 1e-6 of their range and f by up to 1e-4 s; torch itself moves as far from
    one size of batch to another.
    """
    assert (compiled.core, reference.core) == ("numba", "torch")
    x = points(compiled, n)
    f, expected = compiled.evaluate(x), reference.evaluate(x)
    collided = expected == -1.0
    assert 0.01 < collided.mean() < 0.99
    assert ((f == -1.0) != collided).sum() <= (1 if choices else 0)
    both = np.abs(f - expected)[(f == -1.0) == collided]
    assert (both > 1e-4).mean() <= (2e-2 if choices else 1e-3)


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_f_is_that_of_the_torch_simulation(env_id):
    compare(*problems(model(env_id), env_id), 2_000)


@pytest.mark.parametrize("kind", ["a2c relu 32", "rescaled", "normalised", "ppo choices", "dqn"])
def test_f_of_other_policies_is_that_of_the_torch_simulation(kind):
    compare(*problems(model("CutIn-v0", kind)), 2_000, choices=kind in ("ppo choices", "dqn"))


def test_other_horizons_and_ticks():
    compare(*problems(model("CutIn-v0"), horizon=6.0, dt=0.05), 1_000)


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_a_row_is_the_same_bits_in_any_batch(env_id):
    problem, _ = problems(model(env_id), env_id)
    x = points(problem, 150)
    expected = problem.evaluate(x)
    assert np.array_equal(problem.evaluate(x[::-1])[::-1], expected)
    alone = np.concatenate([problem.evaluate(row[None]) for row in x[:20]])
    assert np.array_equal(alone, expected[:20])


def test_a_policy_that_learns_on_is_simulated_with_its_new_weights():
    ego = PPO("MlpPolicy", gym.make("rare_envs/CarFollowing-v0"), device="cpu", seed=0)
    problem, reference = problems(ego, "CarFollowing-v0")
    x = problem.base.sample(200, np.random.default_rng(0))
    before = problem.evaluate(x)
    with torch.no_grad():
        ego.policy.action_net.bias[0] = -1.0  # it brakes
    after = problem.evaluate(x)
    assert not np.array_equal(before, after)
    assert np.allclose(after, reference.evaluate(x), atol=1e-4)


def test_actions_that_are_not_finite_are_reported_as_by_torch():
    ego = PPO("MlpPolicy", gym.make("rare_envs/CarFollowing-v0"), device="cpu", seed=0)
    with torch.no_grad():
        ego.policy.action_net.bias[0] = float("nan")
    problem, _ = problems(ego, "CarFollowing-v0")
    x = problem.base.sample(5, np.random.default_rng(0))
    with pytest.raises(ValueError):
        problem.evaluate(x)
    f, reasons = problem.attempt(x)
    assert np.isnan(f).all() and set(reasons) == set(range(5))
