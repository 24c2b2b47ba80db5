"""Rollout: the one time loop, and the driver that decides in it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World


class Driver(Protocol):
    """An ego. Its memory, if it has any, goes in and out, so that one driver serves any number of rollouts.

    Example:
        >>> import torch
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> class Brake:
        ...     def act(self, episode, memory):
        ...         action = torch.tensor([-2.0, 0.0])  # acceleration [m/s^2], steering angle [rad]
        ...         return action.expand(len(episode.collided), 2), memory
        >>> x = torch.tensor([[20.0, 0.0, 120.0]])  # ego and lead speed [m/s], gap [m]
        >>> float(rollout(World(CAR_FOLLOWING), Brake(), x).state.speed[0, 0])  # after 10 s
        0.0
    """

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Decide for one tick.

        Args:
            episode: B scenarios at this moment; what is decided for those that have collided does not matter.
            memory: What the last call returned, None at the start.

        Returns:
            Acceleration [m/s^2] and steering angle [rad], shape (B, 2), or in a world with meta-actions these, shape
            (B,); and the new memory.
        """
        ...


@runtime_checkable
class StochasticDriver(Driver, Protocol):
    """A driver with noise of its own, which can be part of x."""

    @property
    def noise_columns(self) -> int:
        """Number of columns of x that are its noise, the last ones; 0 where its noise is fixed or off."""

    def with_draws(self, draws: Tensor) -> Driver:
        """Return the driver of B episodes with standard normal draws, shape (B, `noise_columns`)."""


def drive(world: World, driver: Driver, x: Tensor) -> Iterator[Episode]:
    """Drive B scenarios, moment by moment.

    Args:
        world: The world.
        driver: The ego.
        x: Scenario parameters, shape (B, d), and behind them the noise of the ego, if it has `noise_columns`.

    Yields:
        The episodes at time 0 and after each tick up to the horizon. Rows in which the ego has collided are moved on
        with the others, but their f does not change any more.

    Example:
        >>> import torch
        >>> from rare_envs.control.idm import IDM
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> x = torch.tensor([[20.0, 15.0, 30.0]])  # ego and lead speed [m/s], gap [m]
        >>> len(list(drive(World(CAR_FOLLOWING), IDM(), x)))  # time 0 and 100 ticks
        101
    """
    episode, driver = begin_drive(world, driver, x)
    memory = None
    yield episode
    for _ in range(world.clock.ticks):
        episode, memory = drive_tick(world, driver, episode, memory)
        yield episode


def begin_drive(world: World, driver: Driver, x: Tensor) -> tuple[Episode, Driver]:
    """Return the episodes at time 0, and the driver with its noise; arguments as of `drive`."""
    if isinstance(driver, StochasticDriver) and driver.noise_columns:
        own = driver.noise_columns
        x, driver = x[:, :-own], driver.with_draws(x[:, -own:])
    return world.start(x), driver


def drive_tick(world: World, driver: Driver, episode: Episode, memory: Any) -> tuple[Episode, Any]:
    """Return the episodes one tick later, and the driver's memory."""
    action, memory = driver.act(episode, memory)
    episode, action = world.decode_meta_actions(episode, action)
    return world.step(episode, action), memory


def rollout(world: World, driver: Driver, x: Tensor) -> Episode:
    """Return the episodes of `drive` at the horizon; `.f` is the safety measure, shape (B,)."""
    for episode in drive(world, driver, x):
        last = episode
    return last
