"""Plain functions and torch modules as egos."""

import numpy as np
import pytest
import torch

import rare_envs
import samplers
from rare_envs.egos.needs import FunctionEgo, ModuleEgo, wrap_callable

X = [[20.0, 15.0, 30.0], [30.0, 5.0, 20.0], [25.0, 24.0, 60.0]]


class Brake:
    """The same as a policy of Stable-Baselines3's form."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return brake(observation), state


def brake(observation):
    return np.tile(np.array([-0.4, 0.0], dtype=np.float32), (len(observation), 1))


class BrakingNetwork(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.bias = torch.nn.Parameter(torch.tensor([-0.4, 0.0], dtype=torch.float64))
        self.dropout = torch.nn.Dropout(0.5)

    def forward(self, observation):
        assert observation.dtype == self.bias.dtype
        return self.dropout(self.bias.expand(len(observation), 2))


@pytest.mark.parametrize("ego", [brake, BrakingNetwork(), lambda observation: brake(observation).tolist()])
def test_they_drive_as_the_policy_does(ego):
    wanted = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Brake()).evaluate(X)
    np.testing.assert_array_equal(rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego).evaluate(X), wanted)


def test_a_function_can_choose_whole_numbers():
    ego = FunctionEgo(lambda observation: np.full(len(observation), 1))  # -2 m/s^2, as `brake`
    found = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego).evaluate(X)
    np.testing.assert_array_equal(found, rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=brake).evaluate(X))


def test_rows_on_which_a_function_fails_are_found():
    def ego(observation):
        if (observation[:, 0] < 0).any():
            raise ArithmeticError("off the map")
        return brake(observation)

    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego, base="us101-gap")
    assert samplers.estimate(problem, "mc", seed=0, max_sim=200, on_error="failure").n_sim == 200


def test_other_egos_stay_as_they_are():
    policy = Brake()
    for ego in (policy, "idm", Brake, 3, None):
        assert wrap_callable(ego) is ego
    assert isinstance(wrap_callable(torch.nn.Linear(11, 2)), ModuleEgo)
    with pytest.raises(ValueError, match="got the class Brake"):
        rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Brake)


def test_parallel_environments_take_them():
    env = rare_envs.parallel_env("rare_envs/CutIn-v0", agents=["cutter"], ego=brake)
    env.reset(seed=0)
    assert env.step({"cutter": np.zeros(2, np.float32)})[1].keys() == {"cutter"}
