"""Coordinate systems in which a Gaussian mixture is fitted to events, the choice between them, and refits.

Which coordinates one calls normal decides the tails, and with them the probability of a collision: for car-following
p of the IDM is 1e-4 in plain gaps and 7e-11 in the closing speed over the root of the gap. BIC and the likelihood of
events that the fit has not seen are what the events themselves have to say about it.

A refit is the whole fit again, to events drawn anew from the recorded ones, which says how far the events determine it.
Whole clusters are drawn with replacement (the bootstrap of Efron and Tibshirani, "An Introduction to the Bootstrap",
1993, chapter 8): events of one scene depend on each other. All that was chosen by the events is chosen anew in each
refit (Breiman, "Bagging predictors", 1996; Efron, "Estimation and accuracy after model selection", 2014). In two worlds
of car-following refits in the coordinates of the fit gave intervals that held p in 81 and 74 % of 32 and 31 draws of
events, refits that choose 96 and 98 % of 135 and 134 (`benchmarks/uncertainty/recipe_coverage.py`).
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.coordinates import ClosingSpeed, CoordinateKind, Coordinates, Difference, RoomToBrake
from rare_envs.distributions.events import PredictiveCheck
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.space import Distribution, Parameter
from samplers.problem import FloatArray
from training.fit.filters import EventSet, NoSpread, check_spread
from training.fit.mixture import MAX_COMPONENTS, Candidate, Components, append_independent, select_mixture

T = TypeVar("T")
N_FOLDS = 5
"""Parts of the clusters; each is predicted from the others."""
BIC_TIE = 2.0
"""Difference of BIC below which it says nothing (Kass and Raftery, "Bayes factors", 1995, section 3.2)."""
CLEARLY_WORSE = 2.0
"""Paired standard errors of held-out log likelihood by which a coordinate system may be worse than the best."""
N_REFITS = 30
"""Refits where all are of the same family: the noise of log-spread is then .13."""
MIN_CLUSTERS = 5
"""Clusters below which there is nothing to draw anew: refits to so few would all be alike."""
MORE_REFITS = 100
"""Refits where coordinates or number of components differ: one refit alone may then carry the spread."""
FOLD_STARTS = 5
"""Starts of expectation maximisation of the fits to folds and to resampled events.

Fewer than of the fit itself: another local optimum moves log p by .1 to .2, nothing beside the spread of .7 to 1.5 that
other events cause.
"""


class Fit(NamedTuple):
    """What was fitted to events, and what its record says of it."""

    distribution: Distribution
    refits: tuple[Distribution, ...]
    family: str
    """In words."""
    checks: tuple[PredictiveCheck, ...]
    criteria: Mapping[str, Any]
    """Entries of the record: coordinates, and what speaks for them."""
    entries: Mapping[str, Any]
    """Further entries."""
    settings: Mapping[str, Any]
    """Those of the fit, beside the seed."""


@dataclass(frozen=True)
class Asked:
    """How a fit is made."""

    n_refits: int | None = None
    """None: `N_REFITS`, or `MORE_REFITS` where families differ among these."""
    seed: int = 0
    """Of the fits and of what is drawn anew."""
    report: Callable[[str], None] = lambda _: None
    """Told of each fit and refit."""

    def refit(
        self,
        events: EventSet,
        fit: Callable[[EventSet, np.random.Generator], T],
        family: Callable[[T], object] = type,
    ) -> list[T]:
        """Return refits to events drawn anew, none if they are of under `MIN_CLUSTERS`.

        Events that are drawn such that a parameter has one value are drawn again.
        """
        if len(np.unique(events.clusters)) < MIN_CLUSTERS:
            return []
        rng, refits = np.random.default_rng(self.seed), list[T]()
        wanted = N_REFITS if self.n_refits is None else self.n_refits
        while len(refits) < wanted:
            self.report(f"refit {len(refits) + 1} of {wanted}")
            with contextlib.suppress(NoSpread):
                refits.append(fit(draw_events(events, rng), rng))
            if self.n_refits is None and len(refits) == N_REFITS and len({family(each) for each in refits}) > 1:
                wanted = MORE_REFITS
        return refits


def draw_events(events: EventSet, rng: np.random.Generator) -> EventSet:
    """Return as many clusters as there are, drawn with replacement, and columns apart drawn by themselves."""
    names = np.unique(events.clusters)
    rows = [np.flatnonzero(events.clusters == name) for name in rng.choice(names, len(names))]
    labels = np.repeat(np.arange(len(rows)), [len(part) for part in rows])
    apart = events.apart[rng.integers(len(events.apart), size=len(events.apart))] if len(events.apart) else events.apart
    return EventSet(events.joint[np.concatenate(rows)], labels, apart, events.cluster)


@dataclass(frozen=True)
class CoordinateSystem:
    """Kinds of the coordinates of a scenario's parameters."""

    name: str
    """Short name for messages and tables, such as "log gap"."""
    kinds: Mapping[str, CoordinateKind] = field(default_factory=dict)
    """Kind of the coordinate by parameter; plain if none is given."""
    order: tuple[str, ...] = ()
    """Parameters in the order of the coordinates; that of x if empty."""
    within: tuple[Difference | RoomToBrake, ...] = ()
    """What cuts ranges of parameters by others."""
    origins: Mapping[str, float] = field(default_factory=dict)
    """What is subtracted from a parameter whose logarithm is its coordinate; 0 if nothing is given."""

    def coordinates(self, parameters: Sequence[Parameter]) -> Coordinates:
        """Return the coordinates of these first parameters of the scenario."""
        names = tuple(p.name for p in parameters)
        return Coordinates(
            low=np.array([p.low for p in parameters]),
            high=np.array([p.high for p in parameters]),
            kinds=tuple(self.kinds.get(name, "plain") for name in names),
            names=names,
            order=tuple(name for name in self.order if name in names),
            within=tuple(each for each in self.within if each.column in names),
            origins=tuple(self.origins.get(name, 0.0) for name in names),
        )


