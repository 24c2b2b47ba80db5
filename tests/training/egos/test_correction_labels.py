"""Labels of corrections: whom the expert brakes for, and what is recorded of a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from agents import load_driver
from agents.learned.driver import LearnedDriver, replace_head
from agents.learned.networks import HEAD_SIZE
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.sensing import Sensing
from rare_envs.simulation.world import World
from rare_envs.traffic.state import VEHICLE_LENGTH, State
from training.egos.correction_labels import EXPERT, FREE, expert_acceleration, record_drive

CUT_IN = World(find_scenario("rare_envs/CutIn-v0"), Sensing("features", lidar=True))


def traffic(gap: float, aside: float, heading: float = 0.0, speed: float = 15.0) -> State:
    x, y = torch.tensor([[0.0, gap + VEHICLE_LENGTH]]), torch.tensor([[0.0, aside]])
    return State(x, y, torch.tensor([[0.0, heading]]), torch.tensor([[20.0, speed]]), theta=x[:, :0])


@pytest.fixture
def coasting() -> LearnedDriver:
    """An ego that hardly accelerates, brakes or steers, whatever it sees."""
    driver = load_driver("imitation")
    assert isinstance(driver, LearnedDriver)
    return replace(driver, policy=replace_head(driver.policy, torch.zeros(HEAD_SIZE)))


def test_the_expert_brakes_as_hard_as_idm_behind_a_lead() -> None:
    root = 2.0 * np.sqrt(EXPERT.max_acceleration * EXPERT.comfortable_deceleration)
    desired_gap = EXPERT.jam_distance + 20.0 * EXPERT.time_headway + 20.0 * 5.0 / root
    expected = EXPERT.max_acceleration * (1.0 - (20.0 / 40.0) ** 4 - (desired_gap / 15.0) ** 2)
    assert expert_acceleration(traffic(15.0, 0.0)).item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("state", "brakes"),
    [
        (traffic(10.0, 3.5), False),  # beside
        (traffic(10.0, 2.4), True),  # within the margin
        (traffic(10.0, 3.5, heading=-0.08), True),  # comes 1.2 m nearer within 1 s
        (traffic(10.0, 2.6, heading=-0.01), False),  # sways
        (traffic(10.0, 3.5, heading=0.08), False),  # goes away
        (traffic(10.0, 3.0, heading=-0.5), True),  # will be on the other side by then
        (traffic(-12.0, 0.0), False),  # behind
        (traffic(-2.0, 2.1), True),  # overlaps along the road and across it nearly
    ],
)
def test_the_expert_brakes_for_those_in_its_path_and_coming_into_it(state: State, brakes: bool) -> None:
    wanted = expert_acceleration(state).item()
    assert (wanted < -1.0) if brakes else (wanted == FREE)


def test_labels_are_the_teachers_but_for_harder_braking(coasting: LearnedDriver) -> None:
    x = np.array([[25.0, 12.0, 20.0, 15.0, 40.0, 3.5], [20.0, 20.0, 20.0, 60.0, 60.0, 3.5]])
    plain = record_drive(coasting, coasting.policy, CUT_IN, x, 10, corrected=False)
    corrected = record_drive(coasting, coasting.policy, CUT_IN, x, 10, corrected=True)
    assert torch.equal(plain.features, corrected.features)
    assert torch.equal(plain.outputs[:, :2], torch.zeros_like(plain.outputs[:, :2]))
    assert torch.equal(corrected.outputs[:, 1:], plain.outputs[:, 1:])
    assert (corrected.outputs[:, 0] <= 0.0).all()
    hardest = EXPERT.max_deceleration / coasting.policy.scaling.action_std[0].item()
    assert corrected.outputs[:, 0].min().item() == pytest.approx(-hardest, rel=0.05)
    assert (corrected.outputs[:, 0] == 0.0).sum() > 5


def test_nothing_is_recorded_after_a_collision(coasting: LearnedDriver) -> None:
    x = np.array([[25.0, 12.0, 20.0, 15.0, 40.0, 3.5], [20.0, 20.0, 20.0, 60.0, 60.0, 3.5]])
    one, other, both = (
        len(record_drive(coasting, coasting.policy, CUT_IN, rows, 1, corrected=False).features)
        for rows in (x[:1], x[1:], x)
    )
    assert 0 < one < other == 101
    assert both == one + other
