"""Coordinate systems in which a Gaussian mixture is fitted to events, the choice between them, and refits.

Which coordinates one calls normal decides the tails, and with them the probability of a collision: for car-following
p of the IDM is 1e-4 in plain gaps and 7e-11 in the closing speed over the root of the gap. BIC and the likelihood of
events that the fit has not seen are what the events themselves have to say about it.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.coordinates import ClosingSpeed, CoordinateKind, Coordinates, Difference
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.space import Parameter
from samplers.problem import FloatArray
from training.fit.filters import EventSet, check_spread
from training.fit.mixture import MAX_COMPONENTS, Candidate, Components, append_independent, select_mixture
from training.fit.refits import FOLD_STARTS, Asked

N_FOLDS = 5
"""Parts of the clusters; each is predicted from the others."""
BIC_TIE = 2.0
"""Difference of BIC below which it says nothing (Kass and Raftery, "Bayes factors", 1995, section 3.2)."""
CLEARLY_WORSE = 2.0
"""Paired standard errors of held-out log likelihood by which a coordinate system may be worse than the best."""


@dataclass(frozen=True)
class CoordinateSystem:
    """Kinds of the coordinates of a scenario's parameters."""

    name: str
    """Short name for messages and tables, such as "log gap"."""
    kinds: Mapping[str, CoordinateKind] = field(default_factory=dict)
    """Kind of the coordinate by parameter; plain if none is given."""
    order: tuple[str, ...] = ()
    """Parameters in the order of the coordinates; that of x if empty."""
    within: tuple[Difference, ...] = ()
    """Ranges of differences of parameters."""
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
            within=self.within,
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
