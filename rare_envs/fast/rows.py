"""Rows of traffic side by side, and their tick, compiled by numba.

A tick is a few loops over rows that do the same arithmetic for each, so that the compiler computes some at once (SIMD).
Sines and the like, which it cannot, stand in loops of their own, for blocks in which any vehicle is off its line. A row
has the same bits in any block.
"""

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rare_envs.fast import equations as eq
from rare_envs.fast.equations import IDMNumbers, RoadNumbers, compiled, inlined, single
from rare_envs.measures.base import COLLISION
from rare_envs.measures.longitudinal import TTC_MAX
from rare_envs.scenarios.cut_in import OVER_THE_LINE, CutterModel
from rare_envs.traffic.state import VEHICLE_LENGTH

SingleArray: TypeAlias = NDArray[np.float32]
OWN = 8
"""Numbers of a row beside those of its vehicles and theta."""
HIT, UNKNOWN, _LARGEST, _NOWHERE = single(COLLISION, -np.inf, TTC_MAX, np.inf)


class CutterNumbers(NamedTuple):
    """A `CutterModel`, in single precision."""

    comfortable: float
    """b of its IDM [m/s^2]."""
    coolness: float
    """Of the heuristic; -1 for the IDM alone."""
    patience: float
    """Ticks from a place being taken to turning back."""
    most_braking: float
    """That it expects of the ego [m/s^2]."""
    reach: float
    """Distance of centres along the road within which the ego is beside it [m]."""
    line: float
    """y at which its body is over the line [m]."""
    reach_across: float
    """Distance of centres across within which it follows the ego ahead of it [m]."""

    @classmethod
    def of(cls, model: CutterModel, dt: float) -> "CutterNumbers":
        """Return the numbers of a model and a tick [s]."""
        reach, coolness = VEHICLE_LENGTH + model.margin, -1.0 if model.coolness is None else model.coolness
        own = (model.idm.comfortable_deceleration, coolness, model.ticks_to_turn(dt), model.most_braking)
        return cls(*single(*own, reach, OVER_THE_LINE, model.reach_across))


class ScriptNumbers(NamedTuple):
    """How the vehicles around the ego move, and where."""

    number: int
    """`STEADY`, `BRAKING`, `CUT_IN` or `HUMAN_CUT_IN`."""
    cutter_idm: IDMNumbers
    """Of a cutter behind its lead."""
    cutter: CutterNumbers
    """The rest of one that drives as people do."""
    road: RoadNumbers
    dt: float
    """Tick [s]."""


class Rows(NamedTuple):
    """B rows of N vehicles, the ego first, in single precision; `rare_envs.simulation.episode.Episode`."""

    x: SingleArray
    """Shape (N, B), likewise the next four."""
    y: SingleArray
    heading: SingleArray
    speed: SingleArray
    cosine: SingleArray
    """Of the heading; of the ego without meaning."""
    theta: SingleArray
    """Of the state, shape (P, B), with the memory of scripts that have some."""
    acceleration: SingleArray
    """Of the ego [m/s^2], shape (B,), likewise the next five."""
    steering: SingleArray
    """Its steering angle [rad]."""
    gap: SingleArray
    """To its lead [m]."""
    closing: SingleArray
    """Closing speed [m/s]."""
    lane: SingleArray
    """Middle of its lane, y [m]."""
    f: SingleArray
    """The measure so far, `HIT` from a collision on, `UNKNOWN` from an action on that is not finite."""
    spare: SingleArray
    """Written over, shape (2, B)."""
    size: int
    """Rows that are driven, the first ones."""


@inlined
def rows_of(table: SingleArray, vehicles: int, size: int) -> Rows:
    """Return the rows in a table of `make_table`, of which the first `size` are driven."""
    end = 4 * vehicles
    own = len(table) - OWN
    return Rows(
        table[:vehicles],
        table[vehicles : 2 * vehicles],
        table[2 * vehicles : 3 * vehicles],
        table[3 * vehicles : end],
        table[own - vehicles : own],
        table[end : own - vehicles],
        table[own],
        table[own + 1],
        table[own + 2],
        table[own + 3],
        table[own + 4],
        table[own + 5],
        table[own + 6 :],
        size,
    )


STEADY, BRAKING, CUT_IN, HUMAN_CUT_IN = range(4)
"""Numbers of scripts: a lead that keeps its speed, one that brakes, a cutter in front of a lead, and one that looks."""


