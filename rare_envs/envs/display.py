"""Display of an environment of one episode: a window, images or nothing."""

from collections.abc import Collection

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rare_envs.envs.rendering import Renderer
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World

RENDER_MODES = ("rgb_array", "human")


class Display:
    """The picture of an environment in its render mode; HighwayEnv's graphics are loaded for the first one.

    Args:
        world: Of the episodes.
        mode: None, "rgb_array" for images, or "human" for a window.

    Raises:
        ValueError: If the mode is none of these.

    Example:
        >>> import numpy as np, rare_envs, torch
        >>> world = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0").world
        >>> episode = world.start(torch.tensor([[20.0, 20.0, 30.0]]))
        >>> display = Display(world, "rgb_array")
        >>> display.draw(episode, time=0.0).shape
        (208, 800, 3)
        >>> display.close()
    """

    def __init__(self, world: World, mode: str | None) -> None:
        if mode is not None and mode not in RENDER_MODES:
            raise ValueError(f"Expected render_mode None, 'rgb_array' or 'human', got {mode!r}.")
        self._world = world
        self._mode = mode
        self._renderer: Renderer | None = None

    @property
    def is_window(self) -> bool:
        """Whether pictures are shown in a window."""
        return self._mode == "human"

    def draw(
        self,
        episode: Episode | None,
        time: float,
        agents: Collection[int] = (),
        crashed: Collection[int] | None = None,
    ) -> NDArray[np.uint8] | None:
        """Return the picture of an episode, or show it in the window; a warning where there is none to draw.

        Args:
            episode: A batch of one; None before the first.
            time: Since its start [s].
            agents: Vehicles that agents drive.
            crashed: Vehicles that have crashed; None for the ego, if it has, and those that it touches.
        """
        if self._mode is None or episode is None:
            gym.logger.warn(
                "Nothing to render: make the environment with render_mode='rgb_array' or 'human', and reset it first."
            )
            return None
        if self._renderer is None:
            clock = self._world.clock
            self._renderer = Renderer(self._world, self.is_window, clock.decisions_per_second)
        image = self._renderer.draw(episode, time, agents=agents, crashed=crashed)
        return None if self.is_window else image

    def close(self) -> None:
        """Close the window."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
