"""Bases made of strata: cut-ins by who looked and who did not, and brakings to a standstill and others.

**Cut-ins.** Who looks starts from accepted gaps (`training.fit.acceptance`); who does not, from wherever a vehicle is
beside the ego's lane: neighbours at random times. How many do not look has not been counted. In the 100-Car study 44
near-crashes of 3.219e6 km were lane changes of drivers who had not seen the other vehicle, so that

    share = 44 / (3.219e6 km * cut-ins per km * P[near-crash | not looked]).

P was simulated: 0.321 in the traffic of US 101, 0.429 in that of I-80. The logarithm of the share has a standard
deviation of 0.74: 44 events 0.15, traffic of the study thinner by up to 2.7 log(2.7) / 2, changes per km by a factor
of 2 log(2) / 2, and how soon drivers notice 0.4. A refit draws a share anew.

**Brakings.** To a standstill: speed, gap and peak of the deceleration; all of the speed is lost. Others: the loss too,
which leaves 1 m/s or more. A refit counts the shares of both in the clusters that it has drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.coordinates import Coordinates, Difference
from rare_envs.distributions.events import EventFrequency, PredictiveCheck
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.product import ProductDistribution
from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.distributions.stratified import CutNormals, StratifiedDistribution, Stratum
from rare_envs.scenarios.cut_in import ATTENTION_LIMIT
from rare_envs.scenarios.registry import scenario_named
from samplers.problem import FloatArray
from training.fit.acceptance import fit_accepted, profile_limit
from training.fit.coordinates import (
    COORDINATE_SYSTEMS,
    FOLD_STARTS,
    MIN_CLUSTERS,
    N_REFITS,
    CoordinateSystem,
    SystemFit,
    draw_events,
    fit_system,
)
from training.fit.filters import EventSet, recorded_parameters
from training.fit.mixture import COVARIANCE_FLOOR, append_independent, select_mixture
from training.fit.motion import check_answers

ATTITUDES = 6
"""Columns behind the seven of a start: standard normals, of which attention is the first."""
UNSEEN_EVENTS, UNSEEN_KM = 44, 3.219e6
"""Near-crashes of the 100-Car study at lane changes of subjects who did not see the other vehicle, and its km."""
NEAR_IF_UNSEEN = {"us101": 0.321, "i80": 0.429}
"""Share of changes without a look that are near-crashes, of 200,000 draws of the stratum with `human` (+- 0.001); US
101's is the usual one."""
UNSEEN_LOG_SD = math.sqrt(1.0 / UNSEEN_EVENTS + (math.log(2.7) / 2) ** 2 + (math.log(2.0) / 2) ** 2 + 0.4**2)
"""Of the share of those who do not look: see above."""
UNSEEN_COMPONENTS, UNSEEN_STARTS = 3, 2
"""Most components of the neighbours, and starts of refits: more change shares beside and close by less than sites
differ, and fill files."""
UNSEEN_SYSTEM = CoordinateSystem(
    "log (gap + 12 m), log lead gap",
    {"cut_in_gap": "log", "lead_gap": "log", "duration": "log"},
    origins={"cut_in_gap": -12.0},
)
"""Gaps begin with two lengths of bodies below 0, about which a mixture of plain gaps spills over; 12 m is assumed."""
LEAST_STARTS, LEAST_COURSES, LEAST_BRAKINGS = 10, 3, 10
"""Events that a fit needs; a stratum of fewer brakings is left out."""
STOP_LOSS_SPREAD = 1e4
"""Standard deviation of the loss of a braking to a standstill [m/s], cut to 1 m/s: uniform there to 1e-6."""
LEAST_KEPT = 1.0
"""Speed that is left after a braking that is none to a standstill [m/s], and range of the loss above the speed."""
LEAST_LOSS = 3.0
"""Loss of speed from which on a braking counts [m/s]."""
HARD_NEED = 4.9
"""Deceleration of a rapid manoeuvre, half of gravity [m/s^2]."""
CHECK_DRAWS = 200_000