@inlined
def move_others(rows: Rows, script: ScriptNumbers) -> None:
    """Move the vehicles around the ego by a tick, in the place of `Scenario.others`; a scenario has a branch here."""
    x, speed, dt = rows.x[1], rows.speed[1], script.dt
    if script.number == CUT_IN:
        cut_in(rows, script.cutter_idm, dt)
    elif script.number == HUMAN_CUT_IN:
        human_cut_in(rows, script.cutter_idm, script.cutter, dt)
    elif script.number == BRAKING:
        start, loss, lasting, time = rows.theta[0], rows.theta[1], rows.theta[2], rows.theta[3]
        for row in range(rows.size):
            time[row] += dt
            x[row] += speed[row] * dt
            speed[row] = start[row] - loss[row] * eq.lost_share(time[row], lasting[row])
    else:
        for row in range(rows.size):
            x[row] += speed[row] * dt


@inlined
def cut_in(rows: Rows, idm: IDMNumbers, dt: float) -> None:
    """Move cutter and lead: `rare_envs.scenarios.cut_in.others`."""
    x, y, heading, speed, cos = rows.x[1], rows.y[1], rows.heading[1], rows.speed[1], rows.cosine[1]
    lead_x, lead_speed, slope = rows.x[2], rows.speed[2], rows.spare[0]
    lead_y, lead_heading, lead_cos = rows.y[2], rows.heading[2], rows.cosine[2]
    start, length, offset, desired_speed = rows.theta[0], rows.theta[1], rows.theta[2], rows.theta[3]
    bends = False
    for row in range(rows.size):
        gap, closing = lead_x[row] - x[row] - eq.BODY_LENGTH, speed[row] - lead_speed[row] * cos[row]
        ratio = speed[row] / desired_speed[row]
        acceleration = eq.idm_acceleration(idm, speed[row], gap, closing, ratio, eq.fourth_power(ratio))
        x[row] = x[row] + speed[row] * cos[row] * dt
        speed[row] = eq.at_least(speed[row] + acceleration * dt, eq.ZERO)
        lead_x[row] += lead_speed[row] * dt
        lead_y[row], lead_heading[row], lead_cos[row] = eq.ZERO, eq.ZERO, eq.ONE
        y[row], slope[row] = bezier(x[row] - start[row], length[row], offset[row])
        bends |= (slope[row] != eq.ZERO) | (heading[row] != eq.ZERO)
    if bends:
        turn_cutters(rows)


@inlined
def turn_cutters(rows: Rows) -> None:
    """Let cutters head along slopes, which stand in `spare`."""
    heading, cos, slope = rows.heading[1], rows.cosine[1], rows.spare[0]
    for row in range(rows.size):
        heading[row] = slope[row] if slope[row] == eq.ZERO else math.atan(slope[row])
        cos[row] = eq.cosine(heading[row])


_INFINITE = np.float32(np.inf)


