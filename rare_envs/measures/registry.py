"""Measures by name, `module:measure` or `stl:FORMULA`, their combinations, and the terms whose least is f."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import constant, may_hold
from rare_envs.measures import longitudinal as line
from rare_envs.measures import two_dimensional as plane
from rare_envs.measures.base import (
    ADDED_MAX,
    COLLISION,
    EpisodeMeasure,
    Measure,
    MeasureState,
    MeasureTerms,
    Moment,
    TraceMeasure,
)
from rare_envs.measures.temporal_logic import stl
from rare_envs.plugins import did_you_mean, make_object
from rare_envs.traffic.crash import contact_speed

FORMULA = "stl:"


def load_measure(measure: Any) -> Any:
    """Return what "stl:FORMULA" or "module:name" (a function, a measure or its class) stands for; all else as it is."""
    if not isinstance(measure, str) or ":" not in measure:
        return measure
    if measure.startswith(FORMULA):
        try:
            return stl(measure.removeprefix(FORMULA).strip())
        except ImportError as error:
            raise ValueError(str(error)) from error
    return make_object(measure, "measure", call=False)


def _negative_contact_speed(moment: Moment) -> Tensor:
    """Return the negative speed at which bodies meet in a collision [m/s], shape (B,)."""
    return -contact_speed(moment.state, moment.road, moment.before, moment.dt)


def _to_vehicles_and_edge(of: Callable[[Moment], Tensor]) -> MeasureTerms:
    """Return terms that are times to each other vehicle and to the edge of the road."""
    return MeasureTerms(of, plane.find_vehicle_or_edge, plane.name_edge_terms)


class NearCrashState(NamedTuple):
    """State of `NearCrash` in B episodes."""

    ttc: Tensor
    """f of `ttc`: of the episode, or of its second rollout where there was one, shape (B,)."""
    rapid: Tensor
    """Greatest `evasive_manoeuvre`."""
    evaded: Tensor
    """Whether another vehicle had to evade, boolean."""
    collided: Tensor
    """Boolean."""


class NearCrash(EpisodeMeasure):
    """The least time to collision [s] of the same episode without rapid manoeuvres: braking over 0.5 g, 0.4 g across.

    "Any circumstance that requires a rapid, evasive maneuver by the subject vehicle, or any other vehicle ... to avoid
    a crash" (VTTI, "Researcher dictionary for video reduction data" 1.3, 2012, variable 5). Required is what the ego
    does if the same ego with the same noise in the same scenario, its actions limited by `avoid_rapid`, collides: f is
    -1. Episodes without a rapid manoeuvre are such ones by themselves; others are driven a second time, by
    `DrivingProblem`. A single rollout, as a step of an environment, gives their own time to collision. Where another
    vehicle had to evade (`Scenario.evades`) f is 0 at most; -100 in a collision.
    """

    unit = "s"
    twice = True
    collision = -line.DECELERATION_MAX
    """f of an episode with a collision."""

    def start(self, moment: Moment, ticks: int) -> NearCrashState:
        """Return the state after the first moment."""
        ttc, nobody = line.ttc(moment), torch.zeros_like(moment.lead.gap, dtype=torch.bool)
        return NearCrashState(ttc, torch.zeros_like(ttc), nobody if moment.evades is None else moment.evades, nobody)

    def update(self, state: NearCrashState, moment: Moment, before: Tensor, now: Tensor) -> NearCrashState:
        """Return the state after one more moment."""
        evaded = state.evaded if moment.evades is None else state.evaded | (moment.evades & ~before)
        least = torch.minimum(state.ttc, line.ttc(moment))
        return NearCrashState(least, torch.maximum(state.rapid, line.evasive_manoeuvre(moment)), evaded, now)

    def f(self, state: NearCrashState) -> Tensor:
        """Return the measure, shape (B,)."""
        f = torch.where(state.evaded, state.ttc.clamp(max=0.0), state.ttc)
        return torch.where(state.collided, self.collision, f)

    def find_undecided(self, state: NearCrashState) -> Tensor:
        """Return the episodes, (K,) of B, that have to be driven once more: with a rapid manoeuvre that sufficed."""
        return ((state.rapid >= 1.0) & ~state.evaded & ~state.collided).nonzero()[:, 0]

    def settle(self, state: NearCrashState, rows: Tensor, f: Tensor) -> NearCrashState:
        """Return the state with f (K,) of `ttc` in the second rollouts of the episodes `rows` (K,)."""
        return state._replace(ttc=state.ttc.index_copy(0, rows, f))


_SOON: dict[str, Any] = {"cuts": (plane.EARLY_SHARE,), "unattained": plane.CLEARANCE_MAX}
CLEARANCE = Measure(plane.clearance, unit="m", terms=MeasureTerms(plane.distances, **_SOON), collisions_only=True)
"""Distance to the nearest vehicle. A collision belongs to the vehicle that was hit, off the road to the nearest."""
_PAIRS = MeasureTerms(partial(plane.distances, which="all"), plane.find_nearest_pair, plane.name_pairs, **_SOON)
PAIR_CLEARANCE = Measure(partial(plane.clearance, which="all"), unit="m", terms=_PAIRS, collisions_only=True)
"""Distance of the two vehicles that are nearest to each other, the ego or not."""
_BEAMS = MeasureTerms(line.lidar_ttc_terms, None, line.name_lidar_terms, (line.AT_START,), line.TTC_MAX)
_BRAKING, _SUM, _MARGIN = -line.DECELERATION_MAX, -ADDED_MAX, -plane.MARGIN_MAX
MEASURES: MappingProxyType[str, EpisodeMeasure] = MappingProxyType(
    {
        "ttc": Measure(line.ttc, terms=_to_vehicles_and_edge(line.ttc_terms), collisions_only=True),
        "lidar_ttc": Measure(line.lidar_ttc, sees=True, collision=None, terms=_BEAMS),
        "ttc_2d": Measure(plane.ttc_2d, terms=_to_vehicles_and_edge(plane.contact_time_terms), collisions_only=True),
        "mttc": Measure(line.mttc, collisions_only=True),
        "thw": Measure(line.thw, collisions_only=True),
        "drac": Measure(line.drac, collision=_BRAKING, critical=3.4, unit="m/s^2"),
        "required_deceleration": Measure(
            line.required_deceleration, collision=_BRAKING, critical=line.MAX_BRAKING, unit="m/s^2"
        ),
        "btn": Measure(line.btn, collision=_BRAKING, critical=1.0, unit=""),
        "near_crash": NearCrash(),
        "evasive_manoeuvre": Measure(line.evasive_manoeuvre, collision=_BRAKING, critical=1.0, unit=""),
        "ttb": Measure(line.ttb, collision=-line.TTC_MAX),
        "pet": TraceMeasure(plane.pet, unit="s"),
        "rss_longitudinal": Measure(plane.rss_longitudinal, collision=_MARGIN, unit="m"),
        "rss_lateral": Measure(plane.rss_lateral, collision=_MARGIN, unit="m"),
        "rss_margin": Measure(plane.rss_margin, collision=_MARGIN, unit="m"),
        "clearance": CLEARANCE,
        "tet": Measure(line.tet, adds=True, critical=1.0, collision=_SUM),
        "tit": Measure(line.tit, adds=True, critical=1.0, collision=_SUM, unit="s^2"),
        "margin": Measure(
            plane.margin,
            collision=_negative_contact_speed,
            terms=_to_vehicles_and_edge(plane.margin_terms),
            collisions_only=True,
        ),
    }
)
"""Measures by name. If large values are dangerous, f is the critical value less the value."""


def find_measure(measure: Any) -> EpisodeMeasure:
    """Return the measure that a keyword argument `measure` stands for.

    Args:
        measure: Name of one, a `Measure` or another `EpisodeMeasure`, or a function from a `Moment` of B scenarios to
            shape (B,): small is dangerous, the least over the moments counts, a collision counts as -1.

    Raises:
        ValueError: If it is none of these; an unknown name comes with the nearest known one.

    Example:
        >>> find_measure("drac").unit
        'm/s^2'
        >>> find_measure(lambda moment: moment.lead.gap).collision
        -1.0
    """
    if isinstance(measure, str) and measure in MEASURES:
        return MEASURES[measure]
    if not isinstance(measure, str | type):
        if isinstance(measure, EpisodeMeasure):
            return measure
        if callable(measure):
            return Measure(measure, unit="")
    hint = did_you_mean(measure, MEASURES) if isinstance(measure, str) else ""
    raise ValueError(
        f"Unknown measure {measure!r}{hint}; the measures are {', '.join(MEASURES)}, "
        "module:name, stl:FORMULA, or a function of a Moment (see docs/measures.md)."
    )


@dataclass(frozen=True)
class Combined(EpisodeMeasure):
    """A function of the f of several measures, each of which is updated as it would be alone."""

    parts: tuple[EpisodeMeasure, ...]
    how: Callable[[Tensor], Tensor]
    """From the f of the parts, shape (K, B), to shape (B,)."""
    collision: float | None = None
    """f of an episode with a collision; None for the function of the parts."""

    def __post_init__(self) -> None:
        if any(part.twice for part in self.parts):
            raise ValueError("near_crash takes two rollouts and cannot be combined with other measures.")
        units = {part.unit for part in self.parts}
        object.__setattr__(self, "sees", any(part.sees for part in self.parts))
        object.__setattr__(self, "records", any(part.records for part in self.parts))
        object.__setattr__(self, "unit", units.pop() if len(units) == 1 else "")

    def start(self, moment: Moment, ticks: int) -> tuple[MeasureState, ...]:
        """Return that nobody has collided, and the state of each part."""
        nobody = torch.zeros(len(moment.state.x), dtype=torch.bool, device=moment.state.x.device)
        return (nobody, *(part.start(moment, ticks) for part in self.parts))

    def update(
        self, state: tuple[MeasureState, ...], moment: Moment, before: Tensor, now: Tensor
    ) -> tuple[MeasureState, ...]:
        """Return who has collided, and the state of each part after one more moment."""
        updated = (part.update(own, moment, before, now) for part, own in zip(self.parts, state[1:], strict=True))
        return (now, *updated)

    def f(self, state: tuple[MeasureState, ...]) -> Tensor:
        """Return the function of the parts' f, shape (B,)."""
        f = self.how(torch.stack([part.f(own) for part, own in zip(self.parts, state[1:], strict=True)]))
        return f if self.collision is None else torch.where(state[0], self.collision, f)


