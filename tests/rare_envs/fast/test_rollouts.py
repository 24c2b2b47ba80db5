"""Compiled rollouts against the torch simulation: the same collisions, and f to rounding."""

import functools
import warnings
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import rare_envs
from rare_envs import IDM
from rare_envs.control.actions import DISCRETE_ACTIONS
from rare_envs.traffic.road import Road, straight

SCENARIOS = ("CarFollowing-v0", "CutIn-v0", "CutIn-v1", "HardBrake-v0")
EGOS = {"HardBrake-v0": IDM(max_deceleration=2.0)}  # the usual one hits no lead that brakes in a parabola
FEW = 200


def problems(env_id: str, ego: Any = "idm", **kwargs: Any) -> list[rare_envs.DrivingProblem]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of rescaled actions
        return [
            rare_envs.DrivingProblem(f"rare_envs/{env_id}", ego=ego, core=core, **kwargs) for core in ("numba", "torch")
        ]


def points(problem: rare_envs.DrivingProblem, n: int) -> Any:
    """Half of ordinary traffic, half anywhere in the physical box."""
    rng, space = np.random.default_rng(11), problem.space
    bounded = np.isfinite(space.high)
    low, high = (np.where(bounded, end, 0.0) for end in (space.low, space.high))
    anywhere = low + (high - low) * rng.random((n // 2, space.dim))
    anywhere[:, ~bounded] = rng.normal(0.0, 4.0, (n // 2, (~bounded).sum()))  # so that some have not looked
    return np.concatenate([problem.base.sample(n - n // 2, rng), anywhere])


def compare(compiled: Any, reference: Any, n: int, tolerance: float = 1e-5, others: float = 0.0) -> None:
    """Same collisions; f within a tolerance but where rounding moves a lane change or a choice by a tick."""
    assert (compiled.core, reference.core) == ("numba", "torch")
    x = points(compiled, n)
    f, expected = compiled.evaluate(x), reference.evaluate(x)
    collided = expected == -1.0
    assert 0.001 < collided.mean() < 0.99
    assert ((f == -1.0) != collided).mean() <= others / 2
    assert (np.abs(f - expected) > tolerance).mean() <= others


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_f_is_that_of_the_torch_simulation(env_id: str) -> None:
    compare(*problems(env_id, EGOS.get(env_id, IDM())), n=FEW)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", SCENARIOS)
def test_f_is_that_of_the_torch_simulation_in_100_000_rollouts(env_id: str) -> None:
    compare(*problems(env_id, EGOS.get(env_id, IDM())), n=100_000, others=1e-3)


@pytest.mark.parametrize("ego", [IDM(30.0, 0.8, max_deceleration=3.0, cut_off=True), IDM(exponent=3.0)])
def test_other_egos_horizons_and_ticks(ego: IDM) -> None:
    compare(*problems("CutIn-v0", ego, horizon=6.0, dt=0.05), n=FEW)


@pytest.mark.parametrize("road", [Road((-7.0, -3.0, 1.0, 5.0)), straight(2, 2.5)])
@pytest.mark.parametrize("env_id", ["CutIn-v0", "HardBrake-v0"])
def test_other_roads_where_the_ego_begins_beside_the_line(env_id: str, road: Road) -> None:
    compiled, reference = problems(env_id, EGOS.get(env_id, IDM()))
    for problem in (compiled, reference):
        problem.world = replace(problem.world, scenario=replace(problem.world.scenario, road=road))
    compare(compiled, reference, n=FEW, others=0.01)


@functools.cache
def model(env_id: str, kind: str = "ppo") -> Any:
    """An untrained policy with outputs as large as those of a trained one."""
    env: Any = gym.make(f"rare_envs/{env_id}")
    given: dict[str, Any] = {"device": "cpu", "seed": 0}
    if kind == "a2c relu 32":
        made: Any = A2C("MlpPolicy", env, policy_kwargs={"net_arch": [32], "activation_fn": torch.nn.ReLU}, **given)
    elif kind == "rescaled":
        made = PPO("MlpPolicy", gym.wrappers.RescaleAction(env, np.float32([-2, -1]), np.float32([4, 3])), **given)
    elif kind == "normalised":
        wrapped = VecNormalize(DummyVecEnv([lambda: env]))
        wrapped.obs_rms.mean[:], wrapped.obs_rms.var[:] = 0.3, 0.5
        made = PPO("MlpPolicy", wrapped, **given)
    elif kind == "dqn":
        choices = gym.spaces.Discrete(len(DISCRETE_ACTIONS))
        chosen = gym.wrappers.TransformAction(env, lambda action: DISCRETE_ACTIONS[action], choices)
        made = DQN("MlpPolicy", chosen, buffer_size=1, **given)
    else:
        made = PPO("MlpPolicy", env, **given)
    with torch.no_grad():
        net = made.policy.q_net.q_net[-1] if kind == "dqn" else made.policy.action_net
        net.weight.mul_(3.0 if kind == "dqn" else 30.0)
        if kind != "dqn":
            net.weight[1].mul_(0.02)  # a steady hand
    return made


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_f_with_a_policy_is_that_of_the_torch_simulation(env_id: str) -> None:
    """Rounding of the network moves actions by 1e-6, as torch itself does from one size of batch to another."""
    compare(*problems(env_id, model(env_id)), n=FEW, tolerance=1e-4)


@pytest.mark.parametrize("kind", ["a2c relu 32", "rescaled", "normalised", "dqn"])
def test_f_of_other_policies_is_that_of_the_torch_simulation(kind: str) -> None:
    compare(*problems("CutIn-v0", model("CutIn-v0", kind)), n=FEW, tolerance=1e-4, others=0.02 * (kind == "dqn"))


@pytest.mark.parametrize("ego", ["idm", "ppo"])
@pytest.mark.parametrize("env_id", ["CarFollowing-v0", "CutIn-v0"])
def test_a_row_is_the_same_bits_in_any_batch(env_id: str, ego: str) -> None:
    problem = problems(env_id, model(env_id) if ego == "ppo" else ego)[0]
    x = points(problem, 300)
    expected = problem.evaluate(x)
    assert np.array_equal(problem.evaluate(x[::-1])[::-1], expected)
    alone = [problem.evaluate(row[None])[0] for row in x[::15]]
    assert np.array_equal(alone, expected[::15])


def test_a_policy_that_learns_on_is_simulated_with_its_new_weights() -> None:
    ego = PPO("MlpPolicy", gym.make("rare_envs/CarFollowing-v0"), device="cpu", seed=0)
    problem, reference = problems("CarFollowing-v0", ego)
    x = problem.base.sample(FEW, np.random.default_rng(0))
    before = problem.evaluate(x)
    with torch.no_grad():
        ego.policy.action_net.bias[0] = -1.0  # it brakes
    after = problem.evaluate(x)
    assert not np.array_equal(before, after)
    assert np.allclose(after, reference.evaluate(x), atol=1e-4)


def test_actions_that_are_not_finite_are_reported_as_by_torch() -> None:
    ego = PPO("MlpPolicy", gym.make("rare_envs/CarFollowing-v0"), device="cpu", seed=0)
    with torch.no_grad():
        ego.policy.action_net.bias[0] = float("nan")
    problem = problems("CarFollowing-v0", ego)[0]
    x = problem.base.sample(5, np.random.default_rng(0))
    with pytest.raises(ValueError, match="nan"):
        problem.evaluate(x)


@pytest.mark.parametrize(("name", "value"), [("desired_speed", 0.0), ("time_headway", float("nan"))])
def test_where_the_torch_simulation_gives_nan_so_does_the_compiled_one(name: str, value: float) -> None:
    ego = IDM()
    object.__setattr__(ego, name, value)  # its constructor would refuse it
    for problem in problems("CutIn-v0", ego):
        with pytest.raises(ValueError, match="The measure 'ttc' gave NaN"):
            problem.evaluate(points(problem, FEW))
