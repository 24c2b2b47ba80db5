"""The one time loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from torch import Tensor

if TYPE_CHECKING:
    from rare_envs.simulation.episode import Episode

from collections.abc import Iterator

from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World


def drive(world: World, driver: Driver, x: Tensor) -> Iterator[Episode]:
    """Drive B scenarios, moment by moment.

    Args:
        world: The world.
        driver: The ego.
        x: Scenario parameters, shape (B, d), and behind them the noise of the ego, if it has `columns` of its own.

    Yields:
        The episodes at time 0 and after each tick up to the horizon. Rows in which the ego has collided are moved on
        with the others, but their f stays -1.
    """
    own = getattr(driver, "columns", 0)
    if own:
        x, driver = x[:, :-own], driver.with_draws(x[:, -own:])  # type: ignore[attr-defined]
    episode, memory = world.start(x), None
    yield episode
    for _ in range(world.clock.ticks):
        action, memory = driver.act(episode, memory)
        episode, action = world.decode_meta_actions(episode, action)
        episode = world.step(episode, action)
        yield episode


def rollout(world: World, driver: Driver, x: Tensor) -> Episode:
    """Drive B scenarios from start to horizon.

    Args:
        world: The world.
        driver: The ego.
        x: Scenario parameters, shape (B, d).

    Returns:
        The episodes at the horizon; `.f` is the safety measure, shape (B,).
    """
    for episode in drive(world, driver, x):
        last = episode
    return last


class Driver(Protocol):
    """An ego. Its memory, if it has any, goes in and out, so that one driver serves any number of rollouts."""

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
