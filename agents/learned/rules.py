"""Rules laid over the actions of a learned driver: collision avoidance and lane changes, from what its lidar tells.

References:
    Krauss, "Microscopic modeling of traffic flow", 1998, after Gipps, "A behavioural car-following
    model for computer simulation", 1981: the safe speed.
    Treiber and Kesting, "Traffic Flow Dynamics", 2013, chapter 11: the kinematic deceleration and usual values.
    AASHTO, "A Policy on Geometric Design of Highways and Streets", 2011, table 2-2: turning radius of a car.
    Cox and Oakes, "Analysis of Survival Data", 1984: hazard rates.
    Gipps, "A model for the structure of lane-changing decisions", 1986: acceptance of gaps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.control.idm import check_numbers
from rare_envs.devices import constant
from rare_envs.sensors import lidar
from rare_envs.sensors.lidar import AHEAD_BEAM, FEATURES, MAX_RANGE
from rare_envs.simulation.episode import LEARNED_TICK

LEFT_MARKER_COLUMN, RIGHT_MARKER_COLUMN = FEATURES.index("left_marker"), FEATURES.index("right_marker")
_LENGTH, _WIDTH = FEATURES.index("length"), FEATURES.index("width")
_FORWARD, _SIDEWAYS, _ACROSS, _ALONG = 0.5, 0.3, 0.75, 0.25
"""Least cosine of beams that look ahead (to 54 degrees), least sine of those that look aside (from 18) and of those
whose range rate is taken for lateral motion (from 54), least cosine of those whose is taken for motion along."""
_LEAST_GAP, _LEAST_SPEED = 0.1, 1.0
"""Least divisors [m] and [m/s]."""
_LINE_OVERLAP, _SHOWS_LANE_BEYOND = 0.3, 0.25
"""A point counts to the next lane if it is no further than this before its line [m], as bodies stand near the line too;
it shows that there is a lane if it is beyond the line by this share of a lane's width."""
COVARIATES = ("constant", "right", "advantage", "approach", "speed")
"""Of the logarithm of the hazard: 1; 1 for a change to the right; how much faster the next lane is [m/s]; how fast the
gap ahead closes [m/s]; the own speed less `_USUAL_SPEED` [m/s]."""
_BOUND, _USUAL_SPEED = 4.0, 10.0
"""Greatest size of the third and the fourth [m/s], of the last twice that; [m/s]."""
_SETTLED, _LATEST = 0.2, 1.5
"""Speed across at which a change may end [m/s], and the share of its time at which it ends anyway."""
_EXTREME = 2.0
"""Greatest draw of a duration, in standard deviations."""
_LEAST_SHARE = 1e-3
"""Of the way across; the inverse of the course has no slope at 0."""
_UNSTARTED = -1.0
"""Share of a state that has not perceived anything yet."""
STATE_SIZE = 10
"""Numbers that a vehicle keeps in mind of lane changes."""


class Seen(NamedTuple):
    """Features by name: shape (B, M), of beams (B, M, 20), of left and right (B, M, 2)."""

    speed: Tensor
    heading: Tensor
    offset: Tensor
    length: Tensor
    width: Tensor
    lines: Tensor
    """Distances from the own middle to the lines at the left and at the right [m]."""
    lane: Tensor
    """Width of the lane [m]."""
    ranges: Tensor
    rates: Tensor
    angles: Tensor

    @classmethod
    def read(cls, features: Tensor) -> Seen:
        """Return what features (B, M, 51) tell."""
        left, right = features[..., LEFT_MARKER_COLUMN], features[..., RIGHT_MARKER_COLUMN]
        return cls(
            features[..., lidar.SPEED_COLUMN],
            features[..., lidar.HEADING_COLUMN],
            features[..., lidar.LANE_OFFSET_COLUMN],
            features[..., _LENGTH],
            features[..., _WIDTH],
            torch.stack((left, right), dim=-1),
            left + right,
            features[..., lidar.RANGE_COLUMNS],
            features[..., lidar.RATE_COLUMNS],
            lidar.beam_angles(features),
        )

    @property
    def across(self) -> Tensor:
        """Speed across the road, to the right positive [m/s], (B, M)."""
        return self.speed * torch.sin(self.heading)