LOG_DURATION: dict[str, CoordinateKind] = {"duration": "log"}
"""Of lane changes: BIC 1,315 for 1,383 of plain durations on US 101 (259 changes), 711 for 735 on I-80 (131)."""
COORDINATE_SYSTEMS: dict[str, tuple[CoordinateSystem, ...]] = {
    "car_following": (
        CoordinateSystem("plain"),
        CoordinateSystem("log gap", {"gap": "log"}),
        CoordinateSystem(
            "closing speed / sqrt(gap), log gap",
            {"lead_speed": ClosingSpeed("ego_speed", "gap"), "gap": "log"},
            ("ego_speed", "gap", "lead_speed"),
        ),
    ),
    "cut_in": (
        CoordinateSystem("plain", LOG_DURATION),
        CoordinateSystem("log gaps", {"cut_in_gap": "log", "lead_gap": "log", **LOG_DURATION}),
        CoordinateSystem(
            "closing speeds / sqrt(gap), log gaps",
            {
                "cut_in_speed": ClosingSpeed("ego_speed", "cut_in_gap"),
                "lead_speed": ClosingSpeed("cut_in_speed", "lead_gap"),
                "cut_in_gap": "log",
                "lead_gap": "log",
                **LOG_DURATION,
            },
            ("ego_speed", "cut_in_gap", "cut_in_speed", "lead_gap", "lead_speed", "lateral_offset", "duration"),
        ),
    ),
    "hard_brake": (
        CoordinateSystem("plain"),
        CoordinateSystem("log gap", {"gap": "log"}),
        CoordinateSystem("log gap, log peak", {"gap": "log", "peak": "log"}),
    ),
}
"""Coordinate systems that are tried, by scenario."""


@dataclass(frozen=True)
class SystemFit:
    """A mixture fitted in one coordinate system."""

    system: CoordinateSystem
    distribution: TruncatedGaussianMixture
    """Of all columns of x."""
    candidates: Sequence[Candidate]
    """Numbers of components of the columns that are fitted together, with a BIC in units of x."""

    @property
    def bic(self) -> float:
        """Bayesian information criterion of the columns fitted together, comparable between systems."""
        return min(candidate.bic for candidate in self.candidates if candidate.accepted)

    @property
    def family(self) -> str:
        """The family of distributions in words: "3 components, log gap"."""
        k = len(self.distribution.weights)
        return f"{k} component{'s' if k > 1 else ''}, {self.system.name}"


