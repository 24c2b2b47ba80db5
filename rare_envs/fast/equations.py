"""Compilation by numba, and the equations of one vehicle or two, in single precision.

Each function is the scalar twin of the torch function that its docstring names, which has the sources and the
explanations. Operations are in the same order, so that the two differ by the rounding of sines and the like alone.
"""

import hashlib
import math
import os
import shutil
import time
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np

from rare_envs.control.idm import IDM, MAX_HEADING_COMMAND, MIN_RATIO, TAU_HEADING, TAU_LATERAL
from rare_envs.measures.base import GAP_MIN, STILL
from rare_envs.traffic.bodies import DIAGONAL
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import MAX_SLIP_SINE, NEAR_ZERO, STEERING_LIMIT, VEHICLE_LENGTH, VEHICLE_WIDTH

Function = TypeVar("Function", bound=Callable[..., object])
PACKAGE = Path(__file__).parents[1]
COMPILED_IN = ("fast", "control", "measures", "scenarios", "simulation", "traffic")
"""Folders with functions and constants that are compiled."""
UNUSED = 7 * 24 * 3600.0
"""Machine code that no process has used for so long [s] is removed."""
_CONFIG: Any = numba.config
_JIT: Any = numba.njit  # its option `_nrt`, memory that numba manages, is not typed


def compiled(function: Function, **options: Any) -> Function:
    """Compile a function when it is first called; division by zero gives inf, as in torch.

    It can make no arrays and return none: it writes into those that it is given. So numba need not count references to
    arrays, which it does by atomic operations at every slice: two thirds of the time of rollouts with a policy.

    Raises:
        ImportError: numba is switched off, and would leave the function to Python.
    """
    if _CONFIG.DISABLE_JIT:
        raise ImportError("NUMBA_DISABLE_JIT is set")
    before, _CONFIG.CACHE_DIR = _CONFIG.CACHE_DIR, _CACHE
    try:
        return cast(Function, _JIT(cache=True, error_model="numpy", _nrt=False, **options)(function))
    finally:
        _CONFIG.CACHE_DIR = before


inlined = partial(compiled, inline="always")
"""Compiles a function into its callers: `Rows` are many numbers to hand over."""
compiled_fused = partial(compiled, fastmath={"contract"})
"""Compiles a function so that products that are added are not rounded before, where the processor can do so."""


def single(*values: float) -> tuple[float, ...]:
    """Return constants in single precision. To the type checker they are floats; numba infers types by itself."""
    return tuple(cast(float, np.float32(value)) for value in values)


def find_cache() -> str:
    """Return the folder of machine code of the sources as they are, below `NUMBA_CACHE_DIR` or beside this file.

    numba looks at a function's own file alone to tell whether its kept code is out of date, not at those of the
    functions and constants that it uses. Folders of other sources are removed when nobody has used them for long.
    """
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(path for name in COMPILED_IN for path in (PACKAGE / name).glob("*.py")):
        at = path.stat()
        digest.update(f"{path} {at.st_mtime_ns} {at.st_size}".encode())
    place = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent / "__pycache__")
    folder = place / f"compiled-{digest.hexdigest()}"
    for other in place.glob("compiled-*"):
        if time.time() - other.stat().st_mtime > UNUSED:
            shutil.rmtree(other, ignore_errors=True)
    return str(folder)


_CACHE = find_cache()


