"""Terms of an episode: the numbers, one of each vehicle say, whose least is f, and when each is attained."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from rare_envs.devices import may_hold
from rare_envs.measures.base import EpisodeMeasure, Measure, MeasureState, MeasureTerms, Moment
from rare_envs.measures.registry import CLEARANCE, PAIR_CLEARANCE


@runtime_checkable
class TermMeasure(Protocol):
    """A measure whose f is the least over the moments of an episode and, in a moment, over its terms.

    A `Measure` is one. So is an `EpisodeMeasure` of your own with these three attributes.
    """

    @property
    def terms(self) -> MeasureTerms | None:
        """Its terms; None if it has but one."""

    @property
    def collision(self) -> Any:
        """Value of f in an episode with a collision, as in `Measure.collision`."""

    def term_values(self, moment: Moment) -> Tensor:
        """Return f of each of the K terms of a moment, shape (B, K); their least is f of the moment."""


class TermState(NamedTuple):
    """State of `TermTracker` in B episodes with J terms, all of which began at the same time."""

    own: MeasureState
    """State of the measure."""
    values: Tensor
    """f of each term so far, shape (B, J)."""
    ticks: Tensor
    """Tick at which it is attained, int64, shape (B, J)."""
    tick: int
    """Of the last moment."""
    ticks_in_all: int
    """Length of a whole episode."""


@dataclass(frozen=True)
class TermTracker:
    """A measure with terms to search by: its own, or those of another measure whose order is better.

    f is the measure's. Terms that are cut at a share of the horizon come part by part: K early ones, then K late ones.
    """

    measure: EpisodeMeasure
    """Measure whose f it is."""
    order: TermMeasure
    """Measure whose terms they are."""

    @property
    def sees(self) -> bool:
        """Whether the measure needs lidar features; an order has to do with what its measure has."""
        return self.measure.sees

    @property
    def records(self) -> bool:
        """Whether the measure keeps whole episodes."""
        return self.measure.records

    @property
    def unit(self) -> str:
        """Unit of f."""
        return self.measure.unit

    def start(self, moment: Moment, ticks: int) -> TermState:
        """Return the state after the first moment."""
        first = self.order.term_values(moment)
        terms = self.order.terms
        late = [] if terms is None else [torch.full_like(first, terms.unattained) for _ in terms.cuts]
        values = torch.cat((first, *late), 1)
        zero = torch.zeros_like(values, dtype=torch.int64)
        return TermState(self.measure.start(moment, ticks), values, zero, 0, ticks)

    def update(self, state: TermState, moment: Moment, before: Tensor, now: Tensor) -> TermState:
        """Return the state after one more moment; arguments as of `EpisodeMeasure.update`."""
        tick = state.tick + 1
        own = self.measure.update(state.own, moment, before, now)
        latest = self.order.term_values(moment)
        count = latest.shape[1]
        first = count * self.part_of(tick, state.ticks_in_all)
        part = slice(first, first + count)
        old = state.values[:, part]
        lower = (latest < old) & ~now[:, None]
        values, ticks = state.values.clone(), state.ticks.clone()
        values[:, part] = torch.where(lower, latest, old)
        ticks[:, part] = torch.where(lower, tick, ticks[:, part])
        new = now & ~before
        if self.order.collision is not None and may_hold(new):
            term, worth = first + self._find_hit(moment, latest), self._worth(moment, latest)[:, None]
            hit = new[:, None] & (torch.arange(values.shape[1], device=term.device) == term[:, None])
            values = torch.where(new[:, None], torch.maximum(values, worth), values)
            values, ticks = torch.where(hit, worth, values), torch.where(hit, tick, ticks)
        return TermState(own, values, ticks, tick, state.ticks_in_all)

    def f(self, state: TermState) -> Tensor:
        """Return f of the measure, shape (B,)."""
        return self.measure.f(state.own)

    def part_of(self, tick: int, ticks: int) -> int:
        """Return the number of the part of the horizon that a tick of `ticks` belongs to."""
        cuts = () if self.order.terms is None else self.order.terms.cuts
        return sum(tick > cut * ticks for cut in cuts)

    def names(self, vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the J terms."""
        terms = self.order.terms
        if terms is None:
            return ("f",)
        ends = [0, *(round(100 * cut) for cut in terms.cuts), 100]
        parts = [f", {low} to {high} % of the time" for low, high in pairwise(ends)]
        parts = parts if terms.cuts else [""]
        return tuple(name + part for part in parts for name in terms.names(vehicle_names))

    def _find_hit(self, moment: Moment, latest: Tensor) -> Tensor:
        hit = None if self.order.terms is None else self.order.terms.hit
        return latest.argmin(1) if hit is None else hit(moment)

    def _worth(self, moment: Moment, latest: Tensor) -> Tensor:
        collision = self.order.collision
        value: Tensor = collision(moment) if callable(collision) else latest.new_full(latest.shape[:1], collision)
        return value


def find_order(measure: EpisodeMeasure, collisions: str, gamma: float) -> tuple[TermMeasure | None, float]:
    """Return the measure on whose terms to search for f <= gamma, and the threshold of these terms.

    Where {f <= gamma} is the collision, as at gamma = 0 of times to collision, it is the clearance, which tells near
    from far where times are capped and does not jump from car to car: between the ego and the others, or between all
    where `collisions` are "any". Else it is the measure itself; None if that has no terms and no moments.
    """
    if gamma == 0.0 and isinstance(measure, Measure) and measure.collisions_only:
        return (PAIR_CLEARANCE if collisions == "any" else CLEARANCE), 0.0
    if not isinstance(measure, TermMeasure):
        return None, gamma
    whole = isinstance(measure, Measure) and type(measure) is not Measure  # such as `Exposure`, no least over moments
    return (None if whole and measure.terms is None else measure), gamma
