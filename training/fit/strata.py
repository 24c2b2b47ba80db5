"""Bases made of strata: cut-ins by who looked and who did not, and brakings to a standstill and others.

**Cut-ins.** Who looks starts from accepted gaps (`training.fit.acceptance`); who does not, from wherever a vehicle is
beside the ego's lane: neighbours at random times. How many do not look has not been counted. In the 100-Car study 44
near-crashes of 3.219e6 km were lane changes of drivers who had not seen the other vehicle, so that

    share = 44 / (3.219e6 km * cut-ins per km * P[near-crash | not looked]).

P was simulated: 0.321 in the traffic of US 101, 0.440 in that of I-80. The logarithm of the share has a standard
deviation of 0.74: 44 events 0.15, traffic of the study thinner by up to 2.7 log(2.7) / 2, changes per km by a factor
of 2 log(2) / 2, and how soon drivers notice 0.4. A refit draws a share anew.

**Brakings.** To a standstill: speed, gap and peak of the deceleration; all of the speed is lost. Others: the loss too,
which leaves 1 m/s or more. A refit counts the shares of both in the clusters that it has drawn, however few of one
these hold; what is too few for a fit is drawn again from this stratum's own clusters, and has no part in the share.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from rare_envs.control.human_driver import MAX_HUMAN_BRAKING
from rare_envs.distributions.acceptance import AcceptedGaps, needed_after
from rare_envs.distributions.coordinates import Coordinates, Difference, RoomToBrake
from rare_envs.distributions.events import EventFrequency, PredictiveCheck
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.product import ProductDistribution
from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.distributions.stratified import CutNormals, StratifiedDistribution, Stratum
from rare_envs.scenarios.cut_in import ATTENTION_LIMIT
from rare_envs.scenarios.registry import find_scenario
from rare_envs.traffic.state import VEHICLE_LENGTH
from samplers.problem import FloatArray
from training.fit.acceptance import LEAST_LIMIT, MOST_LIMIT, check_starts_vary, fit_accepted, profile_limit
from training.fit.checks import (
    BRAKING_STATES,
    CHECK_DRAWS,
    CUT_IN_STATES,
    UNSEEN_STATES,
    check_answers,
    check_states,
)
from training.fit.coordinates import (
    COORDINATE_SYSTEMS,
    FOLD_STARTS,
    Asked,
    CoordinateSystem,
    Fit,
    SystemFit,
    draw_events,
    fit_system,
)
from training.fit.filters import EventSet, check_spread, drop_events, recorded_parameters
from training.fit.mixture import COVARIANCE_FLOOR, append_independent, select_mixture

PAIR = [0, 1, 3]
"""Columns of a start with the speeds behind and ahead and the gap between."""
ATTITUDES = 6
"""Columns behind the seven of a start: standard normals, of which attention is the first."""
UNSEEN_EVENTS, UNSEEN_KM = 44, 3.219e6
"""Near-crashes of the 100-Car study at lane changes of subjects who did not see the other vehicle, and its km."""
US101_PER_KM = 0.26
"""Cut-ins per km on US 101."""
NEAR_IF_UNSEEN = {"us101": 0.321, "i80": 0.440}
"""Share of changes without a look that are near-crashes, of 200,000 draws of the stratum with `human` (+- 0.001), which
`python -m benchmarks.driving.human_calibration` drives; US 101's is the usual one."""
UNSEEN_LOG_SD = math.sqrt(1.0 / UNSEEN_EVENTS + (math.log(2.7) / 2) ** 2 + (math.log(2.0) / 2) ** 2 + 0.4**2)
"""Of the share of those who do not look: see above."""
UNSEEN_COMPONENTS, UNSEEN_STARTS = 3, 2
"""Most components of the neighbours, and starts of refits: more change shares beside and close by less than sites
differ, and fill files."""
UNSEEN_SYSTEM = CoordinateSystem(
    "log (gap + 12 m), log lead gap",
    {"cut_in_gap": "log", "lead_gap": "log", "duration": "log"},
    within=(RoomToBrake("lead_gap", "cut_in_gap", "ego_speed", "lead_speed", 1.0 - VEHICLE_LENGTH, MAX_HUMAN_BRAKING),),
    origins={"cut_in_gap": -12.0},
)
"""Gaps begin with two lengths of bodies below 0, about which a mixture of plain gaps spills over; 12 m is assumed. The
ego is at least 1 m behind its own lead, past the cutter beside it, and would not run into that one whoever cuts in."""
LEAST_STARTS, LEAST_COURSES, LEAST_BRAKINGS = 10, 3, 10
"""Events that a fit needs; a stratum of fewer brakings is left out."""
STOP_LOSS_SPREAD = 1e4
"""Standard deviation of the loss of a braking to a standstill [m/s], cut to 1 m/s: uniform there to 1e-6."""
LEAST_KEPT = 1.0
"""Speed that is left after a braking that is none to a standstill [m/s], and range of the loss above the speed."""
LEAST_LOSS = 3.0
"""Loss of speed from which on a braking counts [m/s]."""


