"""Queries of a policy: failing rows, memories, and a connection that was lost."""

from typing import Any

import numpy as np
import pytest
import torch

from rare_envs.control.actions import IDLE
from rare_envs.egos.errors import EgoGone, NoAnswer
from rare_envs.egos.policy import PolicyQuery, query_policy


class Picky:
    """A policy that accelerates as it observes, and fails on negative observations."""

    def __init__(self, error: BaseException | None = None, memory: Any = None, times: int = 10**9) -> None:
        self.error, self.memory, self.times = error, memory, times
        self.sizes: list[int] = []

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        assert deterministic
        self.sizes.append(len(observation))
        if self.error is not None and (observation < 0.0).any() and self.times:
            self.times -= 1
            raise self.error
        return np.concatenate((observation, 0.0 * observation), axis=1), self.memory


def query(values: list[float], hidden: Any = None, over: tuple[int, ...] = ()) -> PolicyQuery:
    n = len(values)
    rows = torch.tensor([row in over for row in range(n)])
    return PolicyQuery(np.array(values)[:, None], hidden, np.full(n, hidden is None), rows)


def test_actions_are_scaled_and_those_that_do_not_matter_are_0() -> None:
    action, hidden = query_policy(Picky(memory="kept"), "continuous", query([0.5, 1.0], over=(1,)))
    torch.testing.assert_close(action, torch.tensor([[2.5, 0.0], [0.0, 0.0]]))
    assert hidden == "kept"


def test_failing_rows_get_a_reason_and_no_action() -> None:
    failed: dict[int, str] = {}
    policy = Picky(RuntimeError("no road"))
    action, _ = query_policy(policy, "continuous", query([0.2, -1.0, 0.4, 0.6]), failed)
    torch.testing.assert_close(action[:, 0], torch.tensor([1.0, 0.0, 2.0, 3.0]))
    assert failed == {1: "RuntimeError: no road"}
    assert policy.sizes == [4, 2, 1, 1, 2]


def test_actions_that_are_not_finite_cost_their_row_alone() -> None:
    failed: dict[int, str] = {}
    policy = Picky()
    action, _ = query_policy(policy, "continuous", query([np.nan, 0.4, np.nan], over=(2,)), failed)
    torch.testing.assert_close(action[:, 0], torch.tensor([0.0, 2.0, 0.0]))
    assert failed == {0: "NaN or infinite actions"}
    assert policy.sizes == [3]


def test_without_a_place_for_failed_rows_an_error_is_raised() -> None:
    with pytest.raises(RuntimeError, match="no road"):
        query_policy(Picky(RuntimeError("no road")), "continuous", query([-1.0, 0.0]))
    with pytest.raises(ValueError, match="NaN or infinite actions for 1 of 2"):
        query_policy(Picky(), "continuous", query([np.nan, 0.0]))


def test_who_does_not_answer_is_queried_once_more() -> None:
    action, _ = query_policy(Picky(NoAnswer("lost"), times=1), "continuous", query([-0.2]))
    assert float(action[0, 0]) == pytest.approx(-1.0)
    with pytest.raises(NoAnswer):
        query_policy(Picky(NoAnswer("lost"), times=2), "continuous", query([-0.2]))


@pytest.mark.parametrize("hidden", [None, "kept"])
def test_a_batch_of_a_policy_with_a_memory_is_not_split(hidden: Any) -> None:
    failed: dict[int, str] = {}
    with pytest.raises(RuntimeError, match="no road"):
        query_policy(Picky(RuntimeError("no road"), memory="kept"), "continuous", query([0.1, -1.0], hidden), failed)
    assert failed == {}


def test_an_ego_that_is_gone_is_gone() -> None:
    with pytest.raises(EgoGone):
        query_policy(Picky(EgoGone("not there")), "continuous", query([-1.0, 0.0]), {})


def test_a_failed_row_idles_where_actions_are_meta() -> None:
    class Meta:
        def predict(self, observation: Any, **_: Any) -> Any:
            if (observation < 0.0).any():
                raise RuntimeError("no road")
            return observation[:, 0].astype(int), None

    failed: dict[int, str] = {}
    action, _ = query_policy(Meta(), "meta", query([3.0, -1.0, 4.0]), failed)
    assert action.tolist() == [3, IDLE, 4]
    assert list(failed) == [1]


@pytest.mark.parametrize("answer", ["left", ["left", "left"], [None, None], [{"steering": 0.0}] * 2])
def test_actions_that_are_no_numbers_are_refused(answer: Any) -> None:
    class Wordy:
        def predict(self, observation: Any, **_: Any) -> Any:
            return answer, None

    with pytest.raises(ValueError, match="Expected actions as numbers, one or two for each observation, got"):
        query_policy(Wordy(), "continuous", query([0.1, 0.2]))
