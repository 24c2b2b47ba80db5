"""Background traffic: the drivers of the vehicles around the ego, their state and their noise."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from rare_envs.plugins import check_name
from rare_envs.traffic.bodies import LaneTraffic
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

DRIVERS_GROUP = "rare_envs.drivers"
"""Entry points by which packages offer drivers: name to a function that takes the name and returns a `Background`."""
FIRST_DRAWS = 2
"""Draws of each action with which a coloured noise begins, before those of the ticks."""
FIXED_SEED = 12345
"""Seed of the one sequence of `noise="fixed"`; arbitrary, but results depend on it."""


class _Drivers(Protocol):
    """What all drivers of M vehicles in B scenarios have."""

    @property
    def weights(self) -> Any:
        """Distribution of the weights that tell drivers apart, with their number `dim`; None if all are alike."""

    @property
    def noisy(self) -> bool:
        """Whether they act with noise if they are given draws."""

    def begin(self, draws: Tensor) -> Tensor:
        """Return the memory at the start, (B, M, ...), from standard normal draws of shape (B, M, 2, 2)."""


@runtime_checkable
class Background(_Drivers, Protocol):
    """Drivers of M vehicles in B scenarios, which act by the lidar features of each. Nothing in it is random.

    Example:
        >>> class Coasting:
        ...     weights, noisy = None, False
        ...     def begin(self, draws):
        ...         return draws[..., 0]
        ...     def act(self, features, weights, innovations, memory):
        ...         return features.new_zeros(*features.shape[:2], 2), memory
        >>> isinstance(Coasting(), Background)
        True
    """

    def act(
        self, features: Tensor, weights: Tensor | None, innovations: Tensor | None, memory: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Decide for one tick.

        Args:
            features: `rare_envs.sensors.lidar.FEATURES` of each vehicle, shape (B, M, 51).
            weights: Weights of each scenario, shape (B, `weights.dim`); None for the driver's own.
            innovations: Standard normal draws, shape (B, M, 2); None for mean actions.
            memory: As the last call returned it, at the start `begin`.

        Returns:
            Accelerations [m/s^2] and yaw rates relative to the road [rad/s], shape (B, M, 2), and the new memory.
        """


@runtime_checkable
class TrafficBackground(_Drivers, Protocol):
    """Drivers that act by where everybody is, not by what a lidar shows. Nothing in it is random.

    Example:
        >>> from rare_envs.control.lane_changing import LaneChangingDriver
        >>> isinstance(LaneChangingDriver(), TrafficBackground)
        True
    """

    def decide(self, traffic: LaneTraffic, who: slice, memory: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """Decide for one tick of dt [s].

        Args:
            traffic: All V vehicles of B scenarios.
            who: The M that are driven.
            memory: As the last call returned it, at the start `begin`.
            dt: Tick [s].

        Returns:
            As `Background.act`.
        """


class BackgroundState(NamedTuple):
    """State of the drivers of M vehicles in B scenarios."""

    weights: Tensor
    """Shape (B, W); W = 0 if all drivers are alike."""
    draws: Tensor
    """Standard normal draws of the whole episode, shape (B, 2 + T, M, 2); (B, 0, M, 2) without noise."""
    memory: Tensor
    """Of the drivers, shape (B, M, ...)."""
    tick: Tensor
    """Ticks driven so far, shape (B,)."""

    @classmethod
    def start(cls, drivers: Background | TrafficBackground, weights: Tensor, draws: Tensor) -> BackgroundState:
        """Return the state at the start of an episode; shapes as of the fields."""
        batch, ticks, vehicles, _ = draws.shape
        first = draws[:, :FIRST_DRAWS] if ticks else draws.new_zeros(batch, FIRST_DRAWS, vehicles, 2)
        memory = drivers.begin(first.movedim(1, -1))
        return cls(weights, draws, memory, torch.zeros(batch, dtype=torch.int64, device=draws.device))

    @property
    def innovations(self) -> Tensor | None:
        """The draws of this tick, shape (B, M, 2), those of the last if no episode goes; None without noise."""
        if not self.draws.shape[1]:
            return None
        row = torch.arange(len(self.tick), device=self.tick.device)
        return self.draws[row, (self.tick + FIRST_DRAWS).clamp(max=self.draws.shape[1] - 1)]


def query_background(
    drivers: Background | TrafficBackground,
    background: BackgroundState,
    state: State,
    road: Road,
    perception: Tensor | None,
    dt: float,
) -> tuple[Tensor, BackgroundState]:
    """Query the drivers of vehicles 1 to N - 1 for a tick: actions as of `Background.act`, and the state after it."""
    others, memory = slice(1, None), background.memory
    if isinstance(drivers, TrafficBackground):
        action, later = drivers.decide(LaneTraffic.of(state, road), others, memory, dt)
    else:
        assert perception is not None
        weights = background.weights if background.weights.shape[1] else None
        action, kept = drivers.act(perception[:, others], weights, background.innovations, memory)
        later = memory if kept is None else kept
    return action, background._replace(memory=later, tick=background.tick + 1)


def noise_size(ticks: int, vehicles: int) -> int:
    """Return the number of standard normal draws of an episode."""
    return (FIRST_DRAWS + ticks) * vehicles * 2


def find_drivers(drivers: Any) -> Background | TrafficBackground | None:
    """Return the drivers that a keyword argument `drivers` names: None for the scenario's script, or a ValueError.

    A `Background` or `TrafficBackground`, the name of an installed one ("mgail"; "idm+mobil" and "mgail?rules=0" are
    looked up as "idm" and "mgail", whose loaders get the whole name), or a file that the package `agents` wrote.
    """
    if drivers is None or isinstance(drivers, Background | TrafficBackground):
        return drivers
    if not isinstance(drivers, str | Path):
        raise ValueError(
            f"Expected drivers by name, or an object with weights, begin and act (or decide), got {drivers!r}."
        )
    known = {entry.name: entry for entry in entry_points(group=DRIVERS_GROUP)}
    name = str(drivers)
    offered = "file" if name.endswith(".safetensors") else name.partition("?")[0].partition("+")[0]
    if offered not in known:
        names = sorted({*known, *(f"{name}+mobil" for name in known if name == "idm")} - {"file"})
        check_name("drivers", name, [*names, "FILE.safetensors", "VEHICLE=POLICY.zip"])
    background: Background | TrafficBackground = known[offered].load()(name)
    return background
