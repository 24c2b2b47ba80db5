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
from rare_envs.measures.registry import CLEARANCE, MEASURES
from rare_envs.measures.terms import find_order
from rare_envs.scenarios import highway
from rare_envs.simulation.compiled.failures import NotCompiled, compiler_failures
from rare_envs.simulation.compiled.highway.dense_driver import DenseDriver, OffersDenseDriver, read_dense_driver

if TYPE_CHECKING:
    from rare_envs.simulation.compiled.highway.traffic_rollouts import Found, TrafficRows
    from rare_envs.simulation.world import World

DRIVERS_AT_ONCE, EGOS_AT_ONCE = 128, 32
"""Drivers and egos that are computed side by side: those of 25 highways."""
NO_TERMS, DISTANCES, BEAM_TIMES, LEAD_TIMES = range(4)
"""Terms that compiled rollouts can tell apart."""
ORDERS: dict[int, Any] = {DISTANCES: CLEARANCE, BEAM_TIMES: MEASURES["lidar_ttc"], LEAD_TIMES: MEASURES["ttc"]}
"""The measures whose terms they are."""


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
        """Return f of scenarios x (B, d) within the physical box.

        Raises:
            NotCompiled: A driver has been changed, and is no longer one that is compiled.
            CompilerFails: numba does not work in this process.
        """
        return self._drive(x, NO_TERMS).f

    def terms(self, x: NDArray[np.float64], gamma: float) -> RolloutTerms:
        """Return f and terms of scenarios x (B, d) for a threshold of f; raises what a call raises."""
        measurement = self.world.measurement
        order, _ = find_order(measurement.episode_measure, measurement.collisions, gamma)
        return self._drive(x, next(kind for kind, each in ORDERS.items() if each is order))

    def _drive(self, x: NDArray[np.float64], kind: int) -> RolloutTerms:
        drivers, idm = self.drivers(), self.ego if isinstance(self.ego, IDM) else None
        ego = drivers if isinstance(self.ego, IDM) else self.ego()
        with compiler_failures():
            from rare_envs.simulation.compiled.compilation import single
            from rare_envs.simulation.compiled.equations import IDMNumbers
            from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers
            from rare_envs.simulation.compiled.highway.driver_lanes import DriverBuffers, DriverNumbers
            from rare_envs.simulation.compiled.highway.traffic_rollouts import Rules, drive_among_learned

            world, clock = self.world, self.world.clock
            (tick,) = single(clock.dt)
            by_lidar = world.measurement.episode_measure is MEASURES["lidar_ttc"]
            found = self._found(len(x), kind)
            drive_among_learned(
                self._begin(x),
                DriverNumbers.of(drivers),
                DriverBuffers.of(drivers, DRIVERS_AT_ONCE),
                DriverNumbers.of(ego),
                DriverBuffers.of(ego, EGOS_AT_ONCE),
                IDMNumbers.of(idm or IDM()),
                CurvedRoadNumbers.of(world.scenario.road),
                Rules(idm is None, by_lidar, kind, self._cut(kind) * clock.ticks, tick, clock.ticks),
                found,
            )
        return RolloutTerms(*found)

    def _begin(self, x: NDArray[np.float64]) -> TrafficRows:
        """Return the traffic of scenarios at time 0."""
        from rare_envs.simulation.compiled.highway.traffic_rollouts import TrafficRows

        state, background = self.world.start_traffic(torch.from_numpy(np.ascontiguousarray(x)).float())
        assert background is not None
        fields = (state.x, state.y, state.heading, state.speed, background.weights, background.draws, background.memory)
        return TrafficRows(*(field.numpy().copy(order="C") for field in fields))

    def _found(self, rows: int, kind: int) -> Found:
        """Return arrays for what is found."""
        from rare_envs.simulation.compiled.highway.traffic_rollouts import Found

        others = self.world.scenario.vehicles - 1
        count = {NO_TERMS: 0, DISTANCES: others, BEAM_TIMES: 2 * others, LEAD_TIMES: others + 1}[kind]
        parts = 1 if self._cut(kind) == np.inf else 2
        values = np.full((rows, parts * count), np.inf, dtype=np.float32)
        if parts > 1:
            values[:, count:] = ORDERS[kind].terms.unattained
        return Found(np.empty(rows, dtype=np.float32), values, np.zeros(values.shape, dtype=np.int64))

    def _cut(self, kind: int) -> float:
        """Return the share of the horizon beyond which a term counts as a late one; infinite without such."""
        cuts = () if kind == NO_TERMS else ORDERS[kind].terms.cuts
        return float(cuts[0]) if cuts else np.inf


def find_highway_rollout(world: World, ego: Any) -> HighwayRollout:
    """Return the compiled rollout of a world of learned drivers and its ego.

    Args:
        world: The world.
        ego: An `IDM`, or what reads a `DenseDriver`.

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
    if not isinstance(ego, IDM) and not isinstance(ego(), DenseDriver):
        raise NotCompiled("a policy among learned drivers is not compiled")
    return HighwayRollout(world, read, ego)


def _find_obstacle(world: World) -> str:
    """Return why the torch simulation is needed, whoever drives; empty if it is not."""
    scenario, measurement = world.scenario, world.measurement
    obstacles = {
        f"the scenario {scenario.name!r} with drivers is not compiled": scenario.driven is not highway.driven
        or scenario.road != highway.HIGHWAY.road,
        f"the measure {measurement.measure!r} is not compiled": all(
            measurement.episode_measure is not MEASURES[name] for name in ("ttc", "lidar_ttc")
        ),
        "statistics of episodes are not compiled": measurement.statistics,
        "collisions of other vehicles are not compiled": measurement.collisions != "ego",
        "parameters of the weather are not compiled": bool(world.columns.weather or world.columns.camera_noise),
    }
    return next((words for words, found in obstacles.items() if found), "")
