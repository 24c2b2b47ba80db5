"""Actions: scaled to physical units, clipped, and refused where they are none."""

import math

import numpy as np
import pytest
import torch

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