@dataclass(frozen=True)
class CollisionAvoidance:
    """Upper bounds of acceleration and yaw rate that keep off the vehicle ahead and off those beside.

    Ahead, of each beam that meets a body in the path: at a gap g that closes at dv, the acceleration from v is at most
    (v_safe - v) / T, but -b at the least, with the safe speed of Krauss behind a speed v_l = v - dv,

        v_safe = -b tau + sqrt((b tau)^2 + v_l^2 + 2 b (g - s0)),

    and at most -dv^2 / (2 (g - s1)) where that is harder than b. Nearer than s0, who comes closer brakes by
    b + dv / `closing_time`. Beams are 18 degrees apart: a point well within the own lane is in the path too.

    Beside, at a distance d across that closes at c, the yaw rate towards it is at most
    ((d - d0) / T_y - c) / (T_psi v), HighwayEnv's lateral controller towards a line d0 from it; below 0 it steers who
    moves towards it back, but never further than along the road. No curve is narrower than a car can drive.
    """

    deceleration: float = 2.0
    """b [m/s^2], comfortable: Treiber and Kesting have 1.5 for cars, Tian et al. 2.4 (`rare_envs.IDM`)."""
    reaction_time: float = 0.6
    """tau [s]: below it a follower at equal speed has to open the gap. Krauss has 1, which people fall below."""
    relaxation_time: float = 0.5
    """T [s]."""
    standstill_gap: float = 1.5
    """s0 [m]; Treiber and Kesting have 2."""
    least_gap: float = 0.5
    """s1 [m], what an emergency may leave."""
    hardest: float = 8.0
    """Hardest braking [m/s^2], about what tyres give on a dry road."""
    path_margin: float = 0.3
    """A point is in the path if it is no further than this beside the own body [m]."""
    clearance: float = 0.3
    """d0 [m]."""
    reach: float = 1.0
    """A point is beside if it is no further than this before or behind the own body [m]."""
    lateral_time: float = 0.6
    """T_y [s], HighwayEnv's time constant, as in `rare_envs.control.idm`."""
    heading_time: float = 0.2
    """T_psi [s], likewise."""
    turning_radius: float = 6.4
    """[m], of the middle of AASHTO's design vehicle P."""
    closing_time: float = 0.3
    """[s]; of .3 and .5, the one with fewer collisions on rings of 60 vehicles per km and lane."""
    line_margin: float = 0.4
    """How far within the own lane a point is at least [m]; with .2 hard brakes are a third more frequent."""
    lane_margin: float = 0.9
    """A point in the own lane is in the path if it is no further than this beside the own body [m]."""

    def __post_init__(self) -> None:
        numbers = [each.name for each in fields(self)]
        check_numbers(self, "collision avoidance", {"above 0, finite": numbers})

    def limit(self, seen: Seen, action: Tensor) -> Tensor:
        """Return accelerations [m/s^2] and yaw rates [rad/s] (B, M, 2) within the bounds."""
        acceleration = torch.minimum(action[..., 0], self._bound_acceleration(seen))
        left, right = self._bound_yaw_rates(seen)
        yaw_rate = torch.minimum(torch.maximum(action[..., 1], -left), right)
        return torch.stack((acceleration, yaw_rate), dim=-1)

    def _bound_acceleration(self, seen: Seen) -> Tensor:
        """Return the greatest acceleration [m/s^2], infinite with nobody ahead, (B, M)."""
        cos, across = torch.cos(seen.angles), seen.ranges * torch.sin(seen.angles)
        ahead, gap = cos > _FORWARD, seen.ranges * cos - 0.5 * seen.length[..., None]
        beside = across.abs() - 0.5 * seen.width[..., None]
        line = torch.where(across < 0.0, seen.lines[..., :1], seen.lines[..., 1:])
        in_lane = (line - across.abs() > self.line_margin) & (beside < self.lane_margin)
        in_path = ahead & (seen.ranges < MAX_RANGE) & (gap > 0.0) & ((beside < self.path_margin) | in_lane)
        bound = self.bound_acceleration_behind(gap, -seen.rates / torch.where(ahead, cos, 1.0), seen.speed[..., None])
        return torch.where(in_path, bound, torch.inf).amin(dim=-1)

    def bound_acceleration_behind(self, gap: Tensor, closing: Tensor, speed: Tensor) -> Tensor:
        """Return the greatest acceleration [m/s^2] at a gap [m] that closes at a speed [m/s], at the own speed."""
        b, lag = self.deceleration, self.deceleration * self.reaction_time
        room = 2.0 * b * (gap - self.standstill_gap).clamp(min=0.0) + (speed - closing).clamp(min=0.0).square()
        comfortable = ((lag * lag + room).sqrt() - lag - speed) / self.relaxation_time
        needed = closing.clamp(min=0.0).square() / (2.0 * (gap - self.least_gap).clamp(min=_LEAST_GAP))
        urgent = torch.where(needed > b, -needed.clamp(max=self.hardest), torch.inf)
        bound = torch.minimum(comfortable.clamp(min=-b), urgent)
        firm = -(b + closing.clamp(min=0.0) / self.closing_time).clamp(max=self.hardest)
        return torch.where((gap < self.standstill_gap) & (closing > 0.0), torch.minimum(bound, firm), bound)

    def _bound_yaw_rates(self, seen: Seen) -> tuple[Tensor, Tensor]:
        """Return the greatest yaw rates to the left and right [rad/s], (B, M); below 0 for who is steered back."""
        along, sin = seen.ranges * torch.cos(seen.angles), torch.sin(seen.angles)
        beside = (seen.ranges < MAX_RANGE) & (along.abs() < 0.5 * seen.length[..., None] + self.reach)
        sure, own = sin.abs() > _ACROSS, (sin.sign() * seen.across[..., None]).clamp(min=0.0)
        closing = torch.where(sure, -seen.rates / torch.where(sure, sin.abs(), 1.0), own)
        free = seen.ranges * sin.abs() - 0.5 * seen.width[..., None] - self.clearance
        lag = self.heading_time * seen.speed[..., None].clamp(min=_LEAST_SPEED)
        bound = torch.maximum((free / self.lateral_time - closing) / lag, -own / lag)
        narrowest = seen.speed.clamp(min=0.0) / self.turning_radius
        left, right = (
            torch.minimum(torch.where(beside & side, bound, torch.inf).amin(dim=-1), narrowest)
            for side in (sin < -_SIDEWAYS, sin > _SIDEWAYS)
        )
        return left, right

    def bound_yaw_rates_within(self, seen: Seen, room: Tensor) -> tuple[Tensor, Tensor]:
        """Return the greatest yaw rates to the left and right [rad/s] (B, M) within some room (B, M, 2) [m]."""
        wanted = room / self.lateral_time
        lag = self.heading_time * seen.speed.clamp(min=_LEAST_SPEED)
        return (wanted[..., 0] + seen.across) / lag, (wanted[..., 1] - seen.across) / lag