def share_unseen(per_km: float, near: float) -> float:
    """Return the share of cutters who do not look, of cut-ins per km and the share of theirs that are near-crashes.

    Example:
        >>> f"{share_unseen(0.26, 0.321):.1e}"
        '1.6e-04'
    """
    return UNSEEN_EVENTS / (UNSEEN_KM * per_km * near)


@dataclass(frozen=True)
class Neighbours:
    """Vehicles in the lane beside another's at random times, and those between which they would cut in.

    Example:
        >>> Neighbours(np.array([[14.0, 15.0, 15.0, -2.0, 9.0]]), np.array([0])).events.counts.clusters
        1
    """

    rows: FloatArray
    """ego_speed, cut_in_speed, lead_speed, cut_in_gap (negative: beside) and lead_gap, (n, 5)."""
    clusters: NDArray[np.int64]
    """Window of time of each, (n,)."""
    near: float = NEAR_IF_UNSEEN["us101"]
    """Share of changes without a look that are near-crashes."""

    @property
    def events(self) -> EventSet:
        """The rows as events."""
        return EventSet(self.rows, self.clusters)


def find_neighbours(
    moment: NDArray[Any], lane: NDArray[Any], rear: FloatArray, front: FloatArray, speed: FloatArray
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return who would be cut in on if vehicles changed lanes without looking, (n, 5), and the rows of these vehicles.

    All are columns of vehicles at moments, (m,): positions along the road [m]. Columns of the result are as those of
    `Neighbours.rows`: the neighbour is the nearest vehicle in the next lane whose rear is behind the own front, the
    lead the one ahead of it.
    """
    found, rows = [np.empty((0, 5))], [np.empty(0, dtype=np.intp)]
    order = np.argsort(moment, kind="stable")
    for some in np.split(order, np.flatnonzero(np.diff(moment[order])) + 1):
        lanes = {one: some[lane[some] == one] for one in np.unique(lane[some])}
        lanes = {one: rows_[np.argsort(rear[rows_], kind="stable")] for one, rows_ in lanes.items()}
        for one, own in lanes.items():
            for side in (one - 1, one + 1):
                others = lanes.get(side, np.empty(0, dtype=np.intp))
                place = np.searchsorted(rear[others], front[own], side="left")
                both = (place > 0) & (place < len(others))
                i, k, m = own[both], others[place[both] - 1], others[place[both]]
                found.append(np.column_stack([speed[k], speed[i], speed[m], rear[i] - front[k], rear[m] - front[i]]))
                rows.append(i)
    return np.concatenate(found), np.concatenate(rows)


def keep_neighbours(scenario: str, rows: FloatArray, clusters: NDArray[np.int64], near: float) -> Neighbours:
    """Return neighbours within the ranges of the scenario, whose own lead leaves them room to brake."""
    box = recorded_parameters(scenario, tuple(find_scenario(scenario).parameters)[3].low)[:5]
    keep = UNSEEN_SYSTEM.coordinates(box).contains(rows).all(axis=1)
    return Neighbours(rows[keep], clusters[keep], near)


def _fit_unseen(
    events: EventSet, apart: FloatArray, box: tuple[Parameter, ...], seed: int, starts: int | None
) -> TruncatedGaussianMixture:
    """Return the mixture of neighbours (n, 5), and of the columns apart behind it."""
    joint = UNSEEN_SYSTEM.coordinates(box[:5])
    y = joint.to_coordinates(events.joint)
    components, _ = select_mixture(y, seed, UNSEEN_COMPONENTS, starts, joint.names)
    side = UNSEEN_SYSTEM.coordinates(box[5:])
    alone, _ = select_mixture(side.to_coordinates(apart), seed, 1, None, side.names)
    coordinates = UNSEEN_SYSTEM.coordinates(box)
    return TruncatedGaussianMixture(*append_independent(components, alone), coordinates=coordinates)


def _join_drivers(accepted: Distribution, unseen: Distribution, share: float) -> StratifiedDistribution:
    """Return who did not look, a share, and who did, with the columns of their attitudes."""
    free = np.full(ATTITUDES, np.inf)
    limit, ends = free.copy(), (-free).copy()
    limit[0] = ends[0] = ATTENTION_LIMIT
    strata = (
        Stratum("unseen", float(f"{share:.4g}"), ProductDistribution((unseen, CutNormals(-free, limit)))),
        Stratum("looked", 1.0 - float(f"{share:.4g}"), ProductDistribution((accepted, CutNormals(ends, free)))),
    )
    return StratifiedDistribution(strata, np.array([ATTENTION_LIMIT]), column=7)


def keep_accepted(events: EventSet) -> EventSet:
    """Return starts of cut-ins without those after which no braking avoids a contact: nobody who looks accepts them."""
    ego, cutter, _, gap, _ = events.joint.T
    keep = np.isfinite(needed_after(gap, ego - cutter))
    if keep.all():
        return events
    reason = "the gap is closed before the vehicle behind answers: not looked, or an error of the recording"
    log = drop_events(np.full(len(keep), True), [("braking of the vehicle behind avoids a contact", reason, keep)])
    own = {name: getattr(events, name)[keep] for name in ("joint", "clusters", "answers") if getattr(events, name).size}
    return replace(events, log=(*events.log, *log), **own)


def check_starts(events: EventSet) -> None:
    """Raise a ValueError unless there are starts of cut-ins, and offsets and durations, enough for a fit."""
    if len(events.joint) < LEAST_STARTS or len(events.apart) < LEAST_COURSES:
        raise ValueError(
            f"{len(events.joint)} starts with gaps and {len(events.apart)} with offset and duration are too few; "
            f"{LEAST_STARTS} and {LEAST_COURSES} are needed."
        )


def fit_cut_in(
    scenario: str,
    events: EventSet,
    neighbours: Neighbours | Distribution,
    frequency: EventFrequency | None,
    asked: Asked,
) -> Fit:
    """Return cut-ins of `CutIn-v1` with both strata.

    The events are starts of recorded cut-ins, with offset and duration apart. If nobody counted how frequent they
    are, the share of those who do not look is that of US 101's. A ValueError if the events are too few.
    """
    check_starts(events)
    box = recorded_parameters(scenario)
    near = neighbours.near if isinstance(neighbours, Neighbours) else NEAR_IF_UNSEEN["us101"]
    share = share_unseen(frequency.per_km if frequency else US101_PER_KM, near)
    find_unseen = _unseen_finder(scenario, neighbours, asked.seed)

    def fit(drawn: EventSet, rng: np.random.Generator | None) -> StratifiedDistribution:
        own = share if rng is None else min(share * math.exp(UNSEEN_LOG_SD * rng.standard_normal()), 0.5)
        return _join_drivers(fit_accepted(drawn.joint, drawn.apart, box), find_unseen(drawn.apart, rng), own)

    asked.report("fit")
    fitted, refits = fit(events, None), asked.refit(events, fit)
    (unseen, looked), *others = (_starts_of(each) for each in (fitted, *refits))
    checks = check_states(CUT_IN_STATES, "looked: {}", events.joint[:, PAIR], _draw_pairs(looked, asked.seed))
    if isinstance(neighbours, Neighbours):
        checks += check_states(UNSEEN_STATES, "unseen: {}", neighbours.rows[:, PAIR], _draw_pairs(unseen, asked.seed))
    k = len(unseen.weights)
    return Fit(
        distribution=fitted,
        refits=tuple(refits),
        family=f"accepted gaps (b = {looked.limit:g} m/s^2); unseen: {k} component{'s' * (k > 1)} of neighbours",
        checks=checks,
        criteria={"coordinates": "closing speed, log gaps, log duration; accepted behind"},
        entries={
            "accepted": _describe_accepted(events, looked, [each.limit for _, each in others], box[3]),
            "unseen": _describe_unseen(fitted.strata[0].share, neighbours, near),
            "motion": check_answers(events.joint, events.answers.reshape(-1, 2, 2)) if events.answers.size else {},
        },
        settings={"covariance_floor": COVARIANCE_FLOOR, "most_components_unseen": UNSEEN_COMPONENTS},
    )


def _unseen_finder(scenario: str, neighbours: Neighbours | Distribution, seed: int) -> Callable[..., Any]:
    """Return what gives the mixture of neighbours with columns apart: fitted, to all or for a refit to some; or taken.

    A base that has strata gives its own, and those of its refits in their order.
    """
    if isinstance(neighbours, Neighbours):
        wide = recorded_parameters(scenario, tuple(find_scenario(scenario).parameters)[3].low)
        events = neighbours.events

        def find(apart: FloatArray, rng: np.random.Generator | None) -> TruncatedGaussianMixture:
            if rng is None:
                return _fit_unseen(events, apart, wide, seed, None)
            return _fit_unseen(draw_events(events, rng), apart, wide, seed, UNSEEN_STARTS)

        return find
    given: Any = neighbours
    taken = itertools.cycle((given, *getattr(given, "refits", ())))
    return lambda apart, rng: next(taken).strata[0].base.blocks[0]


def _starts_of(fitted: StratifiedDistribution) -> tuple[Any, Any]:
    """Return the distributions of starts of those who do not look, and of those who do."""
    unseen, looked = (cast(Any, each.base).blocks[0] for each in fitted.strata)
    return unseen, looked


def _describe_accepted(events: EventSet, looked: AcceptedGaps, limits: list[float], gap: Parameter) -> dict[str, Any]:
    """Return what the record says of the gaps that drivers accept."""
    ego, cutter, _, behind, _ = events.joint.T
    return {
        "limit": looked.limit,
        "limits_of_refits": limits,
        "log_likelihood_over_none": profile_limit(ego - cutter, behind, (gap.low, gap.high)),
        "share_of_offers": float(f"{math.exp(looked.log_share):.4g}"),
        "limit_from_to": [LEAST_LIMIT, MOST_LIMIT],
    }


def _describe_unseen(share: float, neighbours: Neighbours | Distribution, near: float) -> dict[str, Any]:
    """Return what the record says of those who do not look."""
    return {
        "share": share,
        "log_sd": round(UNSEEN_LOG_SD, 3),
        "rests_on": "44 near-crashes of the 100-Car study (3.219e6 km) at own lane changes of drivers who did not "
        "see the other vehicle, over cut-ins per km and the simulated share of near-crashes among such changes, "
        f"{near:g}; nobody has counted changes without a look",
        "neighbours": len(neighbours.rows) if isinstance(neighbours, Neighbours) else "those of a shipped base",
    }


def _draw_pairs(base: Any, seed: int) -> FloatArray:
    """Return speeds behind and ahead and the gap of draws of a base, (m, 3)."""
    return np.asarray(base.sample(CHECK_DRAWS, np.random.default_rng(seed))[:, PAIR])


def _with_loss(stop: TruncatedGaussianMixture, parameters: Sequence[Parameter]) -> TruncatedGaussianMixture:
    """Return a mixture of speed, gap and peak with the loss of a braking to a standstill, uniform above the speed."""
    own = stop.coordinates
    k = len(stop.weights)
    means = np.hstack([stop.means, np.full((k, 1), 0.5 * parameters[3].high)])
    covariances = np.zeros((k, 4, 4))
    covariances[:, :3, :3], covariances[:, 3, 3] = stop.covariances, STOP_LOSS_SPREAD**2
    coordinates = Coordinates(
        low=[p.low for p in parameters],  # type: ignore[arg-type]  # lists become arrays
        high=[p.high for p in parameters],  # type: ignore[arg-type]
        kinds=(*own.kinds, "plain"),
        names=tuple(p.name for p in parameters),
        within=(Difference("loss", "speed", 0.0, LEAST_KEPT),),
    )
    return TruncatedGaussianMixture(stop.weights, means, covariances, coordinates=coordinates)


def _slowing_system(system: CoordinateSystem, speed: Parameter) -> CoordinateSystem:
    """Return a system of speed, gap and peak with the log loss first, which leaves 1 m/s or more."""
    kept = Difference("speed", "loss", LEAST_KEPT, speed.high)
    kinds = {**system.kinds, "loss": "log"}
    return CoordinateSystem(f"{system.name}, log loss", kinds, ("loss", "speed", "gap", "peak"), (kept,))


class _Brakings(NamedTuple):
    """What brakings are fitted to: one stratum."""

    name: str
    events: EventSet
    systems: Sequence[CoordinateSystem]
    box: Sequence[Parameter]


def _split_brakings(events: EventSet, parameters: Sequence[Parameter]) -> list[_Brakings]:
    """Return brakings that leave some speed, and those to a standstill, without their loss."""
    speed, loss = events.joint[:, 0], events.joint[:, 3]
    stops, labels = loss > speed - LEAST_KEPT, events.clusters
    narrow = (
        replace(parameters[0], low=LEAST_LOSS + LEAST_KEPT),
        *parameters[1:3],
        replace(parameters[3], low=LEAST_LOSS, high=parameters[0].high - LEAST_KEPT),
    )
    systems = COORDINATE_SYSTEMS["hard_brake"]
    others = [_slowing_system(each, parameters[0]) for each in systems]
    slowing = EventSet(events.joint[~stops], labels[~stops])
    stop = EventSet(events.joint[stops, :3], labels[stops])
    return [_Brakings("slowing", slowing, others, narrow), _Brakings("stop", stop, systems, parameters[:3])]


def keep_strata(events: EventSet) -> EventSet:
    """Return brakings without those of a stratum of too few, and what that dropped; a ValueError if none are left."""
    stops = events.joint[:, 3] > events.joint[:, 0] - LEAST_KEPT
    enough = [(stops == which).sum() >= LEAST_BRAKINGS for which in (False, True)]
    keep = np.where(stops, enough[1], enough[0])
    if not keep.any():
        raise ValueError(f"{len(events.joint)} events are too few; {LEAST_BRAKINGS} of a stratum are needed.")
    if keep.all():
        return events
    rule = f"brakings {'to a standstill' if enough[1] else 'that leave some speed'} alone"
    log = drop_events(np.full(len(keep), True), [(rule, f"fewer than {LEAST_BRAKINGS} are no stratum", keep)])
    return replace(events, joint=events.joint[keep], clusters=events.clusters[keep], log=(*events.log, *log))


def check_events(scenario: str, events: EventSet) -> EventSet:
    """Return the events that a scenario of recordings is fitted to; a ValueError if they are too few or too alike."""
    box = recorded_parameters(scenario)
    if scenario == "cut_in":
        events = keep_accepted(events)
        check_starts(events)
        check_starts_vary(events.joint, events.apart, box)
    elif scenario == "hard_brake":
        events = keep_strata(events)
        for part in _split_brakings(events, box):
            check_spread(part.events.joint, part.box)
    else:
        check_spread(events.joint, box)
    return events


def _share_of_last(parts: Sequence[_Brakings]) -> float:
    """Return the share of the last part in the events of all; none is below half an event, as no share may be 0."""
    count, total = len(parts[-1].events.joint), sum(len(each.events.joint) for each in parts)
    return float(f"{min(max(count, 0.5), total - 0.5) / total:.6g}")


def _draw_enough(part: _Brakings, own: EventSet, rng: np.random.Generator) -> _Brakings:
    """Return a part with enough events for a fit: those it has, or clusters drawn from all of the part's own."""
    while len(part.events.joint) < LEAST_BRAKINGS:
        part = part._replace(events=draw_events(own, rng))
    return part


def fit_hard_brake(scenario: str, events: EventSet, asked: Asked) -> Fit:
    """Return brakings of `HardBrake-v0` with both strata, of events with speed, gap, peak and loss, (n, 4).

    The loss of a braking to a standstill is the speed. Of a stratum of too few brakings there are none, see
    `keep_strata`.
    """
    parameters = tuple(find_scenario(scenario).parameters)
    split = _split_brakings(events, parameters)
    kept = [each for each in split if len(each.events.joint)]
    names = [each.name for each in kept]

    def fit(
        parts: Sequence[_Brakings], stop: float, starts: int | None
    ) -> tuple[StratifiedDistribution, list[SystemFit]]:
        best, strata = list[SystemFit](), list[Stratum]()
        for part, share in zip(parts, (1.0 - stop, stop) if len(parts) > 1 else (1.0,), strict=True):
            fits = [fit_system(part.events, each, part.box, asked.seed, starts) for each in part.systems]
            best.append(min(fits, key=lambda each: each.bic))
            base = best[-1].distribution
            strata.append(Stratum(part.name, share, _with_loss(base, parameters) if part.name == "stop" else base))
        return StratifiedDistribution(tuple(strata), np.zeros(len(strata) - 1), column=3, less=0), best

    def refit(drawn: EventSet, rng: np.random.Generator) -> StratifiedDistribution:
        parts = [each for each in _split_brakings(drawn, parameters) if each.name in names]
        enough = [_draw_enough(each, own.events, rng) for each, own in zip(parts, kept, strict=True)]
        return fit(enough, _share_of_last(parts), FOLD_STARTS)[0]

    asked.report("fit")
    fitted, best = fit(kept, _share_of_last(kept), None)
    checks: tuple[PredictiveCheck, ...] = ()
    for part in split:
        for name, _, base in fitted.strata:
            if name == part.name:
                drawn = base.sample(CHECK_DRAWS, np.random.default_rng(asked.seed))[:, :3]
                checks += check_states(BRAKING_STATES, f"{name}: {{}}", part.events.joint[:, :3], drawn)
    pairs = list(zip(names, best, strict=True))
    return Fit(
        distribution=fitted,
        refits=tuple(asked.refit(events, refit)),
        family="; ".join(f"{name}: {each.family}" for name, each in pairs),
        checks=checks,
        criteria={
            "coordinates": "; ".join(f"{name}: {each.system.name}" for name, each in pairs),
            "bic": round(sum(each.bic for each in best), 2),
        },
        entries={"strata": {each.name: len(each.events.joint) for each in reversed(split)}},
        settings={"covariance_floor": COVARIANCE_FLOOR},
    )