ZERO, HALF, ONE, TWO, THREE, FOUR, SIX = single(0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0)
BODY_LENGTH, _HALF_LENGTH, _HALF_WIDTH = single(VEHICLE_LENGTH, VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2)
NEAREST, _MAX_SINE, _MAX_STEERING = single(NEAR_ZERO, MAX_SLIP_SINE, STEERING_LIMIT)
_MAX_HEADING, _HEADING_GAIN, _LATERAL_GAIN = single(MAX_HEADING_COMMAND, 1.0 / TAU_HEADING, -TAU_LATERAL)
_LEAST_GAP, _LEAST_SPEED, _LEAST_RATIO, _FAR, _LEAST_FREE, _NOTHING = single(
    GAP_MIN, STILL, MIN_RATIO, DIAGONAL, 1e-3, -20.0
)


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
    @lru_cache
    def of(cls, idm: IDM) -> "IDMNumbers":
        """Return the parameters of an IDM."""
        return cls(*single(*(getattr(idm, name) for name in cls._fields)))


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
        first, half = sum(road.edges[:2]) / 2, (road.edges[-1] - road.edges[0]) / 2
        return cls(*single(first, road.lanes - 1, road.width, road.middle, half, (road.width + VEHICLE_WIDTH) / 2))


@compiled
def clip(value: float, low: float, high: float) -> float:
    """Return `value` within [low, high]."""
    return min(max(value, low), high)


@compiled
def at_least(value: float, low: float) -> float:
    """Return the larger of both, NaN if `value` is, as torch does; `max` would hide it."""
    return low if value < low else value


