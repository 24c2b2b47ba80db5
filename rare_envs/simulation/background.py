"""Background traffic: the drivers of the vehicles around the ego, their state and their noise."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from rare_envs.distributions.space import Distribution
from rare_envs.plugins import did_you_mean
from rare_envs.traffic.neighbours import LaneTraffic
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

DRIVERS_GROUP = "rare_envs.drivers"
"""Entry points by which packages offer drivers: name to a function that takes the name and returns a `Background`."""
FIRST_DRAWS = 2
"""Draws of each action with which a coloured noise begins, before those of the ticks."""
FIXED_SEED = 12345
"""Seed of the one sequence of `noise="fixed"`; arbitrary, but results depend on it."""


class DriverWeights(Distribution, Protocol):
    """Distribution of the weights that tell one driver from another."""

    @property
    def dim(self) -> int:
        """Number of weights."""


@runtime_checkable
class Background(Protocol):
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

    @property
    def weights(self) -> DriverWeights | None:
        """Distribution of the weights that tell one driver from another; None if all are alike."""

    @property
    def noisy(self) -> bool:
        """Whether they act with noise if they are given draws."""

    def begin(self, draws: Tensor) -> Tensor:
        """Return the memory at the start, (B, M, ...), from standard normal draws of shape (B, M, 2, 2)."""

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
class TrafficBackground(Protocol):
    """Drivers that act by where everybody is, not by what a lidar shows. Nothing in it is random.

    Example:
        >>> from rare_envs.control.lane_changing import LaneChangingDriver
        >>> isinstance(LaneChangingDriver(), TrafficBackground)
        True
    """

    @property
    def weights(self) -> DriverWeights | None:
        """As of `Background`."""

    @property
    def noisy(self) -> bool:
        """As of `Background`."""

    def begin(self, draws: Tensor) -> Tensor:
        """As of `Background`."""

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
    """Shape (B, W); W = 0 where all drivers are alike."""
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


def step_background(drivers: Background, state: BackgroundState, features: Tensor) -> tuple[Tensor, BackgroundState]:
    """Query the drivers for one tick.

    Args:
        drivers: Of the M vehicles.
        state: Theirs.
        features: `rare_envs.sensors.lidar.FEATURES` of each vehicle, shape (B, M, 51).

    Returns:
        Accelerations [m/s^2] and yaw rates [rad/s], shape (B, M, 2), and the state one tick later. Beyond the last
        draw, where no episode goes, draws are repeated.
    """
    innovations = None
    if state.draws.shape[1]:
        row = torch.arange(len(state.tick), device=state.tick.device)
        at = (state.tick + FIRST_DRAWS).clamp(max=state.draws.shape[1] - 1)
        innovations = state.draws[row, at]
    weights = state.weights if state.weights.shape[1] else None
    action, memory = drivers.act(features, weights, innovations, state.memory)
    memory = state.memory if memory is None else memory
    return action, state._replace(memory=memory, tick=state.tick + 1)


def needs_lidar(drivers: Background | TrafficBackground | None) -> bool:
    """Return whether drivers act by lidar features."""
    return drivers is not None and not isinstance(drivers, TrafficBackground)


def query_background(
    drivers: Background | TrafficBackground,
    background_state: BackgroundState,
    state: State,
    road: Road,
    perception: Tensor | None,
    dt: float,
) -> tuple[Tensor, BackgroundState]:
    """Query the drivers of all vehicles but the ego for one tick, by lidar or by where everybody is.

    Args:
        drivers: Of the N - 1 vehicles.
        background_state: Theirs.
        state: Traffic of B scenarios.
        road: Their road.
        perception: Lidar features, shape (B, N, 51); None for drivers that do not need them.
        dt: Tick [s].

    Returns:
        Accelerations [m/s^2] and yaw rates [rad/s], shape (B, N - 1, 2), and the drivers' state one tick later.
    """
    others = slice(1, None)
    if isinstance(drivers, TrafficBackground):
        action, memory = drivers.decide(LaneTraffic.of(state, road), others, background_state.memory, dt)
        return action, background_state._replace(memory=memory, tick=background_state.tick + 1)
    assert perception is not None
    return step_background(drivers, background_state, perception[:, others])


def noise_size(ticks: int, vehicles: int) -> int:
    """Return the number of standard normal draws of an episode."""
    return (FIRST_DRAWS + ticks) * vehicles * 2


def find_drivers(drivers: Any) -> Background | TrafficBackground | None:
    """Return the drivers that a keyword argument `drivers` names.

    Args:
        drivers: None for the scenario's script, a `Background` or `TrafficBackground`, the name of an installed one
            ("mgail"; "idm+mobil" and "mgail?rules=0" are looked up as "idm" and "mgail", whose loaders get the whole
            name), or the path of a file that the package `agents` wrote.

    Raises:
        ValueError: If it is none of these.
    """
    if drivers is None:
        return None
    if not isinstance(drivers, str | Path):
        if isinstance(drivers, Background | TrafficBackground):
            return drivers
        raise ValueError(
            f"Expected drivers by name, or an object with weights, begin and act (or decide), got {drivers!r}."
        )
    known = {entry.name: entry for entry in entry_points(group=DRIVERS_GROUP)}
    name = str(drivers)
    is_file = name.endswith(".safetensors")
    offered = "file" if is_file else name.partition("?")[0].partition("+")[0]
    if offered not in known:
        names = sorted({*known, *(f"{name}+mobil" for name in known if name == "idm")} - {"file"})
        listed = ", ".join(map(repr, names)) or "none is installed: pip install rare-envs"
        raise ValueError(
            f"Unknown drivers {name!r}{did_you_mean(name, names)}; expected one of {listed}, or a .safetensors file."
        )
    background: Background | TrafficBackground = known[offered].load()(name)
    return background
