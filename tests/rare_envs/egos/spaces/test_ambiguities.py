"""Actions that can be taken in several ways are noted, others are not."""

import numpy as np
import pytest
from gymnasium import spaces

from rare_envs.egos.needs import AMBIGUOUS, TAKEN_AS_ACCELERATIONS, name_ambiguities


@pytest.mark.parametrize(
    ("space", "kinds", "notes"),
    [
        (None, ("features",), ()),
        (spaces.Box(-1.0, 1.0, (2,)), ("features",), ()),
        (spaces.Discrete(5), ("kinematics",), (AMBIGUOUS,)),
        (spaces.Discrete(5), ("camera", "lidar"), (TAKEN_AS_ACCELERATIONS,)),
    ],
)
def test_only_five_numbers_can_be_two_things(space, kinds, notes):
    assert name_ambiguities(space, kinds) == notes


def test_other_bounds_are_told_as_people_write_them():
    (note,) = name_ambiguities(spaces.Box(np.float32([-0.3, -4.0]), np.float32([0.1, 2.0])), ("features",))
    assert note.startswith("the ego's actions, between [-0.3, -4.0] and [0.1, 2.0], are mapped to [-1, 1]")
