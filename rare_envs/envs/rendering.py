"""Pictures of a state, drawn by HighwayEnv's own graphics."""

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.road import Road
from rare_envs.state import State

WIDTH, HEIGHT = 800, 160
"""Size of the image [pixels]; it is higher where the road asks for it."""
_SCALING = 8.0
"""Pixels per metre."""
_MARGIN = 4.0
"""Shown beside the road [m] at least."""
_SEGMENT = 6 * 4.33
"""A curve is drawn as straight pieces this long [m]: six stripes of HighwayEnv's."""
_AHEAD, _BEHIND = 4, 2
"""Pieces drawn ahead of the ego's and behind it."""


class Renderer:
    """Draws states onto one surface that follows the ego."""

    def __init__(self, road: Road, window: bool, fps: int) -> None:
        """Prepare a surface.

        Args:
            road: The road.
            window: Whether to show it in a window too.
            fps: Frames per second of the window.
        """
        import pygame
        from highway_env.road.graphics import WorldSurface

        self._pygame: Any = pygame
        self._road = road
        height = max(HEIGHT, 16 * round((road.lanes * road.width + 2 * _MARGIN) * _SCALING / 16))
        self._surface = WorldSurface((WIDTH, height), 0, pygame.Surface((WIDTH, height)))
        self._surface.scaling = _SCALING
        self._surface.centering_position = [0.3, 0.5]
        self._fps = fps
        self._screen = None
        if window:
            pygame.display.init()  # not pygame.init(), which would also want a sound card
            self._screen = pygame.display.set_mode((WIDTH, height))
            self._clock = pygame.time.Clock()

    def draw(self, state: State, crashed: bool) -> NDArray[np.uint8]:
        """Draw the first scenario of a state.

        Args:
            state: Traffic of B scenarios; the first is drawn.
            crashed: Whether to paint the ego as crashed.

        Returns:
            The image, shape (H, WIDTH, 3).
        """
        from highway_env.road.graphics import RoadGraphics
        from highway_env.road.road import Road as Traffic
        from highway_env.vehicle.graphics import VehicleGraphics
        from highway_env.vehicle.kinematics import Vehicle

        ego_x = float(state.x[0, 0])
        traffic = Traffic(_network(self._road, ego_x))
        positions = self._road.to_world(state.x[0], state.y[0], state.heading[0])
        for j, (x, y, heading) in enumerate(zip(*(each.tolist() for each in positions), strict=True)):
            vehicle = Vehicle(traffic, [x, y], heading, float(state.speed[0, j]))
            vehicle.color = VehicleGraphics.EGO_COLOR if j == 0 else VehicleGraphics.BLUE
            traffic.vehicles.append(vehicle)
        if crashed:
            traffic.vehicles[0].color = VehicleGraphics.RED
        self._surface.move_display_window_to(_point(self._road, ego_x, self._road.middle))
        RoadGraphics.display(traffic, self._surface)
        RoadGraphics.display_traffic(traffic, self._surface, offscreen=True)
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


def _network(road: Road, x: float) -> Any:
    """HighwayEnv's road network of the lanes around x [m]."""
    from highway_env.road.lane import LineType, StraightLane
    from highway_env.road.road import RoadNetwork

    here = x // _SEGMENT
    cuts = [-1e3, 9e3] if road.curve is None else [_SEGMENT * (here + k) for k in range(-_BEHIND, _AHEAD + 2)]
    network = RoadNetwork()
    for lane in range(road.lanes):
        y, width = road.centre(lane), road.edges[lane + 1] - road.edges[lane]
        left = LineType.CONTINUOUS_LINE if lane == 0 else LineType.STRIPED
        right = LineType.CONTINUOUS_LINE if lane == road.lanes - 1 else LineType.NONE
        for start, end in pairwise(cuts):
            piece = StraightLane(_point(road, start, y), _point(road, end, y), width, [left, right])
            network.add_lane("0", "1", piece)
    return network


def _point(road: Road, x: float, y: float) -> NDArray[np.float64]:
    """World coordinates [m], shape (2,), of a point of the road."""
    zero = torch.zeros((), dtype=torch.float64)
    world_x, world_y, _ = road.to_world(zero + x, zero + y, zero)
    return np.array([float(world_x), float(world_y)])
