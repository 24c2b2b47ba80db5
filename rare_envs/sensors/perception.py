"""Perception: the 51 features of learned drivers, their own state, the road and a lidar.

References:
    Kuefler, Morton, Wheeler and Kochenderfer, "Imitating driver behavior with generative adversarial networks", 2017.
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
    simulation", 2018: the same features and order, from their released code.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import constant
from rare_envs.sensors.lidar import AHEAD_BEAM, BEAM_SPACING, BEAMS, Bodies, find_met, sense
from rare_envs.traffic.road import Road, WorldPose
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

BEAM_NAMES = tuple(round(math.degrees(BEAM_SPACING * (k - AHEAD_BEAM))) for k in range(BEAMS))
FEATURES = (
    "lane_offset",
    "heading",
    "speed",
    "length",
    "width",
    "curvature",
    "left_marker",
    "right_marker",
    "colliding",
    "off_road",
    "reversing",
    *(f"range_{angle}" for angle in BEAM_NAMES),
    *(f"rate_{angle}" for angle in BEAM_NAMES),
)
"""Names in order. The three flags are always 0: in recorded traffic they are constant, so no policy can learn what they
mean; they are kept so that the layout is the published one."""
LANE_OFFSET_COLUMN = FEATURES.index("lane_offset")
HEADING_COLUMN = FEATURES.index("heading")
SPEED_COLUMN = FEATURES.index("speed")
CURVATURE_COLUMN = FEATURES.index("curvature")
RANGE_COLUMNS = slice(11, 11 + BEAMS)
RATE_COLUMNS = slice(11 + BEAMS, 11 + 2 * BEAMS)


class OnRoad(NamedTuple):
    """Positions of vehicles relative to their road; shapes (B, V)."""

    offset: Tensor
    """To the right of the middle of the nearest lane [m]."""
    heading: Tensor
    """Relative to the road [rad]."""
    curvature: Tensor
    """Of the road there [1/m]."""
    left: Tensor
    """Distance to the marker on the left of that lane [m]."""
    right: Tensor
    """Likewise on the right."""


def perceive(bodies: Bodies, on_road: OnRoad, observers: int | None = None) -> Tensor:
    """Return the 51 features of the first vehicles.

    Args:
        bodies: V vehicles in B scenes.
        on_road: Where they are on the road.
        observers: M, how many of the vehicles look; None for all.

    Returns:
        Shape (B, M, 51), in the order of `FEATURES`, SI units.
    """
    m = bodies.x.shape[1] if observers is None else observers
    readings = sense(bodies, m)
    zero = torch.zeros_like(bodies.x)
    core = (
        on_road.offset,
        on_road.heading,
        bodies.speed,
        bodies.length.expand_as(zero),
        bodies.width.expand_as(zero),
        on_road.curvature,
        on_road.left,
        on_road.right,
        zero,
        zero,
        zero,
    )
    return torch.cat((torch.stack(core, dim=-1)[:, :m], readings.range, readings.rate), dim=-1)


def perceive_traffic(state: State, road: Road, pose: WorldPose | None = None) -> Tensor:
    """Return the 51 features of all vehicles, shape (B, N, 51).

    Args:
        state: Traffic of B scenarios.
        road: Their road.
        pose: Where they are in the world, if that is known already.

    Example:
        >>> from rare_envs.traffic import straight
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, 0 * x, 0 * x, torch.tensor([[20.0, 10.0]]), theta=x[:, :0])
        >>> seen = perceive_traffic(state, straight(1))
        >>> seen[0, 0, RANGE_COLUMNS][AHEAD_BEAM].item(), seen[0, 0, RATE_COLUMNS][AHEAD_BEAM].item()
        (27.5, -10.0)
    """
    x, y, heading, curvature = pose or road.place(state.x, state.y, state.heading)
    bodies = _bodies(state, x, y, heading)
    left, right = road.markers(state.y)
    return perceive(bodies, OnRoad(0.5 * (left - right), state.heading, curvature, left, right))


def find_vehicles_met(state: State, road: Road) -> Tensor:
    """Return the index of the vehicle that each of the ego's beams meets first, -1 for none, int64, shape (B, 20).

    Example:
        >>> from rare_envs.traffic import straight
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, 0 * x, 0 * x, torch.tensor([[20.0, 10.0]]), theta=x[:, :0])
        >>> find_vehicles_met(state, straight(1))[0, AHEAD_BEAM - 1 : AHEAD_BEAM + 2].tolist()
        [-1, 1, -1]
    """
    return find_met(_bodies(state, *road.to_world(state.x, state.y, state.heading)), 1)[:, 0]


def _bodies(state: State, x: Tensor, y: Tensor, heading: Tensor) -> Bodies:
    """Return the vehicles' bodies at their places in the flat world, (B, N) each."""
    return Bodies(x, y, heading, state.speed, constant(VEHICLE_LENGTH, x), constant(VEHICLE_WIDTH, x))
