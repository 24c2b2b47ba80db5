"""Crashes: who hit whom and where, how fast, and the risk of an injury.

Two bodies touch when they begin to overlap along the last of the four axes on which they can be apart; that axis is the
normal of the contact. Along the tick bodies are taken to move straight, from where they were to where they are.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from rare_envs.traffic.bodies import boxes_overlap, crossing, encounter, pairs
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

CRASH_KINDS = ("none", "rear_end", "rear_ended", "side", "road_edge", "others")
"""Kinds of crash by number: none; the ego runs into a vehicle ahead; it is run into from behind; flank against flank
(side-swipe); the ego leaves the road; only other vehicles collided."""
NONE, REAR_END, REAR_ENDED, SIDE, ROAD_EDGE, OTHERS = range(len(CRASH_KINDS))
RESTITUTION = 0.0
"""Share of the closing speed with which bodies part again: 0, a plastic impact, as usual above 10 m/s; near 0.3 at
walking pace."""
MPH = 2.2369362920544
"""Miles per hour in a metre per second."""
MAIS3 = {"all": (-6.9540, 0.1637), "frontal": (-6.9774, 0.1620), "rear": (-8.0329, 0.1793)}
"""Intercept and slope per mph of delta-v, by crash mode; see `injury_risk`."""
ValueT = TypeVar("ValueT", float, Tensor)
_ROUNDING = 1e-4
"""Bodies that overlap in single precision are no further apart than this [m]."""


class Crash(NamedTuple):
    """Crashes of B episodes.

    Of two vehicles, the first is the one that runs into the other: it moves faster towards it than the other towards
    the first, along the road, or across it where flanks meet.

    Example:
        >>> import rare_envs
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0")
        >>> crash = problem.crashes([[30.0, 10.0, 5.0]])
        >>> problem.crash_kinds([[30.0, 10.0, 5.0]]), crash.vehicles.tolist()
        (['rear_end'], [[0, 1]])
        >>> describe_crash(crash)["impact_speed"] == crash.impact_speed.item()
        True
    """

    kind: Tensor
    """Index of `CRASH_KINDS`, int64, shape (B,)."""
    vehicles: Tensor
    """Indices of the two vehicles, int64, shape (B, 2); -1 for the edge of the road, and for nobody."""
    impact_speed: Tensor
    """Relative speed at contact [m/s], shape (B,)."""
    closing_speed: Tensor
    """Its part along the normal of the contact [m/s], shape (B,)."""
    delta_v: Tensor
    """Change of velocity of the two in the impact [m/s], shape (B, 2): (1 + restitution) / 2 of the closing speed, as
    masses are equal and nothing rubs; all of it (1 + restitution times) against the edge, which is a wall."""
    injury_risk: Tensor
    """Probability that an occupant of the two is injured seriously (MAIS 3 or more), shape (B, 2), see
    `injury_risk`."""

    @classmethod
    def nothing(cls, like: Tensor) -> "Crash":
        """Return no crash in B = len(like) episodes of the dtype and device of `like`."""
        batch, whole = len(like), torch.int64
        zero = torch.zeros(batch, dtype=like.dtype, device=like.device)
        both = zero[:, None].expand(batch, 2)
        nobody = torch.full((batch, 2), -1, dtype=whole, device=like.device)
        return cls(torch.full_like(zero, NONE, dtype=whole), nobody, zero, zero, both, both)

    def replace_where(self, where: Tensor, by: "Crash") -> "Crash":
        """Return these crashes, but `by` in the episodes `where`, boolean, shape (B,)."""
        return Crash(
            *(
                torch.where(where if old.ndim == 1 else where[:, None], new, old)
                for old, new in zip(self, by, strict=True)
            )
        )


def injury_risk(delta_v: ValueT, mode: str = "all") -> ValueT:
    """Return the probability of a serious injury (MAIS 3 or more) of an occupant by delta-v [m/s], any shape.

    Logistic, 1 / (1 + exp(-(a + b delta-v))), from tow-away crashes of light vehicles in the United States, 2010 to
    2015 (NASS-CDS), in the mode "frontal", "rear" (struck from behind) or "all" (Wang, DOT HS 813 219, 2022);
    restraint, age and intrusion are averaged over. That sample has few light crashes, and the curve does not go to 0
    at 0 (about 0.1 %), so it is an order of severity rather than a forecast.
    """
    intercept, slope = MAIS3[mode]
    exponent = intercept + slope * MPH * delta_v
    return torch.sigmoid(exponent) if isinstance(exponent, Tensor) else 1.0 / (1.0 + math.exp(-exponent))


def crash_of(state: State, road: Road, before: State | None = None, dt: float = 0.1) -> Crash:
    """Return the crash of the ego in each of B scenarios at its moment; ways of the tick from `before`, or by speeds.

    With the first vehicle that it touched, or with the edge of the road where it overlaps none and is off the road.
    """
    off_road = road.off_road(state.y[:, 0]).tolist()
    return _find_crashes(state, road, before, dt, [(0, j) for j in range(1, state.x.shape[1])], off_road)


def crash_of_others(state: State, road: Road, before: State | None = None, dt: float = 0.1) -> Crash:
    """Return the crash of vehicles other than the ego, of kind "others"; arguments as of `crash_of`."""
    couples = [couple for couple in zip(*pairs(state.x.shape[1]), strict=True) if 0 not in couple]
    crash = _find_crashes(state, road, before, dt, couples, [False] * len(state.x))
    return crash._replace(kind=torch.where(crash.kind == NONE, NONE, OTHERS))


class _Body(NamedTuple):
    """A vehicle at the end of a tick [m, rad, m/s]."""

    x: float
    """In the flat world, as the next four."""
    y: float
    heading: float
    vx: float
    vy: float
    ahead: float
    """Place along the road, and speed; then across it."""
    along: float
    aside: float
    across: float
    speed: float


def _find_crashes(
    state: State, road: Road, before: State | None, dt: float, couples: Sequence[tuple[int, int]], off_road: list[bool]
) -> Crash:
    """Return the first contacts among couples of vehicles, row by row: few crash in a tick, each other than the next.

    So no numbers of many rows are worked on side by side, of which each takes longer to start than to compute.
    """
    x, y, heading = road.to_world(state.x, state.y, state.heading)
    if before is None:
        vx, vy = state.speed * torch.cos(heading), state.speed * torch.sin(heading)
        along, across = state.speed * torch.cos(state.heading), state.speed * torch.sin(state.heading)
    else:
        old_x, old_y, _ = road.to_world(before.x, before.y, before.heading)
        vx, vy = (x - old_x) / dt, (y - old_y) / dt
        along, across = (state.x - before.x) / dt, (state.y - before.y) / dt
    columns = (x, y, heading, vx, vy, state.x, along, state.y, across, state.speed)
    table = torch.stack(columns, dim=-1).tolist()
    if not table:
        return Crash.nothing(state.x[:, 0])
    rows = [_find_crash([_Body(*each) for each in row], couples, off) for row, off in zip(table, off_road, strict=True)]
    kind, vehicles, *numbers = zip(*rows, strict=True)
    whole = (torch.tensor(each, device=x.device) for each in (kind, vehicles))
    return Crash(*whole, *(torch.tensor(each, dtype=x.dtype, device=x.device) for each in numbers))


def _find_crash(bodies: Sequence[_Body], couples: Sequence[tuple[int, int]], off_road: bool) -> tuple[Any, ...]:
    """Return the fields of a `Crash` of one row."""
    contacts = [(_find_contact(bodies[i], bodies[j]), i, j) for i, j in couples]
    touching = [(contact, i, j) for contact, i, j in contacts if contact is not None]
    if touching:
        (_, kind, closing, impact), one, other = min(touching, key=lambda each: each[0][0])
        first, second = bodies[one], bodies[other]
        ways = (second.aside - first.aside, first.across, second.across)
        way, own, its = ways if kind == SIDE else (second.ahead - first.ahead, first.along, second.along)
        runs = own * _sign(way) >= -its * _sign(way)  # who moves faster towards the other
        change, both = (1.0 + RESTITUTION) / 2.0 * closing, ("all", "all") if kind == SIDE else ("frontal", "rear")
        risks = [injury_risk(change, mode) for mode in both]
        return kind, (one, other) if runs else (other, one), impact, closing, (change, change), risks
    if off_road:
        across = abs(bodies[0].across)
        change = (1.0 + RESTITUTION) * across
        return ROAD_EDGE, (0, -1), bodies[0].speed, across, (change, 0.0), (injury_risk(change), 0.0)
    return NONE, (-1, -1), 0.0, 0.0, (0.0, 0.0), (0.0, 0.0)


def _find_contact(one: _Body, other: _Body) -> tuple[float, int, float, float] | None:
    """Return when two bodies began to overlap [s], at most 0, the kind, closing and relative speed; None if apart."""
    dx, dy, dvx, dvy = other.x - one.x, other.y - one.y, other.vx - one.vx, other.vy - one.vy
    turn = other.heading - one.heading
    cos_turn, sin_turn = abs(math.cos(turn)) / 2, abs(math.sin(turn)) / 2
    axes = []
    for number, course in enumerate((one.heading, one.heading, other.heading, other.heading)):
        cos, sin = math.cos(course), math.sin(course)
        if number % 2 == 0:
            offset, rate = dx * cos + dy * sin, dvx * cos + dvy * sin
            reach = VEHICLE_LENGTH / 2 + VEHICLE_LENGTH * cos_turn + VEHICLE_WIDTH * sin_turn
        else:
            offset, rate = dy * cos - dx * sin, dvy * cos - dvx * sin
            reach = VEHICLE_WIDTH / 2 + VEHICLE_LENGTH * sin_turn + VEHICLE_WIDTH * cos_turn
        gap = abs(offset) - reach
        if gap >= _ROUNDING:
            return None
        since = -offset / rate - reach / abs(rate) if rate else -math.inf
        axes.append((since, gap, number, -rate * _sign(offset), offset))
    since, _, number, closing, _ = max(axes, key=lambda each: each[0])
    if since == -math.inf:  # nothing moves: the axis along which they overlap least
        _, _, number, closing, _ = max(axes, key=lambda each: each[1])
    angle = turn if number >= 2 else 0.0
    lengthwise = (abs(math.cos(angle)) >= abs(math.sin(angle))) == (number % 2 == 0)
    kind = (REAR_END if axes[0][-1] > 0 else REAR_ENDED) if lengthwise else SIDE
    return since, kind, max(closing, 0.0), math.hypot(dvx, dvy)


def _sign(value: float) -> float:
    """Return 1, -1 or 0."""
    return math.copysign(1.0, value) if value else 0.0


def contact_speed(state: State, road: Road, before: State | None, dt: float) -> Tensor:
    """Return the closing speed of the ego's crash [m/s], (B,), 0 for none: as `crash_of`, of many rows at once."""
    met = encounter(state, road, "ego", before, dt)
    axes, rate = met.axes, met.rate
    since, axis = crossing(axes, rate)[0].max(-1)
    resting = torch.isinf(since)
    axis = torch.where(resting, axes.gap.argmax(-1), axis)
    touching = boxes_overlap(*met[:4])
    at = torch.where(touching, torch.where(resting, torch.finfo(since.dtype).min, since), torch.inf)
    towards = (-rate * torch.sign(axes.offset)).gather(-1, axis[..., None])[..., 0]
    closing = towards.gather(1, at.argmin(1, keepdim=True))[:, 0].clamp(min=0.0)
    across = state.speed[:, 0] * torch.sin(state.heading[:, 0])
    if before is not None:
        across = (state.y[:, 0] - before.y[:, 0]) / dt
    alone = torch.where(road.off_road(state.y[:, 0]), across.abs(), 0.0)
    return torch.where(touching.any(1), closing, alone)


def describe_crash(crash: Crash, row: int = 0) -> dict[str, Any] | None:
    """Return one crash in plain values, for `info` and for files; None if there was none.

    Returns:
        "kind" (of `CRASH_KINDS`), "vehicles" (who ran into whom), "impact_speed", "closing_speed", "delta_v" [m/s] and
        "injury_risk" (both of the two vehicles in this order).

    Example:
        >>> from rare_envs.scenarios import State, straight
        >>> x = torch.tensor([[0.0, 4.9]])  # bodies of 5 m
        >>> state = State(x, 0 * x, 0 * x, torch.tensor([[20.0, 10.0]]), theta=x[:, :0])
        >>> described = describe_crash(crash_of(state, straight(1)))
        >>> described["kind"], described["vehicles"], described["delta_v"]
        ('rear_end', [0, 1], [5.0, 5.0])
    """
    kind = CRASH_KINDS[int(crash.kind[row])]
    if kind == CRASH_KINDS[NONE]:
        return None
    return {name: kind if name == "kind" else values[row].tolist() for name, values in crash._asdict().items()}
