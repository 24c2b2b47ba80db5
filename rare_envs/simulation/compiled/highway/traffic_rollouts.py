"""Whole rollouts on a curved road among learned drivers, compiled by numba: traffic at time 0 to f and its terms.

`SLOTS` rollouts go on side by side, tick by tick: lidar and network of all their drivers are computed at once, the rest
for one after the other. Where one ends, with its collision or at the horizon, the next row takes its slot. Drivers side
by side do not depend on each other, so f of a row is the same bits in any batch.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.measures.base import COLLISION
from rare_envs.sensors.lidar import BEAMS
from rare_envs.simulation.compiled.compilation import compiled, single
from rare_envs.simulation.compiled.equations import (
    IDMNumbers,
    at_most,
    boxes_overlap,
    idm_acceleration,
    lead_in_lane,
    off_road,
    steer_to_line,
    steering_for,
    ttc,
)
from rare_envs.simulation.compiled.highway.curved_road import (
    CurvedRoadNumbers,
    bicycle_on_curve,
    lane_at,
    lane_middle,
    place_on_curve,
    point_on_curve,
)
from rare_envs.simulation.compiled.highway.driver_lanes import (
    DriverBuffers,
    DriverNumbers,
    apply_drivers,
    decide_action,
    next_noise,
    write_beam_features,
    write_own_features,
)
from rare_envs.simulation.compiled.highway.lidar_lanes import (
    BEAM_FIELDS,
    BODY_FIELDS,
    LOOKING,
    measure_beams,
    place_body,
)
from rare_envs.simulation.compiled.highway.moment_terms import clearances, lidar_times, time_terms
from rare_envs.simulation.compiled.rollouts import SingleArray

_HIT, _FAR = single(COLLISION, np.inf)
FIRST_DRAW = 2
"""Draws before those of the ticks."""


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

    learned_ego: bool
    """Whether the ego is a learned driver, else the IDM."""
    by_lidar: bool
    """Whether f is the least time along the ego's beams, else the time to collision with the lead."""
    terms: int
    """Which terms are wanted: 0 none, 1 distances, 2 times along beams, 3 times to collision."""
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