_LEAST = partial(torch.amin, dim=0)


def minimum(*measures: Any) -> Combined:
    """Return the most dangerous of several measures: the least of their f.

    Args:
        *measures: Anything that `find_measure` takes.

    Raises:
        ValueError: If there is none, or one is unknown.

    Example:
        >>> import rare_envs
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=minimum("ttc", "thw"), horizon=0.1)
        >>> problem.evaluate([[20.0, 10.0, 30.0]]).round(2).tolist()  # of 2.98 s and 1.49 s
        [1.49]
    """
    return Combined(_find_all(measures), _LEAST)


def weighted(*terms: tuple[Any, float]) -> Combined:
    """Return the weighted sum of measures; after a collision, the sum of their collision values.

    Args:
        *terms: Pairs of a measure, as `find_measure` takes it, and its weight, positive and finite.

    Raises:
        ValueError: If there is none, or a measure is unknown, or a weight is not positive.

    Example:
        >>> import rare_envs
        >>> both = weighted(("ttc", 1.0), ("thw", 2.0))
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=both, horizon=0.1)
        >>> problem.evaluate([[20.0, 10.0, 30.0]]).round(2).tolist()  # 2.98 s + 2 (1.49 s)
        [5.97]
    """
    if not all(isinstance(term, tuple) and len(term) == 2 for term in terms):
        raise ValueError(f"Expected pairs of a measure and its weight, as in weighted(('ttc', 1.0)), got {terms!r}.")
    weights = tuple(float(weight) for _, weight in terms)
    if not all(0.0 < weight < float("inf") for weight in weights):
        raise ValueError(f"Expected positive weights (small f is dangerous, in each of the measures), got {weights}.")
    return Combined(_find_all([measure for measure, _ in terms]), partial(_add_weighted, weights))


