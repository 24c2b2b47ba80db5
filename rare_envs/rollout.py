"""The one time loop."""

from torch import Tensor

from rare_envs.drivers import Driver
from rare_envs.world import Episode, World


def rollout(world: World, driver: Driver, x: Tensor) -> Episode:
    """Drive B scenarios from start to horizon.

    Args:
        world: The world.
        driver: The ego.
        x: Scenario parameters, shape (B, d).

    Returns:
        The episodes at the horizon; `.f` is the safety measure, shape (B,). Rows in which the ego has collided are
        moved on with the others, but their f stays -1.
    """
    episode, memory = world.start(x), None
    for _ in range(world.ticks):
        action, memory = driver.act(episode.state, episode.lead, memory)
        episode = world.step(episode, action)
    return episode
