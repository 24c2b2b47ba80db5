"""Compiled steps of environments against those of torch: whole episodes with their observations, rewards and infos."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

import rare_envs  # noqa: F401  (registers its ids)
from rare_envs.fast.choice import find_scripted_step


def flat(info, prefix=""):
    """Return the numbers of an info by name."""
    found = {}
    for name, value in info.items():
        if isinstance(value, dict):
            found.update(flat(value, f"{prefix}{name}."))
        else:
            found[prefix + name] = value
    return found


def assert_same(info, expected, tolerance=1e-5):
    info, expected = flat(info), flat(expected)
    assert info.keys() == expected.keys()
    for name, value in expected.items():
        if np.asarray(value).dtype.kind == "f":
            assert np.allclose(info[name], value, rtol=1e-5, atol=tolerance, equal_nan=True), name
        else:
            assert np.array_equal(info[name], value), name


@pytest.mark.parametrize("env_id", ["CarFollowing-v0", "CutIn-v0", "CutIn-v1", "HardBrake-v0"])
def test_episodes_are_those_of_torch(env_id):
    observation = "kinematics" if env_id == "HardBrake-v0" else "features"
    compiled, reference = (
        gym.make(f"rare_envs/{env_id}", observation=observation, core=core) for core in ("numba", "torch")
    )
    ends, rng = set(), np.random.default_rng(0)
    for seed in range(6):
        for env in (compiled, reference):
            observed, _ = env.reset(seed=seed)
        mean, over = np.array([(-0.3, 0.9, 0.2)[seed % 3], (0.0, 0.01, 0.4)[seed % 3]]), False
        while not over:
            action = rng.normal(mean, 0.05).clip(-1, 1).astype(np.float32)
            observed, reward, terminated, truncated, info = compiled.step(action)
            expected, expected_reward, *ends_expected, expected_info = reference.step(action)
            assert [terminated, truncated] == ends_expected
            assert observed.dtype == expected.dtype and np.allclose(observed, expected, atol=1e-5)
            assert reward == pytest.approx(expected_reward, abs=1e-5)
            assert_same(info, expected_info)
            over = terminated or truncated
        ends.add(info["collision_type"])
        assert compiled.unwrapped._episode.state.x.shape == reference.unwrapped._episode.state.x.shape
        for one, other in zip(compiled.unwrapped._episode.state, reference.unwrapped._episode.state, strict=True):
            assert np.allclose(one, other, atol=1e-4)  # what scripts remember too
    assert len(ends) >= 2


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_batches_are_those_of_torch(mode):
    compiled, reference = (
        gym.make_vec("rare_envs/CutIn-v0", num_envs=16, horizon=4.0, autoreset_mode=mode, core=core)
        for core in ("numba", "torch")
    )
    rng, ended = np.random.default_rng(0), 0
    for env in (compiled, reference):
        env.reset(seed=1)
    for _ in range(60):
        actions = rng.normal((0.5, 0.1), 0.2, (16, 2)).clip(-1, 1).astype(np.float32)
        *found, info = compiled.step(actions)
        *expected, expected_info = reference.step(actions)
        for value, other in zip(found, expected, strict=True):
            assert np.allclose(value, other, atol=1e-4)
        for infos in (info, expected_info):
            infos["final_obs"] = np.array([row for row in infos.get("final_obs", ()) if row is not None], np.float32)
        assert_same(info, expected_info, 1e-4)
        ended += int(found[2].sum())
    assert ended > 3


@pytest.mark.parametrize("env_id", ["CarFollowing-v0", "CutIn-v0", "CutIn-v1", "HardBrake-v0"])
@pytest.mark.parametrize("dt", [0.1, 1.0])  # ten ticks of a decision, or one
def test_meta_actions_are_those_of_torch(env_id, dt):
    pair = [
        gym.make_vec(f"rare_envs/{env_id}", num_envs=64, action="meta", dt=dt, core=core) for core in ("numba", "torch")
    ]
    rng, ended = np.random.default_rng(0), 0
    for env in pair:
        env.reset(seed=1)
    for _ in range(30):
        actions = rng.integers(0, 5, 64)
        (*found, info), (*expected, expected_info) = (env.step(actions) for env in pair)
        for value, other in zip(found, expected, strict=True):
            assert np.allclose(value, other, atol=1e-4)
        assert_same({"reward_terms": info["reward_terms"]}, {"reward_terms": expected_info["reward_terms"]}, 1e-4)
        ended += int(found[2].sum())
    assert ended > 3


def test_a_cutter_at_the_end_of_its_path_is_level_whatever_the_rest_of_its_batch_does():
    """A heading whose cosine rounds to 1 would stay, but for rows beside which another cutter turns."""
    env = gym.make("rare_envs/CutIn-v0", core="numba").unwrapped
    env.reset(seed=0)
    state, far = env._episode.state, torch.tensor([0.0, 500.0, 1000.0])
    moved = state._replace(x=state.x + far, heading=state.heading + torch.tensor([0.0, 1e-4, 0.0]))
    env._episode = env._episode._replace(state=moved)
    env.step(np.zeros(2, np.float32))
    assert env._episode.state.heading.tolist() == [[0.0, 0.0, 0.0]]


def test_states_in_double_precision_are_left_to_torch():
    env = gym.make("rare_envs/CutIn-v0", core="numba").unwrapped
    env.reset(seed=0)
    with torch.inference_mode():
        env._episode = env.world.start(torch.from_numpy(env._x[None]))
    env.step(np.zeros(2, np.float32))
    assert env._episode.state.x.dtype == torch.float64


@pytest.mark.parametrize(("env_id", "arguments"), [("Highway-v0", {}), ("CutIn-v0", {"observation": "lidar"})])
def test_other_worlds_are_stepped_by_torch(env_id, arguments):
    env = gym.make(f"rare_envs/{env_id}", **arguments).unwrapped
    assert find_scripted_step(env.world) is None and env._compiled is None
    with pytest.raises(ValueError, match="core='numba' cannot simulate this"):
        find_scripted_step(env.world, "numba")
