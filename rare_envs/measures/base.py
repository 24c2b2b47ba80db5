"""Safety measures: from the moments of an episode to its f, which is small where it is dangerous and always finite."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from rare_envs.devices import may_hold, scalars
from rare_envs.traffic.bodies import Lead, lead_of
from rare_envs.traffic.road import Road, straight
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State, map_leaves, map_tensors

GAP_MIN = 0.01
"""Gaps are floored here [m] so that only a collision, never a narrow escape, comes to 0 or less."""
GAP_MAX = 1e6
"""And cut here [m], if there is no lead."""
STILL = 1e-4
"""Speeds in a denominator are floored here [m/s], far below gap / TTC_MAX, so no value under the cap changes."""
COLLISION = -1.0
"""f of an episode with a collision, unless a measure says otherwise (Tian et al. 2024, equation 3)."""
ADDED_MAX = 1000.0
"""Cap of what is added up over an episode [unit x s]."""
MeasureState: TypeAlias = Any
"""State of a measure in B episodes: a tensor (B, ...), a tuple of such, or an object with `replace_rows(rows, new)`."""


class Moment(NamedTuple):
    """B scenarios at one moment.

    Example:
        >>> moment = Moment.of_two(gap=25.0, speed=20.0, lead_speed=15.0)
        >>> moment.lead.gap.item(), moment.lead.closing_speed.item()
        (25.0, 5.0)
        >>> moment.acceleration.tolist()  # nothing is known of the tick before
        [[0.0, 0.0]]
    """

    state: State
    """The traffic."""
    lead: Lead
    """The ego's lead."""
    road: Road
    """The road that all are on."""
    perception: Tensor | None
    """Lidar features of the vehicles, shape (B, M, 51), the ego's first; None unless the measure needs them."""
    before: State | None = None
    """The state one tick earlier; None at the start."""
    dt: float = 0.1
    """Tick [s]."""
    evades: Tensor | None = None
    """Whether another vehicle makes a rapid evasive manoeuvre, boolean, shape (B,), as the scenario says; None if
    it says nothing, or the measure does not ask (`EpisodeMeasure.twice`)."""

    @classmethod
    def of_two(cls, gap: float, speed: float, lead_speed: float) -> Moment:
        """Return an ego and its lead in one straight lane, for examples: bumper to bumper [m], speeds [m/s]."""
        x = torch.tensor([[0.0, gap + VEHICLE_LENGTH]])
        zero, road = torch.zeros_like(x), straight(1)
        state = State(x, zero, zero, torch.tensor([[speed, lead_speed]]), theta=x[:, :0])
        return cls(state, lead_of(state, road), road, None)

    @property
    def acceleration(self) -> Tensor:
        """Mean acceleration of every vehicle over the last tick [m/s^2], shape (B, N); 0 at the start."""
        if self.before is None:
            return torch.zeros_like(self.state.speed)
        return (self.state.speed - self.before.speed) / self.dt


def gap_of(moment: Moment) -> Tensor:
    """Return the gap to the lead [m], positive and finite, shape (B,)."""
    return moment.lead.gap.clamp(GAP_MIN, GAP_MAX)


def acceleration_of(moment: Moment, vehicle: Tensor) -> Tensor:
    """Return a vehicle's acceleration along the ego's heading over the last tick [m/s^2], 0 for number 0, (B,)."""
    heading = moment.state.heading
    along = moment.acceleration * torch.cos(heading - heading[:, :1])
    return torch.where(vehicle > 0, along.gather(1, vehicle[:, None])[:, 0], 0.0)


class Obstacle(NamedTuple):
    """The nearest vehicle ahead of the ego whose body overlaps its own across the road: without steering they meet."""

    gap: Tensor
    """Bumper to bumper along the road [m], in [`GAP_MIN`, `GAP_MAX`], shape (B,)."""
    closing_speed: Tensor
    """Ego's speed less its own along the ego's heading [m/s]; 0 if there is none."""
    vehicle: Tensor
    """Its number, int64; 0 if there is none."""


def find_obstacle(moment: Moment) -> Obstacle:
    """Return what is in the way of the ego; a lead that only reaches into its lane, or is beside it, is not."""
    x, y, heading, speed = moment.state[:4]
    ahead = x[:, 1:] - x[:, :1]
    met = (ahead >= 0) & ((y[:, 1:] - y[:, :1]).abs() < VEHICLE_WIDTH)
    way, vehicle = torch.nn.functional.pad(torch.where(met, ahead, torch.inf), (1, 0), value=torch.inf).min(1)
    closing = speed[:, :1] - speed * torch.cos(heading - heading[:, :1])  # of the ego itself 0
    return Obstacle((way - VEHICLE_LENGTH).clamp(GAP_MIN, GAP_MAX), closing.gather(1, vehicle[:, None])[:, 0], vehicle)


