"""Drives in HighwayEnv's environments, and egos that travel to worker processes."""

import pickle
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import rare_envs
from rare_envs.egos.wrappers import wrap_policy
from rare_envs.interop.problem import make_highway_env, strip_ego
from tests.rare_envs.interop.egos import Always, faster

FAST = {"vehicles_count": 3, "duration": 4}

IDLE = Always(1)


def fast(ego: Any = IDLE, **kwargs: Any) -> rare_envs.HighwayEnvProblem:
    return rare_envs.highway_env_problem("highway-fast-v0", ego=ego, config=FAST, vehicles=2, **kwargs)


def test_workers_and_their_number_change_no_bit() -> None:
    x = fast().base.sample(5, np.random.default_rng(1))
    expected = fast(Always(3)).evaluate(x)
    with fast(faster, workers=2) as problem:
        np.testing.assert_array_equal(problem.evaluate(x), expected)
        np.testing.assert_array_equal(problem.evaluate(x[::-1])[::-1], expected)


def test_a_model_of_stable_baselines3_is_an_ego() -> None:
    env = make_highway_env("highway-fast-v0", FAST)
    model = DQN("MlpPolicy", env, seed=0, buffer_size=10, policy_kwargs={"net_arch": [8]})
    problem = fast(model)
    x = problem.base.sample(2, np.random.default_rng(2))
    f = problem.evaluate(x)
    assert np.isfinite(f).all()
    scenario = rare_envs.HighwayEnvScenario(make_highway_env("highway-fast-v0", FAST), vehicles=2)
    observation, _ = scenario.reset(options={"x": x[0]})
    over = False
    while not over:
        observation, _, terminated, truncated, info = scenario.step(model.predict(observation, deterministic=True)[0])
        over = terminated or truncated
    assert info["measure"] == f[0]


def test_statistics_of_a_model_travel_without_its_environment() -> None:
    vec_env = VecNormalize(DummyVecEnv([lambda: make_highway_env("highway-fast-v0", FAST)]))
    model = DQN("MlpPolicy", vec_env, seed=0, buffer_size=10, policy_kwargs={"net_arch": [8]})
    vec_env.obs_rms.mean[...] = 0.5  # type: ignore[union-attr]
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 5, 5)).astype(np.float32)
    expected = model.predict(np.asarray(vec_env.normalize_obs(seen)), deterministic=True)[0]
    there = wrap_policy(pickle.loads(pickle.dumps(strip_ego(model))), vec_env.observation_space)
    assert there.normalise(seen)[0, 0, 0] == pytest.approx(vec_env.normalize_obs(seen)[0, 0, 0])  # type: ignore[call-overload]
    np.testing.assert_array_equal(there.predict(seen)[0], expected)


def test_a_maker_that_fails_is_told_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"a function without arguments that makes one, got .* which fails: TypeError"):
        fast(lambda observation: 1)
