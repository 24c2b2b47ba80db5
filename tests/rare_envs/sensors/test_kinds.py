"""Kinds of observation, and HighwayEnv's kinematics."""

import pytest

from rare_envs.simulation.observation import observe_kinematics, read_kinds
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State
from tests.rare_envs.traffic_states import traffic


@pytest.mark.parametrize("observation", ["camera+speed", "speed+camera", ("speed", "camera")])
def test_kinds_have_one_spelling(observation: object) -> None:
    assert read_kinds(observation) == "camera+speed"


@pytest.mark.parametrize("observation", ["", "radar", "camera+", None, ["camera", 3], "lidar+lidar"])
def test_other_observations_are_refused(observation: object) -> None:
    with pytest.raises(ValueError, match="observation"):
        read_kinds(observation)


@pytest.mark.parametrize("observation", ["OccupancyGrid", {"type": "Kinematics"}])
def test_those_of_highway_env_have_another_place(observation: object) -> None:
    with pytest.raises(ValueError, match=r"expected one of .*highway_env_problem and HighwayEnv's ids"):
        read_kinds(observation)


EGO = (0.0, 0.0, 0.0, 20.0)
Vehicle = tuple[float, float, float, float]


def still(x: float, y: float = 0.0) -> Vehicle:
    """A vehicle as fast as the ego."""
    return x, y, 0.0, 20.0


def places(state: State, vehicle: int = 0) -> list[float]:
    """How far ahead [m] the observed others are, in the order of their rows."""
    rows = observe_kinematics(state, straight(2), vehicle)[0, 1:]
    assert not rows[rows[:, 0] == 0].any()  # who is missing is all zeros
    return (200.0 * rows[rows[:, 0] == 1, 1]).tolist()


def test_the_nearest_four_along_the_road_come_first_and_in_the_order_of_the_state_if_level() -> None:
    state = traffic(EGO, still(70.0), still(-5.0, 4.0), still(30.0), still(110.0), still(8.0, 4.0), still(20.0))
    assert places(state) == pytest.approx([-5.0, 8.0, 20.0, 30.0])
    beside = traffic(EGO, still(0.1, 40.0), still(9.0))
    assert places(beside) == pytest.approx([0.1, 9.0])  # 40 m away, but not along the road
    level = traffic(EGO, still(30.0, 4.0), still(6.0, 4.0), still(-6.0, -4.0), still(6.0, 0.0))
    rows = observe_kinematics(level, straight(2))[0, 1:]
    assert (8.0 * rows[:, 2]).tolist() == pytest.approx([4.0, -4.0, 0.0, 4.0])
