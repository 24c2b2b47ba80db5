"""The judge of ordinary traffic, and what it says of drivers by rule, of flawed ones and of the shipped egos."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

import agents
import rare_envs
from benchmarks.driving.ordinary_traffic import FLOOR_HEADWAY, VERDICT_NAMES, judge
from rare_envs.control.idm import IDM


@dataclass(frozen=True)
class Flawed:
    """IDM with lane keeping, and something wrong with its actions."""

    steering: float | None = None
    brakes: bool = True
    acceleration: float | None = None

    def act(self, episode: Any, memory: Any) -> tuple[torch.Tensor, Any]:
        action, memory = IDM().act(episode, memory)
        acceleration, steering = action.unbind(1)
        if self.acceleration is not None:
            acceleration = torch.full_like(acceleration, self.acceleration)
        if self.steering is not None:
            steering = torch.full_like(steering, self.steering)
        if not self.brakes:
            acceleration = acceleration.clamp(min=0.0)
        return torch.stack((acceleration, steering), 1), memory


def reasons(found: Any) -> Counter[str]:
    return Counter(VERDICT_NAMES[k] for k in found.reason.tolist())


@pytest.mark.parametrize("case", [*(pytest.param(c, marks=pytest.mark.slow) for c in ("straight", "i80")), "bends"])
def test_a_driver_by_rule_is_nominal(case: str) -> None:
    found = judge(agents.load_ego("idm"), case, rollouts=6, seed=3, seconds=20.0)
    assert reasons(found) == {"passed": 6}
    assert found.headway.min() > FLOOR_HEADWAY and found.margin.min() > 0.4


@pytest.mark.parametrize("reason", ["left its lane", "too close", "left behind"])
def test_a_flawed_driver_is_caught_and_the_reason_is_told(reason: str) -> None:
    flaws: dict[str, Any] = {"left its lane": {"steering": 0.005}, "too close": {"brakes": False}}
    ego = Flawed(**flaws.get(reason, {"acceleration": -1.0}))
    found = reasons(judge(ego, "straight", rollouts=16, seed=1, seconds=30.0))
    assert found.keys() <= {reason, "passed"} and found["passed"] < 8  # some leads only ever drive away


def test_it_brakes_for_those_who_cut_in() -> None:
    """The driver of the traffic, which never met encounters, collides in one of seven."""
    collided = {}
    for name in ("imitation", "mgail?rules=0"):
        problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=agents.load_ego(name))
        collided[name] = (problem.evaluate(problem.base.sample(256, np.random.default_rng(2026))) < 0.0).mean()
    assert collided["imitation"] == 0.0 < 0.1 < collided["mgail?rules=0"]


@pytest.mark.parametrize(
    ("name", "case", "seconds"),
    [
        ("imitation", "straight", 20.0),
        ("vision", "bends", 4.0),
        pytest.param("vision", "i80", 60.0, marks=pytest.mark.slow),
    ],
)
def test_shipped_egos_keep_lane_and_distance(name: str, case: str, seconds: float) -> None:
    rollouts = 4 if seconds < 10.0 else 16
    found = judge(agents.load_ego(name), case, rollouts=rollouts, seed=2026, seconds=seconds)
    assert reasons(found)["passed"] >= rollouts - (rollouts > 4)
    assert found.margin.min() > 0.3