class AdjacentLanes(NamedTuple):
    """What is seen of the lanes to the left and to the right, up to 8 to 13 m along, shape (..., 2) each."""

    lead_gap: Tensor
    """Gap to the nearest body ahead in that lane [m], negative beside it, infinite if none is seen."""
    lead_closing: Tensor
    """Speed at which it closes [m/s], 0 if none is seen."""
    lag_gap: Tensor
    """Likewise of the nearest behind."""
    lag_closing: Tensor
    beyond: Tensor
    """Whether a body is seen beyond the line, so that there is a lane."""

    @classmethod
    def read(cls, seen: Seen) -> AdjacentLanes:
        """Return what is seen of the lanes beside, differentiable."""
        ranges, beams = seen.ranges[..., None, :], seen.angles
        angle = beams + seen.heading[..., None, None]
        side = constant((-1.0, 1.0), ranges)[:, None]
        along, across = ranges * torch.cos(angle), side * ranges * torch.sin(angle)
        line, lane, met = seen.lines[..., None], seen.lane[..., None, None], ranges < MAX_RANGE
        inside = met & (across > line - _LINE_OVERLAP) & (across < line + lane)
        cos = torch.cos(beams)
        known = cos.abs() > _ALONG
        rate = torch.where(known, seen.rates[..., None, :] / torch.where(known, cos, 1.0), 0.0).expand_as(across)
        half = 0.5 * seen.length[..., None, None]
        lead = torch.where(inside & (along > 0.0), along - half, torch.inf).min(dim=-1)
        lag = torch.where(inside & (along <= 0.0), -along - half, torch.inf).min(dim=-1)
        lead_rate, lag_rate = (rate.gather(-1, each.indices[..., None])[..., 0] for each in (lead, lag))
        return cls(
            lead.values,
            torch.where(lead.values < torch.inf, -lead_rate, 0.0),
            lag.values,
            torch.where(lag.values < torch.inf, lag_rate, 0.0),
            (met & (across > line + _SHOWS_LANE_BEYOND * lane)).any(dim=-1),
        )

    def least_gap_after(self, seconds: float) -> Tensor:
        """Return the smaller of the gaps ahead and behind after some time at the present speeds [m], (..., 2)."""
        return torch.minimum(self.lead_gap - seconds * self.lead_closing, self.lag_gap - seconds * self.lag_closing)


