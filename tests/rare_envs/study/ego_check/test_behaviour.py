"""Each check of behaviour finds the ego that breaks it, and passes one that does not."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rare_envs
from rare_envs.study.ego_check.checks import (
    Probe,
    check_determinism,
    check_driving,
    check_latency,
    check_memory,
    check_row_independence,
)


class Ego:
    """Acts by a function of the observations and of the number of calls so far."""

    observation_space = action_space = None

    def __init__(self, act: Callable[[NDArray[Any], int], NDArray[Any]]) -> None:
        self.act, self.calls = act, 0

    def predict(
        self, observation: NDArray[Any], state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        self.calls += 1
        return self.act(observation, self.calls), state


def probe_of(act: Callable[[NDArray[Any], int], NDArray[Any]]) -> Probe:
    ego = Ego(act)
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego, horizon=1.0)
    return Probe.of(ego, problem)


def brake(observation: NDArray[Any], calls: int) -> NDArray[Any]:
    return np.stack([-np.ones(len(observation)), np.zeros(len(observation))], axis=1)


def depend_on_calls(observation: NDArray[Any], calls: int) -> NDArray[Any]:
    return np.full((len(observation), 2), 0.01 * calls)


def depend_on_rows(observation: NDArray[Any], calls: int) -> NDArray[Any]:
    return np.tile((observation - observation.mean(axis=0))[:, :1], 2)


@pytest.mark.parametrize(
    ("check", "act", "status"),
    [
        (check_determinism, brake, ["pass"]),
        (check_determinism, depend_on_calls, ["warn"]),
        (check_memory, brake, ["pass"]),
        (check_row_independence, brake, ["pass", "pass"]),
        (check_row_independence, depend_on_rows, ["pass", "fail"]),
        (check_driving, brake, ["pass"]),
    ],
)
def test_a_check_finds_what_it_is_for(check: Any, act: Any, status: list[str]) -> None:
    assert [finding.status for finding in check(probe_of(act))] == status


def test_latency_is_told_by_batch_size() -> None:
    (finding,) = check_latency(probe_of(brake))
    assert finding.status == "pass"
    assert [f"for {size}" in finding.found for size in (1, 64, 1024)] == [True, True, True]