def with_collision(measure: Any, value: float = COLLISION) -> Combined:
    """Return a measure in which an episode with a collision has one value: Tian et al.'s equation (3), for any measure.

    Args:
        measure: Anything that `find_measure` takes.
        value: f of an episode with a collision.

    Raises:
        ValueError: If the measure is unknown.

    Example:
        >>> import rare_envs
        >>> gap = with_collision(lambda moment: moment.lead.gap, -5.0)
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=gap)
        >>> problem.evaluate([[20.0, 10.0, 5.0], [20.0, 20.0, 40.0]]).round(1).tolist()
        [-5.0, 40.0]
    """
    return Combined(_find_all([measure]), _LEAST, float(value))


def _add_weighted(weights: tuple[float, ...], f: Tensor) -> Tensor:
    """Return the weighted sum over the first axis: (K, B) to (B,)."""
    return (f * constant(weights, f)[:, None]).sum(0)


def _find_all(measures: Any) -> tuple[EpisodeMeasure, ...]:
    if not measures:
        raise ValueError("Expected one or more measures, got none.")
    return tuple(find_measure(measure) for measure in measures)


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
class TermTracker(EpisodeMeasure):
    """A measure with terms to search by: its own, or those of another measure whose order is better.

    f is the measure's. Terms that are cut at a share of the horizon come part by part: K early ones, then K late ones.
    """

    measure: EpisodeMeasure
    """Measure whose f it is."""
    order: Measure
    """Measure whose terms they are; its lidar features are those of the other."""

    def __post_init__(self) -> None:
        for name in ("sees", "records", "unit"):
            object.__setattr__(self, name, getattr(self.measure, name))  # attributes by their names

    @property
    def _terms(self) -> MeasureTerms:
        return self.order.terms or MeasureTerms(self.order.of, names=lambda _: ("f",))

    def start(self, moment: Moment, ticks: int) -> TermState:
        """Return the state after the first moment."""
        first = self.order.term_values(moment)
        late = [torch.full_like(first, self._terms.unattained) for _ in self._terms.cuts]
        values = torch.cat((first, *late), 1)
        zero = torch.zeros_like(values, dtype=torch.int64)
        return TermState(self.measure.start(moment, ticks), values, zero, 0, ticks)

    def update(self, state: TermState, moment: Moment, before: Tensor, now: Tensor) -> TermState:
        """Return the state after one more moment; arguments as of `EpisodeMeasure.update`."""
        tick = state.tick + 1
        own = self.measure.update(state.own, moment, before, now)
        latest = self.order.term_values(moment)
        count = latest.shape[1]
        first = count * sum(tick > cut * state.ticks_in_all for cut in self._terms.cuts)
        part = slice(first, first + count)
        old = state.values[:, part]
        lower = (latest < old) & ~now[:, None]
        values, ticks = state.values.clone(), state.ticks.clone()
        values[:, part] = torch.where(lower, latest, old)
        ticks[:, part] = torch.where(lower, tick, ticks[:, part])
        new, collision = now & ~before, self.order.collision
        if collision is not None and may_hold(new):
            term = first + (self._terms.hit(moment) if self._terms.hit else latest.argmin(1))
            worth = (collision(moment) if callable(collision) else torch.full_like(latest[:, 0], collision))[:, None]
            hit = new[:, None] & (torch.arange(values.shape[1], device=term.device) == term[:, None])
            values = torch.where(new[:, None], torch.maximum(values, worth), values)
            values, ticks = torch.where(hit, worth, values), torch.where(hit, tick, ticks)
        return TermState(own, values, ticks, tick, state.ticks_in_all)

    def f(self, state: TermState) -> Tensor:
        """Return f of the measure, shape (B,)."""
        return self.measure.f(state.own)

    def names(self, vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the J terms."""
        ends = [0, *(round(100 * cut) for cut in self._terms.cuts), 100]
        parts = [f", {low} to {high} % of the time" for low, high in pairwise(ends)]
        parts = parts if self._terms.cuts else [""]
        return tuple(name + part for part in parts for name in self._terms.names(vehicle_names))


def find_order(measure: EpisodeMeasure, collisions: str, gamma: float) -> tuple[Measure | None, float]:
    """Return the measure on whose terms to search for f <= gamma, and the threshold of these terms.

    If {f <= gamma} is the collision, as at gamma = 0 of times to collision, it is the clearance, between all where
    `collisions` are "any": it tells near from far where times are capped, and does not jump from car to car. Else the
    measure itself; None if that is no least over terms and moments.
    """
    if type(measure) is not Measure or measure.adds:
        return None, gamma
    if gamma == 0.0 and measure.collisions_only:
        return (PAIR_CLEARANCE if collisions == "any" else CLEARANCE), 0.0
    return measure, gamma
