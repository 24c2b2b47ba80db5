"""The driver by rule on paper, and that it keeps its lane and its distance."""

import pytest
import torch

from agents.learned.driver import RuleDriver
from rare_envs.control.idm import IDM
from rare_envs.sensors.lidar import AHEAD_BEAM, RANGE_COLUMNS, RATE_COLUMNS
from rare_envs.traffic.neighbours import Lead


def seen(offset=0.0, heading=0.0, speed=15.0, ahead=100.0, rate=0.0):
    features = torch.zeros(1, 1, 51)
    features[..., :5] = torch.tensor([offset, heading, speed, 5.0, 2.0])
    features[..., RANGE_COLUMNS] = 100.0
    features[..., RANGE_COLUMNS.start + AHEAD_BEAM], features[..., RATE_COLUMNS.start + AHEAD_BEAM] = ahead, rate
    return features


def test_it_is_idm_on_the_beam_ahead():
    (action,), _ = RuleDriver().act(seen(ahead=22.5, rate=-3.0))
    expected = IDM().acceleration(torch.tensor([15.0]), Lead(torch.tensor([20.0]), torch.tensor([3.0])))
    assert action[0, 0] == pytest.approx(float(expected))


def test_a_beam_that_meets_nothing_is_a_free_road():
    (action,), memory = RuleDriver().act(seen())
    assert action[0, 0] == pytest.approx(2.22 * (1 - (15 / 21.72) ** 4), rel=1e-5)
    assert action[0, 1] == 0
    assert memory is None


def test_it_steers_back_to_the_middle_and_along_the_road():
    driver = RuleDriver()
    assert driver.act(seen(offset=0.09))[0][0, 0, 1] == pytest.approx(-5 * 0.01, rel=1e-3)
    assert driver.act(seen(heading=0.01))[0][0, 0, 1] == pytest.approx(-0.05)
    assert driver.act(seen(offset=3.0))[0][0, 0, 1] == pytest.approx(-0.3)


def test_it_settles_in_the_lane():
    driver, offset, heading = RuleDriver(), 1.5, 0.1
    for _ in range(60):
        (action,), _ = driver.act(seen(offset, heading))
        offset, heading = offset + 1.5 * float(torch.tensor(heading).sin()), heading + 0.1 * float(action[0, 1])
    assert abs(offset) < 0.05
    assert abs(heading) < 0.01
