"""Lidar and perception: 20 beams from the middle of each vehicle, and the 51 features of learned drivers.

Which body a beam meets first is decided without gradients, and only for beams that can meet it: a body that covers
less than 9 degrees to either side of its bearing can be met by the beam nearest to that bearing only, less than 27
degrees by three. Range and rate of the one chosen body are then computed with gradients; the minimum over bodies
passes its gradient to the chosen one only, so nothing is lost.

References:
    Kuefler, Morton, Wheeler and Kochenderfer, "Imitating driver behavior with generative adversarial networks", 2017.
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
    simulation", 2018: the same beams, features and order, from their released code.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import can_look, constant, indices
from rare_envs.traffic.bodies import rotate
from rare_envs.traffic.road import Road, WorldPose
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

BEAMS = 20
BEAM_SPACING = 2.0 * math.pi / BEAMS
"""Angle between neighbouring beams [rad]."""
FIRST_BEAM_ANGLE = -0.9 * math.pi
"""Angle of beam 0 [rad], -162 degrees; positive is to the right, as y is. Beam `AHEAD_BEAM` looks straight ahead."""
AHEAD_BEAM = 9
MAX_RANGE = 100.0
"""Range of a beam that meets nothing [m]; its rate is 0."""

_WINDOWS = (
    ((0,), math.sin(0.5 * BEAM_SPACING)),
    ((-1, 0, 1), math.sin(1.5 * BEAM_SPACING)),
    (tuple(range(BEAMS)), 0.0),
)
"""Beams that may meet a body, counted from the one nearest to its bearing, while the sine of half the angle that it
covers, half diagonal over distance, is less than this."""
_FEW = 512
"""Pairs of vehicles up to which all are tested with all beams: the last window alone costs the fewest operations."""
_NOTHING = torch.iinfo(torch.int64).max
"""Key of a beam that has met nothing, see `_key`."""
_VEHICLE_BITS = 16
"""Last bits of a key, which hold the number of the vehicle."""
_FLAT = 1e-9
"""Least size of a direction's component, so that a beam along a side divides by no zero."""


class Bodies(NamedTuple):
    """Boxes that move along their headings; shapes (B, V), a size may be one number for all."""

    x: Tensor
    """Middle of the box [m], in one flat frame for all."""
    y: Tensor
    heading: Tensor
    """[rad], positive from +x to +y."""
    speed: Tensor
    """[m/s]."""
    length: Tensor
    """[m]."""
    width: Tensor
    """[m]."""


def beam_angles(like: Tensor) -> Tensor:
    """Return the angles of the beams relative to the heading [rad], shape (20,), with dtype and device of a tensor."""
    return FIRST_BEAM_ANGLE + BEAM_SPACING * torch.arange(BEAMS, dtype=like.dtype, device=like.device)


def sense(bodies: Bodies, observers: int | None = None) -> tuple[Tensor, Tensor]:
    """Return ranges [m] and rates [m/s] of the lidars of the first M of V vehicles (of all for None), (B, M, 20).

    To the nearest body along a beam, at most `MAX_RANGE`, and its velocity less the observer's; differentiable.
    Vehicles that are not there are parked further than `MAX_RANGE` from all others.
    """
    bodies = Bodies(*(field.expand_as(bodies.x) for field in bodies))
    m = bodies.x.shape[1] if observers is None else observers
    with torch.no_grad():
        target, distance = _first_met(bodies, m)
    met = target >= 0
    index = target.clamp(min=0).flatten(1)

    def of_target(field: Tensor) -> Tensor:
        return field.gather(1, index).view(target.shape)

    along, across = bodies.speed * torch.cos(bodies.heading), bodies.speed * torch.sin(bodies.heading)
    angle = bodies.heading[:, :m, None] + beam_angles(bodies.x)
    rate_x, rate_y = of_target(along) - along[:, :m, None], of_target(across) - across[:, :m, None]
    rate = torch.where(met, rate_x * torch.cos(angle) + rate_y * torch.sin(angle), 0.0)
    if torch.is_grad_enabled() or bodies.x.dtype != distance.dtype:
        heading = of_target(bodies.heading)
        dx, dy = of_target(bodies.x) - bodies.x[:, :m, None], of_target(bodies.y) - bodies.y[:, :m, None]
        distance, _ = _crossing(dx, dy, heading, angle - heading, of_target(bodies.length), of_target(bodies.width))
    return torch.where(met, distance.clamp(0.0, MAX_RANGE), MAX_RANGE), rate


def _crossing(
    dx: Tensor, dy: Tensor, heading: Tensor, turn: Tensor, length: Tensor, width: Tensor
) -> tuple[Tensor, Tensor]:
    """Return where a beam enters and leaves a box, as distances along the beam (slab method; Kay and Kajiya, 1986)."""
    ahead, aside = rotate(dx, dy, torch.cos(heading), torch.sin(heading))
    along, across = _away_from_zero(torch.cos(turn)).reciprocal(), _away_from_zero(torch.sin(turn)).reciprocal()
    middle_along, half_along = ahead * along, 0.5 * length * along.abs()
    middle_across, half_across = aside * across, 0.5 * width * across.abs()
    enters = torch.maximum(middle_along - half_along, middle_across - half_across)
    leaves = torch.minimum(middle_along + half_along, middle_across + half_across)
    return enters, leaves


def _away_from_zero(value: Tensor) -> Tensor:
    """Return components of directions, none of them nearer to 0 than `_FLAT`."""
    return value.masked_fill(value.abs() < _FLAT, _FLAT)