Report = Callable[[str], None]
Check = Callable[[FloatArray, FloatArray, FloatArray], NDArray[np.bool_]]


def needed(behind: FloatArray, ahead: FloatArray, gap: FloatArray) -> FloatArray:
    """Return the deceleration that keeps a vehicle behind from one ahead that keeps its speed, (n,) [m/s^2]."""
    return np.asarray(np.maximum(behind - ahead, 0.0) ** 2 / (2.0 * np.maximum(gap, 0.01)))


CUT_IN_STATES: dict[str, Check] = {
    **{f"TTC < {t} s": lambda v, ahead, gap, t=t: v - ahead > gap / t for t in (2, 3, 5)},  # type: ignore[misc]
    "needed deceleration > 0.5 m/s^2": lambda v, ahead, gap: needed(v, ahead, gap) > 0.5,
    "needed deceleration > 1 m/s^2": lambda v, ahead, gap: needed(v, ahead, gap) > 1.0,
    "closing": lambda v, ahead, gap: v > ahead,
    "gap < 3 m": lambda v, ahead, gap: gap < 3.0,
}
"""Of speed behind, speed ahead [m/s] and gap [m], (n,) each, where the cutter looked."""
UNSEEN_STATES: dict[str, Check] = {
    "beside": lambda v, ahead, gap: gap < 0.0,
    "beside or needed deceleration > 4.9 m/s^2": lambda v, ahead, gap: (
        (gap < 0.0) | (needed(v, ahead, gap) > HARD_NEED)
    ),
}
BRAKING_STATES: dict[str, Check] = {
    "time headway < 0.5 s": lambda speed, gap, peak: gap < 0.5 * speed,
    "gap < 3 m": lambda speed, gap, peak: gap < 3.0,
    "peak > 3 m/s^2": lambda speed, gap, peak: peak > 3.0,
}


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
    """Return neighbours within the scenario's ranges."""
    box = recorded_parameters(scenario, tuple(scenario_named(scenario).parameters)[3].low)[:5]
    keep = np.logical_and.reduce([(rows[:, j] >= p.low) & (rows[:, j] <= p.high) for j, p in enumerate(box)])
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
    source: Mapping[str, Any],
    command: str,
    *,
    frequency: EventFrequency | None = None,
    n_refits: int | None = None,
    seed: int = 0,
    report: Report = lambda _: None,
) -> FittedDistribution:
    """Return a base of `CutIn-v1` with its two strata.

    Args:
        scenario: Short name or environment id.
        events: Starts of recorded cut-ins, with offset and duration apart.
        neighbours: At random times; or a base made of strata, whose `unseen` is taken where there are none.
        source: Site, data, publisher, licence and so on, for the file.
        command: Command that writes the file.
        frequency: Of cut-ins; None where nobody counted: then the share of those who do not look is that of US 101's.
        n_refits: Number of refits.
        seed: Of fits and refits.
        report: Told of each.

    Raises:
        ValueError: The events are too few.
    """
    check_starts(events)
    box = recorded_parameters(scenario)
    wide = recorded_parameters(scenario, tuple(scenario_named(scenario).parameters)[3].low)
    own = isinstance(neighbours, Neighbours)
    near = neighbours.near if isinstance(neighbours, Neighbours) else NEAR_IF_UNSEEN["us101"]
    share = share_unseen(frequency.per_km if frequency else 0.26, near)
    taken = () if own else (neighbours, *getattr(neighbours, "refits", ()))

    def fit_both(drawn: EventSet, k: int, w: float, rng: np.random.Generator) -> Any:
        accepted = fit_accepted(drawn.joint, drawn.apart, box)
        if isinstance(neighbours, Neighbours):
            rows = neighbours.events if k < 0 else draw_events(neighbours.events, rng)
            unseen: Any = _fit_unseen(rows, drawn.apart, wide, seed, UNSEEN_STARTS if k >= 0 else None)
        else:
            unseen = taken[(k + 1) % len(taken)].strata[0].base.blocks[0]
        return _join_drivers(accepted, unseen, w)

    rng = np.random.default_rng(seed)
    report("fit")
    fitted = fit_both(events, -1, share, rng)
    refits = []
    wanted = 0 if len(np.unique(events.clusters)) < MIN_CLUSTERS else N_REFITS if n_refits is None else n_refits
    for k in range(wanted):
        report(f"refit {k + 1} of {wanted}")
        drawn = draw_events(events, rng)
        w = min(share * math.exp(UNSEEN_LOG_SD * rng.standard_normal()), 0.5)
        refits.append(fit_both(drawn, k, w, rng))
    ego, cutter, _, gap, _ = events.joint.T
    looked, unseen = fitted.strata[1].base.blocks[0], fitted.strata[0].base.blocks[0]
    k = len(unseen.weights)
    record = {
        "kind": "fitted to recorded events",
        "coordinates": "closing speed, log gaps, log duration; accepted behind",
        "source": dict(source),
        "filters": list(events.log),
        "accepted": {
            "limit": looked.limit,
            "limits_of_refits": [each.strata[1].base.blocks[0].limit for each in refits],
            "log_likelihood_over_none": profile_limit(ego - cutter, gap, (box[3].low, box[3].high)),
            "share_of_offers": float(f"{math.exp(looked.log_share):.4g}"),
            "limit_from_to": [0.1, 20.0],
        },
        "unseen": {
            "share": fitted.strata[0].share,
            "log_sd": round(UNSEEN_LOG_SD, 3),
            "rests_on": "44 near-crashes of the 100-Car study (3.219e6 km) at own lane changes of drivers who did not "
            "see the other vehicle, over cut-ins per km and the simulated share of near-crashes among such changes, "
            f"{near:g}; nobody has counted changes without a look",
            "neighbours": len(neighbours.rows) if isinstance(neighbours, Neighbours) else "those of a shipped base",
        },
        "motion": check_answers(events.joint, events.answers.reshape(-1, 2, 2)) if events.answers.size else {},
        "settings": {"covariance_floor": COVARIANCE_FLOOR, "most_components_unseen": UNSEEN_COMPONENTS, "seed": seed},
        "command": command,
        "libraries": {name: version(name) for name in ("numpy", "scipy", "scikit-learn")},
    }
    checks = _check_pairs("looked", CUT_IN_STATES, events.joint[:, [0, 1, 3]], looked, (0, 1, 3), seed)
    if isinstance(neighbours, Neighbours):
        checks += _check_pairs("unseen", UNSEEN_STATES, neighbours.rows[:, [0, 1, 3]], unseen, (0, 1, 3), seed)
    plural = "s" if k > 1 else ""
    return FittedDistribution(
        distribution=fitted,
        refits=tuple(refits),
        events=events.counts,
        family=f"accepted gaps (b = {looked.limit:g} m/s^2); unseen: {k} component{plural} of neighbours",
        frequency=frequency,
        checks=checks,
        record=record,
    )