@compiled
def drive_among_learned(
    rows: TrafficRows,
    driver: DriverNumbers,
    buffers: DriverBuffers,
    ego: DriverNumbers,
    ego_buffers: DriverBuffers,
    idm: IDMNumbers,
    road: CurvedRoadNumbers,
    rules: Rules,
    found: Found,
) -> None:
    """Drive rows from start to horizon.

    Args:
        rows: The traffic; moved on.
        driver: Of the vehicles around the ego.
        buffers: For N - 1 of them in each slot.
        ego: The ego, if it is a learned driver.
        ego_buffers: For one in each slot.
        idm: The ego, if it is the IDM.
        road: The road.
        rules: What is simulated and measured.
        found: Written to.
    """
    vehicles, dt = rows.x.shape[1], rules.dt
    others = vehicles - 1
    slots = min(buffers.features.shape[1] // others, ego_buffers.features.shape[1])
    row_of, done = np.full(slots, -1), np.zeros(slots, dtype=np.int64)
    x, y, heading, cos, sin, curvature = np.zeros((6, slots, vehicles), dtype=np.float32)
    poses = Poses(x, y, heading, cos, sin, curvature)
    gap, closing = np.zeros((2, slots), dtype=np.float32)
    seen = np.zeros((others, BODY_FIELDS * LOOKING), dtype=np.float32)
    ego_seen = np.zeros_like(seen)
    beams = np.zeros((BEAMS, BEAM_FIELDS * LOOKING), dtype=np.float32)
    ego_beams = np.zeros_like(beams)
    ego_looks, next_row, running = rules.learned_ego or rules.by_lidar, 0, 0
    while True:
        for slot in range(slots):
            if row_of[slot] < 0 and next_row < len(rows.x):
                row_of[slot], done[slot] = next_row, 0
                begin_row(rows, next_row, slot, buffers, found)
                place_row(rows, next_row, slot, poses, road)
                next_row, running = next_row + 1, running + 1
        if running == 0:
            return
        for slot in range(slots):
            if row_of[slot] >= 0:
                speed = rows.speed[row_of[slot]]
                for vehicle in range(1, vehicles):
                    place_bodies(poses, speed, slot, vehicle, seen, others * slot + vehicle - 1)
                if ego_looks:
                    place_bodies(poses, speed, slot, 0, ego_seen, slot)
        if ego_looks:
            measure_beams(ego_seen, ego_beams)
        for slot in range(slots):
            if row_of[slot] >= 0:
                gap[slot], closing[slot] = measure_row(
                    rows, row_of[slot], slot, done[slot], poses, ego_beams, road, rules, found
                )
                if done[slot] == rules.ticks:
                    row_of[slot], running = -1, running - 1
        if running == 0:
            continue
        measure_beams(seen, beams)
        observe_drivers(rows, row_of, poses, beams, 1, driver, buffers, road)
        apply_drivers(driver, buffers)
        if rules.learned_ego:
            observe_drivers(rows, row_of, poses, ego_beams, 0, ego, ego_buffers, road)
            apply_drivers(ego, ego_buffers)
        for slot in range(slots):
            row = row_of[slot]
            if row < 0:
                continue
            place = curvature[slot, 0]
            if rules.learned_ego:
                acceleration, steering = steer_as_learned(rows, row, slot, place, ego, ego_buffers)
            else:
                acceleration = idm_acceleration(idm, rows.speed[row, 0], gap[slot], closing[slot], idm.desired_speed)
                offset = rows.y[row, 0] - lane_middle(rows.y[row, 0], road)
                steering = steer_to_line(offset, rows.heading[row, 0], rows.speed[row, 0])
            moved = bicycle_on_curve(
                rows.x[row, 0],
                rows.y[row, 0],
                rows.heading[row, 0],
                rows.speed[row, 0],
                acceleration,
                steering,
                dt,
                place,
            )
            move_drivers(rows, row, slot, done[slot], poses, driver, buffers, dt)
            rows.x[row, 0], rows.y[row, 0], rows.heading[row, 0], rows.speed[row, 0] = moved
            place_row(rows, row, slot, poses, road)
            done[slot] += 1
            if has_collided(rows, row, slot, poses, road):
                record_collision(rows, row, slot, done[slot], poses, road, rules, found)
                row_of[slot], running = -1, running - 1


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


@compiled
def observe_drivers(
    rows: TrafficRows,
    row_of: NDArray[np.int64],
    poses: Poses,
    beams: SingleArray,
    first: int,
    driver: DriverNumbers,
    buffers: DriverBuffers,
    road: CurvedRoadNumbers,
) -> None:
    """Write the features of all drivers: of vehicles 1 to N - 1 with `first` 1, of the egos with 0."""
    write_beam_features(buffers.features, beams, driver)
    each = rows.x.shape[1] - 1 if first else 1
    for slot in range(len(row_of)):
        row = row_of[slot]
        if row < 0:
            continue
        for vehicle in range(first, first + each):
            y, lane = rows.y[row, vehicle], lane_at(rows.y[row, vehicle], road)
            left, right = y - road.edges[lane], road.edges[lane + 1] - y
            write_own_features(
                buffers.features,
                each * slot + vehicle - first,
                rows.heading[row, vehicle],
                rows.speed[row, vehicle],
                poses.curvature[slot, vehicle],
                left,
                right,
                driver,
            )


@compiled
def steer_as_learned(
    rows: TrafficRows, row: int, slot: int, curvature: float, ego: DriverNumbers, buffers: DriverBuffers
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and steering angle [rad]: `agents.learned.driver.LearnedEgo.act`."""
    still = np.zeros(2, dtype=np.float32)
    acceleration, yaw_rate = decide_action(buffers.outputs, slot, still, ego)
    speed = rows.speed[row, 0]
    return acceleration, steering_for(yaw_rate + speed * curvature, speed)


@compiled
def move_drivers(
    rows: TrafficRows,
    row: int,
    slot: int,
    tick: int,
    poses: Poses,
    driver: DriverNumbers,
    buffers: DriverBuffers,
    dt: float,
) -> None:
    """Move vehicles 1 to N - 1 of a row by a tick."""
    noise, others = np.zeros(2, dtype=np.float32), rows.x.shape[1] - 1
    for other in range(1, others + 1):
        if rows.draws.shape[1]:
            draws = rows.draws[row, FIRST_DRAW + tick, other - 1]
            next_noise(rows.memory[row, other - 1], draws, driver, noise)
        acceleration, yaw_rate = decide_action(buffers.outputs, others * slot + other - 1, noise, driver)
        moved = point_on_curve(
            rows.x[row, other],
            rows.y[row, other],
            rows.heading[row, other],
            rows.speed[row, other],
            acceleration,
            yaw_rate,
            dt,
            poses.curvature[slot, other],
        )
        rows.x[row, other], rows.y[row, other], rows.heading[row, other], rows.speed[row, other] = moved


@compiled
def has_collided(rows: TrafficRows, row: int, slot: int, poses: Poses, road: CurvedRoadNumbers) -> bool:
    """Return whether the ego touches another vehicle or is off the road."""
    return touches_another(poses, slot) or off_road(rows.y[row, 0], road)


@compiled
def touches_another(poses: Poses, slot: int) -> bool:
    """Return whether the ego's body overlaps another: `rare_envs.traffic.overlap.ego_overlaps`."""
    x, y, heading = poses.x[slot], poses.y[slot], poses.heading[slot]
    for other in range(1, len(x)):
        if boxes_overlap(x[other] - x[0], y[other] - y[0], heading[0], heading[other]):
            return True
    return False


@compiled
def measure_row(
    rows: TrafficRows,
    row: int,
    slot: int,
    tick: int,
    poses: Poses,
    ego_beams: SingleArray,
    road: CurvedRoadNumbers,
    rules: Rules,
    found: Found,
) -> tuple[float, float]:
    """Measure a moment without a collision; return gap [m] and closing speed [m/s] of the ego's lead."""
    x, y, heading, speed = rows.x[row], rows.y[row], rows.heading[row], rows.speed[row]
    gap, closing = lead_in_lane(x, y, heading, speed, lane_middle(y[0], road), road.reach)
    others = len(x) - 1
    latest = np.empty(2 * others + 1, dtype=np.float32)
    if rules.by_lidar:
        value = lidar_times(ego_beams, slot, latest)
        count = 2 * others
    else:
        value = ttc(gap, closing, y[0], heading[0], speed[0], road)
        count = others
    found.f[row] = at_most(value, found.f[row])
    if rules.terms == 1:
        late = others if tick > rules.cut else 0
        clearances(poses.x[slot], poses.y[slot], poses.heading[slot], found.values[row, late : late + others], latest)
        lower_terms(found, row, tick, late, latest, count)
    elif rules.terms == 2:
        lower_terms(found, row, tick, 0, latest, count)
    elif rules.terms == 3:
        time_terms(x, y, heading, speed, lane_middle(y[0], road), road, latest)
        lower_terms(found, row, tick, 0, latest, others + 1)
    return gap, closing


@compiled
def lower_terms(found: Found, row: int, tick: int, first: int, latest: SingleArray, count: int) -> None:
    """Take `count` terms of a moment where they are less than those so far, which begin at number `first`."""
    for number in range(count):
        if latest[number] < found.values[row, first + number]:
            found.values[row, first + number] = latest[number]
            found.ticks[row, first + number] = tick


@compiled
def record_collision(
    rows: TrafficRows,
    row: int,
    slot: int,
    tick: int,
    poses: Poses,
    road: CurvedRoadNumbers,
    rules: Rules,
    found: Found,
) -> None:
    """Write what a collision counts as: `rare_envs.measures.terms.TermTracker.update`."""
    if rules.by_lidar:
        return
    found.f[row] = _HIT
    if rules.terms == 0:
        return
    others = rows.x.shape[1] - 1
    distances, enough = np.empty(others, dtype=np.float32), np.full(others, np.inf, dtype=np.float32)
    clearances(poses.x[slot], poses.y[slot], poses.heading[slot], enough, distances)
    term = np.argmin(distances)
    if rules.terms == 1:
        term += others if tick > rules.cut else 0
    elif off_road(rows.y[row, 0], road) and not touches_another(poses, slot):
        term = others
    found.values[row, term], found.ticks[row, term] = _HIT, tick
