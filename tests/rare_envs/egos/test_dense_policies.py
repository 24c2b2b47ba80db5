"""Dense policies of Stable-Baselines3: read from models, and queried layer by layer."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize

import rare_envs
import training
from rare_envs.egos.dense_policies import DensePolicy, find_inference, read_dense_policy
from rare_envs.egos.wrappers import WrappedPolicy, wrap_policy

CAR_FOLLOWING, CUT_IN = "rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0"


class Careful(PPO):
    """A PPO that brakes whatever its network says."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        action, state = super().predict(observation, state, episode_start, deterministic)
        return np.full_like(action, -1.0), state


def make(algorithm=PPO, env=CAR_FOLLOWING, **policy_kwargs):
    env = gym.make(env) if isinstance(env, str) else env
    return algorithm("MlpPolicy", env, device="cpu", seed=0, policy_kwargs=policy_kwargs or None)


def hooked():
    model = make()
    model.policy.action_net.register_forward_hook(lambda *_: None)
    return model


def replaced_inside(find_part, name):
    model = make()
    setattr(find_part(model.policy) if find_part else model, name, lambda *_, **__: None)
    return model


@pytest.mark.parametrize(
    ("ego", "reason"),
    [
        (lambda: make(Careful), "a Careful"),
        (lambda: make(SAC), "a SAC"),
        (lambda: make(activation_fn=torch.nn.ELU), "the layers Linear, ELU"),
        (lambda: make(net_arch=(256, 256)), "256 units"),
        (lambda: make(features_extractor_class=type("Own", (FlattenExtractor,), {})), "other parts than dense layers"),
        (hooked, "a Linear that was changed"),
        (lambda: replaced_inside(None, "predict"), "a PPO that was changed"),
        (lambda: replaced_inside(lambda policy: policy.action_dist, "mode"), "a DiagGaussianDistribution that was"),
    ],
)
def test_other_policies_are_simulated_by_torch(ego, reason):
    model = ego()
    assert rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model).core == "torch"
    with pytest.raises(ValueError, match=f"core='numba' cannot simulate this: .*{reason}"):
        rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model, core="numba")


@pytest.mark.parametrize("net_arch", [[64, 64], []])
@pytest.mark.parametrize("observation", ["features", "kinematics"])  # one value after the other, or vehicles in rows
def test_actions_between_rectifiers_are_those_of_predict_to_the_last_bit(net_arch, observation):
    env = gym.make(CUT_IN, observation=observation)
    model = make(A2C, env, activation_fn=torch.nn.ReLU, net_arch=net_arch)
    found = find_inference(model)
    assert isinstance(found, DensePolicy)
    for size in (1, 25, 4096):
        seen = np.random.default_rng(1).uniform(-5, 5, (size, *env.observation_space.shape)).astype(np.float32)
        np.testing.assert_array_equal(found.predict(seen)[0], model.predict(seen, deterministic=True)[0])


@pytest.mark.parametrize("gain", [0.3, 5.0])
@pytest.mark.parametrize("net_arch", [[64, 64], [256, 128, 32]])
def test_actions_between_tangents_are_as_near_to_exact_ones_as_those_of_predict(net_arch, gain):
    model = make(PPO, CUT_IN, net_arch=net_arch)
    with torch.no_grad():
        for weights in model.policy.parameters():  # from nearly linear units to nearly all at their bounds
            weights.copy_(gain * torch.randn(weights.shape, generator=torch.Generator().manual_seed(weights.numel())))
            weights /= weights.shape[-1] ** 0.5
        model.policy.action_net.weight /= 8 * gain  # the actions' bounds clip few of them
    seen = np.random.default_rng(1).uniform(-5, 5, (1000, 11)).astype(np.float32)
    found = find_inference(model)
    assert isinstance(found, DensePolicy)
    single = model.predict(seen, deterministic=True)[0]
    policy = model.policy.double()
    with torch.no_grad():
        means = policy.action_net(policy.mlp_extractor.forward_actor(torch.from_numpy(seen).double()))
    exact = np.clip(means.numpy(), *(model.action_space.low, model.action_space.high))
    ours, theirs = (np.abs(actions - exact).mean() for actions in (found.predict(seen)[0], single))
    assert np.mean(exact == means.numpy()) > 0.3
    assert ours < 1.5 * theirs + 2**-24  # a unit near 0 has the rounding of a number near 1/2


def test_wrappers_stay_around_the_layers():
    statistics = VecNormalize(training.sb3_vec_env(CUT_IN, num_envs=2))
    statistics.obs_rms.mean[:] = np.random.default_rng(1).normal(size=11)
    model = PPO("MlpPolicy", statistics, device="cpu", seed=0)
    inner = wrap_policy(model, gym.make(CUT_IN).observation_space)
    wrapped = WrappedPolicy(inner, bounds=(np.full(2, -2.0), np.ones(2)))
    found = find_inference(wrapped)
    assert type(found) is type(found.policy) is WrappedPolicy
    assert isinstance(found.policy.policy, DensePolicy)
    seen = np.random.default_rng(1).uniform(-5, 5, (25, 11)).astype(np.float32)
    np.testing.assert_allclose(found.predict(seen)[0], wrapped.predict(seen, deterministic=True)[0], atol=1e-6)


@pytest.mark.parametrize("switched_off", [True, False])
def test_statistics_that_leave_the_observations_as_they_are_are_not_applied(switched_off):
    statistics = VecNormalize(training.sb3_vec_env(CUT_IN, num_envs=2), norm_obs=switched_off)
    statistics.norm_obs = False  # with moments of the time before, or none
    ego = WrappedPolicy(make(PPO, CUT_IN), statistics.normalize_obs)
    if switched_off:
        statistics.obs_rms.mean[:] = 5.0
    assert read_dense_policy(ego).normalisation is None
    x = rare_envs.DrivingProblem(CUT_IN).base.sample(20, np.random.default_rng(0))
    f, expected = (
        rare_envs.DrivingProblem(CUT_IN, ego=each, core="numba").evaluate(x) for each in (ego, make(PPO, CUT_IN))
    )
    assert np.array_equal(f, expected)


def test_rollouts_are_those_of_predict_and_weights_are_read_for_each(monkeypatch):
    model = make(PPO, CUT_IN)
    problem = rare_envs.DrivingProblem(CUT_IN, ego=model, core="torch", horizon=3.0)
    x = problem.base.sample(40, np.random.default_rng(0))
    first = problem.evaluate(x)
    with torch.no_grad():
        model.policy.action_net.bias[0] = 2.0
    learned = problem.evaluate(x)
    assert (first != learned).any()
    monkeypatch.setattr("rare_envs.egos.policy.find_inference", lambda policy: policy)
    by_predict = problem.evaluate(x)
    np.testing.assert_array_equal(learned <= 0, by_predict <= 0)
    np.testing.assert_allclose(learned, by_predict, atol=1e-5)