@inlined
def human_cut_in(rows: Rows, idm: IDMNumbers, model: CutterNumbers, dt: float) -> None:
    """Move cutter and lead: `rare_envs.scenarios.cut_in.CutterModel.others`; theta has the columns of `CutInTheta`."""
    ego_x, ego_y, ego_speed = rows.x[0], rows.y[0], rows.speed[0]
    x, y, heading, speed, cos = rows.x[1], rows.y[1], rows.heading[1], rows.speed[1], rows.cosine[1]
    lead_x, lead_speed, slope = rows.x[2], rows.speed[2], rows.spare[0]
    lead_y, lead_heading, lead_cos = rows.y[2], rows.heading[2], rows.cosine[2]
    length, offset, desired_speed, delay = rows.theta[0], rows.theta[1], rows.theta[2], rows.theta[3]
    first_speed, onset, lasting, loss = rows.theta[5], rows.theta[6], rows.theta[7], rows.theta[8]
    time, way, waited, over, turned = rows.theta[9], rows.theta[10], rows.theta[11], rows.theta[12], rows.theta[13]
    bends = False
    for row in range(rows.size):
        gap, gap_to_ego = lead_x[row] - x[row] - eq.BODY_LENGTH, ego_x[row] - x[row] - eq.BODY_LENGTH
        behind = (gap_to_ego >= eq.ZERO) & (gap_to_ego < gap) & (abs(ego_y[row] - y[row]) < model.reach_across)
        gap = gap_to_ego if behind else gap
        closing = speed[row] - (ego_speed[row] if behind else lead_speed[row]) * cos[row]
        ratio = speed[row] / desired_speed[row]
        if model.coolness < eq.ZERO:
            free = eq.fourth_power(ratio) if idm.exponent == eq.FOUR else ratio**idm.exponent
            acceleration = eq.idm_acceleration(idm, speed[row], gap, closing, ratio, free)
        else:
            acceleration = eq.improved_acceleration(
                idm, model.comfortable, model.coolness, speed[row], gap, closing, ratio
            )
        over[row] = over[row] + eq.ONE if over[row] >= eq.ZERO else (eq.ZERO if y[row] < model.line else over[row])
        ahead, back = speed[row] * cos[row] * dt, False
        if way[row] < length[row]:
            if over[row] * dt >= delay[row] and is_taken(x[row] - ego_x[row], ego_speed[row] - speed[row], model):
                patience = model.patience if delay[row] == -_INFINITE else eq.ZERO
                back = waited[row] >= patience
                waited[row] += eq.ONE
            else:
                waited[row] = eq.ZERO
            turned[row] = eq.ONE if back else turned[row]
            after = eq.at_least(way[row] - ahead if back else way[row] + ahead, eq.ZERO)
            way[row] = min(after, length[row])
            y[row], slope[row] = bezier(way[row], length[row], offset[row])
            slope[row] = -slope[row] if back else slope[row]
        else:
            waited[row], y[row], slope[row] = eq.ZERO, eq.ZERO, eq.ZERO
        x[row] += ahead
        speed[row] = eq.at_least(speed[row] + acceleration * dt, eq.ZERO)
        time[row] += dt
        lead_x[row] += lead_speed[row] * dt
        if loss[row] > eq.ZERO:
            lead_speed[row] = first_speed[row] - loss[row] * eq.lost_share(time[row] - onset[row], lasting[row])
        lead_y[row], lead_heading[row], lead_cos[row] = eq.ZERO, eq.ZERO, eq.ONE
        bends |= (slope[row] != eq.ZERO) | (heading[row] != eq.ZERO)
    if bends:
        turn_cutters(rows)


@compiled
def is_taken(distance: float, closing: float, model: CutterNumbers) -> bool:
    """Return whether the place that the cutter moves to is taken: part of `CutterModel._decide`."""
    behind, approach = distance - eq.BODY_LENGTH, eq.at_least(closing, eq.ZERO)
    needed = approach * approach / (eq.TWO * eq.at_least(behind, eq.NEAREST))
    return abs(distance) < model.reach or (behind >= eq.ZERO and needed > model.most_braking)


@compiled
def bezier(progress: float, length: float, offset: float) -> tuple[float, float]:
    """Return y and slope of the path: `rare_envs.scenarios.cut_in.bezier`."""
    t = eq.clip(progress / length, eq.ZERO, eq.ONE)
    return offset * (eq.ONE + t * t * (eq.TWO * t - eq.THREE)), offset * (eq.SIX * t * (t - eq.ONE)) / length


@compiled
def begin(rows: Rows, f: SingleArray) -> None:
    """Go on from a moment with the measure (B,) that it has had so far."""
    for row in range(rows.size):
        rows.f[row] = f[row]
    for vehicle in range(len(rows.x)):
        for row in range(rows.size):
            rows.cosine[vehicle, row] = eq.cosine(rows.heading[vehicle, row])


@inlined
def tick(rows: Rows, turns: bool, script: ScriptNumbers) -> bool:
    """Move all by a tick, egos steered if any `turns`, and look; return whether any is off its line."""
    move_others(rows, script)
    move_egos(rows, turns, script.dt)
    mark_hits(rows, turns, script.road)
    return look(rows, turns, script.road)


