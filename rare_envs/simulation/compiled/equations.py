"""Equations of motion, of the IDM and of the time to collision for one scenario at a time, compiled by numba.

Each function is the scalar twin of the torch function that its docstring names, which has the sources and the
explanations. Operations are in the same order and in single precision, so that the two differ by the rounding of
transcendental functions alone. Importing this module needs numba.
"""

import math
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rare_envs.compilation import compiled, single
from rare_envs.control.idm import IDM, MAX_HEADING_COMMAND, MIN_RATIO, TAU_HEADING, TAU_LATERAL
from rare_envs.measures.base import GAP_MIN, STILL
from rare_envs.measures.longitudinal import TTC_MAX
from rare_envs.traffic import vehicle_models
from rare_envs.traffic.bodies import DIAGONAL
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

PerVehicle: TypeAlias = NDArray[np.float32] | tuple[Any, ...]
"""One number of each vehicle, the ego first; those of a tuple stay in registers."""
ZERO, _HALF, ONE, TWO, _FOUR = single(0.0, 0.5, 1.0, 2.0, 4.0)
BODY_LENGTH, _HALF_LENGTH, _HALF_WIDTH = single(VEHICLE_LENGTH, VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2)
_NEAREST, _MAX_SINE, _MAX_STEERING = single(
    vehicle_models.NEAR_ZERO, vehicle_models.MAX_SLIP_SINE, vehicle_models.STEERING_LIMIT
)
_MAX_HEADING, _HEADING_GAIN, _LATERAL_GAIN = single(MAX_HEADING_COMMAND, 1.0 / TAU_HEADING, -TAU_LATERAL)
_LEAST_GAP, _LEAST_SPEED, _LARGEST_TTC = single(GAP_MIN, STILL, TTC_MAX)
_LEAST_RATIO, _FAR, _NOWHERE = single(MIN_RATIO, DIAGONAL, np.inf)


class IDMNumbers(NamedTuple):
    """Parameters of an `IDM` [SI units], in single precision."""

    desired_speed: float
    time_headway: float
    max_acceleration: float
    closing_gain: float
    """1 / (2 sqrt(a_max b))."""
    exponent: float
    jam_distance: float
    jam_distance_speed: float
    max_deceleration: float
    added_length: float
    cut_off: float
    """1 with the cut-off, else 0."""

    @classmethod
    def of(cls, idm: IDM) -> "IDMNumbers":
        """Return the parameters of an IDM."""
        return cls(*single(*(getattr(idm, name) for name in cls._fields)))


class RoadWidth(Protocol):
    """The part of a road's numbers that tells how far its edges are [m]."""

    @property
    def middle(self) -> float:
        """Middle of the whole road, its y."""

    @property
    def half(self) -> float:
        """Half the width of the whole road."""


class RoadNumbers(NamedTuple):
    """A straight `Road` with equal lanes [m], in single precision."""

    first: float
    """Centre of lane 0."""
    last: float
    """Number of the last lane, from 0."""
    width: float
    """Of a lane."""
    middle: float
    """Of the whole road."""
    half: float
    """Half the width of the whole road."""
    reach: float
    """Distance from a lane's centre within which a vehicle reaches into the lane."""

    @classmethod
    def of(cls, road: Road) -> "RoadNumbers":
        """Return the numbers of a road."""
        half, reach = (road.edges[-1] - road.edges[0]) / 2, (road.width + VEHICLE_WIDTH) / 2
        return cls(*single(road.centre(0), road.lanes - 1, road.width, road.middle, half, reach))


@compiled
def clip(value: float, low: float, high: float) -> float:
    """Return `value` within [low, high]."""
    return min(max(value, low), high)


@compiled
def at_least(value: float, low: float) -> float:
    """Return the larger of both, NaN where `value` is, as torch does; `max` would hide it."""
    return low if value < low else value


@compiled
def at_most(value: float, high: float) -> float:
    """Return the smaller of both, NaN where `value` is."""
    return high if value > high else value


@compiled
def sine(angle: float) -> float:
    """Return the sine; the libraries' takes ten times as long for the 0 of a vehicle that drives straight."""
    return angle if angle == ZERO else math.sin(angle)


@compiled
def cosine(angle: float) -> float:
    """Return the cosine, of 0 as `sine` does."""
    return ONE if angle == ZERO else math.cos(angle)


@compiled
def slip_of(steering: float) -> float:
    """Return the slip angle of the bicycle model [rad]."""
    return math.atan(math.tan(steering) * _HALF)


@compiled
def bicycle(
    x: float, y: float, heading: float, speed: float, acceleration: float, steering: float, dt: float
) -> tuple[float, float, float, float]:
    """Return x, y, heading and speed after a tick: `rare_envs.traffic.vehicle_models.bicycle`."""
    slip = slip_of(steering)
    course = heading + slip
    distance = speed * dt
    turn = distance * math.sin(slip) / _HALF_LENGTH
    after = at_least(speed + acceleration * dt, ZERO)
    return x + distance * math.cos(course), y + distance * math.sin(course), heading + turn, after


@compiled
def steering_for(yaw_rate: float, speed: float) -> float:
    """Return the steering angle [rad]: `rare_envs.traffic.vehicle_models.steering_for`."""
    sine = _HALF_LENGTH / max(speed, _NEAREST) * yaw_rate
    slip = math.asin(clip(sine, -_MAX_SINE, _MAX_SINE))
    return clip(math.atan(TWO * math.tan(slip)), -_MAX_STEERING, _MAX_STEERING)


