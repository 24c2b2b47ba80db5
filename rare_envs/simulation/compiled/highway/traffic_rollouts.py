"""Whole rollouts on a curved road among learned drivers, compiled by numba: traffic at time 0 to f and its terms.

Some rollouts go on side by side in slots, tick by tick: lidar and network of all their drivers are computed at once,
the rest for one after the other. Where one ends, with its collision or at the horizon, the next row takes its slot.
Drivers side by side do not depend on each other, so f of a row is the same bits in any batch.
"""

import numpy as np

from rare_envs.compilation import compiled, single, whole
from rare_envs.simulation.compiled.highway.avoidance_lanes import limit_action
from rare_envs.simulation.compiled.highway.curved_road import (
    CurvedRoadNumbers,
    bicycle_on_curve,
    lane_at,
    point_on_curve,
)
from rare_envs.simulation.compiled.highway.driver_lanes import (
    NO_NOISE,
    DriverBuffers,
    DriverNumbers,
    apply_drivers,
    decide_action,
    next_noise,
    write_beam_features,
    write_own_features,
)
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import perceive_own
from rare_envs.simulation.compiled.highway.driving_rules.rule_lanes import apply_rules
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import TrafficRules
from rare_envs.simulation.compiled.highway.ego_lanes import (
    BY_DRIVER,
    BY_POLICY,
    EgoNumbers,
    apply_policies,
    decide_ego,
    steer_as_learned,
)
from rare_envs.simulation.compiled.highway.lidar_lanes import measure_beams
from rare_envs.simulation.compiled.highway.measure_kinds import BY_LIDAR
from rare_envs.simulation.compiled.highway.row_measures import has_collided, measure_rows, record_collision
from rare_envs.simulation.compiled.highway.traffic_slots import (
    NO_ROW,
    Found,
    Rules,
    Sight,
    Slots,
    TrafficRows,
    are_free,
    fill_slots,
    place_row,
    see_others,
)
from rare_envs.simulation.compiled.rollouts import SingleArray

FIRST_DRAW = 2
"""Draws before those of the ticks."""
(_UNKNOWN,) = single(np.nan)
_FIRST_ROW, _EGO, _OTHERS = whole(0, 0, 1)


@compiled
def drive_among_learned(
    rows: TrafficRows,
    slots: Slots,
    sight: Sight,
    driver: DriverNumbers,
    buffers: DriverBuffers,
    ego: EgoNumbers,
    road: CurvedRoadNumbers,
    rules: Rules,
    found: Found,
    driving_rules: TrafficRules | None,
) -> None:
    """Drive rows from start to horizon.

    Args:
        rows: The traffic; moved on.
        slots: In which they are driven.
        sight: Of the vehicles in the slots.
        driver: Of the vehicles around the ego.
        buffers: For N - 1 of them in each slot.
        ego: The ego, with arrays for one in each slot.
        road: The road.
        rules: What is simulated and measured.
        found: Written to.
        driving_rules: Of everybody; with None the compiler leaves out what has to do with them.
    """
    ego_looks, next_row = ego.kind == BY_DRIVER or rules.measure == BY_LIDAR, _FIRST_ROW
    while True:
        next_row = fill_slots(rows, next_row, slots, buffers, road, found)
        if are_free(slots):
            return
        see_others(rows, slots, sight, ego_looks)
        if ego_looks:
            measure_beams(sight.ego_seen, sight.ego_beams)
        measure_rows(rows, slots, sight.ego_beams, road, rules, found)
        if are_free(slots):
            continue
        measure_beams(sight.seen, sight.beams)
        observe_drivers(rows, slots, sight.beams, _OTHERS, driver, buffers, road)
        apply_drivers(driver, buffers)
        decide_drivers(rows, slots, sight.beams, driver, buffers, road, driving_rules)
        if ego.kind == BY_POLICY:
            apply_policies(rows, slots, ego)
        elif ego.kind == BY_DRIVER:
            observe_drivers(rows, slots, sight.ego_beams, _EGO, ego.driver, ego.buffers, road)
            apply_drivers(ego.driver, ego.buffers)
            steer_as_learned(rows, slots, sight.ego_beams, ego, road, driving_rules)
        move_rows(rows, slots, buffers, ego, road, rules, found)


