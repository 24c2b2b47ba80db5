"""Wrappers of policies: which stacking fits which spaces, and what a stacked policy is shown."""

from typing import Any

import numpy as np
from gymnasium import spaces

from rare_envs.egos.wrappers import (
    FrameStackedPolicy,
    describe_missing_normalisation,
    find_frame_stacking,
)

SMALL = (36, 60)


def test_frames_of_spaces() -> None:
    image, row = spaces.Box(0, 255, (*SMALL, 3), np.uint8), spaces.Box(-5.0, 5.0, (51,))
    first = spaces.Box(0, 255, (6, *SMALL), np.uint8)
    assert find_frame_stacking(image, image) == (1, False)
    assert find_frame_stacking(image, first) == (2, False)
    assert find_frame_stacking(row, spaces.Box(-5.0, 5.0, (102,))) == (2, False)
    both = spaces.Dict({"camera": image, "lidar": row})
    assert find_frame_stacking(both, both) == (1, False)
    assert find_frame_stacking(both, spaces.Dict({"camera": first, "lidar": row})) is None  # not the same number
    assert find_frame_stacking(both, spaces.Dict({"camera": image})) is None
    assert find_frame_stacking(both, image) is None


class Echo:
    """A policy whose action is what it is shown."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        return observation, state


def test_frames_side_by_side_begin_with_zeros_and_along_an_axis_with_copies() -> None:
    one, two = np.array([[1.0], [2.0]]), np.array([[3.0], [4.0]])
    for new_axis, first, second in (
        (False, [[0, 1], [0, 2]], [[1, 3], [0, 4]]),
        (True, [[[1], [1]], [[2], [2]]], [[[1], [3]], [[4], [4]]]),
    ):
        policy = FrameStackedPolicy(Echo(), 2, new_axis)
        shown, state = policy.predict(one)
        np.testing.assert_array_equal(shown, first)
        shown, _ = policy.predict(two, state, episode_start=np.array([False, True]))  # the second row begins anew
        np.testing.assert_array_equal(shown, second)


class Model:
    """What a Stable-Baselines3 model in memory tells of its training."""

    def __init__(self, high: float, statistics: Any = None) -> None:
        self.observation_space = spaces.Box(-high, high, (3,))
        self.get_vec_normalize_env = lambda: statistics


def test_bounds_tell_of_normalised_observations_unless_the_statistics_are_there() -> None:
    given = spaces.Box(-5.0, 5.0, (3,))
    assert "NormalizeObservation" in describe_missing_normalisation(Model(np.inf), given)
    assert describe_missing_normalisation(Model(5.0), given) == ""
    assert describe_missing_normalisation(Model(np.inf, statistics=object()), given) == ""
    assert describe_missing_normalisation(Model(np.inf), spaces.Box(-np.inf, np.inf, (3,))) == ""
