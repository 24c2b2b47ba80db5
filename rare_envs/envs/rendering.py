"""Pictures of a state, drawn by HighwayEnv's own graphics."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.state import LANE_WIDTH, State

WIDTH, HEIGHT = 800, 160
"""Size of the image [pixels]."""
_SCALING = 8.0
"""Pixels per metre."""


class Renderer:
    """Draws states onto one surface that follows the ego."""

    def __init__(self, lanes: int, window: bool, fps: int) -> None:
        """Prepare a surface.

        Args:
            lanes: Number of lanes.
            window: Whether to show it in a window too.
            fps: Frames per second of the window.
        """
        import pygame
        from highway_env.road.graphics import WorldSurface
        from highway_env.road.road import RoadNetwork

        self._pygame: Any = pygame
        self._network = RoadNetwork.straight_road_network(lanes, start=-1e3, length=1e4)
        self._surface = WorldSurface((WIDTH, HEIGHT), 0, pygame.Surface((WIDTH, HEIGHT)))
        self._surface.scaling = _SCALING
        self._surface.centering_position = [0.3, 0.5]
        self._middle = (lanes - 1) * LANE_WIDTH / 2
        self._fps = fps
        self._screen = None
        if window:
            pygame.display.init()  # not pygame.init(), which would also want a sound card
            self._screen = pygame.display.set_mode((WIDTH, HEIGHT))
            self._clock = pygame.time.Clock()

    def draw(self, state: State, crashed: bool) -> NDArray[np.uint8]:
        """Draw the first scenario of a state.

        Args:
            state: Traffic of B scenarios; the first is drawn.
            crashed: Whether to paint the ego as crashed.

        Returns:
            The image, shape (HEIGHT, WIDTH, 3).
        """
        from highway_env.road.graphics import RoadGraphics
        from highway_env.road.road import Road
        from highway_env.vehicle.graphics import VehicleGraphics
        from highway_env.vehicle.kinematics import Vehicle

        road = Road(self._network)
        for j in range(state.x.shape[1]):
            position = [float(state.x[0, j]), float(state.y[0, j])]
            vehicle = Vehicle(road, position, float(state.heading[0, j]), float(state.speed[0, j]))
            vehicle.color = VehicleGraphics.EGO_COLOR if j == 0 else VehicleGraphics.BLUE
            road.vehicles.append(vehicle)
        if crashed:
            road.vehicles[0].color = VehicleGraphics.RED
        self._surface.move_display_window_to(np.array([float(state.x[0, 0]), self._middle]))
        RoadGraphics.display(road, self._surface)
        RoadGraphics.display_traffic(road, self._surface, offscreen=True)
        if self._screen is not None:
            self._screen.blit(self._surface, (0, 0))
            self._pygame.event.pump()
            self._clock.tick(self._fps)
            self._pygame.display.flip()
        image: NDArray[np.uint8] = np.moveaxis(self._pygame.surfarray.array3d(self._surface), 0, 1)
        return image

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None
