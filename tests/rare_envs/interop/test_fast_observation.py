"""The quick observation is HighwayEnv's, bit for bit."""

from typing import Any

import numpy as np
import pytest

from rare_envs.interop.problem import make_highway_env
from rare_envs.interop.scene import install_fast_observation

FEATURES = ["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "long_off", "cos_d"]
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "highway": ("highway-fast-v0", {"vehicles_count": 8}),
    "one vehicle": ("highway-fast-v0", {"vehicles_count": 1}),
    "behind, unclipped": (
        "highway-fast-v0",
        {"observation": {"type": "Kinematics", "see_behind": True, "clip": False, "vehicles_count": 3}},
    ),
    "shuffled, as it is": (
        "highway-fast-v0",
        {"observation": {"type": "Kinematics", "order": "shuffled", "normalize": False, "features": FEATURES}},
    ),
    "merge, with its obstacle": ("merge-v1", {}),
    "intersection": ("intersection-v2", {"initial_vehicle_count": 5}),
    "roundabout": ("roundabout-v1", {}),
}


@pytest.mark.parametrize("kind", list(KINDS))
def test_same_bits(kind: str) -> None:
    env_id, config = KINDS[kind]
    slow, fast = make_highway_env(env_id, config), make_highway_env(env_id, config)
    install_fast_observation(fast.unwrapped)
    np.testing.assert_array_equal(slow.reset(seed=3)[0], fast.reset(seed=3)[0])
    for action in (1, 0, 2, 1):
        one, other = slow.step(action), fast.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[0].dtype == other[0].dtype
        if one[2] or one[3]:
            break


def test_blind_egos_see_zeros() -> None:
    env = make_highway_env("highway-fast-v0", {"vehicles_count": 2})
    install_fast_observation(env.unwrapped, blind=True)
    observation = env.reset(seed=0)[0]
    assert observation.shape == (5, 5)
    assert not observation.any()