class ChangeState(NamedTuple):
    """What M vehicles in B scenarios keep in mind of lane changes; shapes (B, M, 2), for left and right, or (B, M)."""

    patience: Tensor
    """Hazard that is left until a change begins, for left and right."""
    unseen: Tensor
    """Time since a body was last seen beyond the line, for left and right [s]."""
    side: Tensor
    """Of the change under way: -1 to the left, 1 to the right, 0 for none."""
    share: Tensor
    """Of the time of its course that has passed; -1 before anything was perceived."""
    pace: Tensor
    """What passes in a second [1/s]."""
    distance: Tensor
    """Across, from where it began to the middle of the new lane [m]."""
    crossed: Tensor
    """1 once it has crossed the line, otherwise 0."""
    offset: Tensor
    """From the middle of the lane, a tick ago [m]."""

    @classmethod
    def unpack(cls, memory: Tensor) -> ChangeState:
        """Return the state in a memory of shape (B, M, 10)."""
        return cls(memory[..., 0:2], memory[..., 2:4], *memory[..., 4:].unbind(dim=-1))

    def pack(self) -> Tensor:
        """Return it as a memory of shape (B, M, 10)."""
        return torch.cat((self.patience, self.unseen, torch.stack(self[2:], dim=-1)), dim=-1)

    def distance_left(self, seen: Seen) -> Tensor:
        """Return the distance across to the middle of the new lane [m], (B, M); lanes are taken as equally wide."""
        return seen.lane * (1.0 - self.crossed) - self.side * seen.offset


