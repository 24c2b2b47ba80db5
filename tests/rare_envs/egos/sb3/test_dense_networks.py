"""Which policies are read as dense networks; all others are left to their own `predict`."""

import functools

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC

import agents
import rare_envs
from rare_envs.egos.dense_policies import read_dense_policy
from rare_envs.simulation.compiled.failures import NotCompiled

CAR_FOLLOWING = "rare_envs/CarFollowing-v0"


class Careful(PPO):
    """A PPO that brakes whatever its network says."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        action, state = super().predict(observation, state, episode_start, deterministic)
        return np.full_like(action, -1.0), state


@functools.cache
def make(algorithm=PPO, **policy_kwargs):
    return algorithm("MlpPolicy", gym.make(CAR_FOLLOWING), device="cpu", seed=0, policy_kwargs=policy_kwargs or None)


def hooked():
    model = PPO("MlpPolicy", gym.make(CAR_FOLLOWING), device="cpu")
    model.policy.action_net.register_forward_hook(lambda *_: None)
    return model


def replaced():
    model = PPO("MlpPolicy", gym.make(CAR_FOLLOWING), device="cpu")
    model.predict = lambda *_, **__: None
    return model


@pytest.mark.parametrize(
    ("ego", "reason"),
    [
        (lambda: make(Careful), "a Careful"),
        (lambda: make(SAC), "a SAC"),
        (lambda: make(activation_fn=torch.nn.ELU), "the layers Linear, ELU"),
        (lambda: make(net_arch=(256, 256)), "256 units"),
        (lambda: make(features_extractor_class=type("Own", (_flatten(),), {})), "other parts than dense layers"),
        (hooked, "a Linear that was changed"),
        (replaced, "a PPO that was changed"),
    ],
)
def test_other_policies_are_simulated_by_torch(ego, reason):
    model = ego()
    assert rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model).core == "torch"
    with pytest.raises(ValueError, match=f"core='numba' cannot simulate this: .*{reason}"):
        rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model, core="numba")


def _flatten():
    from stable_baselines3.common.torch_layers import FlattenExtractor

    return FlattenExtractor


def test_meta_actions_and_other_observations_are_simulated_by_torch():
    env = gym.make(CAR_FOLLOWING, action="meta")
    assert (
        rare_envs.DrivingProblem(CAR_FOLLOWING, ego=PPO("MlpPolicy", env, device="cpu"), action="meta").core == "torch"
    )
    env = gym.make(CAR_FOLLOWING, observation="lidar")
    assert rare_envs.DrivingProblem(CAR_FOLLOWING, ego=PPO("MlpPolicy", env, device="cpu")).core == "torch"


def test_a_saved_policy_is_read(tmp_path):
    make().save(tmp_path / "ego.zip")
    saved = agents.load_ego(tmp_path / "ego.zip")
    assert rare_envs.DrivingProblem(CAR_FOLLOWING, ego=saved).core == "numba"
    for one, other in zip(read_dense_policy(saved).layers, read_dense_policy(make().policy).layers, strict=True):
        assert np.array_equal(one[0], other[0]) and np.array_equal(one[1], other[1])


def test_what_is_read_of_an_algorithm():
    policy = read_dense_policy(make(A2C, net_arch=(32,), activation_fn=torch.nn.ReLU))
    assert policy.activation == "relu" and not policy.chooses and policy.normalisation is None
    assert [weight.shape for weight, _ in policy.layers] == [(32, 7), (2, 32)]
    assert policy.clip is not None and policy.clip[0].tolist() == [-1.0, -1.0]


def test_anybodys_object_is_no_network():
    with pytest.raises(NotCompiled, match="the ego, a object, is not compiled"):
        read_dense_policy(object())