@compiled
def centre_of(y: float, road: RoadNumbers) -> float:
    """Return the centre of the lane that y is in [m]: `Road.centre_of` of equal lanes."""
    lane = clip(np.rint((y - road.first) / road.width), ZERO, road.last)
    return lane * road.width + road.first


@compiled
def lane_keeping(y: float, heading: float, speed: float, road: RoadNumbers) -> float:
    """Return the steering angle [rad]: `rare_envs.control.idm.lane_keeping`."""
    return steer_to_line(y - centre_of(y, road), heading, speed)


@compiled
def steer_to_line(offset: float, heading: float, speed: float) -> float:
    """Return the steering angle [rad]: `rare_envs.control.idm.steering_control`."""
    speed = max(speed, _NEAREST)
    command = math.asin(clip(offset / (_LATERAL_GAIN * speed), -ONE, ONE))
    command = clip(command, -_MAX_HEADING, _MAX_HEADING)
    return steering_for(_HEADING_GAIN * (command - heading), speed)


@compiled
def idm_acceleration(idm: IDMNumbers, speed: float, gap: float, closing_speed: float, desired_speed: float) -> float:
    """Return the acceleration [m/s^2]: `rare_envs.control.idm.IDM.acceleration`."""
    ratio = speed / desired_speed
    square = ratio * ratio
    free = square * square if idm.exponent == _FOUR else ratio**idm.exponent
    return idm_interaction(idm, speed, gap, closing_speed, ratio, free)


@compiled
def idm_interaction(
    idm: IDMNumbers, speed: float, gap: float, closing_speed: float, ratio: float, free: float
) -> float:
    """Return the acceleration [m/s^2] from the speed's ratio to the desired one and that to the power `exponent`."""
    headway = idm.time_headway + closing_speed * idm.closing_gain
    if idm.cut_off > ZERO:
        headway = max(headway, ZERO)
    desired_gap = idm.jam_distance + speed * headway
    if idm.jam_distance_speed != ZERO:
        desired_gap = desired_gap + idm.jam_distance_speed * np.sqrt(max(ratio, _LEAST_RATIO))
    share = desired_gap / max(gap + idm.added_length, _NEAREST)
    return at_least(idm.max_acceleration * (ONE - free - share * share), -idm.max_deceleration)


@compiled
def are_near(dx: float, dy: float) -> bool:
    """Return whether centres are so near that bodies may overlap."""
    return abs(dx) < _FAR and abs(dy) < _FAR


@compiled
def boxes_overlap(dx: float, dy: float, heading: float, other_heading: float) -> bool:
    """Return whether two bodies overlap: `rare_envs.traffic.bodies.boxes_overlap`, where centres are near."""
    if not are_near(dx, dy):
        return False
    cos, sin = math.cos(heading), math.sin(heading)
    turn = other_heading - heading
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    cos, sin = math.cos(turn), math.sin(turn)
    other_along, other_across = along * cos + across * sin, across * cos - along * sin
    cos, sin = abs(cos), abs(sin)
    long, wide = (
        _HALF_LENGTH + _HALF_LENGTH * cos + _HALF_WIDTH * sin,
        _HALF_WIDTH + _HALF_LENGTH * sin + _HALF_WIDTH * cos,
    )
    return abs(along) < long and abs(across) < wide and abs(other_along) < long and abs(other_across) < wide


@compiled
def off_road(y: float, road: RoadWidth) -> bool:
    """Return whether y is beyond an outer edge: `Road.off_road`."""
    return abs(y - road.middle) > road.half


@compiled
def lead_of(
    x: PerVehicle,
    y: PerVehicle,
    heading: PerVehicle,
    speed: PerVehicle,
    road: RoadNumbers,
) -> tuple[float, float]:
    """Return gap [m] and closing speed [m/s] of vehicle 0's lead: `traffic.neighbours.lead_of`; arguments (N,)."""
    return lead_in_lane(x, y, heading, speed, centre_of(y[0], road), road.reach)


@compiled
def lead_in_lane(
    x: PerVehicle,
    y: PerVehicle,
    heading: PerVehicle,
    speed: PerVehicle,
    lane: float,
    reach: float,
) -> tuple[float, float]:
    """Return `lead_of` for a lane [m] and the distance from it within which vehicles reach into it [m]."""
    nearest, lead_speed = _NOWHERE, speed[0]
    for other in range(1, len(x)):
        ahead = x[other] - x[0]
        if ahead >= ZERO and abs(y[other] - lane) <= reach and ahead <= nearest:
            nearest, lead_speed = ahead, speed[other] * cosine(heading[other] - heading[0])
    return nearest - BODY_LENGTH, speed[0] - lead_speed


@compiled
def ttc(gap: float, closing_speed: float, y: float, heading: float, speed: float, road: RoadWidth) -> float:
    """Return the time to collision [s]: `rare_envs.measures.longitudinal.ttc`."""
    across = speed * sine(heading)
    sign: float = np.sign(across)
    room = road.half - (y - road.middle) * sign
    to_edge = max(room, _LEAST_GAP) / max(abs(across), _LEAST_SPEED)
    return at_most(at_most(time_to_lead(gap, closing_speed), to_edge), _LARGEST_TTC)


@compiled
def straight_ttc(gap: float, closing_speed: float) -> float:
    """Return `ttc` of a vehicle that drives straight on, which meets no edge."""
    return at_most(time_to_lead(gap, closing_speed), _LARGEST_TTC)


@compiled
def time_to_lead(gap: float, closing_speed: float) -> float:
    """Return the time to collision with the lead [s], without a cap: `time_to_collision._time_to_lead`."""
    return max(gap, _LEAST_GAP) / at_least(closing_speed, _LEAST_SPEED)
