"""Pictures of episodes: roads and vehicles by HighwayEnv's own graphics, numbers above, a legend below; the palette."""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.actions import TARGET_SPEEDS
from rare_envs.measures.longitudinal import TTC_MAX
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World
from rare_envs.traffic.bodies import overlaps
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

ROLE_COLOURS = {"ego": "#22aa3c", "lead": "#3b82d6", "cutter": "#f09a1a", "others": "#b4b4c4"}
"""Colours of vehicles by what scenarios call them, on paper and on asphalt; "others" for other names."""
OTHER_COLOURS = ("#8e5aa8", "#3aa6a6", "#7a7a7a", "#b4667e", "#6b7fb0")
"""Colours that tell vehicles of other names apart in curves."""
CRASH_COLOUR = "#d62828"
"""Outline of vehicles that have crashed: they keep their own colour, so that the ego stays the ego."""


def as_rgb(colour: str) -> tuple[int, int, int]:
    """Return a colour as numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


_SEGMENT = 6 * 4.33
"""A curve is drawn as straight pieces this long [m]: six stripes of HighwayEnv's."""
_AHEAD, _BEHIND = 4, 2
"""Pieces drawn ahead of the ego's and behind it."""


def make_traffic(state: State, road: Road, row: int = 0) -> Any:
    """Return HighwayEnv's road around the ego of a row with the vehicles, `Vehicle`s of HighwayEnv, the ego first."""
    from highway_env.road.road import Road as Traffic
    from highway_env.vehicle.kinematics import Vehicle

    traffic = Traffic(make_network(road, float(state.x[row, 0])))
    world = road.to_world(state.x[row], state.y[row], state.heading[row])
    for x, y, heading, speed in torch.stack((*world, state.speed[row]), dim=1).tolist():
        traffic.vehicles.append(Vehicle(traffic, [x, y], heading, speed))
    return traffic


def make_scene(episode: Episode) -> Any:
    """Return HighwayEnv's road of a batch of one, with crashes; with meta-actions the ego is an `MDPVehicle`."""
    from highway_env.vehicle.controller import MDPVehicle

    traffic, crashed = make_traffic(episode.state, episode.road), find_crashed(episode)
    if episode.aim is not None:
        seen = traffic.vehicles[0]
        target = (*seen.lane_index[:2], int(episode.aim.lane[0, 0]))
        aim = TARGET_SPEEDS[int(episode.aim.speed[0, 0])]
        speeds = np.array(TARGET_SPEEDS)
        traffic.vehicles[0] = MDPVehicle(traffic, seen.position, seen.heading, seen.speed, target, aim, speeds)
    for j, vehicle in enumerate(traffic.vehicles):
        vehicle.crashed = j in crashed
    return traffic


def find_crashed(episode: Episode, row: int = 0) -> Collection[int]:
    """Return the ego and the vehicles that it touches, in a row; nobody if it has not collided."""
    if not bool(episode.collided[row]):
        return ()
    state = State(*(field[row : row + 1] for field in episode.state))
    return {0, *(overlaps(state, episode.road)[0].nonzero().flatten() + 1).tolist()}


def find_signals(world: World, episode: Episode, row: int = 0) -> set[int]:
    """Return the vehicles with their indicator on, in a row."""
    signals = world.find_signals(episode)
    return set() if signals is None else {j + 1 for j, on in enumerate(signals[row].tolist()) if on}


def make_network(road: Road, x: float) -> Any:
    """Return HighwayEnv's road network of the lanes around x [m]; a curve in straight pieces."""
    from highway_env.road.lane import LineType, StraightLane
    from highway_env.road.road import RoadNetwork

    here = x // _SEGMENT
    cuts = [-1e3, 9e3] if road.reference_line is None else [_SEGMENT * (here + k) for k in range(-_BEHIND, _AHEAD + 2)]
    network = RoadNetwork()
    for lane in range(road.lanes):
        y, width = road.centre(lane), road.edges[lane + 1] - road.edges[lane]
        left = LineType.CONTINUOUS_LINE if lane == 0 else LineType.STRIPED
        right = LineType.CONTINUOUS_LINE if lane == road.lanes - 1 else LineType.NONE
        for number, (start, end) in enumerate(pairwise(cuts)):
            piece = StraightLane(world_point(road, start, y), world_point(road, end, y), width, [left, right])
            network.add_lane(str(number), str(number + 1), piece)
    return network


