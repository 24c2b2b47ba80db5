"""Kinds of observation: how they may be written, and functions of one or several."""

import numpy as np
import pytest

from rare_envs.sensors.kinds import OBSERVATIONS, batch_size, kinds_of, map_kinds, read_kinds


@pytest.mark.parametrize("observation", ["camera+speed", "speed+camera", ["speed", "camera"], ("camera", "speed")])
def test_kinds_have_one_spelling(observation: object) -> None:
    assert read_kinds(observation) == "camera+speed"
    assert kinds_of(read_kinds(observation)) == ("camera", "speed")


def test_each_kind_alone_is_itself() -> None:
    assert [read_kinds(name) for name in OBSERVATIONS] == list(OBSERVATIONS)


@pytest.mark.parametrize("observation", ["", "radar", "camera+", [], 3, None, ["camera", 3], "lidar+lidar"])
def test_other_observations_are_refused(observation: object) -> None:
    with pytest.raises(ValueError, match="observation"):
        read_kinds(observation)


@pytest.mark.parametrize("observation", ["OccupancyGrid", "GrayscaleObservation", {"type": "Kinematics"}])
def test_those_of_highway_env_have_another_place(observation: object) -> None:
    with pytest.raises(ValueError, match=r"expected one of .*highway_env_problem and HighwayEnv's ids"):
        read_kinds(observation)


def test_functions_go_to_one_or_to_each() -> None:
    one = np.arange(3.0)
    several = {"a": one, "b": np.ones((3, 2))}
    np.testing.assert_array_equal(map_kinds(np.add, one, one), 2 * one)
    doubled = map_kinds(np.add, several, several)
    assert list(doubled) == ["a", "b"]
    np.testing.assert_array_equal(doubled["b"], np.full((3, 2), 2.0))
    assert (batch_size(one), batch_size(several)) == (3, 3)
