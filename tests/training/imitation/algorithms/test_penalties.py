"""Penalties on paper."""

import pytest
import torch

from training.imitation.algorithms.config import Config
from training.imitation.algorithms.penalties import Penalties, compute_penalties, total_cost


def test_penalties_on_paper():
    x, y = torch.tensor([[0.0, 6.0, 0.0]]), torch.tensor([[1.8, 1.8, 5.4]])
    size = torch.full((1, 3), 4.5), torch.full((1, 3), 2.0)
    edges = torch.tensor([[0.0, 3.6, 7.2]])
    features = torch.zeros(1, 3, 51)
    features[..., 11:31] = 100.0
    action = torch.tensor([[[-3.0, 0.0], [0.0, 0.0], [0.0, 0.0]]])
    cost = compute_penalties(x, y, 0.0 * x, *size, edges, features, action, 3)
    # 1.5 m to the car ahead, which overlaps across by 2 m: (1 - 1.5 / 3) (1 + 2 / 0.8); 1.6 m beside the third: none
    assert cost.collision[0].tolist() == pytest.approx([0.5 * 3.5, 0.5 * 3.5, 0.0])
    assert cost.brake[0].tolist() == [1.0, 0.0, 0.0]
    assert (cost.edge == 0).all()
    off = compute_penalties(x, y - 1.5, 0.0 * x, *size, edges, features, action, 3)
    assert off.edge[0, 0] == pytest.approx(0.7)


def test_closing_in_costs_before_contact():
    features = torch.zeros(1, 1, 51)
    features[..., 11:31] = 100.0
    features[..., 11 + 9], features[..., 31 + 9] = 22.25, -10.0  # 20 m of gap, 10 m/s: 2.5 m/s^2 are needed
    one = torch.zeros(1, 1)
    edges = torch.tensor([[0.0, 3.6]])
    cost = compute_penalties(one, one + 1.8, one, one + 4.5, one + 2, edges, features, torch.zeros(1, 1, 2), 1)
    assert cost.collision == pytest.approx(0.1)


def test_manners_cost_on_paper():
    """Distance to whoever reaches into the own path, the middle of the lane, and the limit."""
    x, y = torch.tensor([[0.0, 20.5, 14.5]]), torch.tensor([[1.8, 1.8, 4.2]])
    speed = torch.tensor([[30.0, 24.0, 30.0]])
    size = torch.full((1, 3), 4.5), torch.full((1, 3), 2.0)
    features = torch.zeros(1, 3, 51)
    features[..., 11:31] = 100.0
    features[0, :, 0], features[0, :, 2] = torch.tensor([0.0, -0.2, 0.6]), speed[0]
    cost = compute_penalties(x, y, speed, *size, torch.tensor([[0.0, 3.6, 7.2]]), features, torch.zeros(1, 3, 2), 3)
    # 16 m to the lead, less 6 in which to slow down at 3 m/s^2, of 2 + 1.2 * 30 m. The third is as near to it,
    # but, 0.4 m beside its path, only half in it
    assert cost.headway[0].tolist() == pytest.approx([1 - 10 / 38, 0.0, 0.5 * (1 - (1.5 - 6) / 38)])
    assert cost.lane[0].tolist() == pytest.approx([0.0, 0.0, 0.3])
    assert cost.speed[0].tolist() == pytest.approx([0.1, 0.0, 0.1])


def test_total_cost_by_hand():
    costs = Penalties(*(torch.tensor([float(value)]) for value in (1, 2, 3, 4, 5, 6)))
    names = ("collision", "edge", "brake", "headway", "lane", "speed")
    weights = {f"{name}_weight": 10.0**power for power, name in enumerate(names)}
    assert total_cost(Config(critic_weight=0.5, **weights), torch.tensor([2.0]), costs).tolist() == [654322.0]