class EpisodeMeasure(ABC):
    """A safety measure as a fold over the moments of B episodes, as they come. Nothing in it changes.

    A class of your own inherits from it, and needs the three methods only.

    Example:
        >>> class LastSpeed(EpisodeMeasure):
        ...     def start(self, moment, ticks):
        ...         return moment.state.speed[:, 0]
        ...
        ...     def update(self, state, moment, before, now):
        ...         return torch.where(before, state, moment.state.speed[:, 0])
        ...
        ...     def f(self, state):
        ...         return state
        >>> import rare_envs
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=LastSpeed(), horizon=1.0)
        >>> problem.evaluate([[20.0, 20.0, 100.0]]).round(1).tolist()  # [m/s] after 1 s
        [20.4]
    """

    sees: bool = False
    """Whether it needs the lidar features of the vehicles, `Moment.perception`."""
    records: bool = False
    """Whether it keeps whole episodes, which are then simulated in smaller batches."""
    unit: str = ""
    """Unit of f; empty for a number without one."""
    critical: float | None = None
    """The critical value of a measure whose large values are dangerous; None if small ones are."""
    twice: bool = False
    """Whether f takes a second rollout of some episodes, as that of `rare_envs.measures.registry.NearCrash` does."""

    @abstractmethod
    def start(self, moment: Moment, ticks: int) -> MeasureState:
        """Return the state after the first moment of episodes that are `ticks` long."""

    @abstractmethod
    def update(self, state: MeasureState, moment: Moment, before: Tensor, now: Tensor) -> MeasureState:
        """Return the state after one more moment.

        Args:
            state: After the moments before.
            moment: The next moment.
            before: Whether the ego had collided before this moment, boolean, shape (B,): what follows is meaningless.
            now: Whether it has by this moment, boolean, shape (B,).
        """

    @abstractmethod
    def f(self, state: MeasureState) -> Tensor:
        """Return the measure of the episodes so far, shape (B,)."""

    def gamma(self, value: Any) -> Any:
        """Return the f that corresponds to a value in the measure's own unit and sign: the critical value less it."""
        return value if self.critical is None else self.critical - value


def check_one_each(value: Any, like: Tensor) -> Tensor:
    """Return what a measure's function gave, if it is one number for each of B episodes, as `like` (B,) has."""
    if isinstance(value, Tensor) and value.shape == like.shape and value.dtype != torch.bool:
        return value
    came = f"a tensor of shape {tuple(value.shape)}, {value.dtype}" if isinstance(value, Tensor) else repr(value)
    raise ValueError(
        f"Expected one number for each of {len(like)} episodes, a tensor of shape ({len(like)},), small where it is "
        f"dangerous, got {came}."
    )


