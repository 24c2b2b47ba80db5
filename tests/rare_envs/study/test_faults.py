"""Scenarios on which an ego raises, stops, or gives NaN or a wrong shape are found, and no others lost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rare_envs
import samplers
from rare_envs.plugins import EgoGone
from samplers.evaluate import Evaluator

ENV = "rare_envs/CarFollowing-v0"
GAP = 30.0
"""Starts in front of less than this are those on which the egos below fail."""


class Coasting:
    """Fails where a scenario begins with a short gap, however the batch is made up."""

    def __init__(self, fail: Any = None, memory: bool = False) -> None:
        self.fail = fail
        self.memory = memory

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        actions = np.zeros((len(observation), 2), np.float32)
        short = (observation[:, 3] * 50.0 < GAP) & bool(episode_start[0])
        return (self.fail(actions, short) if self.fail and short.any() else actions), (1 if self.memory else None)


def raises(actions: Any, short: Any) -> Any:
    raise RuntimeError("no\nroad")


def stops(actions: Any, short: Any) -> Any:
    raise SystemExit(7)


def gives_nan(actions: Any, short: Any) -> Any:
    actions[short] = np.nan
    return actions


FAILING = {
    "raises": (raises, "RuntimeError: no road"),
    "ends the program": (stops, "SystemExit(7)"),
    "gives NaN": (gives_nan, "NaN or infinite actions"),
    "gives infinity": (lambda actions, short: np.where(short[:, None], np.inf, actions), "NaN or infinite actions"),
    "gives the wrong shape": (lambda actions, short: actions[:, :1], "Expected actions of shape"),
    "gives too few actions": (lambda actions, short: actions[~short], "Expected actions of shape"),
    "gives words": (lambda actions, short: np.full(actions.shape, "left"), "Expected actions as numbers"),
    "gives nothing": (lambda actions, short: None, "Expected actions as numbers"),
}


@pytest.fixture(scope="module")
def x() -> np.ndarray:
    points = rare_envs.DrivingProblem(ENV).base.sample(60, np.random.default_rng(3))
    points[:, 2] = np.where(np.arange(60) % 13 == 4, 25.0, 60.0 + np.arange(60) / 2)
    return points


def tolerate(problem: Any) -> Evaluator:
    return Evaluator(problem, on_error="failure")


def problem(ego: Any) -> rare_envs.DrivingProblem:
    return rare_envs.DrivingProblem(ENV, ego=ego, horizon=1.0)


@pytest.mark.parametrize(("how", "memory"), [*((how, False) for how in FAILING), ("raises", True)])
def test_only_scenarios_on_which_the_ego_fails_are_lost(how: str, memory: bool, x: np.ndarray) -> None:
    fail, reason = FAILING[how]
    tolerant = tolerate(problem(Coasting(fail, memory)))
    f = tolerant.evaluate(x)
    bad = x[:, 2] < GAP
    np.testing.assert_array_equal(np.isnan(f), bad)
    np.testing.assert_array_equal(f[~bad], problem(Coasting()).evaluate(x)[~bad])
    np.testing.assert_array_equal([fault.x for fault in tolerant.faults], x[bad])
    assert tolerant.n_retried < (5 if memory else 2) * len(x)
    assert all(reason in fault.reason and "\n" not in fault.reason for fault in tolerant.faults)


def test_nobody_is_asked_again_once_the_ego_is_gone(x: np.ndarray) -> None:
    calls = []

    def gone(actions: Any, short: Any) -> Any:
        calls.append(1)
        raise EgoGone("not there")

    with pytest.raises(EgoGone):
        tolerate(problem(Coasting(gone))).evaluate(x)
    assert len(calls) == 1
    with pytest.raises(EgoGone, match="not there"):
        samplers.estimate(problem(Coasting(gone)), "mc", gamma=3.0, max_sim=300, seed=0, on_error="bound")
    assert len(calls) == 2


@pytest.mark.parametrize(("how", "memory"), [("raises", True), ("gives NaN", False)])
def test_terms_of_the_same_scenarios_are_lost_and_no_others(how: str, memory: bool, x: np.ndarray) -> None:
    fail, reason = FAILING[how]
    tolerant, bad = tolerate(problem(Coasting(fail, memory))), x[:, 2] < GAP
    found, expected = tolerant.terms(x), problem(Coasting()).terms(x)
    np.testing.assert_array_equal(found.f, np.where(bad, np.nan, expected.f))
    np.testing.assert_array_equal(found.values, np.where(bad[:, None], np.nan, expected.values))
    np.testing.assert_array_equal(found.ticks[~bad], expected.ticks[~bad])
    assert (found.threshold, found.names) == (expected.threshold, expected.names)
    np.testing.assert_array_equal([fault.x for fault in tolerant.faults], x[bad])
    assert all(reason in fault.reason for fault in tolerant.faults)
    assert 0 < tolerant.n_retried < (5 if memory else 2) * len(x)
