"""Checks of the interface: declared spaces, actions, and observations at their bounds."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

import rare_envs
from rare_envs.study.ego_check.checks import (
    Probe,
    check_declared_spaces,
)


class Ego:
    """Acts by the first two observed numbers, times `scale`."""

    observation_space: Any = None
    action_space: Any = None
    scale = 1.0

    def predict(
        self, observation: NDArray[Any], state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        return np.clip(observation[:, :2], -1.0, 1.0) * self.scale, state


def probe_of(**attributes: Any) -> Probe:
    ego = Ego()
    for name, value in attributes.items():
        setattr(ego, name, value)
    return Probe.of(ego, rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego, horizon=1.0))


def test_missing_spaces_are_told() -> None:
    (finding,) = check_declared_spaces(probe_of())
    assert finding.status == "warn"
    assert finding.found == "it has no observation_space and action_space"


@pytest.mark.filterwarnings("ignore:.*are mapped to")
@pytest.mark.parametrize(("high", "status"), [(1.0, "pass"), (3.0, "warn"), (np.inf, "pass")])
def test_a_range_of_actions_that_is_not_the_environments_is_told(high: float, status: str) -> None:
    probe = probe_of(action_space=spaces.Box(-high, high, (2,)))
    (finding,) = (each for each in check_declared_spaces(probe) if each.check == "action space")
    assert finding.status == status
