"""Policies as drivers: what fits a world, and what a policy is shown."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from rare_envs.control.actions import IDLE
from rare_envs.control.idm import IDM
from rare_envs.egos.policy import PolicyDriver, as_driver, check_spaces
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.episode import Clock
from rare_envs.simulation.observation import observation_space
from rare_envs.simulation.world import World

WORLD = World(CAR_FOLLOWING)
X = torch.tensor([[20.0, 15.0, 30.0], [25.0, 15.0, 40.0], [30.0, 15.0, 50.0]])


class Recorder:
    """A policy that keeps what it is shown."""

    def __init__(self, **attributes: Any) -> None:
        self.shown: list[Any] = []
        self.__dict__.update(attributes)

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        self.shown.append((observation.copy(), episode_start.copy()))
        return np.zeros((len(observation), 2)), state


def test_what_stands_for_a_driver() -> None:
    assert as_driver("idm", WORLD) == IDM()
    ego = IDM(desired_speed=30.0)
    assert as_driver(ego, WORLD) is ego
    assert isinstance(as_driver(Recorder(), WORLD), PolicyDriver)


@pytest.mark.parametrize(
    ("ego", "message"),
    [
        ("imd", "Unknown ego 'imd'"),
        (Recorder, "got the class Recorder"),
        (object(), "got object"),
        (Recorder(dt=0.2), "Expected dt=0.2 s"),
        (Recorder(observation_space=observation_space(2, "lidar")), "observation='lidar'"),
    ],
)
def test_what_does_not(ego: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        as_driver(ego, WORLD)


def test_spaces_of_actions() -> None:
    expected = WORLD.observation_space
    check_spaces(Recorder(action_space=spaces.Box(-2, 2, (2,))), expected)
    check_spaces(Recorder(action_space=spaces.Discrete(5)), expected)
    check_spaces(Recorder(action_space=spaces.Discrete(5)), expected, "meta")
    check_spaces(Recorder(action_space=spaces.Discrete(5)), expected, "discrete")
    with pytest.raises(ValueError, match=r"takes Discrete\(5\) \(five accelerations\); leave action='discrete' out"):
        check_spaces(Recorder(action_space=spaces.Box(-1, 1, (2,))), expected, "discrete")
    for space, kind in ((spaces.Discrete(4), "continuous"), (spaces.MultiDiscrete([2, 2]), "continuous")):
        with pytest.raises(ValueError, match=r"the environment takes Box"):
            check_spaces(Recorder(action_space=space), expected, kind)
    with pytest.raises(ValueError, match=r"takes Discrete\(5\) \(LANE_LEFT"):
        check_spaces(Recorder(action_space=spaces.Box(-1, 1, (2,))), expected, "meta")


def test_rows_after_a_collision_and_rows_that_failed_are_shown_what_another_row_sees() -> None:
    episode = WORLD.start(X)._replace(collided=torch.tensor([True, False, False]))
    policy = Recorder()
    _, memory = PolicyDriver(policy).act(episode, None)
    PolicyDriver(policy, failed_rows={1: "no road"}).act(episode, memory)
    (first, begins), (second, goes_on) = policy.shown
    np.testing.assert_allclose(first[:, 0] * 30.0, [25.0, 25.0, 30.0])
    np.testing.assert_allclose(second[:, 0] * 30.0, [30.0, 30.0, 30.0])
    assert begins.all()
    assert not goes_on.any()


def test_a_policy_with_meta_actions_is_queried_once_a_second() -> None:
    class Meta(Recorder):
        def predict(self, *args: Any, **kwargs: Any) -> Any:
            super().predict(*args, **kwargs)
            return np.full(3, 3), None

    world = World(CAR_FOLLOWING, clock=Clock(horizon=2.0, action="meta"))
    policy, memory = Meta(), None
    driver = as_driver(policy, world)
    actions = []
    for _ in range(12):
        action, memory = driver.act(world.start(X), memory)
        actions.append(int(action[0]))
    assert actions == [3, *[IDLE] * 9, 3, IDLE]
    assert len(policy.shown) == 2
