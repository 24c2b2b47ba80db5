"""Lane changes: whether to begin one, and the way across, laid over the steering of a learned driver.

References:
    Cox and Oakes, "Analysis of Survival Data", 1984: hazard rates.
    Gipps, "A model for the structure of lane-changing decisions", 1986: acceptance of gaps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from agents.learned.collision_avoidance import LEFT_MARKER_COLUMN, RIGHT_MARKER_COLUMN, check_positive
from rare_envs.devices import constant
from rare_envs.sensors.lidar import (
    AHEAD_BEAM,
    FEATURES,
    HEADING_COLUMN,
    LANE_OFFSET_COLUMN,
    MAX_RANGE,
    RANGE_COLUMNS,
    RATE_COLUMNS,
    SPEED_COLUMN,
    beam_angles,
)
from rare_envs.simulation.episode import LEARNED_TICK

_LENGTH, _WIDTH = FEATURES.index("length"), FEATURES.index("width")
LINE_OVERLAP = 0.3
"""A point counts to the next lane if it is no further than this before its line [m]: bodies stand near the line too."""
SHOWS_LANE_BEYOND = 0.25
"""Share of a lane's width by which a point has to be beyond the line to show that there is a lane."""
LEAST_COSINE_ALONG = 0.25
"""Least cosine of beams whose range rate is taken for motion along the road."""
COVARIATES = ("constant", "right", "advantage", "approach", "speed")
"""Of the logarithm of the hazard: 1; 1 for a change to the right; how much faster the next lane is [m/s]; how fast the
gap ahead closes [m/s]; the own speed less `USUAL_SPEED` [m/s]."""
BOUND = 4.0
"""Greatest size of the third and the fourth [m/s]; of the last twice that."""
USUAL_SPEED = 10.0
"""[m/s]."""
_SETTLED = 0.2
"""Speed across at which a change may end [m/s]."""
_LATEST = 1.5
"""Share of its time at which it ends anyway."""
_EXTREME = 2.0
"""Greatest draw of a duration, in standard deviations."""
_LEAST_SPEED = 1.0
"""Least speed to divide by [m/s]."""
_LEAST_SHARE = 1e-3
"""Of the way across; the inverse of the course has no slope at 0."""
_UNSTARTED = -1.0
"""Share of a state that has not perceived anything yet."""
STATE_SIZE = 10
"""Numbers that a vehicle keeps in mind."""


class AdjacentLanes(NamedTuple):
    """What is seen of the lanes to the left and to the right, shape (..., 2) each.

    Beams are 18 degrees apart, so that in the next lane a body is met for sure if it is within 8 m of the own middle,
    and its rear or front up to 13 m. What is further along that lane stays unseen. A beam that meets its side finds the
    gap up to 2 m too long.
    """

    lead_gap: Tensor
    """Gap to the nearest body ahead in that lane [m], negative beside it, infinite if none is seen."""
    lead_closing: Tensor
    """Speed at which it closes [m/s], 0 if none is seen."""
    lag_gap: Tensor
    """Likewise of the nearest behind."""
    lag_closing: Tensor
    beyond: Tensor
    """Whether a body is seen beyond the line, so that there is a lane."""


def look_aside(features: Tensor) -> AdjacentLanes:
    """Return what features (..., 51) show of the lanes beside, differentiable."""
    ranges, beams = features[..., None, RANGE_COLUMNS], beam_angles(features)
    angle = beams + features[..., HEADING_COLUMN, None, None]
    side = constant((-1.0, 1.0), features)[:, None]
    along, across = ranges * torch.cos(angle), side * ranges * torch.sin(angle)
    line = torch.stack((features[..., LEFT_MARKER_COLUMN], features[..., RIGHT_MARKER_COLUMN]), dim=-1)[..., None]
    width = (features[..., LEFT_MARKER_COLUMN] + features[..., RIGHT_MARKER_COLUMN])[..., None, None]
    met = ranges < MAX_RANGE
    inside = met & (across > line - LINE_OVERLAP) & (across < line + width)
    cos = torch.cos(beams)
    known = cos.abs() > LEAST_COSINE_ALONG
    rate = torch.where(known, features[..., None, RATE_COLUMNS] / torch.where(known, cos, 1.0), 0.0).expand_as(across)
    half = 0.5 * features[..., _LENGTH, None, None]
    lead = torch.where(inside & (along > 0.0), along - half, torch.inf).min(dim=-1)
    lag = torch.where(inside & (along <= 0.0), -along - half, torch.inf).min(dim=-1)
    lead_rate, lag_rate = (rate.gather(-1, each.indices[..., None])[..., 0] for each in (lead, lag))
    return AdjacentLanes(
        lead.values,
        torch.where(lead.values < torch.inf, -lead_rate, 0.0),
        lag.values,
        torch.where(lag.values < torch.inf, lag_rate, 0.0),
        (met & (across > line + SHOWS_LANE_BEYOND * width)).any(dim=-1),
    )


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


