"""Background drivers: their noise, their clock, and how they are named."""

import pytest
import torch

import agents
from agents.files import LANE_CHANGING, RULE_BASED, SHIPPED_DRIVERS
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.simulation.background import BackgroundState, find_drivers, query_background


def step_background(drivers, state, features):
    """Query drivers that act by lidar features (B, M, 51); the ego's do not matter."""
    return query_background(drivers, state, None, None, torch.cat((features[:, :1], features), dim=1), 0.1)


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


def test_rows_of_a_batch_may_be_at_different_ticks():
    """As after an episode of a vector environment was replaced."""
    drivers = agents.load_driver("mgail")
    draws = torch.randn(2, 6, 5, 2)
    first = BackgroundState.start(drivers, torch.zeros(2, 0), draws)
    features = torch.randn(2, 5, 51)
    _, later = step_background(drivers, first, features)
    mixed = BackgroundState(*(torch.stack((a[0], b[1])) for a, b in zip(first, later, strict=True)))
    action, _ = step_background(drivers, mixed, features)
    torch.testing.assert_close(action[0], step_background(drivers, first, features)[0][0], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(action[1], step_background(drivers, later, features)[0][1], rtol=1e-5, atol=1e-5)


def test_drivers_are_found_by_name_and_wrong_names_refused():
    assert find_drivers(None) is None
    for driver in (agents.load_driver("mgail"), agents.load_driver("idm+mobil")):
        assert find_drivers(driver) is driver
    assert find_drivers("idm+mobil") == LaneChangingDriver()  # by the loader of "idm"
    for wrong, message in (
        ("mgial", "did you mean 'mgail'"),
        (3, "weights, begin and act"),
        ("idm+x", "'idm\\+mobil'"),
    ):
        with pytest.raises(ValueError, match=message):
            find_drivers(wrong)


@pytest.mark.parametrize("name", [*SHIPPED_DRIVERS, RULE_BASED, LANE_CHANGING])
def test_each_shipped_driver_is_installed_by_its_name(name):
    """Each name needs an entry point of its own."""
    found = find_drivers(name)
    assert type(found) is type(agents.load_driver(name))
    assert getattr(found, "name", name) == name
