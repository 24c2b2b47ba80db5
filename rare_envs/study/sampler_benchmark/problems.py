"""Problems of the benchmark: those of `samplers.benchmark`, and scenarios whose collisions were counted."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from samplers.benchmark import PROBLEMS, BenchmarkProblem, LimitState


class CountedCollisions(NamedTuple):
    """Collisions of the IDM ego in plain draws from a base distribution.

    Example:
        >>> counted = COUNTED_COLLISIONS["cut_in_us101_d6"]
        >>> f"{counted.collisions / counted.rollouts:.2e}"
        '7.83e-04'
    """

    env_id: str
    base: str
    collisions: int
    rollouts: int


COUNTED_COLLISIONS = {
    "following_us101_d3": CountedCollisions("rare_envs/CarFollowing-v0", "us101-gap", 2459, 20_000_000),
    "following_highway_d3": CountedCollisions("rare_envs/CarFollowing-v0", "highway", 5045, 20_000_000),
    "cut_in_us101_d6": CountedCollisions("rare_envs/CutIn-v0", "us101-15-offsets", 15_667, 20_000_000),
    "cut_in_highway_d6": CountedCollisions("rare_envs/CutIn-v0", "highway", 6062, 20_000_000),
}
"""Counted once, and fixed with the version of the benchmark; `benchmarks/results/truth.json` counts more rollouts."""


def make_driving_state(counted: CountedCollisions) -> LimitState:
    """Return a scenario as a limit state in standard normal space."""
    from rare_envs.problem import DrivingProblem  # here: the other problems need no torch

    problem = DrivingProblem(counted.env_id, base=counted.base)
    p = counted.collisions / counted.rollouts
    error = (p * (1 - p) / counted.rollouts) ** 0.5
    return LimitState(lambda u: problem.evaluate(problem.base.from_standard_normal(u)), problem.dim, p, error)


DRIVING_GROUP = "driving"
"""Name of the set that needs the extra `driving`."""
ALL_PROBLEMS: dict[str, BenchmarkProblem] = {
    **PROBLEMS,
    **{
        name: BenchmarkProblem(
            partial(make_driving_state, counted),
            DRIVING_GROUP,
            "plain rollouts (python -m benchmarks.estimators.truth)",
            counted.rollouts,
            "20,000 rollouts of other draws",
        )
        for name, counted in COUNTED_COLLISIONS.items()
    },
}
GROUPS = tuple(dict.fromkeys(problem.group for problem in ALL_PROBLEMS.values()))
"""Names of the sets of problems."""