@dataclass(frozen=True)
class LaneChanges:
    """Lane changes at a hazard rate, on a cubic course.

    Begin. The hazard of a change to a side is exp(coefficients . `COVARIATES`) [1/s] while there is a lane (a body was
    seen beyond the line within `remembered`), a gap (`accepted_gap` is left after `accepted_time`, ahead and behind)
    and speed enough. It uses up an exponentially distributed patience of that side; at 0 the change begins, with a
    duration of its own. Who at the first moment will reach the line within `foresight`, if there is a lane and a
    gap, or within `near` anyway, is changing already: the course is taken up there.

    Course. The distance left is D (1 - 3 s^2 + 2 s^3) with s = t / `duration`; errors are corrected as by a critically
    damped oscillator, and below `slow` time passes slower. A change ends with its course, along the lane; none is given
    up for want of a gap, which the rule of collision avoidance waits for.

    Edge of the road. Whose middle is over the line while the lane is still the old one has no lane there: its change is
    given up. Who is not changing keeps `margin` inside its line where it knows of no lane beyond.
    """

    coefficients: tuple[float, ...] = (-6.0, 0.0, 0.0, 0.0, 0.0)
    """Of `COVARIATES`; those of the shipped drivers were fitted to lane changes on US 101."""
    duration: float = 3.7
    """[s]; it moves across faster than 0.2 m/s for 3.4 s, the median of 372 changes on US 101."""
    spread: float = 0.27
    """Standard deviation of its logarithm: 26 changes in the scenes learned from, by their quartiles."""
    accepted_gap: float = 1.5
    """[m]; of 38 who begin a change in those scenes 34 leave so much after `accepted_time`."""
    accepted_time: float = 1.0
    """[s]."""
    least_gap: float = 0.5
    """[m]."""
    least_speed: float = 3.0
    """Speed below which none begins [m/s]."""
    remembered: float = 10.0
    """[s]."""
    foresight: float = 2.1
    """[s]: about the ratio, 1.9, of the coefficients of speed across and offset in a logistic regression of who crosses
    within 3 s, and enough that seven in ten of those who are changing are taken for it."""
    over_line: float = 0.4
    """Who moves out and is over the line by so much [m] has a lane there; people at the edge of the road are not."""
    frequency: float = 1.5
    """Natural frequency of the correction [rad/s]."""
    slow: float = 10.0
    """[m/s]."""
    near: float = 1.8
    """[s]; within it 38 of 41 who move towards a lane that is not free are changing, within 2.4 s 41 of 55."""
    margin: float = 0.2
    """[m]; with .1 to .3 nobody leaves the road in the scenes learned from, with 0 some do."""

    def __post_init__(self) -> None:
        coefficients = tuple(float(value) for value in self.coefficients)
        if len(coefficients) != len(COVARIATES) or not all(map(math.isfinite, coefficients)):
            raise ValueError(
                f"Expected {len(COVARIATES)} finite coefficients of the hazard, got {self.coefficients!r}."
            )
        object.__setattr__(self, "coefficients", coefficients)
        numbers = [each.name for each in fields(self) if each.name != "coefficients"]
        check_numbers(self, "lane changes", {"above 0, finite": numbers})

    def begin(self, draws: Tensor) -> ChangeState:
        """Return the state before anything was perceived, from standard normal draws (B, M, 2)."""
        none = torch.zeros_like(draws[..., 0])
        never = torch.full_like(draws, torch.inf)
        return ChangeState(patience_of(draws), never, none, none + _UNSTARTED, none, none, none, none)

    def step(
        self, seen: Seen, state: ChangeState, innovations: Tensor | None, action: Tensor, rule: CollisionAvoidance
    ) -> tuple[Tensor, ChangeState]:
        """Return an action (B, M, 2) as a change has it, and the new state; from draws (B, M, 2), None for 0."""
        lanes = AdjacentLanes.read(seen)
        state = self._remember(seen, lanes, state)
        state = self._take_up(seen, lanes, state)
        state = self._begin_change(seen, lanes, state, innovations)
        left = state.distance_left(seen)
        settled = (seen.across.abs() < _SETTLED) | (state.share >= _LATEST)
        over = ((state.share >= 1.0) & settled) | (_of_side(seen.lines, state.side) < 0.0)
        state = state._replace(side=torch.where(over, 0.0, state.side))
        slowness = (seen.speed / self.slow).clamp(0.0, 1.0)
        action = self._follow_course(seen, lanes, state, left, slowness, action, rule)
        return action, state._replace(share=state.share + LEARNED_TICK * (state.pace * slowness))

    def _remember(self, seen: Seen, lanes: AdjacentLanes, state: ChangeState) -> ChangeState:
        """Return the state with what is known of the lanes beside, also where a line was crossed."""
        moved = torch.where(state.share == _UNSTARTED, 0.0, state.offset - seen.offset)  # about a lane across a line
        crossed = moved.abs() > 0.5 * seen.lane
        came_from = torch.stack((moved > 0.0, moved < 0.0), dim=-1)  # to the right of the lane that it left
        unseen = torch.where(crossed[..., None], torch.where(came_from, 0.0, torch.inf), state.unseen + LEARNED_TICK)
        return state._replace(
            unseen=torch.where(lanes.beyond, 0.0, unseen),
            crossed=torch.where(crossed & (moved * state.side > 0.0), 1.0, state.crossed),
            offset=seen.offset,
        )

    def _take_up(self, seen: Seen, lanes: AdjacentLanes, state: ChangeState) -> ChangeState:
        """Return the state with changes that were under way at the first moment."""
        first, side = state.share == _UNSTARTED, self._recognise(seen, lanes)
        offset, begins = side * seen.offset, first & (side != 0.0)
        gone = (offset / seen.lane.clamp(min=1.0)).clamp(_LEAST_SHARE, 0.5)
        share = 0.5 - torch.sin(torch.asin(1.0 - 2.0 * gone) / 3.0)  # where the cubic course has gone so far
        return state._replace(
            side=torch.where(begins, side, state.side),
            share=torch.where(begins, share, torch.where(first, 0.0, state.share)),
            pace=torch.where(begins, 1.0 / self.duration, state.pace),
            distance=torch.where(begins, torch.maximum(seen.lane, seen.lane - offset), state.distance),
        )

    def _recognise(self, seen: Seen, lanes: AdjacentLanes) -> Tensor:
        """Return the side of a change that is under way, -1 to the left, 1 to the right, 0 for none, (B, M)."""
        across, line = seen.across.abs(), 0.5 * seen.lane
        side = seen.across.sign()
        offset = side * seen.offset
        crosses = offset + self.foresight * across > line
        on_line = offset + 0.5 * seen.width > line + self.over_line
        free = _of_side(lanes.least_gap_after(0.5 * self.accepted_time), side) > self.least_gap
        changing = crosses & free & (_of_side(lanes.beyond, side) | on_line)
        return torch.where(changing | (offset + self.near * across > line), side, 0.0)

    def _begin_change(
        self, seen: Seen, lanes: AdjacentLanes, state: ChangeState, innovations: Tensor | None
    ) -> ChangeState:
        """Return the state one tick of hazard later."""
        may_begin = lanes.least_gap_after(self.accepted_time) > self.accepted_gap
        may_begin = may_begin & (seen.speed[..., None] > self.least_speed)
        waits = (state.side == 0.0)[..., None] & (state.unseen < self.remembered) & may_begin
        patience = torch.where(waits, state.patience - self._hazard(seen, lanes) * LEARNED_TICK, state.patience)
        ripe = patience <= 0.0
        side = torch.where(ripe[..., 0], -1.0, torch.where(ripe[..., 1], 1.0, 0.0)).to(seen.speed.dtype)
        draws = torch.zeros_like(patience) if innovations is None else innovations.to(patience.dtype)
        begins, draw = side != 0.0, _of_side(draws, -side).clamp(-_EXTREME, _EXTREME)
        begun = state._replace(side=torch.where(begins, side, state.side), crossed=state.crossed * ~begins)
        return begun._replace(
            patience=torch.where(ripe, patience_of(draws), patience),
            share=torch.where(begins, 0.0, state.share),
            pace=torch.where(begins, torch.exp(-self.spread * draw) / self.duration, state.pace),
            distance=torch.where(begins, begun.distance_left(seen), state.distance),
        )

    def _hazard(self, seen: Seen, lanes: AdjacentLanes) -> Tensor:
        """Return exp(coefficients . `COVARIATES`) [1/s] for either side, (B, M, 2)."""
        led, lagged = lanes.lead_gap < torch.inf, lanes.lag_gap < torch.inf
        advantage = torch.where(led, -lanes.lead_closing, torch.where(lagged, lanes.lag_closing, 0.0))
        approach = -seen.rates[..., AHEAD_BEAM, None].expand_as(advantage)
        right = constant((0.0, 1.0), advantage).expand_as(advantage)
        speed = (seen.speed[..., None] - _USUAL_SPEED).expand_as(advantage).clamp(-2.0 * _BOUND, 2.0 * _BOUND)
        met = (each.clamp(-_BOUND, _BOUND) for each in (advantage, approach))
        covariates = torch.stack((torch.ones_like(right), right, *met, speed), dim=-1)
        return torch.exp((covariates * constant(self.coefficients, covariates)).sum(dim=-1))

    def _follow_course(
        self,
        seen: Seen,
        lanes: AdjacentLanes,
        state: ChangeState,
        left: Tensor,
        slowness: Tensor,
        action: Tensor,
        rule: CollisionAvoidance,
    ) -> Tensor:
        """Return an action (B, M, 2) on the course where a change is under way, else within the known lanes.

        There is some distance left [m], and time passes slower by a factor, (B, M) each.
        """
        share, pace, frequency = state.share.clamp(0.0, 1.0), state.pace * slowness, self.frequency * slowness
        wanted = state.distance * (1.0 - share.square() * (3.0 - 2.0 * share))
        across = 6.0 * state.distance * share * (1.0 - share) * pace
        gain = 6.0 * state.distance * (1.0 - 2.0 * share) * pace.square()
        is_across = state.side * seen.speed * torch.sin(seen.heading)
        gain = gain + 2.0 * frequency * (across - is_across) + frequency.square() * (left - wanted)
        changing, gap = state.side != 0.0, _of_side(lanes.lead_gap, state.side)
        # whoever is ahead in the new lane is kept off too
        follows = changing & (state.crossed == 0.0) & (gap < torch.inf) & (gap > 0.0)
        ahead, closing = torch.where(follows, gap, MAX_RANGE), _of_side(lanes.lead_closing, state.side)
        bound = rule.bound_acceleration_behind(ahead, closing, seen.speed)
        acceleration = torch.where(follows, torch.minimum(action[..., 0], bound), action[..., 0])
        free = (state.unseen < self.remembered) | changing[..., None]
        room = torch.where(free, MAX_RANGE, seen.lines - self.margin)
        leftmost, rightmost = rule.bound_yaw_rates_within(seen, room)
        inside = torch.minimum(torch.maximum(action[..., 1], -leftmost), rightmost)
        course = state.side * gain / seen.speed.clamp(min=_LEAST_SPEED)
        return torch.stack((acceleration, torch.where(changing, course, inside)), dim=-1)


def patience_of(draws: Tensor) -> Tensor:
    """Return exponentially distributed patiences from standard normal draws of any shape."""
    patience: Tensor = -torch.special.log_ndtr(draws)
    return patience


def _of_side(values: Tensor, side: Tensor) -> Tensor:
    """Return the values (..., 2) of a side, -1 or 1, shape (...); of the right for 0."""
    return torch.where(side < 0.0, values[..., 0], values[..., 1])