class ChangeAction(NamedTuple):
    """How to act in a change, shape (B, M) each."""

    changing: Tensor
    """True where a change is under way."""
    yaw_rate: Tensor
    """[rad/s]; means something only there."""
    follows: Tensor
    """True where it has to keep off somebody ahead in the new lane too."""
    gap: Tensor
    """To that one [m]; means something only there."""
    closing: Tensor
    """Speed at which it closes [m/s]."""
    room: Tensor
    """How far across it may go to the left and to the right [m], negative if it has to come back; shape (B, M, 2)."""


@dataclass(frozen=True)
class LaneChanges:
    """Lane changes at a hazard rate, on a cubic course.

    Begin. The hazard of a change to a side is exp(coefficients . `COVARIATES`) [1/s] while there is a lane, a gap and
    speed enough. Each driver has a patience for either side, exponentially distributed, which the hazard uses up; at 0
    the change begins, with a duration of its own, and the next patience is drawn, all from the noise of the driver.

    There is a lane where a body was seen beyond the line within `remembered`. A gap is enough if `accepted_gap` will
    be left after `accepted_time` at the present speeds, ahead and behind.

    Who at the first moment moves across so that its middle will reach the line within `foresight` is changing already:
    the course is taken up there. So is who will be at the line within `near`, also where the new lane is not free or
    nobody shows it.

    Course. The distance left is D (1 - 3 s^2 + 2 s^3) with s = t / `duration`, and its speed and acceleration; errors
    are corrected as by a critically damped oscillator. Below `slow` time passes slower, so that headings stay small. A
    change ends with its course, when the vehicle goes along its lane again; then the network steers again. No change is
    given up for want of a gap: the rule of collision avoidance keeps the vehicle off until there is one.

    The edge of the road shows in two ways. Whose middle is over the line while the lane is still the old one has no
    lane there: its change is given up. And who is not changing keeps `margin` inside its line where it knows of no lane
    beyond, and steers back from further out.

    Raises:
        ValueError: If there are not 5 coefficients, or another setting is not a positive number.

    Example:
        >>> changes = LaneChanges()
        >>> state = changes.begin(torch.zeros(1, 1, 2))
        >>> state.patience  # the median
        tensor([[[0.6931, 0.6931]]])
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
        check_positive(self, "lane changes", but=("coefficients",))

    def begin(self, draws: Tensor) -> ChangeState:
        """Return the state before anything was perceived, from standard normal draws (B, M, 2)."""
        none = torch.zeros_like(draws[..., 0])
        return ChangeState(
            patience_of(draws), torch.full_like(draws, torch.inf), none, none + _UNSTARTED, none, none, none, none
        )

    def step(
        self, features: Tensor, state: ChangeState, innovations: Tensor | None
    ) -> tuple[ChangeAction, ChangeState]:
        """Decide for one tick.

        Args:
            features: What M vehicles in B scenarios perceive, shape (B, M, 51).
            state: As the last call returned it, at the start `begin`.
            innovations: Standard normal draws, shape (B, M, 2); None for 0.

        Returns:
            How to act, and the new state.
        """
        lanes = look_aside(features)
        state = self._remember(features, lanes, state)
        state = self._take_up(features, lanes, state)
        state = self._begin_change(features, lanes, state, innovations)
        left = _distance_left(features, state)
        across = features[..., SPEED_COLUMN] * torch.sin(features[..., HEADING_COLUMN])
        settled = (across.abs() < _SETTLED) | (state.share >= _LATEST)
        over = ((state.share >= 1.0) & settled) | self._is_given_up(features, state)
        state = state._replace(side=torch.where(over, 0.0, state.side))
        action = self._follow_course(features, lanes, state, left)
        passes = state.pace * self._slowness(features)
        return action, state._replace(share=state.share + LEARNED_TICK * passes)

    def covariates(self, features: Tensor, lanes: AdjacentLanes) -> Tensor:
        """Return `COVARIATES` for either side, shape (B, M, 2, 5)."""
        led, lagged = lanes.lead_gap < torch.inf, lanes.lag_gap < torch.inf
        advantage = torch.where(led, -lanes.lead_closing, torch.where(lagged, lanes.lag_closing, 0.0))
        approach = -features[..., RATE_COLUMNS][..., AHEAD_BEAM, None].expand_as(advantage)
        right = constant((0.0, 1.0), features).expand_as(advantage)
        speed = (features[..., SPEED_COLUMN, None] - USUAL_SPEED).expand_as(advantage).clamp(-2.0 * BOUND, 2.0 * BOUND)
        met = (each.clamp(-BOUND, BOUND) for each in (advantage, approach))
        return torch.stack((torch.ones_like(right), right, *met, speed), dim=-1)

    def may_begin(self, features: Tensor, lanes: AdjacentLanes) -> Tensor:
        """Return whether gaps and speed are enough, for either side, shape (B, M, 2)."""
        enough = _gap_after(lanes, self.accepted_time) > self.accepted_gap
        return enough & (features[..., SPEED_COLUMN, None] > self.least_speed)

    def recognise(self, features: Tensor, lanes: AdjacentLanes) -> Tensor:
        """Return the side of a change that is under way, -1 to the left, 1 to the right, 0 for none, shape (B, M)."""
        across = features[..., SPEED_COLUMN] * torch.sin(features[..., HEADING_COLUMN])
        side, width = across.sign(), features[..., LEFT_MARKER_COLUMN] + features[..., RIGHT_MARKER_COLUMN]
        offset = side * features[..., LANE_OFFSET_COLUMN]
        crosses = offset + self.foresight * across.abs() > 0.5 * width
        on_line = offset + 0.5 * features[..., _WIDTH] > 0.5 * width + self.over_line
        free = _of_side(_gap_after(lanes, 0.5 * self.accepted_time), side) > self.least_gap
        changing = crosses & free & (_of_side(lanes.beyond, side) | on_line)
        changing = changing | (offset + self.near * across.abs() > 0.5 * width)
        return torch.where(changing, side, 0.0)

    def _is_given_up(self, features: Tensor, state: ChangeState) -> Tensor:
        """Return whether a change ends because it crossed the edge of the road, shape (B, M)."""
        return _of_side(_to_lines(features), state.side) < 0.0

    def _room(self, features: Tensor, state: ChangeState) -> Tensor:
        """Return how far across the vehicle may go to either side [m]; further than it can see if that is free."""
        free = (state.unseen < self.remembered) | (state.side != 0.0)[..., None]
        return torch.where(free, MAX_RANGE, _to_lines(features) - self.margin)

    def _remember(self, features: Tensor, lanes: AdjacentLanes, state: ChangeState) -> ChangeState:
        """Return the state with what is known of the lanes beside, also where a line was crossed."""
        offset = features[..., LANE_OFFSET_COLUMN]
        moved = torch.where(state.share == _UNSTARTED, 0.0, state.offset - offset)  # about a lane's width across a line
        crossed = moved.abs() > 0.5 * (features[..., LEFT_MARKER_COLUMN] + features[..., RIGHT_MARKER_COLUMN])
        came_from = torch.stack((moved > 0.0, moved < 0.0), dim=-1)  # to the right of the lane that it left
        unseen = torch.where(crossed[..., None], torch.where(came_from, 0.0, torch.inf), state.unseen + LEARNED_TICK)
        return state._replace(
            unseen=torch.where(lanes.beyond, 0.0, unseen),
            crossed=torch.where(crossed & (moved * state.side > 0.0), 1.0, state.crossed),
            offset=offset,
        )

    def _take_up(self, features: Tensor, lanes: AdjacentLanes, state: ChangeState) -> ChangeState:
        """Return the state with changes that were under way at the first moment."""
        first = state.share == _UNSTARTED
        found = self.recognise(features, lanes)
        side, width = found, features[..., LEFT_MARKER_COLUMN] + features[..., RIGHT_MARKER_COLUMN]
        offset, begins = side * features[..., LANE_OFFSET_COLUMN], first & (found != 0.0)
        gone = (offset / width.clamp(min=1.0)).clamp(_LEAST_SHARE, 0.5)
        share = 0.5 - torch.sin(torch.asin(1.0 - 2.0 * gone) / 3.0)  # where the cubic course has gone so far
        return state._replace(
            side=torch.where(begins, side, state.side),
            share=torch.where(begins, share, torch.where(first, 0.0, state.share)),
            pace=torch.where(begins, 1.0 / self.duration, state.pace),
            distance=torch.where(begins, torch.maximum(width, width - offset), state.distance),
        )

    def _begin_change(
        self, features: Tensor, lanes: AdjacentLanes, state: ChangeState, innovations: Tensor | None
    ) -> ChangeState:
        """Return the state one tick of hazard later."""
        waits = (state.side == 0.0)[..., None] & (state.unseen < self.remembered) & self.may_begin(features, lanes)
        coefficients = constant(self.coefficients, features)
        hazard = torch.exp((self.covariates(features, lanes) * coefficients).sum(dim=-1))
        patience = torch.where(waits, state.patience - hazard * LEARNED_TICK, state.patience)
        ripe = patience <= 0.0
        side = torch.where(ripe[..., 0], -1.0, torch.where(ripe[..., 1], 1.0, 0.0)).to(features.dtype)
        draws = torch.zeros_like(patience) if innovations is None else innovations.to(patience.dtype)
        begins, draw = side != 0.0, _of_side(draws, -side).clamp(-_EXTREME, _EXTREME)
        begun = state._replace(side=torch.where(begins, side, state.side), crossed=state.crossed * ~begins)
        return begun._replace(
            patience=torch.where(ripe, patience_of(draws), patience),
            share=torch.where(begins, 0.0, state.share),
            pace=torch.where(
                begins,
                torch.exp(-self.spread * draw) / self.duration,
                state.pace,
            ),
            distance=torch.where(begins, _distance_left(features, begun), state.distance),
        )

    def _slowness(self, features: Tensor) -> Tensor:
        """Return how fast time passes on the course, 0 to 1, shape (B, M)."""
        return (features[..., SPEED_COLUMN] / self.slow).clamp(0.0, 1.0)

    def _follow_course(self, features: Tensor, lanes: AdjacentLanes, state: ChangeState, left: Tensor) -> ChangeAction:
        """Return how to act with some distance left [m]."""
        slowness = self._slowness(features)
        share, pace, frequency = state.share.clamp(0.0, 1.0), state.pace * slowness, self.frequency * slowness
        wanted = state.distance * (1.0 - share.square() * (3.0 - 2.0 * share))
        across = 6.0 * state.distance * share * (1.0 - share) * pace
        gain = 6.0 * state.distance * (1.0 - 2.0 * share) * pace.square()
        speed = features[..., SPEED_COLUMN]
        is_across = state.side * speed * torch.sin(features[..., HEADING_COLUMN])
        gain = gain + 2.0 * frequency * (across - is_across) + frequency.square() * (left - wanted)
        changing, gap = state.side != 0.0, _of_side(lanes.lead_gap, state.side)
        follows = changing & (state.crossed == 0.0) & (gap < torch.inf) & (gap > 0.0)
        return ChangeAction(
            changing,
            state.side * gain / speed.clamp(min=_LEAST_SPEED),
            follows,
            torch.where(follows, gap, MAX_RANGE),
            _of_side(lanes.lead_closing, state.side),
            self._room(features, state),
        )


def patience_of(draws: Tensor) -> Tensor:
    """Return exponentially distributed patiences from standard normal draws of any shape."""
    patience: Tensor = -torch.special.log_ndtr(draws)
    return patience


def _distance_left(features: Tensor, state: ChangeState) -> Tensor:
    """Return the distance across to the middle of the new lane [m], shape (B, M); lanes are taken as equally wide."""
    width = features[..., LEFT_MARKER_COLUMN] + features[..., RIGHT_MARKER_COLUMN]
    return width * (1.0 - state.crossed) - state.side * features[..., LANE_OFFSET_COLUMN]


def _to_lines(features: Tensor) -> Tensor:
    """Return the distances from the own middle to the lines at the left and at the right [m], shape (B, M, 2)."""
    return torch.stack((features[..., LEFT_MARKER_COLUMN], features[..., RIGHT_MARKER_COLUMN]), dim=-1)


def _gap_after(lanes: AdjacentLanes, seconds: float) -> Tensor:
    """Return the smaller of the gaps ahead and behind after some time at the present speeds [m], shape (..., 2)."""
    ahead, behind = lanes.lead_gap - seconds * lanes.lead_closing, lanes.lag_gap - seconds * lanes.lag_closing
    return torch.minimum(ahead, behind)


def _of_side(values: Tensor, side: Tensor) -> Tensor:
    """Return the values (..., 2) of a side, -1 or 1, shape (...); of the right for 0."""
    return torch.where(side < 0.0, values[..., 0], values[..., 1])
