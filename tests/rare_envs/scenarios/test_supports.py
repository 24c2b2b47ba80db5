"""Whatever the flagship asks a scenario for is a scenario: its wide draws stay within the parameters' supports."""

import numpy as np
import pytest
from numpy.typing import NDArray

import rare_envs
import samplers
from rare_envs.scenarios.registry import SCENARIOS

FAR = [("rare_envs/CarFollowing-v0", base) for base in ("us101", "us101-log-gap", "i80-all-pairs", "i24")]
"""Bases of car-following with collisions so rare, 1e-5 to 1e-11, that 1,200 simulations may find none."""
CASES = [
    pytest.param(env_id, base, marks=[] if base == each.default_base and env_id.endswith("v0") else pytest.mark.slow)
    for env_id, each in SCENARIOS.items()
    if each.drivers is None
    for base in each.bases
]


class Recording:
    """A driving problem that keeps every x that it is asked for."""

    def __init__(self, problem: rare_envs.DrivingProblem) -> None:
        self.problem = problem
        self.dim, self.base = problem.dim, problem.base
        self.asked: list[NDArray[np.float64]] = []

    def evaluate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        self.asked.append(x.copy())
        return self.problem.evaluate(x)


@pytest.mark.parametrize(("env_id", "base"), CASES)
def test_two_stage_asks_for_scenarios_only(env_id: str, base: str) -> None:
    recording = Recording(rare_envs.DrivingProblem(env_id, base=base))
    result = samplers.estimate(recording, samplers.TwoStage(), seed=0, max_sim=1200, ensemble_run=False)
    x, space = np.concatenate(recording.asked), recording.problem.space
    assert len(x) == result.n_sim
    assert result.p > 0 or (env_id, base) in FAR
    space.validate(x)  # raises where a value is not finite or out of the parameter's range
    assert np.isfinite(space.log_prob(x)).all()  # so no weight is 0 for want of support
    u = space.to_standard_normal(x)
    assert np.linalg.norm(u, axis=1).max() > 3 * np.sqrt(space.dim)  # some draws were wide indeed


@pytest.mark.parametrize(("env_id", "base"), CASES)
def test_points_far_out_are_scenarios_too(env_id: str, base: str) -> None:
    """Three times as wide as traffic and more, in every direction."""
    space = rare_envs.DrivingProblem(env_id, base=base).space
    u = np.random.default_rng(0).standard_normal((400, space.dim))
    for width in (1.5, 3.0, 8.0):
        space.validate(space.from_standard_normal(width * u))
