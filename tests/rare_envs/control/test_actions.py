"""Actions: scaled to physical units, clipped, and refused where they are none."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN

import rare_envs
from rare_envs.control import actions
from rare_envs.control.actions import (
    DISCRETE_ACTIONS,
    IDLE,
    MAX_ACCELERATION,
    MAX_STEERING,
    META_ACTIONS,
    action_space,
    read_actions,
    space_of_actions,
    to_meta,
    to_physical,
)


def test_an_action_of_one_is_the_largest() -> None:
    action = torch.tensor([[1.0, -1.0], [-0.5, 0.0], [7.0, -9.0]])
    expected = [[MAX_ACCELERATION, -MAX_STEERING], [-0.5 * MAX_ACCELERATION, 0.0], [MAX_ACCELERATION, -MAX_STEERING]]
    torch.testing.assert_close(to_physical(action, 3), torch.tensor(expected))


def test_indices_stand_for_accelerations() -> None:
    found = to_physical(torch.arange(len(DISCRETE_ACTIONS)), len(DISCRETE_ACTIONS))
    torch.testing.assert_close(found[:, 0], torch.tensor([-5.0, -2.0, 0.0, 1.0, 2.0]))
    assert not found[:, 1].any()


def test_a_policy_in_double_precision_acts_as_in_single() -> None:
    action = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2))
    single = to_physical(torch.from_numpy(action.astype(np.float32)), 20)
    assert torch.equal(to_physical(torch.from_numpy(action), 20), single)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.zeros(3, 3), r"shape \(3, 2\)"),
        (torch.zeros(2, 2), r"shape \(3, 2\)"),
        (torch.tensor([[0.0, math.nan], [0.0, 0.0], [math.inf, 0.0]]), "for 2 of 3 observations"),
        (torch.tensor([0, 5, 1]), r"indices in 0\.\.4"),
    ],
)
def test_what_is_no_action_is_refused(action: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        to_physical(action, 3)


@pytest.mark.parametrize("action", [torch.zeros(3), torch.tensor([0, 1, 5]), torch.tensor([True, False, True])])
def test_what_is_no_meta_action_is_refused(action: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="meta-actions"):
        to_meta(action, 3)


def test_rows_that_do_not_matter_may_hold_anything() -> None:
    over = torch.tensor([True, False])
    action = torch.tensor([[math.nan, 3.0], [1.0, 0.0]])
    torch.testing.assert_close(to_physical(action, 2, over), torch.tensor([[0.0, 0.0], [MAX_ACCELERATION, 0.0]]))
    assert read_actions("meta", torch.tensor([99, 3]), 2, over).tolist() == [IDLE, 3]


def test_spaces_hold_the_actions() -> None:
    assert space_of_actions("continuous") == action_space()
    assert all(action_space().contains(row) for row in DISCRETE_ACTIONS)
    assert space_of_actions("meta").n == len(META_ACTIONS)  # type: ignore[attr-defined]


def test_discrete_actions_are_rows_of_the_table() -> None:
    """One step of each index is that of its continuous action, alone and in a batch; DQN trains."""
    discrete, continuous = gym.make("rare_envs/CutIn-v0", action="discrete"), gym.make("rare_envs/CutIn-v0")
    assert discrete.action_space == gym.spaces.Discrete(len(DISCRETE_ACTIONS))
    for index, action in enumerate(DISCRETE_ACTIONS):
        discrete.reset(seed=1)
        continuous.reset(seed=1)
        found, wanted = discrete.step(index), continuous.step(action)
        np.testing.assert_array_equal(found[0], wanted[0])
        assert found[1:4] == wanted[1:4]
    batch = gym.make_vec("rare_envs/CutIn-v0", num_envs=5, action="discrete")
    same = gym.make_vec("rare_envs/CutIn-v0", num_envs=5)
    batch.reset(seed=2)
    same.reset(seed=2)
    np.testing.assert_array_equal(batch.step(np.arange(5))[0], same.step(DISCRETE_ACTIONS)[0])
    model = DQN("MlpPolicy", discrete, buffer_size=50, learning_starts=4, batch_size=4, device="cpu", seed=0).learn(12)
    named, guessed = (
        rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=model, horizon=1.0, **options)
        for options in ({"action": "discrete"}, {})
    )
    assert named.notes == ()
    assert len(guessed.notes) == 1
    assert "taken as five accelerations" in guessed.notes[0]


def test_agents_of_a_parallel_environment_act_by_index_too() -> None:
    many = rare_envs.parallel_env("rare_envs/CutIn-v0", action="discrete", agents=["ego"])
    alone = rare_envs.parallel_env("rare_envs/CutIn-v0", agents=["ego"])
    many.reset(seed=1)
    alone.reset(seed=1)
    found, wanted = many.step({"ego": 1})[0], alone.step({"ego": DISCRETE_ACTIONS[1]})[0]
    np.testing.assert_array_equal(found["ego"], wanted["ego"])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_becomes_nan_where_nobody_can_look(value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions, "can_look", lambda _: False)
    physical = to_physical(
        torch.tensor([[value, 0.5], [0.5, 0.5], [0.5, value]]), 3, torch.tensor([False, False, True])
    )
    assert physical.isnan().tolist() == [[True, False], [False, False], [False, False]]  # the last is ignored
