"""Traces: episodes recorded moment by moment, and measures that are functions of a whole episode."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from rare_envs.measures.base import COLLISION, check_one_each
from rare_envs.measures.moment import Moment
from rare_envs.traffic.lead import Lead
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State


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

    @property
    def time(self) -> Tensor:
        """Time of each moment [s], shape (T,)."""
        x = self.state.x
        return torch.arange(len(x), dtype=x.dtype, device=x.device) * self.dt

    def of(self, function: Callable[[Moment], Tensor]) -> Tensor:
        """Return a function of a moment, such as `ttc`, at every moment, shape (T, B)."""
        before = State(*(torch.cat((field[:1], field[:-1])) for field in self.state))
        moment = Moment(
            State(*map(_flat, self.state)),
            Lead(*map(_flat, self.lead)),
            self.road,
            None if self.perception is None else _flat(self.perception),
            State(*map(_flat, before)),
            self.dt,
        )
        return function(moment).view(self.valid.shape)


def _flat(values: Tensor) -> Tensor:
    """Join the first two axes: (T, B, ...) to (T B, ...)."""
    return values.flatten(0, 1)


@dataclass(frozen=True, eq=False)
class Record:
    """The moments of B episodes so far; they need not have begun at the same time."""

    moments: tuple[Moment, ...]
    """The latest last; older ones than any of the episodes are dropped."""
    first: Tensor
    """Index of the first moment of each episode, int64, shape (B,)."""
    last: Tensor
    """Index of the last moment of each that counts: the newest, or the collision, int64, shape (B,)."""
    collided: Tensor
    """Boolean, shape (B,)."""
    ticks: int
    """Length of a whole episode."""

    def append(self, moment: Moment, before: Tensor, now: Tensor) -> "Record":
        """Return the record with one more moment; arguments as of `EpisodeMeasure.update`."""
        old = int(self.first.min())
        moments = (*self.moments[old:], moment)
        last = torch.where(before, self.last - old, len(moments) - 1)
        return Record(moments, self.first - old, last, now, self.ticks)

    def replace_rows(self, rows: Tensor, new: "Record") -> "Record":
        """Return the record with the episodes `rows` replaced by new ones that have just begun."""
        newest, fresh = self.moments[-1], new.moments[-1]
        seen = newest.perception
        if seen is not None and fresh.perception is not None:
            seen = _replace_rows(seen, rows, fresh.perception)
        merged = newest._replace(
            state=State(*(_replace_rows(a, rows, b) for a, b in zip(newest.state, fresh.state, strict=True))),
            lead=Lead(*(_replace_rows(a, rows, b) for a, b in zip(newest.lead, fresh.lead, strict=True))),
            perception=seen,
        )
        at = torch.full_like(self.first[rows], len(self.moments) - 1)
        return replace(
            self,
            moments=(*self.moments[:-1], merged),
            first=_replace_rows(self.first, rows, at),
            last=_replace_rows(self.last, rows, at),
            collided=_replace_rows(self.collided, rows, new.collided),
        )

    def trace(self) -> Trace:
        """Return the trace of the episodes so far, as a measure gets it."""
        time = torch.arange(self.ticks + 1, device=self.first.device)[:, None]
        at = torch.minimum(self.first + time, self.last)
        row = torch.arange(len(self.first), device=self.first.device)

        def align(values: list[Tensor]) -> Tensor:
            return torch.stack(values)[at, row]

        states, leads = [each.state for each in self.moments], [each.lead for each in self.moments]
        seen = [each.perception for each in self.moments if each.perception is not None]
        return Trace(
            State(*(align(list(values)) for values in zip(*states, strict=True))),
            Lead(*(align(list(values)) for values in zip(*leads, strict=True))),
            self.moments[-1].road,
            align(seen) if seen else None,
            self.first + time <= self.last,
            self.collided,
            self.moments[-1].dt,
        )


def _replace_rows(old: Tensor, rows: Tensor, new: Tensor) -> Tensor:
    """Return a copy of `old` with some rows replaced."""
    old = old.clone()
    old[rows] = new
    return old


@dataclass(frozen=True)
class TraceMeasure:
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
    records: ClassVar[bool] = True
    """It keeps whole episodes."""

    def gamma(self, value: float) -> float:
        """Return the threshold of f that corresponds to a value in the measure's own unit and sign."""
        return value if self.critical is None else self.critical - value

    def start(self, moment: Moment, ticks: int) -> Record:
        """Return a record of the first moment."""
        at = torch.zeros(len(moment.state.x), dtype=torch.int64, device=moment.state.x.device)
        return Record((moment,), at, at, at > 0, ticks)

    def update(self, state: Record, moment: Moment, before: Tensor, now: Tensor) -> Record:
        """Return the record with one more moment."""
        return state.append(moment, before, now)

    def f(self, state: Record) -> Tensor:
        """Return the function of the episodes so far, shape (B,)."""
        value = check_one_each(self.of(state.trace()), state.first)
        f = value if self.critical is None else self.critical - value
        return f if self.collision is None else torch.where(state.collided, self.collision, f)