@compiled
def at_most(value: float, high: float) -> float:
    """Return the smaller of both, NaN if `value` is."""
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
def keep_straight(x: float, speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Return x and speed after a tick: `rare_envs.scenarios.base.keep_straight`."""
    return x + speed * dt, at_least(speed + acceleration * dt, ZERO)


@compiled
def lost_share(time: float, duration: float) -> float:
    """Return the share of a loss of speed after a time: `rare_envs.scenarios.hard_brake.lost_share`."""
    u = clip(time / duration, ZERO, ONE)
    return u * u * (THREE - TWO * u)


@compiled
def bicycle(
    x: float, y: float, heading: float, speed: float, acceleration: float, steering: float, dt: float
) -> tuple[float, float, float, float]:
    """Return x, y, heading and speed after a tick: `rare_envs.traffic.state.bicycle`."""
    slip = math.atan(math.tan(steering) * HALF)
    course, distance = heading + slip, speed * dt
    turn = distance * math.sin(slip) / _HALF_LENGTH
    after = at_least(speed + acceleration * dt, ZERO)
    return x + distance * math.cos(course), y + distance * math.sin(course), heading + turn, after


@compiled
def steering_for(yaw_rate: float, speed: float) -> float:
    """Return the steering angle [rad]: `rare_envs.traffic.state.steering_for`."""
    slip = math.asin(clip(_HALF_LENGTH / max(speed, NEAREST) * yaw_rate, -_MAX_SINE, _MAX_SINE))
    return clip(math.atan(TWO * math.tan(slip)), -_MAX_STEERING, _MAX_STEERING)


@compiled
def centre_of(y: float, road: RoadNumbers) -> float:
    """Return the centre of the lane that y is in [m]: `Road.centre_of` of equal lanes."""
    lane = clip(np.rint((y - road.first) / road.width), ZERO, road.last)
    return lane * road.width + road.first


@compiled
def off_road(y: float, road: RoadNumbers) -> bool:
    """Return whether y is beyond an outer edge: `Road.off_road`."""
    return abs(y - road.middle) > road.half


@compiled
def steer_to_line(offset: float, heading: float, speed: float) -> float:
    """Return the steering angle [rad]: `rare_envs.control.idm.yaw_rate_towards`."""
    speed = max(speed, NEAREST)
    command = math.asin(clip(offset / (_LATERAL_GAIN * speed), -ONE, ONE))
    command = clip(command, -_MAX_HEADING, _MAX_HEADING)
    return steering_for(_HEADING_GAIN * (command - heading), speed)


@compiled
def fourth_power(ratio: float) -> float:
    """Return a number to the fourth, by two products."""
    square = ratio * ratio
    return square * square


@compiled
def idm_acceleration(idm: IDMNumbers, speed: float, gap: float, closing: float, ratio: float, free: float) -> float:
    """Return the acceleration [m/s^2], of speed / desired speed and its power `free`: `IDM.acceleration`."""
    interaction = idm_interaction(idm, speed, gap, closing, ratio)
    return at_least(idm.max_acceleration * (ONE - free - interaction), -idm.max_deceleration)


@compiled
def idm_interaction(idm: IDMNumbers, speed: float, gap: float, closing: float, ratio: float) -> float:
    """Return the square of desired gap / gap: `IDM.interaction`."""
    headway = idm.time_headway + closing * idm.closing_gain
    if idm.cut_off > ZERO:
        headway = max(headway, ZERO)
    desired_gap = idm.jam_distance + speed * headway
    if idm.jam_distance_speed != ZERO:
        desired_gap = desired_gap + idm.jam_distance_speed * np.sqrt(max(ratio, _LEAST_RATIO))
    share = desired_gap / max(gap + idm.added_length, NEAREST)
    return share * share


@compiled
def improved_acceleration(
    idm: IDMNumbers, comfortable: float, coolness: float, speed: float, gap: float, closing: float, ratio: float
) -> float:
    """Return the acceleration [m/s^2] behind a steady lead: `rare_envs.control.idm.improved_acceleration`."""
    a, interaction = idm.max_acceleration, idm_interaction(idm, speed, gap, closing, ratio)
    near = a - interaction * a
    if ratio > ONE:
        above = (ratio ** (-a * idm.exponent / comfortable) - ONE) * comfortable
        improved = above + min(near, ZERO)
    elif interaction >= ONE:
        improved = near
    else:
        improved = (ONE - (fourth_power(ratio) if idm.exponent == FOUR else ratio**idm.exponent)) * a
        free = max(improved, _LEAST_FREE)
        if (interaction - ONE) * a > _NOTHING * free:  # else the share is less than what all is rounded by
            improved -= improved * math.exp(math.log(max(interaction, _LEAST_RATIO)) * (a / free))
    approach = at_least(closing, ZERO)
    heuristic = ZERO if approach == ZERO else -(approach * approach) / (max(gap, NEAREST) * TWO)
    less = improved - heuristic
    if less < ZERO:
        milder = math.tanh(less / comfortable) * comfortable + heuristic
        improved += coolness * (milder - improved)
    return clip(improved, -idm.max_deceleration, a)


@compiled
def are_near(dx: float, dy: float) -> bool:
    """Return whether centres are so near that bodies may overlap."""
    return (abs(dx) < _FAR) & (abs(dy) < _FAR)


@compiled
def boxes_overlap(dx: float, dy: float, heading: float, other_heading: float) -> bool:
    """Return whether two bodies overlap: `rare_envs.traffic.bodies.boxes_overlap`, where centres are near."""
    if not are_near(dx, dy):
        return False
    cos, sin = cosine(heading), sine(heading)
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    cos, sin = cosine(other_heading - heading), sine(other_heading - heading)
    other_along, other_across = along * cos + across * sin, across * cos - along * sin
    cos, sin = abs(cos), abs(sin)
    long = _HALF_LENGTH + _HALF_LENGTH * cos + _HALF_WIDTH * sin
    wide = _HALF_WIDTH + _HALF_LENGTH * sin + _HALF_WIDTH * cos
    return abs(along) < long and abs(across) < wide and abs(other_along) < long and abs(other_across) < wide


@compiled
def time_to_lead(gap: float, closing: float) -> float:
    """Return the time to collision with the lead [s], without a cap: `longitudinal._time_to_lead`."""
    return max(gap, _LEAST_GAP) / at_least(closing, _LEAST_SPEED)


@compiled
def time_to_edge(y: float, heading: float, speed: float, road: RoadNumbers) -> float:
    """Return the time until the centre leaves the road [s]: `longitudinal.time_to_edge`."""
    across = speed * sine(heading)
    sign: float = np.sign(across)
    room = road.half - (y - road.middle) * sign
    return max(room, _LEAST_GAP) / max(abs(across), _LEAST_SPEED)
