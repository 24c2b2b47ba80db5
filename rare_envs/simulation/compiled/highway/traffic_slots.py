"""Rows of traffic on a curved road, and the slots in which some of them are driven side by side, compiled by numba."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.compilation import compiled, single, whole
from rare_envs.sensors.lidar import BEAMS
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers, place_on_curve
from rare_envs.simulation.compiled.highway.driver_lanes import DriverBuffers
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_FIELDS, BODY_FIELDS, LOOKING, place_body
from rare_envs.simulation.compiled.rollouts import SingleArray

NO_ROW = -1
"""Stands for the row of a slot in which none is driven."""
(_FAR,) = single(np.inf)
(_EGO,) = whole(0)


class TrafficRows(NamedTuple):
    """B rows of N vehicles at time 0, the ego first, in single precision; moved on."""

    x: SingleArray
    """Shape (B, N), likewise the next three."""
    y: SingleArray
    heading: SingleArray
    speed: SingleArray
    weights: SingleArray
    """Of the drivers' last layers, shape (B, W); W = 0 for the driver's own."""
    draws: SingleArray
    """Standard normal, shape (B, 2 + ticks, N - 1, 2); (B, 0, N - 1, 2) without noise."""
    memory: SingleArray
    """Of the noise, shape (B, N - 1, 2, 2)."""
    minds: SingleArray
    """What drivers keep in mind of lane changes, shape (B, N - 1, 10); (B, N - 1, 0) if they make none by rule."""


class Found(NamedTuple):
    """Results of B rows."""

    f: SingleArray
    """Shape (B,)."""
    values: SingleArray
    """Terms, shape (B, J); J = 0 if they are not wanted."""
    ticks: NDArray[np.int64]
    """At which they are attained, likewise."""


class Rules(NamedTuple):
    """What is simulated and measured."""

    measure: int
    """One of `measure_kinds.MEASURE_KINDS`."""
    any_collision: bool
    """Whether collisions between other vehicles count as well."""
    terms: int
    """Which terms are wanted, see `measure_kinds.ORDERS`."""
    cut: float
    """Tick beyond which a term counts as a late one; infinite without such."""
    dt: float
    ticks: int


class Poses(NamedTuple):
    """Where the vehicles of the slots are in the flat world, shape (slots, N) each."""

    x: SingleArray
    y: SingleArray
    heading: SingleArray
    cos: SingleArray
    """Of the heading, likewise the sine."""
    sin: SingleArray
    curvature: SingleArray
    """Of the road."""


class Slots(NamedTuple):
    """Slots in which rows are driven side by side, written over at every tick."""

    row: NDArray[np.int64]
    """Number of the row, or `NO_ROW`, shape (slots,), likewise the next three."""
    tick: NDArray[np.int64]
    gap: SingleArray
    """To the ego's lead [m]."""
    closing: SingleArray
    """Speed at which it shrinks [m/s]."""
    poses: Poses
    latest: SingleArray
    """Terms of a moment of one slot, shape (more than a measure has,), likewise the next."""
    enough: SingleArray
    """Distances above which they need not be exact."""

    @classmethod
    def of(cls, slots: int, vehicles: int) -> "Slots":
        """Return free slots for rows of N vehicles."""
        poses = Poses(*np.zeros((len(Poses._fields), slots, vehicles), dtype=np.float32))
        gap, closing = np.zeros((2, slots), dtype=np.float32)
        latest, enough = np.zeros((2, vehicles * (vehicles + 3) // 2), dtype=np.float32)
        return cls(np.full(slots, NO_ROW), np.zeros(slots, dtype=np.int64), gap, closing, poses, latest, enough)


class Sight(NamedTuple):
    """What the vehicles of all slots see, written over at every tick; arguments of `measure_beams`."""

    seen: SingleArray
    """By the drivers around the ego."""
    beams: SingleArray
    ego_seen: SingleArray
    """By the egos."""
    ego_beams: SingleArray

    @classmethod
    def of(cls, vehicles: int) -> "Sight":
        """Return arrays for rows of N vehicles."""
        shapes = 2 * ((vehicles - 1, BODY_FIELDS * LOOKING), (BEAMS, BEAM_FIELDS * LOOKING))
        return cls(*(np.zeros(shape, dtype=np.float32) for shape in shapes))


@compiled
def fill_slots(
    rows: TrafficRows, next_row: int, slots: Slots, buffers: DriverBuffers, road: CurvedRoadNumbers, found: Found
) -> int:
    """Begin rows in the slots that are free, and return the number of the next row."""
    for slot in range(len(slots.row)):
        if slots.row[slot] == NO_ROW and next_row < len(rows.x):
            slots.row[slot], slots.tick[slot] = next_row, 0
            begin_row(rows, next_row, slot, buffers, found)
            place_row(rows, next_row, slot, slots.poses, road)
            next_row += 1
    return next_row


@compiled
def are_free(slots: Slots) -> bool:
    """Return whether no row is driven."""
    for slot in range(len(slots.row)):
        if slots.row[slot] != NO_ROW:
            return False
    return True


@compiled
def begin_row(rows: TrafficRows, row: int, slot: int, buffers: DriverBuffers, found: Found) -> None:
    """Put the weights of a row's drivers, if it has any, into the places of its slot."""
    found.f[row] = _FAR
    others = rows.x.shape[1] - 1
    for driver in range(others * slot, others * (slot + 1)):
        for number in range(rows.weights.shape[1]):
            buffers.head[number, driver] = rows.weights[row, number]


@compiled
def place_row(rows: TrafficRows, row: int, slot: int, poses: Poses, road: CurvedRoadNumbers) -> None:
    """Write where the vehicles of a row are in the flat world."""
    for vehicle in range(rows.x.shape[1]):
        place = place_on_curve(rows.x[row, vehicle], rows.y[row, vehicle], rows.heading[row, vehicle], road)
        poses.x[slot, vehicle], poses.y[slot, vehicle], poses.heading[slot, vehicle] = place[0], place[1], place[2]
        poses.cos[slot, vehicle], poses.sin[slot, vehicle], poses.curvature[slot, vehicle] = (
            place[3],
            place[4],
            place[5],
        )


@compiled
def see_others(rows: TrafficRows, slots: Slots, sight: Sight, egos: bool) -> None:
    """Write the bodies that each driver sees, and each ego if that is wanted."""
    others = rows.x.shape[1] - 1
    for slot in range(len(slots.row)):
        if slots.row[slot] == NO_ROW:
            continue
        speed = rows.speed[slots.row[slot]]
        for vehicle in range(1, others + 1):
            place_bodies(slots.poses, speed, slot, vehicle, sight.seen, others * slot + vehicle - 1)
        if egos:
            place_bodies(slots.poses, speed, slot, _EGO, sight.ego_seen, slot)


@compiled
def place_bodies(poses: Poses, speed: SingleArray, slot: int, vehicle: int, seen: SingleArray, observer: int) -> None:
    """Write the other vehicles as one of a slot sees them; speeds have shape (N,)."""
    x, y, cos, sin = poses.x[slot], poses.y[slot], poses.cos[slot], poses.sin[slot]
    along, across, body = speed[vehicle] * cos[vehicle], speed[vehicle] * sin[vehicle], 0
    for other in range(len(x)):
        if other == vehicle:
            continue
        place_body(
            seen[body],
            observer,
            x[other] - x[vehicle],
            y[other] - y[vehicle],
            cos[vehicle],
            sin[vehicle],
            cos[other],
            sin[other],
            speed[other] * cos[other] - along,
            speed[other] * sin[other] - across,
        )
        body += 1