@inlined
def decide_by_idm(rows: Rows, turns: bool, idm: IDMNumbers) -> None:
    """Decide for the egos: `rare_envs.control.idm.IDM.act`."""
    speed, gap, closing, acceleration = rows.speed[0], rows.gap, rows.closing, rows.acceleration
    if idm.exponent == eq.FOUR:
        for row in range(rows.size):
            ratio = speed[row] / idm.desired_speed
            acceleration[row] = eq.idm_acceleration(
                idm, speed[row], gap[row], closing[row], ratio, eq.fourth_power(ratio)
            )
    else:
        for row in range(rows.size):
            ratio = speed[row] / idm.desired_speed
            free = ratio**idm.exponent
            acceleration[row] = eq.idm_acceleration(idm, speed[row], gap[row], closing[row], ratio, free)
    if turns:
        for row in range(rows.size):
            rows.steering[row] = eq.steer_to_line(rows.y[0, row] - rows.lane[row], rows.heading[0, row], speed[row])


@inlined
def move_egos(rows: Rows, turns: bool, dt: float) -> None:
    """Move the egos by the bicycle model."""
    x, y, heading, speed, acceleration = rows.x[0], rows.y[0], rows.heading[0], rows.speed[0], rows.acceleration
    if turns:
        for row in range(rows.size):
            x[row], y[row], heading[row], speed[row] = eq.bicycle(
                x[row], y[row], heading[row], speed[row], acceleration[row], rows.steering[row], dt
            )
        return
    for row in range(rows.size):
        x[row], speed[row] = eq.keep_straight(x[row], speed[row], acceleration[row], dt)


@inlined
def mark_hits(rows: Rows, turns: bool, road: RoadNumbers) -> None:
    """Set f of the egos that touch another vehicle or are off the road."""
    x, y, heading, f = rows.x[0], rows.y[0], rows.heading[0], rows.f
    for other in range(1, len(rows.x)):
        other_x, other_y, other_heading = rows.x[other], rows.y[other], rows.heading[other]
        near = False
        for row in range(rows.size):
            near |= eq.are_near(other_x[row] - x[row], other_y[row] - y[row])
        if near:
            for row in range(rows.size):
                dx, dy = other_x[row] - x[row], other_y[row] - y[row]
                if f[row] > HIT and eq.boxes_overlap(dx, dy, heading[row], other_heading[row]):
                    f[row] = HIT
    if turns:
        for row in range(rows.size):
            f[row] = HIT if f[row] > HIT and eq.off_road(y[row], road) else f[row]


@inlined
def look(rows: Rows, turns: bool, road: RoadNumbers) -> bool:
    """Find the egos' leads, `rare_envs.traffic.bodies.lead_of`, and let f be the least time to collision so far.

    Return whether any ego, of which any may have left its line if one `turns`, is not in the middle of a lane along it.
    """
    x, speed, f, gap, closing, lane = rows.x[0], rows.speed[0], rows.f, rows.gap, rows.closing, rows.lane
    off_line = turns and find_lanes(rows, road)
    for row in range(rows.size):
        gap[row], closing[row] = _NOWHERE, speed[row]
    for other in range(1, len(rows.x)):
        other_x, other_y, other_speed, cosines = rows.x[other], rows.y[other], rows.speed[other], rows.cosine[other]
        if off_line:
            cosines = rows.spare[0]
            for row in range(rows.size):
                cosines[row] = eq.cosine(rows.heading[other, row] - rows.heading[0, row])
        for row in range(rows.size):
            ahead = other_x[row] - x[row]
            nearer = (ahead >= eq.ZERO) & (abs(other_y[row] - lane[row]) <= road.reach) & (ahead <= gap[row])
            gap[row] = ahead if nearer else gap[row]
            closing[row] = other_speed[row] * cosines[row] if nearer else closing[row]
    for row in range(rows.size):
        gap[row], closing[row] = gap[row] - eq.BODY_LENGTH, speed[row] - closing[row]
        time = eq.at_most(eq.time_to_lead(gap[row], closing[row]), _LARGEST)
        f[row] = eq.at_most(time, f[row])
    if off_line:
        for row in range(rows.size):
            f[row] = eq.at_most(eq.time_to_edge(rows.y[0, row], rows.heading[0, row], speed[row], road), f[row])
    return off_line


@compiled
def find_lanes(rows: Rows, road: RoadNumbers) -> bool:
    """Find the egos' lanes; return whether any is off its line."""
    y, heading, lane, off_line = rows.y[0], rows.heading[0], rows.lane, False
    for row in range(rows.size):
        lane[row] = eq.centre_of(y[row], road)
        off_line |= (heading[row] != eq.ZERO) | (y[row] != lane[row])
    return off_line
