"""Crashes: who hit whom and where, how fast, and the risk of an injury.

Two bodies touch when they begin to overlap along the last of the four axes on which they can be apart; that axis is the
normal of the contact. Along the tick bodies are taken to move straight, from where they were to where they are.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import indices, may_hold
from rare_envs.traffic.bodies import Which, boxes_overlap, crossing, encounter, pairs
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

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


def injury_risk(delta_v: Tensor, mode: str = "all") -> Tensor:
    """Return the probability of a serious injury (MAIS 3 or more) of an occupant by delta-v [m/s], any shape.

    Logistic, 1 / (1 + exp(-(a + b delta-v))), from tow-away crashes of light vehicles in the United States, 2010 to
    2015 (NASS-CDS), in the mode "frontal", "rear" (struck from behind) or "all" (Wang, DOT HS 813 219, 2022);
    restraint, age and intrusion are averaged over. That sample has few light crashes, and the curve does not go to 0
    at 0 (about 0.1 %), so it is an order of severity rather than a forecast.
    """
    intercept, slope = MAIS3[mode]
    return torch.sigmoid(intercept + slope * MPH * delta_v)


def crash_of(state: State, road: Road, before: State | None = None, dt: float = 0.1) -> Crash:
    """Return the crash of the ego in each of B scenarios at its moment; ways of the tick from `before`, or by speeds.

    With the first vehicle that it touched, or with the edge of the road where it overlaps none and is off the road.
    """
    crash = _pair_crash(state, road, before, dt, "ego")
    off = (crash.kind == NONE) & road.off_road(state.y[:, 0])
    return crash.replace_where(off, _edge_crash(state, before, dt)) if may_hold(off) else crash


def crash_of_others(state: State, road: Road, before: State | None = None, dt: float = 0.1) -> Crash:
    """Return the crash of vehicles other than the ego, of kind "others"; arguments as of `crash_of`."""
    crash = _pair_crash(state, road, before, dt, "others")
    return crash._replace(kind=torch.where(crash.kind == NONE, NONE, OTHERS))


def _pair_crash(state: State, road: Road, before: State | None, dt: float, which: Which) -> Crash:
    """Return the first contact among some pairs of vehicles."""
    n = state.x.shape[1]
    of_pairs = slice(0, n - 1) if which == "ego" else slice(n - 1, None)
    numbers = [indices(index[of_pairs], state.x) for index in pairs(n)]
    if not len(numbers[0]):
        return Crash.nothing(state.x[:, 0])
    met = encounter(state, road, which, before, dt)
    axes, rate = met.axes, met.rate
    enter, _ = crossing(axes, rate)
    since, axis = enter.max(-1)
    resting = torch.isinf(since)  # nothing moves: the axis along which they overlap least
    axis = torch.where(resting, axes.gap.argmax(-1), axis)
    touching = boxes_overlap(*met[:4])
    at = torch.where(touching, torch.where(resting, torch.finfo(since.dtype).min, since), torch.inf)
    pair = at.argmin(1, keepdim=True)

    def of(values: Tensor) -> Tensor:
        return values.gather(1, pair)[:, 0]

    def on_axis(values: Tensor) -> Tensor:
        return of(values.gather(-1, axis[..., None])[..., 0])

    towards = torch.sign(on_axis(axes.offset))  # the normal points from the first to the second
    closing = (-on_axis(rate) * towards).clamp(min=0.0)
    couple = torch.stack([of(each.expand_as(at)) for each in numbers], -1)
    kind = _kind(of(axis), of(met.other_heading - met.heading), of(axes.offset[..., 0]))
    own, its = (_approach(state, before, dt, kind == SIDE, each) for each in (couple, couple.flip(-1)))
    vehicles = torch.where((own >= its)[:, None], couple, couple.flip(-1))
    change = ((1.0 + RESTITUTION) / 2.0 * closing)[:, None].expand(-1, 2)
    modes = [injury_risk(change[:, 0], mode) for mode in ("frontal", "rear", "all")]
    risk = torch.where((kind != SIDE)[:, None], torch.stack(modes[:2], -1), modes[2][:, None])
    speed = of((met.dvx.square() + met.dvy.square()).sqrt())
    crash, apart = Crash(kind, vehicles, speed, closing, change, risk), ~touching.any(1)
    return crash.replace_where(apart, Crash.nothing(speed)) if may_hold(apart) else crash


def _approach(state: State, before: State | None, dt: float, side: Tensor, couple: Tensor) -> Tensor:
    """Return the speed of the first of two towards the second, across the road or along it [m/s], shape (B,)."""
    along, across = state.speed * torch.cos(state.heading), state.speed * torch.sin(state.heading)
    if before is not None:
        along, across = (state.x - before.x) / dt, (state.y - before.y) / dt
    place, speed = torch.where(side[:, None], state.y, state.x), torch.where(side[:, None], across, along)
    first, second = place.gather(1, couple).unbind(1)
    return speed.gather(1, couple[:, :1])[:, 0] * torch.sign(second - first)


def _kind(axis: Tensor, turn: Tensor, ahead: Tensor) -> Tensor:
    """Return the kind by the normal's angle to the heading of the first, and by whether the second is ahead of it."""
    angle = torch.where(axis >= 2, turn, 0.0)
    lengthwise = (torch.cos(angle).abs() >= torch.sin(angle).abs()) == (axis % 2 == 0)
    return torch.where(lengthwise, torch.where(ahead > 0, REAR_END, REAR_ENDED), SIDE)


def _edge_crash(state: State, before: State | None, dt: float) -> Crash:
    """Return the crash of the ego with the edge of the road, a wall along it."""
    crash = Crash.nothing(state.x[:, 0])
    across = state.speed[:, 0] * torch.sin(state.heading[:, 0])
    if before is not None:
        across = (state.y[:, 0] - before.y[:, 0]) / dt
    change = torch.stack(((1.0 + RESTITUTION) * across.abs(), torch.zeros_like(across)), -1)
    risk = torch.stack((injury_risk(change[:, 0]), torch.zeros_like(across)), -1)
    edge = crash.vehicles + indices((1, 0), across)
    return Crash(torch.full_like(crash.kind, ROAD_EDGE), edge, state.speed[:, 0], across.abs(), change, risk)


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