def name_others(vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the vehicles but the ego."""
    return vehicle_names[1:]


@dataclass(frozen=True)
class MeasureTerms:
    """Terms of a measure: K numbers of a moment, the most dangerous of which is the measure; one of each vehicle, say.

    Samplers search among the failures of each term by itself, which are simpler than those of all together.

    Example:
        >>> import rare_envs
        >>> def distances(moment):
        ...     return (moment.state.x[:, 1:] - moment.state.x[:, :1]).abs()
        >>> nearest = Measure(lambda moment: distances(moment).amin(1), terms=MeasureTerms(distances), unit="m")
        >>> problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", measure=nearest)
        >>> terms = problem.terms([[20.0, 20.0, 20.0, 30.0, 40.0, 3.5]])
        >>> terms.names, terms.values.round(1).tolist(), terms.f.round(1).tolist()  # to the cutter and to the lead
        (('cutter', 'lead'), [[34.0, 79.8]], [34.0])
    """

    of: Callable[[Moment], Tensor]
    """A moment to the terms in the measure's own unit and sign, shape (B, K)."""
    hit: Callable[[Moment], Tensor] | None = None
    """The moment of a collision to the number of the term that the collision belongs to, int64, shape (B,); None for
    the most dangerous one at that moment."""
    names: Callable[[tuple[str, ...]], tuple[str, ...]] = name_others
    """Names of the N vehicles, the ego's first, to those of the K terms."""
    cuts: tuple[float, ...] = ()
    """Shares of the horizon at which each term is cut into one before and one after, which count as different terms."""
    unattained: float = 1e3
    """f of a term that has no moment, such as one of the late moments of an episode that ended early."""


@dataclass(frozen=True)
class Measure(EpisodeMeasure):
    """A measure that is decided by the most dangerous moment of an episode (f is the least), or that adds up over it.

    If large values are dangerous, such as those of a deceleration, f is the critical value less the value, so that
    f <= 0 says that the critical value was reached.

    Example:
        >>> import rare_envs
        >>> from rare_envs.measures.longitudinal import drac
        >>> comfort = Measure(drac, critical=2.0, collision=-100.0, unit="m/s^2")
        >>> comfort.gamma(3.0)  # f <= -1 if avoiding a crash takes 3 m/s^2
        -1.0
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=comfort)
        >>> problem.evaluate([[20.0, 10.0, 25.0]]).round(2).tolist()  # at first 10^2 / (2 25) = 2 m/s^2, then less
        [0.0]
        >>> slow = Measure(lambda moment: (moment.state.speed[:, 0] < 19.9).float(), critical=2.0, adds=True)
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=slow)
        >>> problem.evaluate([[20.0, 10.0, 150.0]]).round(1).tolist()  # 6.5 s of the 10 s
        [-4.5]
    """

    of: Callable[[Moment], Tensor]
    """A moment to the measure in its own unit and sign, shape (B,)."""
    sees: bool = False
    """Whether it needs the lidar features of the vehicles."""
    collision: float | Callable[[Moment], Tensor] | None = COLLISION
    """f of an episode with a collision: a number, a function of the moment of the collision, or None for the least of
    the moments before it."""
    critical: float | None = None
    """The critical value of a measure whose large values are dangerous; None if small ones are."""
    unit: str = "s"
    """Unit of f."""
    terms: MeasureTerms | None = field(default=None, repr=False)
    """Numbers of a moment of which `of` is the most dangerous; None for none but itself."""
    collisions_only: bool = False
    """Whether f is positive in episodes without a collision and only in those: then {f <= 0} is the collision."""
    adds: bool = False
    """Whether f is the critical value (or 0) less the integral of `of` over time [s], in rectangles of one tick."""

    def start(self, moment: Moment, ticks: int) -> Tensor:
        """Return f of the first moment, which is the whole state; where f adds up, nothing is added yet."""
        value = self._value(moment)
        return torch.full_like(value, self.critical or 0.0) if self.adds else self.gamma(value)

    def update(self, state: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        """Return f after one more moment: the lesser, or less one tick, or what a collision counts as after one."""
        if self.adds:
            f = (state - self._value(moment) * moment.dt).clamp(min=(self.critical or 0.0) - ADDED_MAX)
        else:
            f = torch.minimum(state, self.gamma(self._value(moment)))
        worth = state
        if callable(self.collision):
            new = now & ~before
            worth = torch.where(new, self.collision(moment), state) if may_hold(new) else state
        elif self.collision is not None:
            (worth,) = scalars((self.collision,), f)
        return torch.where(now, worth, f)

    def f(self, state: Tensor) -> Tensor:
        """Return the state, which is f."""
        return state

    def term_values(self, moment: Moment) -> Tensor:
        """Return f of each of the K terms of a moment, shape (B, K); their least is f of the moment."""
        values: Tensor = self.gamma(self._value(moment)[:, None] if self.terms is None else self.terms.of(moment))
        return values

    def _value(self, moment: Moment) -> Tensor:
        return check_one_each(self.of(moment), moment.lead.gap)


class Trace(NamedTuple):
    """B episodes from start to horizon, T moments of N vehicles.

    T is that of a whole episode, always: an episode that ended early, in a collision, repeats its last moment, so that
    the same episode gives the same value wherever it was driven.

    Example:
        >>> import torch
        >>> x = torch.tensor([[[0.0, 30.0]], [[2.0, 31.0]]])  # T = 2 moments, B = 1 episode, N = 2 vehicles
        >>> state = State(x, 0 * x, 0 * x, torch.tensor([20.0, 10.0]).expand_as(x), x[..., :0])
        >>> lead = Lead(x[..., 1] - x[..., 0] - 5.0, torch.full((2, 1), 10.0))
        >>> driven = torch.ones(2, 1, dtype=torch.bool)
        >>> trace = Trace(state, lead, None, None, driven, torch.zeros(1, dtype=torch.bool), dt=0.1)
        >>> trace.of(lambda moment: moment.lead.gap / moment.lead.closing_speed).tolist()
        [[2.5], [2.4000000953674316]]
    """

    state: State
    """Every field with an axis for time in front: shapes (T, B, N), theta (T, B, P)."""
    lead: Lead
    """The ego's; shapes (T, B)."""
    road: Road
    perception: Tensor | None
    """Lidar features of the vehicles, shape (T, B, M, 51); None unless the measure needs them."""
    valid: Tensor
    """Mask of the moments that were driven, up to a collision and with it, boolean, shape (T, B)."""
    collided: Tensor
    """Whether the ego has collided, boolean, shape (B,)."""
    dt: float
    """Tick [s]."""

    def of(self, function: Callable[[Moment], Tensor]) -> Tensor:
        """Return a function of a moment, such as `ttc`, at every moment, shape (T, B)."""
        before = map_tensors(lambda field: torch.cat((field[:1], field[:-1])), self.state)
        moment = Moment(self.state, self.lead, self.road, self.perception, before, self.dt)
        values: Tensor = function(map_tensors(lambda field: field.flatten(0, 1), moment))
        return values.view(self.valid.shape)


@dataclass(frozen=True, eq=False)
class Record:
    """The moments of B episodes so far; they need not have begun at the same time."""

    moments: tuple[Moment, ...]
    """The latest last, without the states before them; older ones than any of the episodes are dropped."""
    first: Tensor
    """Index of the first moment of each episode, int64, shape (B,)."""
    last: Tensor
    """Index of the last moment of each that counts: the newest, or the collision, int64, shape (B,)."""
    collided: Tensor
    """Boolean, shape (B,)."""
    ticks: int
    """Length of a whole episode."""

    def replace_rows(self, rows: Tensor, new: Record) -> Record:
        """Return the record with the episodes `rows` replaced by new ones that have just begun."""

        def put(old: Any, fresh: Any) -> Any:
            if isinstance(old, Tensor):
                old = old.clone()
                old[rows] = fresh
            return old

        at = torch.full_like(new.first, len(self.moments) - 1)
        merged = map_leaves(put, self.moments[-1], new.moments[-1])
        first, last, collided = map_leaves(put, (self.first, self.last, self.collided), (at, at, new.collided))
        return replace(self, moments=(*self.moments[:-1], merged), first=first, last=last, collided=collided)

    def trace(self) -> Trace:
        """Return the trace of the episodes so far, as a measure gets it."""
        time = torch.arange(self.ticks + 1, device=self.first.device)[:, None]
        at = torch.minimum(self.first + time, self.last)
        row = torch.arange(len(self.first), device=self.first.device)

        def align(newest: Any, *older: Any) -> Any:
            return torch.stack((*older, newest))[at, row] if isinstance(newest, Tensor) else newest

        state, lead, road, perception, _, dt, _ = map_leaves(align, self.moments[-1], *self.moments[:-1])
        return Trace(state, lead, road, perception, self.first + time <= self.last, self.collided, dt)


@dataclass(frozen=True)
class TraceMeasure(EpisodeMeasure):
    """A measure that is a function of the whole episode.

    Example:
        >>> import rare_envs
        >>> def hardest_braking(trace):
        ...     return (-trace.state.speed[:, :, 0].diff(dim=0) / trace.dt).amax(dim=0)
        >>> measure = TraceMeasure(hardest_braking, critical=6.0, unit="m/s^2")
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=measure)
        >>> problem.evaluate([[20.0, 10.0, 40.0]]).round(2).tolist()  # it brakes by 5 m/s^2
        [1.0]
    """

    of: Callable[[Trace], Tensor]
    """A trace of B episodes to the measure in its own unit and sign, shape (B,)."""
    sees: bool = False
    """Whether it needs the lidar features of the vehicles."""
    collision: float | None = COLLISION
    """f of an episode with a collision; None for the value of the function."""
    critical: float | None = None
    """The critical value of a measure whose large values are dangerous, as in `Measure`."""
    unit: str = ""
    records = True

    def start(self, moment: Moment, ticks: int) -> Record:
        """Return a record of the first moment."""
        at = torch.zeros(len(moment.state.x), dtype=torch.int64, device=moment.state.x.device)
        return Record((moment._replace(before=None),), at, at, at > 0, ticks)

    def update(self, state: Record, moment: Moment, before: Tensor, now: Tensor) -> Record:
        """Return the record with one more moment."""
        old = int(state.first.min())
        moments = (*state.moments[old:], moment._replace(before=None))
        last = torch.where(before, state.last - old, len(moments) - 1)
        return Record(moments, state.first - old, last, now, state.ticks)

    def f(self, state: Record) -> Tensor:
        """Return the function of the episodes so far, shape (B,)."""
        f: Tensor = self.gamma(check_one_each(self.of(state.trace()), state.first))
        return f if self.collision is None else torch.where(state.collided, self.collision, f)