@compiled
def observe_drivers(
    rows: TrafficRows,
    slots: Slots,
    beams: SingleArray,
    first: int,
    driver: DriverNumbers,
    buffers: DriverBuffers,
    road: CurvedRoadNumbers,
) -> None:
    """Write the features of all drivers: of vehicles 1 to N - 1 with `first` 1, of the egos with 0."""
    write_beam_features(buffers.features, beams, driver)
    each = rows.x.shape[1] - 1 if first else 1
    for slot in range(len(slots.row)):
        row = slots.row[slot]
        if row == NO_ROW:
            continue
        for vehicle in range(first, first + each):
            y, lane = rows.y[row, vehicle], lane_at(rows.y[row, vehicle], road)
            left, right = y - road.edges[lane], road.edges[lane + 1] - y
            write_own_features(
                buffers.features,
                each * slot + vehicle - first,
                rows.heading[row, vehicle],
                rows.speed[row, vehicle],
                slots.poses.curvature[slot, vehicle],
                left,
                right,
                driver,
            )


@compiled
def decide_drivers(
    rows: TrafficRows,
    slots: Slots,
    beams: SingleArray,
    driver: DriverNumbers,
    buffers: DriverBuffers,
    road: CurvedRoadNumbers,
    driving_rules: TrafficRules | None,
) -> None:
    """Write the actions of vehicles 1 to N - 1 of all slots, whose network has been applied."""
    others = rows.x.shape[1] - 1
    for slot in range(len(slots.row)):
        row, noise, fresh = slots.row[slot], NO_NOISE, NO_NOISE
        if row == NO_ROW:
            continue
        for other in range(1, others + 1):
            if rows.draws.shape[1]:
                draws = rows.draws[row, FIRST_DRAW + slots.tick[slot], other - 1]
                noise, fresh = next_noise(rows.memory[row, other - 1], draws, driver), (draws[0], draws[1])
            lane, speed = others * slot + other - 1, rows.speed[row, other]
            action = decide_action(buffers.outputs, lane, noise, driver)
            if driving_rules is None:
                action = limit_action(action[0], action[1], speed, beams, lane, driver.avoidance)
            else:
                own = perceive_own(rows.y[row, other], rows.heading[row, other], speed, road)
                action = apply_rules(action, own, beams, lane, rows.minds[row, other - 1], fresh, driving_rules.drivers)
            buffers.actions[0, lane], buffers.actions[1, lane] = action


@compiled
def move_rows(
    rows: TrafficRows,
    slots: Slots,
    buffers: DriverBuffers,
    ego: EgoNumbers,
    road: CurvedRoadNumbers,
    rules: Rules,
    found: Found,
) -> None:
    """Move all rows by a tick, and free the slots of those with a collision; arguments as of `drive_among_learned`.

    f is NaN where the actions of a policy are not finite.
    """
    for slot in range(len(slots.row)):
        row = slots.row[slot]
        if row == NO_ROW:
            continue
        acceleration, steering = decide_ego(rows, slots, slot, ego, road)
        if acceleration != acceleration:
            found.f[row], slots.row[slot] = _UNKNOWN, NO_ROW
            continue
        move_ego(rows, slots, slot, acceleration, steering, rules.dt)
        move_drivers(rows, slots, slot, buffers.actions, rules.dt)
        place_row(rows, row, slot, slots.poses, road)
        slots.tick[slot] += 1
        if has_collided(rows, row, slot, slots.poses, road, rules.any_collision):
            record_collision(rows, slots, slot, road, rules, found)
            slots.row[slot] = NO_ROW


@compiled
def move_ego(rows: TrafficRows, slots: Slots, slot: int, acceleration: float, steering: float, dt: float) -> None:
    """Move the ego of a slot by a tick."""
    row = slots.row[slot]
    moved = bicycle_on_curve(
        rows.x[row, 0],
        rows.y[row, 0],
        rows.heading[row, 0],
        rows.speed[row, 0],
        acceleration,
        steering,
        dt,
        slots.poses.curvature[slot, 0],
    )
    rows.x[row, 0], rows.y[row, 0], rows.heading[row, 0], rows.speed[row, 0] = moved


@compiled
def move_drivers(rows: TrafficRows, slots: Slots, slot: int, actions: SingleArray, dt: float) -> None:
    """Move vehicles 1 to N - 1 of a slot by a tick."""
    row, others = slots.row[slot], rows.x.shape[1] - 1
    for other in range(1, others + 1):
        lane = others * slot + other - 1
        moved = point_on_curve(
            rows.x[row, other],
            rows.y[row, other],
            rows.heading[row, other],
            rows.speed[row, other],
            actions[0, lane],
            actions[1, lane],
            dt,
            slots.poses.curvature[slot, other],
        )
        rows.x[row, other], rows.y[row, other], rows.heading[row, other], rows.speed[row, other] = moved
