"""Actions: scaled to physical units, clipped, and refused where they are none."""

import math

import pytest
import torch

from rare_envs.control import actions
from rare_envs.control.actions import DISCRETE_ACTIONS, IDLE, MAX_ACCELERATION, MAX_STEERING, read_actions, to_physical


def test_an_action_of_one_is_the_largest() -> None:
    action = torch.tensor([[1.0, -1.0], [-0.5, 0.0], [7.0, -9.0]])
    expected = [[MAX_ACCELERATION, -MAX_STEERING], [-0.5 * MAX_ACCELERATION, 0.0], [MAX_ACCELERATION, -MAX_STEERING]]
    torch.testing.assert_close(to_physical(action, 3), torch.tensor(expected))


def test_indices_stand_for_accelerations() -> None:
    found = to_physical(torch.arange(len(DISCRETE_ACTIONS)), len(DISCRETE_ACTIONS))
    torch.testing.assert_close(found[:, 0], torch.tensor([-5.0, -2.0, 0.0, 1.0, 2.0]))
    assert not found[:, 1].any()


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


def test_rows_that_do_not_matter_may_hold_anything() -> None:
    over = torch.tensor([True, False])
    action = torch.tensor([[math.nan, 3.0], [1.0, 0.0]])
    torch.testing.assert_close(to_physical(action, 2, over), torch.tensor([[0.0, 0.0], [MAX_ACCELERATION, 0.0]]))
    assert read_actions("meta", torch.tensor([99, 3]), 2, over).tolist() == [IDLE, 3]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_becomes_nan_where_nobody_can_look(value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions, "can_look", lambda _: False)
    physical = to_physical(
        torch.tensor([[value, 0.5], [0.5, 0.5], [0.5, value]]), 3, torch.tensor([False, False, True])
    )
    assert physical.isnan().tolist() == [[True, False], [False, False], [False, False]]  # the last is ignored