def _check_pairs(
    what: str, states: Mapping[str, Check], recorded: FloatArray, base: Any, columns: Sequence[int], seed: int
) -> tuple[PredictiveCheck, ...]:
    """Return recorded and expected counts of states of rows (n, 3), the columns of draws of a base."""
    drawn = base.sample(CHECK_DRAWS, np.random.default_rng(seed))[:, list(columns)]
    return tuple(
        PredictiveCheck(
            f"{what}: {name}",
            int(occurs(*recorded.T).sum()),
            float(f"{float(occurs(*drawn.T).mean()) * len(recorded):.3g}"),
        )
        for name, occurs in states.items()
    )


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


def fit_hard_brake(
    scenario: str,
    events: EventSet,
    source: Mapping[str, Any],
    command: str,
    *,
    frequency: EventFrequency | None = None,
    n_refits: int | None = None,
    seed: int = 0,
    report: Report = lambda _: None,
) -> FittedDistribution:
    """Return a base of `HardBrake-v0` with its strata, of brakings: speed, gap, peak and loss, (n, 4).

    The loss of a braking to a standstill is the speed. Arguments and errors are as those of `fit_cut_in`.
    """
    parameters = tuple(scenario_named(scenario).parameters)
    narrow = (
        replace(parameters[0], low=LEAST_LOSS + LEAST_KEPT),
        *parameters[1:3],
        replace(parameters[3], low=LEAST_LOSS, high=parameters[0].high - LEAST_KEPT),
    )
    systems = COORDINATE_SYSTEMS["hard_brake"]
    slowing_systems = [_slowing_system(each, parameters[0]) for each in systems]

    def split(drawn: EventSet) -> tuple[EventSet, EventSet]:
        speed, loss = drawn.joint[:, 0], drawn.joint[:, 3]
        stops = loss > speed - LEAST_KEPT
        labels = drawn.clusters
        return EventSet(drawn.joint[stops, :3], labels[stops]), EventSet(drawn.joint[~stops], labels[~stops])

    def fit_all(drawn: EventSet, starts: int | None) -> tuple[StratifiedDistribution, dict[str, SystemFit]]:
        stop, slowing = split(drawn)
        if max(len(stop.joint), len(slowing.joint)) < LEAST_BRAKINGS:
            raise ValueError(f"{len(drawn.joint)} events are too few; {LEAST_BRAKINGS} of a stratum are needed.")
        share = float(f"{len(stop.joint) / len(drawn.joint):.6g}")
        best: dict[str, SystemFit] = {}
        strata = []
        for name, some, own, box, w in (
            ("slowing", slowing, slowing_systems, narrow, 1.0 - share),
            ("stop", stop, systems, parameters[:3], share),
        ):
            if len(some.joint) >= LEAST_BRAKINGS:
                fits = [fit_system(some, each, box, seed, starts) for each in own]
                best[name] = min(fits, key=lambda fit: fit.bic)
                base = best[name].distribution
                strata.append(Stratum(name, w, _with_loss(base, parameters) if name == "stop" else base))
        if len(strata) == 1:
            strata = [strata[0]._replace(share=1.0)]
        return StratifiedDistribution(tuple(strata), np.zeros(len(strata) - 1), column=3, less=0), best

    report("fit")
    fitted, best = fit_all(events, None)
    rng, refits = np.random.default_rng(seed), list[StratifiedDistribution]()
    wanted = 0 if len(np.unique(events.clusters)) < MIN_CLUSTERS else N_REFITS if n_refits is None else n_refits
    while len(refits) < wanted:
        report(f"refit {len(refits) + 1} of {wanted}")
        drawn = draw_events(events, rng)
        one = fit_all(drawn, FOLD_STARTS)[0] if min(_sizes(split(drawn), best)) >= LEAST_BRAKINGS else None
        if one is not None:
            refits.append(one)
    stop, slowing = split(events)
    checks: tuple[PredictiveCheck, ...] = ()
    for name, _, base in fitted.strata:
        own = stop if name == "stop" else slowing
        checks += _check_pairs(name, BRAKING_STATES, own.joint[:, :3], base, (0, 1, 2), seed)
    family = "; ".join(f"{name}: {fit.family}" for name, fit in best.items())
    record = {
        "kind": "fitted to recorded events",
        "coordinates": "; ".join(f"{name}: {fit.system.name}" for name, fit in best.items()),
        "bic": round(sum(fit.bic for fit in best.values()), 2),
        "source": dict(source),
        "filters": list(events.log),
        "strata": {"stop": len(stop.joint), "slowing": len(slowing.joint)},
        "settings": {"covariance_floor": COVARIANCE_FLOOR, "seed": seed},
        "command": command,
        "libraries": {name: version(name) for name in ("numpy", "scipy", "scikit-learn")},
    }
    return FittedDistribution(
        distribution=fitted,
        refits=tuple(refits),
        events=events.counts,
        family=family,
        frequency=frequency,
        checks=checks,
        record=record,
    )


def _sizes(parts: tuple[EventSet, EventSet], kept: Mapping[str, Any]) -> list[int]:
    """Return the numbers of brakings of strata that are kept, of those to a standstill and of others."""
    return [len(part.joint) for part, name in zip(parts, ("stop", "slowing"), strict=True) if name in kept]