def _first_met(bodies: Bodies, m: int) -> tuple[Tensor, Tensor]:
    """Return what each beam of the first m vehicles meets first."""
    batch, v = bodies.x.shape
    dx = bodies.x[:, None, :] - bodies.x[:, :m, None]
    dy = bodies.y[:, None, :] - bodies.y[:, :m, None]
    distance = (dx.square() + dy.square()).sqrt()
    distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)  # its own body a vehicle does not see
    half_diagonal = 0.5 * (bodies.length.square() + bodies.width.square()).sqrt()[:, None, :]
    bearing = torch.atan2(dy, dx) - bodies.heading[:, :m, None]
    facing = torch.round((bearing - FIRST_BEAM_ANGLE) / BEAM_SPACING).to(torch.int64)

    relative = bodies.heading[:, :m, None] - bodies.heading[:, None, :]
    untested = distance < MAX_RANGE + half_diagonal
    if not can_look(dx):
        return _read_keys(_test_all_beams(bodies, dx, dy, relative, untested))
    keys = torch.full((batch * m * BEAMS,), _NOTHING, dtype=torch.int64, device=dx.device)
    for offsets, sine in _WINDOWS if batch * m * v > _FEW else _WINDOWS[-1:]:
        enough = untested & (half_diagonal < sine * distance) if sine else untested
        pair = enough.flatten().nonzero().squeeze(1)  # observer and body, as a number in (B, m, V)
        if not len(pair):
            continue
        untested = untested & ~enough
        observer = torch.div(pair, v, rounding_mode="floor")
        vehicle = pair - observer * v
        body = vehicle + torch.div(observer, m, rounding_mode="floor") * v
        beam = (_take(facing, pair) + indices(offsets, dx)) % BEAMS
        enters, leaves = _crossing(
            _take(dx, pair),
            _take(dy, pair),
            _take(bodies.heading, body),
            _take(relative, pair) + (FIRST_BEAM_ANGLE + BEAM_SPACING * beam),
            _take(bodies.length, body),
            _take(bodies.width, body),
        )
        meets = (enters <= leaves) & (leaves > 0.0) & (enters < MAX_RANGE)
        key = torch.where(meets, _key(enters, vehicle[:, None]), _NOTHING)
        slot = observer[:, None] * BEAMS + beam
        keys.scatter_reduce_(0, slot.flatten(), key.flatten(), "amin")
    return _read_keys(keys.view(batch, m, BEAMS))


def _test_all_beams(bodies: Bodies, dx: Tensor, dy: Tensor, relative: Tensor, in_range: Tensor) -> Tensor:
    """Return the least `_key` of each beam, (B, m, 20), testing all with all bodies: what a GPU does soonest."""
    beam = torch.arange(BEAMS, device=dx.device)
    heading, length, width = (field[:, None, :, None] for field in (bodies.heading, bodies.length, bodies.width))
    turn = relative[..., None] + (FIRST_BEAM_ANGLE + BEAM_SPACING * beam)
    enters, leaves = _crossing(dx[..., None], dy[..., None], heading, turn, length, width)
    meets = in_range[..., None] & (enters <= leaves) & (leaves > 0.0) & (enters < MAX_RANGE)
    vehicle = torch.arange(dx.shape[2], device=dx.device)[:, None]
    return torch.where(meets, _key(enters, vehicle), _NOTHING).amin(2)


def _read_keys(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return the vehicles, -1 for none, and their distances [m] that keys stand for, shapes as theirs."""
    distance = (keys >> _VEHICLE_BITS).to(torch.int32).view(torch.float32)
    return torch.where(keys == _NOTHING, -1, keys & (2**_VEHICLE_BITS - 1)), distance


def _take(field: Tensor, numbers: Tensor) -> Tensor:
    """Return entries of a field by their numbers in it (n,), as a column (n, 1)."""
    return field.flatten().index_select(0, numbers)[:, None]


def _key(distance: Tensor, vehicle: Tensor) -> Tensor:
    """Return integers ordered as the distances (the bits of positive singles are), with the vehicle in the last."""
    bits = distance.clamp(min=0.0).float().view(torch.int32).to(torch.int64)
    return (bits << _VEHICLE_BITS) | vehicle


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
    """Return the 51 `FEATURES` of the first M of V vehicles in B scenes (of all for None), (B, M, 51), SI units."""
    m = bodies.x.shape[1] if observers is None else observers
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
    return torch.cat((torch.stack(core, dim=-1)[:, :m], *sense(bodies, m)), dim=-1)


def perceive_traffic(state: State, road: Road, pose: WorldPose | None = None) -> Tensor:
    """Return the 51 `FEATURES` of all vehicles, (B, N, 51); `pose` is where they are in the world, if that is known."""
    x, y, heading, curvature = pose or road.place(state.x, state.y, state.heading)
    bodies = _bodies(state, x, y, heading)
    left, right = road.markers(state.y)
    return perceive(bodies, OnRoad(0.5 * (left - right), state.heading, curvature, left, right))


@torch.no_grad()
def find_vehicles_met(state: State, road: Road) -> Tensor:
    """Return the index of the vehicle that each of the ego's beams meets first, -1 for none, int64, shape (B, 20)."""
    bodies = _bodies(state, *road.to_world(state.x, state.y, state.heading))
    return _first_met(Bodies(*(field.expand_as(bodies.x) for field in bodies)), 1)[0][:, 0]


def _bodies(state: State, x: Tensor, y: Tensor, heading: Tensor) -> Bodies:
    """Return the vehicles' bodies at their places in the flat world, (B, N) each."""
    return Bodies(x, y, heading, state.speed, constant(VEHICLE_LENGTH, x), constant(VEHICLE_WIDTH, x))