def world_point(road: Road, x: float, y: float) -> NDArray[np.float64]:
    """Return world coordinates [m], shape (2,), of a point of the road."""
    zero = torch.zeros((), dtype=torch.float64)
    world_x, world_y, _ = road.to_world(zero + x, zero + y, zero)
    return np.array([float(world_x), float(world_y)])


FRAME_WIDTH, FRAME_HEIGHT = 800, 160
"""Size of the picture of the road [pixels]; it is higher where the road asks for it."""
TEXT_HEIGHT = 24
"""Height of the lines of text above and below [pixels]; all heights are multiples of 16, as video codecs want."""
_SCALING = 8.0
"""Pixels per metre."""
_MARGIN = 4.0
"""Shown beside the road [m] at least."""

Colour = tuple[int, int, int]
AGENT: Colour = (200, 0, 150)
"""Outline of vehicles other than the ego that an agent drives, HighwayEnv's purple."""
SIGNAL: Colour = (255, 150, 0)
"""Outline of vehicles with their indicator on, amber."""
_PAPER: Colour = (255, 255, 255)
_INK: Colour = (30, 30, 30)
_Outlines = dict[str, tuple[Colour, Collection[int]]]
"""Colours of the outlines of vehicles, and whose, by what they mean."""


RENDER_MODES = ("rgb_array", "human")


