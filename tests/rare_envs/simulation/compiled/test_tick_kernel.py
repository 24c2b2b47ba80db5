"""Compiled rewards and observations against their torch twins; ticks are tested by whole episodes of environments."""

from types import SimpleNamespace

import numpy as np
import torch

from rare_envs.simulation.compiled import tick_kernel
from rare_envs.simulation.compiled.equations import RoadNumbers
from rare_envs.simulation.observation import observe_features
from rare_envs.simulation.reward import RewardTerms, reward_terms
from rare_envs.traffic import straight
from rare_envs.traffic.bodies import others_overlap
from rare_envs.traffic.neighbours import lead_of
from rare_envs.traffic.state import State

N, ROAD = 300, straight(2)


def traffic() -> State:
    """Three vehicles near each other, some of them overlapping or off the road."""
    rng = np.random.default_rng(3)
    ranges = ((0, 40), (-4, 8), (-0.3, 0.3), (0, 45))
    x, y, heading, speed = (torch.from_numpy(rng.uniform(low, high, (N, 3))).float() for low, high in ranges)
    return State(x, y, heading, speed, theta=x[:, :0])


def rows(state: State):
    """x, y, heading and speed of each row."""
    return zip(*(field.numpy() for field in state[:4]), strict=True)


def test_rewards():
    state, rng = traffic(), np.random.default_rng(4)
    action = torch.from_numpy(rng.uniform((-5, -0.1), (5, 0.1), (N, 2))).float()
    collided = torch.from_numpy(rng.random(N) < 0.3)
    lead = lead_of(state, ROAD)
    episode = SimpleNamespace(state=state, lead=lead, road=ROAD, collided=collided)
    expected = torch.stack(reward_terms(episode, action)).numpy()  # type: ignore[arg-type]
    found = np.empty((6, N), np.float32)
    for row in range(N):
        ego = (field[row, 0].numpy()[()] for field in state[1:4])
        of_lead = (value[row].numpy()[()] for value in lead)
        numbers = RoadNumbers.of(ROAD)
        tick_kernel.write_reward(found[:, row], *ego, *action[row].numpy(), *of_lead, bool(collided[row]), numbers)
    assert np.allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert len(found) == len(RewardTerms._fields) and (expected.min(1) < 0).sum() == 5


def test_observations():
    state = traffic()
    found = np.empty((N, 11), np.float32)
    for row, (x, y, heading, speed) in enumerate(rows(state)):
        tick_kernel.write_features(found[row], x, y, heading, speed)
    assert np.allclose(found, observe_features(state).numpy(), atol=1e-6)
    assert (np.abs(found) == 5.0).any()


def test_contact_of_others():
    state = traffic()
    found = [tick_kernel.others_touch(x, y, heading) for x, y, heading, _ in rows(state)]
    assert np.array_equal(found, others_overlap(state, ROAD).numpy())
    assert 0 < sum(found) < N
