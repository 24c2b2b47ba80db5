"""Probe: an ego in its environment with observations to query it with, for the checks of `check-ego`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from rare_envs.arrays import AnyArray
from rare_envs.egos.policy import PolicyDriver
from rare_envs.problem import DrivingProblem
from rare_envs.sensors.kinds import batch_size, map_kinds
from rare_envs.simulation.observation import observe
from rare_envs.simulation.rollout import drive

BATCH_ROWS = 32
"""Observations in a query."""


@dataclass(frozen=True)
class Probe:
    """An ego in its environment, and observations to query it with."""

    ego: Any
    problem: DrivingProblem
    seen: Any
    """Observations of ordinary scenarios at time 0, shape (ROWS, ...), or several of that kind by name."""

    @classmethod
    def of(cls, ego: Any, problem: DrivingProblem) -> Probe:
        """Return a probe with observations of ordinary scenarios at time 0."""
        x = problem.base.sample(BATCH_ROWS, np.random.default_rng(0))
        with torch.inference_mode():
            start = next(drive(problem.world, problem.driver, torch.from_numpy(x).float()))
            seen = map_kinds(torch.Tensor.numpy, observe(start, problem.world.sensing.observation))
        return cls(ego, problem, seen)

    @property
    def space(self) -> spaces.Space[Any]:
        """Space of the environment's observations."""
        return self.problem.world.observation_space

    def transform_seen(self, change: Callable[[AnyArray], Any]) -> Any:
        """Return the observations after a function, each of its own type."""
        return map_kinds(lambda part: np.asarray(change(part)).astype(part.dtype), self.seen)

    def repeat_seen(self, size: int) -> Any:
        """Return as many observations as `size`, repeating those that there are."""
        return self.transform_seen(lambda part: np.resize(part, (size, *part.shape[1:])))

    @property
    def policy(self) -> Any:
        """Policy of the ego with the wrappers of its training; None if the ego is a driver."""
        return self.problem.driver.policy if isinstance(self.problem.driver, PolicyDriver) else None

    def query(self, observation: Any, state: Any = None, start: Any = None) -> tuple[AnyArray, Any]:
        """Return the actions as numbers, and the memory."""
        begun = np.full(batch_size(observation), state is None) if start is None else start
        action, state = self.policy.predict(
            map_kinds(np.copy, observation), state=state, episode_start=begun, deterministic=True
        )
        return np.asarray(action), state


def largest_difference(one: AnyArray, other: AnyArray) -> float:
    """Return the largest difference of actions; infinite where shapes or NaN differ."""
    if one.shape != other.shape:
        return np.inf
    apart = np.abs(one.astype(float) - other.astype(float))
    apart[np.isnan(one.astype(float)) & np.isnan(other.astype(float))] = 0.0
    return float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0))