class Renderer:
    """Painter of episodes of a world, on one surface that follows the ego; HighwayEnv's graphics are loaded for it."""

    def __init__(self, world: World, mode: str | None = "rgb_array") -> None:
        """Paint into arrays, for "human" into a window too, or nothing by `render`, for None."""
        if mode is not None and mode not in RENDER_MODES:
            raise ValueError(f"Expected render_mode None, 'rgb_array' or 'human', got {mode!r}.")
        self._world, self._road, self._mode = world, world.scenario.road, mode
        self._roles = [name if name in ROLE_COLOURS else "others" for name in world.scenario.vehicle_names]
        self.is_window = mode == "human"
        self._pygame: Any = None
        """The library, once a surface is there."""

    def _open(self) -> None:
        """Prepare a surface, and the window."""
        import pygame
        import pygame.freetype
        from highway_env.road.graphics import WorldSurface

        self._pygame = pygame
        height = max(FRAME_HEIGHT, 16 * round((self._road.lanes * self._road.width + 2 * _MARGIN) * _SCALING / 16))
        self._surface = WorldSurface((FRAME_WIDTH, height), 0, pygame.Surface((FRAME_WIDTH, height)))
        self._surface.scaling = _SCALING
        self._surface.centering_position = [0.3, 0.5]
        self._canvas = pygame.Surface((FRAME_WIDTH, height + 2 * TEXT_HEIGHT))
        pygame.freetype.init()
        self._font = pygame.freetype.Font(None, 14)
        self._font.origin = True  # texts are placed by their base line
        if self.is_window:
            pygame.display.init()  # not pygame.init(), which would also want a sound card
            self._screen = pygame.display.set_mode(self._canvas.get_size())
            self._clock = pygame.time.Clock()

    def render(self, episode: Episode | None, time: float, **details: Any) -> NDArray[np.uint8] | None:
        """Return the picture of `draw`, or show it in the window; warn if there is none."""
        if self._mode is None or episode is None:
            gym.logger.warn(
                "Nothing to render: make the environment with render_mode='rgb_array' or 'human', and reset it first."
            )
            return None
        image = self.draw(episode, time, **details)
        return None if self.is_window else image

    def draw(
        self,
        episode: Episode,
        time: float | None = None,
        row: int = 0,
        agents: Collection[int] = (),
        crashed: Collection[int] | None = None,
    ) -> NDArray[np.uint8]:
        """Return the image, (H, FRAME_WIDTH, 3), of one of B episodes, a time after its start [s].

        Vehicles that signal, that agents drive, and those that have `crashed` (None: the ego, if it has, and whom it
        touches), are outlined.
        """
        if self._pygame is None:
            self._open()
        outlines: _Outlines = {
            "indicator on": (SIGNAL, find_signals(self._world, episode, row) - set(agents)),
            "driven by an agent": (AGENT, set(agents) - {0}),
            "crashed": (as_rgb(CRASH_COLOUR), find_crashed(episode, row) if crashed is None else crashed),
        }
        self._draw_road(episode.state, row, outlines)
        self._canvas.fill(_PAPER)
        self._canvas.blit(self._surface, (0, TEXT_HEIGHT))
        self._write(8, 17, caption(self._world, episode, time, row))
        self._draw_legend(outlines)
        if self.is_window:
            self._screen.blit(self._canvas, (0, 0))
            self._pygame.event.pump()
            self._clock.tick(self._world.clock.decisions_per_second)
            self._pygame.display.flip()
        image: NDArray[np.uint8] = np.moveaxis(self._pygame.surfarray.array3d(self._canvas), 0, 1)
        return image

    def _draw_road(self, state: State, row: int, outlines: _Outlines) -> None:
        from highway_env.road.graphics import RoadGraphics

        traffic = make_traffic(state, self._road, row)
        for vehicle, role in zip(traffic.vehicles, self._roles, strict=True):
            vehicle.color = as_rgb(ROLE_COLOURS[role])
        self._surface.move_display_window_to(world_point(self._road, float(state.x[row, 0]), self._road.middle))
        RoadGraphics.display(traffic, self._surface)
        RoadGraphics.display_traffic(traffic, self._surface, offscreen=True)
        for colour, vehicles in outlines.values():
            for j in sorted(vehicles):
                pixels = [self._surface.pos2pix(*corner) for corner in traffic.vehicles[j].polygon()[:4]]
                self._pygame.draw.polygon(self._surface, colour, pixels, width=3)

    def _draw_legend(self, outlines: _Outlines) -> None:
        """Draw colours and what they mean, in a line below the road."""
        shown = [(role, as_rgb(ROLE_COLOURS[role]), 0) for role in ROLE_COLOURS if role in self._roles]
        shown += [(text, colour, 3) for text, (colour, vehicles) in outlines.items() if vehicles]
        x, y = 8, self._canvas.get_height() - TEXT_HEIGHT + 6
        for text, colour, line in shown:
            self._pygame.draw.rect(self._canvas, colour, (x, y, 20, 11), width=line)
            x += 26 + self._write(x + 26, y + 10, text) + 18

    def _write(self, x: int, y: int, text: str) -> int:
        """Write a line, and return how long it is."""
        width: int = self._font.render_to(self._canvas, (x, y), text, _INK).width
        return width

    def close(self) -> None:
        """Close the window, if there is one; another picture opens it again."""
        if self.is_window and self._pygame is not None:
            self._pygame.display.quit()
            self._pygame = None


def caption(world: World, episode: Episode, time: float | None, row: int = 0) -> str:
    """Return time, speed, gap and time to collision of the ego, and the measure of the episode so far, as text."""
    gap, closing = float(episode.lead.gap[row]), float(episode.lead.closing_speed[row])
    parts = [] if time is None else [f"{time:4.1f} s"]
    parts.append(f"ego {float(episode.state.speed[row, 0]):4.1f} m/s")
    if bool(episode.collided[row]):
        return "    ".join([*parts, "crash"])
    parts.append(f"gap {max(gap, 0.0):5.1f} m" if np.isfinite(gap) else "nobody ahead")
    if closing > 0 and gap / closing < TTC_MAX:
        parts.append(f"time to collision {max(gap, 0.0) / closing:4.1f} s")
    measure, f = world.measurement.measure, float(episode.f[row])
    if measure not in ("ttc", "lidar_ttc"):
        parts.append(f"{measure if isinstance(measure, str) else 'f'} so far {f:.2f}")
    elif f < TTC_MAX:
        parts.append(f"closest so far {f:.1f} s")
    return "    ".join(parts)
