"""Actions: from [-1, 1] to physical units, and what is refused."""

import pytest
import torch

from rare_envs.control.actions import DISCRETE_ACTIONS, to_physical


def test_actions() -> None:
    physical = to_physical(torch.tensor([[0.5, -1.0], [-3.0, 0.0]]), 2)
    torch.testing.assert_close(physical, torch.tensor([[2.5, -0.1], [-5.0, 0.0]]))
    torch.testing.assert_close(to_physical(torch.tensor([0, 4]), 2), torch.tensor([[-5.0, 0.0], [2.0, 0.0]]))
    assert len(DISCRETE_ACTIONS) == 5
    for wrong in (torch.tensor([5]), torch.tensor([[1, 0, 0]]), torch.tensor([[float("nan"), 0.0]])):
        with pytest.raises(ValueError, match=r"action"):
            to_physical(wrong, 1)