def fit_system(
    events: EventSet,
    system: CoordinateSystem,
    parameters: Sequence[Parameter],
    seed: int = 0,
    starts: int | None = None,
) -> SystemFit:
    """Return a mixture in one system; columns apart get one component of their own. `NoSpread` if one is constant."""
    n = events.joint.shape[1]
    check_spread(events.joint, parameters)
    check_spread(events.apart, parameters[n:])
    components, candidates = _fit_in(system.coordinates(parameters[:n]), events.joint, seed, MAX_COMPONENTS, starts)
    if events.apart.shape[1]:
        apart, _ = _fit_in(system.coordinates(parameters[n:]), events.apart, seed, 1, None)
        components = append_independent(components, apart)
    mixture = TruncatedGaussianMixture(*components, coordinates=system.coordinates(parameters))
    return SystemFit(system, mixture, candidates)


def _fit_in(
    coordinates: Coordinates, x: FloatArray, seed: int, most: int, starts: int | None
) -> tuple[Components, list[Candidate]]:
    """Return a mixture fitted to the coordinates y of events x (n, d), and its candidates with a BIC in units of x."""
    names = [coordinates.names[j] for j in coordinates.columns]
    components, candidates = select_mixture(coordinates.to_coordinates(x), seed, most, starts, names)
    excess = 2.0 * float(coordinates.log_jacobian(coordinates.interior(x)).sum())  # of a BIC of y over that of x
    return components, [candidate._replace(bic=candidate.bic - excess) for candidate in candidates]


def held_out_log_prob(
    events: EventSet, system: CoordinateSystem, parameters: Sequence[Parameter], seed: int = 0
) -> FloatArray:
    """Return the log density of each event (n,) under a fit to the other folds of clusters; NaN if too few."""
    names = np.random.default_rng(seed).permutation(np.unique(events.clusters))
    own = parameters[: events.joint.shape[1]]
    scores = np.full(len(events.joint), np.nan)
    for fold in np.array_split(names, min(N_FOLDS, len(names))):
        test = np.isin(events.clusters, fold)
        rest = EventSet(events.joint[~test], events.clusters[~test])
        with contextlib.suppress(ValueError):
            fitted = fit_system(rest, system, own, seed, FOLD_STARTS)
            scores[test] = fitted.distribution.log_prob(events.joint[test])
    return scores


def choose_system(bic: Sequence[float], held_out: Sequence[FloatArray], clusters: NDArray[np.int64]) -> int:
    """Return which coordinate system is supported best, of BICs and log densities of held-out events, (n,) each.

    The one with the least BIC among those whose held-out log likelihood is not clearly worse than the best one's:
    by no more than `CLEARLY_WORSE` paired standard errors, of sums over clusters (n,). If others are within
    `BIC_TIE` of it, the held-out log likelihood decides between these.
    """
    known = np.isfinite(np.stack(held_out)).all(axis=0)
    if not known.any():
        return int(np.argmin(bic))
    totals = [score[known].sum() for score in held_out]
    best = held_out[int(np.argmax(totals))]
    cluster = np.unique(clusters[known], return_inverse=True)[1].ravel()
    eligible = []
    for i, score in enumerate(held_out):
        losses = np.bincount(cluster, weights=(best - score)[known])
        error = float(np.sqrt(len(losses)) * losses.std(ddof=1)) if len(losses) > 1 else np.inf
        if losses.sum() <= CLEARLY_WORSE * error:
            eligible.append(i)
    least = min(bic[i] for i in eligible)
    return max((i for i in eligible if bic[i] <= least + BIC_TIE), key=lambda i: totals[i])


def refit(
    events: EventSet, systems: Sequence[CoordinateSystem], parameters: Sequence[Parameter], asked: Asked
) -> tuple[SystemFit, ...]:
    """Return refits, each in the coordinate system that its events support best by the BIC."""

    def fit(drawn: EventSet, _: np.random.Generator) -> SystemFit:
        fits = [fit_system(drawn, system, parameters, asked.seed, FOLD_STARTS) for system in systems]
        return min(fits, key=lambda fit: fit.bic)

    return tuple(asked.refit(events, fit, lambda each: each.family))


def describe_family(family: str, refits: Sequence[SystemFit]) -> str:
    """Return the family of a fit in words, with the share of the refits in each coordinates if they differ."""
    systems = Counter(each.system.name for each in refits)
    counts = ", ".join(f"{number} in {name}" for name, number in systems.most_common())
    return family if len(systems) < 2 else f"{family}; of the refits {counts}"
