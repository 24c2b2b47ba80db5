"""The judge of ordinary driving finds good egos good and bad ones bad, and says why."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

import agents
from rare_envs.control.idm import IDM
from training.egos.nominal_driving import VERDICT_NAMES, judge, summarise_verdicts
from training.egos.nominal_traffic import CASES, FLOOR_HEADWAY, OrdinaryDrivers, draw_starts


@dataclass(frozen=True)
class Flawed:
    """IDM with lane keeping, and something wrong with its actions."""

    steering: float | None = None
    """In place of its own [rad]."""
    brakes: bool = True
    acceleration: float | None = None
    """In place of its own [m/s^2]."""

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


def reasons(found: Any) -> set[str]:
    return {VERDICT_NAMES[k] for k in found.reason.tolist()}


@pytest.mark.parametrize("case", ["straight", "i80", "bends"])
def test_a_driver_by_rule_is_nominal(case: str) -> None:
    found = summarise_verdicts(judge("idm", case, rollouts=24, seed=3, seconds=30.0))
    assert found.passed == found.judged == 24
    assert found.headway > FLOOR_HEADWAY
    assert found.margin > 0.4


@pytest.mark.parametrize(
    ("ego", "reason"),
    [
        (Flawed(steering=0.005), "left its lane"),
        (Flawed(brakes=False), "too close"),
        (Flawed(acceleration=-1.0), "left behind"),
    ],
)
def test_a_flawed_driver_is_caught_and_the_reason_is_told(ego: Any, reason: str) -> None:
    found = judge(ego, "straight", rollouts=16, seed=1, seconds=30.0)
    assert reasons(found) <= {reason, "passed"}
    assert (found.reason == 0).mean() < 0.5  # some leads only ever drive away


def test_who_is_run_into_from_behind_is_not_to_blame() -> None:
    """The follower of this world does not brake, and the ego does."""

    @dataclass(frozen=True)
    class Careless(OrdinaryDrivers):
        def act(self, features: Any, weights: Any, innovations: Any, memory: Any) -> Any:
            action, memory = super().act(features, weights, innovations, memory)
            return torch.zeros_like(action), memory

    case = replace(CASES["straight"], drivers=Careless)
    found = judge(Flawed(acceleration=-1.0), case, rollouts=8, seed=0, seconds=20.0)
    assert reasons(found) == {"hit by others"}
    assert summarise_verdicts(found).judged == 0


def test_who_runs_into_its_lead_is_to_blame() -> None:
    """Who starts too close has some time to open the distance, but not to run into a lead that stops at once."""

    @dataclass(frozen=True)
    class Blocked(OrdinaryDrivers):
        def act(self, features: Any, weights: Any, innovations: Any, memory: Any) -> Any:
            action, memory = super().act(features, weights, innovations, memory)
            return torch.full_like(action, -1e4), memory

    def near(n: int, rng: np.random.Generator) -> Any:
        x = draw_starts(n, rng)
        x[:, 0], x[:, 2] = 20.0, 6.0
        return x

    case = replace(CASES["straight"], drivers=Blocked, starts=near)
    assert reasons(judge(Flawed(acceleration=0.0), case, rollouts=4, seconds=5.0)) == {"collided"}


def test_the_judge_repeats_itself_and_tiles_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    ego = agents.load_ego("noisy:idm")  # with noise of its own in x
    one = judge(ego, "i80", rollouts=6, seed=5, seconds=5.0)
    monkeypatch.setattr("training.egos.nominal_driving.DRIVE_BATCH", 4)
    other = judge(ego, "i80", rollouts=6, seed=5, seconds=5.0)
    assert (one.reason == other.reason).all()
    np.testing.assert_allclose(one.margin, other.margin, atol=1e-5)


def test_an_ego_that_predicts_is_asked_for_what_it_observes() -> None:
    class Seen:
        shape: tuple[int, ...] = ()

        def predict(self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True):
            self.shape = observation.shape
            return np.zeros((len(observation), 2)), None

    ego = Seen()
    judge(ego, "straight", rollouts=2, seconds=1.0, observation="camera")
    assert ego.shape == (2, 66, 200, 3)


def test_an_unknown_case_is_refused() -> None:
    with pytest.raises(ValueError, match="did you mean 'straight'"):
        judge("idm", "straightt")
