"""Highway rollouts: a world of learned drivers as compiled rollouts take it, and what they find."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.idm import IDM
from rare_envs.scenarios import highway
from rare_envs.simulation.compiled.failures import NotCompiled, compiler_failures
from rare_envs.simulation.compiled.highway.dense_driver import DenseDriver, OffersDenseDriver, read_dense_driver
from rare_envs.simulation.compiled.highway.measure_kinds import (
    NO_TERMS,
    ORDERS,
    count_terms,
    find_cut,
    find_measure_kind,
    find_term_kind,
)

if TYPE_CHECKING:
    from rare_envs.simulation.compiled.highway.traffic_slots import Found, Rules, TrafficRows
    from rare_envs.simulation.world import World

DRIVERS_AT_ONCE = 128
"""Drivers around the egos that are computed side by side: those of 25 highways."""
NOISE_MEMORY = 4
"""Numbers that a driver keeps of its noise; those of lane changes stand behind them."""


class RolloutTerms(NamedTuple):
    """f of B rollouts and their J terms; see `rare_envs.terms.episode_terms.EpisodeTerms`.

    Example:
        >>> RolloutTerms._fields
        ('f', 'values', 'ticks')
    """

    f: NDArray[np.float32]
    """Shape (B,)."""
    values: NDArray[np.float32]
    """Shape (B, J)."""
    ticks: NDArray[np.int64]
    """Shape (B, J)."""


@dataclass(frozen=True)
class HighwayRollout:
    """The rollouts of a world of learned drivers and its ego, compiled: called with x (B, d), it returns f (B,).

    It keeps no compiled code, so that it can be sent to other processes.

    Example:
        >>> import rare_envs
        >>> problem = rare_envs.DrivingProblem("rare_envs/Highway-v0", core="torch")
        >>> rollout = find_highway_rollout(problem.world, problem.driver)
        >>> x = problem.base.sample(3, np.random.default_rng(0))
        >>> np.abs(rollout(x) - problem.evaluate(x)).max() < 1e-4
        np.True_
    """

    world: World
    drivers: Callable[[], DenseDriver]
    """Reads the drivers of the traffic, with their present weights."""
    ego: IDM | Callable[[], Any]
    """The ego, or what reads it."""

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return f of scenarios x (B, d) within the physical box; NaN where a policy's outputs are not finite.

        Raises:
            NotCompiled: A driver has been changed, and is no longer one that is compiled.
            CompilerFails: numba does not work in this process.
        """
        return self._drive(x, NO_TERMS).f

    def terms(self, x: NDArray[np.float64], gamma: float) -> RolloutTerms:
        """Return f and terms of scenarios x (B, d) for a threshold of f; raises what a call raises."""
        return self._drive(x, find_term_kind(self.world.measurement, gamma))

    def _drive(self, x: NDArray[np.float64], kind: int) -> RolloutTerms:
        drivers, ego = self.drivers(), self.ego if isinstance(self.ego, IDM) else self.ego()
        with compiler_failures():
            from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers
            from rare_envs.simulation.compiled.highway.driver_lanes import DriverBuffers, DriverNumbers
            from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import TrafficRules
            from rare_envs.simulation.compiled.highway.ego_lanes import EGOS_AT_ONCE, EgoNumbers
            from rare_envs.simulation.compiled.highway.traffic_rollouts import drive_among_learned
            from rare_envs.simulation.compiled.highway.traffic_slots import Sight, Slots

            vehicles = self.world.scenario.vehicles
            found = self._found(len(x), kind)
            drive_among_learned(
                self._begin(x),
                Slots.of(min(DRIVERS_AT_ONCE // (vehicles - 1), EGOS_AT_ONCE), vehicles),
                Sight.of(vehicles),
                DriverNumbers.of(drivers),
                DriverBuffers.of(drivers, DRIVERS_AT_ONCE),
                EgoNumbers.of(ego, drivers),
                CurvedRoadNumbers.of(self.world.scenario.road),
                self._rules(kind),
                found,
                TrafficRules.of(drivers, ego),
            )
        return RolloutTerms(*found)

    def _rules(self, kind: int) -> Rules:
        """Return what is simulated and measured, with one of the kinds of terms."""
        from rare_envs.compilation import single
        from rare_envs.simulation.compiled.highway.traffic_slots import Rules

        clock, measurement = self.world.clock, self.world.measurement
        measure = find_measure_kind(measurement)
        assert measure is not None
        (tick,) = single(clock.dt)
        return Rules(measure, measurement.collisions == "any", kind, find_cut(kind) * clock.ticks, tick, clock.ticks)

    def _begin(self, x: NDArray[np.float64]) -> TrafficRows:
        """Return the traffic of scenarios at time 0."""
        from rare_envs.simulation.compiled.highway.traffic_slots import TrafficRows

        state, background = self.world.start_traffic(torch.from_numpy(np.ascontiguousarray(x)).float())
        assert background is not None
        memory = background.memory.flatten(2)
        noise, minds = memory[..., :NOISE_MEMORY].reshape(*memory.shape[:2], 2, 2), memory[..., NOISE_MEMORY:]
        fields = (state.x, state.y, state.heading, state.speed, background.weights, background.draws, noise, minds)
        return TrafficRows(*(field.numpy().copy(order="C") for field in fields))

    def _found(self, rows: int, kind: int) -> Found:
        """Return arrays for what is found."""
        from rare_envs.simulation.compiled.highway.traffic_slots import Found

        count = count_terms(kind, self.world.scenario.vehicles)
        parts = 1 if find_cut(kind) == np.inf else 2
        values = np.full((rows, parts * count), np.inf, dtype=np.float32)
        if parts > 1:
            values[:, count:] = ORDERS[kind].terms.unattained
        return Found(np.empty(rows, dtype=np.float32), values, np.zeros(values.shape, dtype=np.int64))


def find_highway_rollout(world: World, ego: Any) -> HighwayRollout:
    """Return the compiled rollout of a world of learned drivers and its ego.

    Args:
        world: The world.
        ego: An `IDM`, or what reads a `DenseDriver`, or a `DensePolicy` that observes as `World.sensing` says.

    Raises:
        NotCompiled: There is none.

    Example:
        >>> from agents import load_driver
        >>> from rare_envs.simulation import World
        >>> find_highway_rollout(World(highway.HIGHWAY, background=load_driver("mgail")), IDM()).ego == IDM()
        True
    """
    background: Any = world.background
    obstacle = _find_obstacle(world)
    if obstacle:
        raise NotCompiled(obstacle)
    if not isinstance(background, OffersDenseDriver):
        raise NotCompiled(f"the drivers, a {type(background).__name__}, are not compiled")
    read = partial(read_dense_driver, background)
    read()
    if not isinstance(ego, IDM):
        ego()
    return HighwayRollout(world, read, ego)


def _find_obstacle(world: World) -> str:
    """Return why the torch simulation is needed, whoever drives; empty if it is not."""
    scenario, measurement = world.scenario, world.measurement
    obstacles = {
        f"the scenario {scenario.name!r} with drivers is not compiled": scenario.driven is not highway.driven
        or scenario.road != highway.HIGHWAY.road,
        f"the measure {measurement.measure!r} is not compiled": find_measure_kind(measurement) is None,
        "statistics of episodes are not compiled": measurement.statistics,
        "parameters of the weather are not compiled": bool(world.columns.weather or world.columns.camera_noise),
    }
    return next((words for words, found in obstacles.items() if found), "")
