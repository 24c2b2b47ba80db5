"""What care is worth: an ego that keeps its distance is safer in every kind of event, one that never brakes in none."""

from typing import Any

import numpy as np
import pytest

import rare_envs
from agents import load_ego
from samplers.sample import clopper_pearson


class KeepsSpeed:
    """Never brakes nor steers."""

    def predict(self, observation: Any, state: Any = None, **_: Any) -> Any:
        return np.zeros((len(observation), 2), np.float32), state


def find_stratum(base: Any, name: str) -> Any:
    return next(each for each in base.strata if each.name == name)


@pytest.mark.parametrize(
    ("env_id", "name"),
    [("CutIn-v1", "looked"), ("CutIn-v1", "unseen"), ("HardBrake-v0", "stop"), ("HardBrake-v0", "slowing")],
)
def test_a_longer_headway_is_safer_in_every_stratum(env_id: str, name: str) -> None:
    problems = [
        rare_envs.DrivingProblem(env_id, ego=load_ego(f"idm?max_deceleration=2&time_headway={headway}"))
        for headway in (2.0, 0.3)  # weak brakes, so that both fail
    ]
    x = find_stratum(problems[0].base, name).base.sample(20_000, np.random.default_rng(0))
    careful, hasty = (problem.evaluate(x) <= 0.0 for problem in problems)
    gained, lost = int((hasty & ~careful).sum()), int((careful & ~hasty).sum())
    assert gained - lost > 3.0 * (gained + lost) ** 0.5 > 0  # standard deviations, if care changed nothing


@pytest.mark.parametrize(
    ("env_id", "name"), [("CutIn-v1", "looked"), ("HardBrake-v0", "stop"), ("HardBrake-v0", "slowing")]
)
def test_who_keeps_its_speed_collides_ten_thousand_times_per_million_km_in_every_event(env_id: str, name: str) -> None:
    problem = rare_envs.DrivingProblem(env_id, ego=KeepsSpeed())
    base: Any = problem.base
    stratum = find_stratum(base, name)
    hits = int((problem.evaluate(stratum.base.sample(200, np.random.default_rng(0))) <= 0.0).sum())
    least, _ = clopper_pearson(hits, 200, 0.95)
    assert 1e6 * base.frequency.per_km * stratum.share * least > 1e4
