"""Base distributions fitted to events, with all that says what they are worth, as the text of a base file.

Predictive checks compare dangerous initial states, counted in the recorded events, with what a base distribution
expects: one fitted to the bulk of the events may still expect more or fewer, and the probability of a collision depends
on these states alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.fitted import EventFrequency, FittedDistribution, PredictiveCheck
from rare_envs.distributions.mixture import CoordinateMixture
from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.scenarios.registry import scenario_named
from samplers.problem import FloatArray
from training.fit.coordinates import (
    COORDINATE_SYSTEMS,
    FOLD_STARTS,
    N_FOLDS,
    SYSTEMS_APART,
    CoordinateSystem,
    SystemFit,
    choose_system,
    describe_family,
    fit_system,
    held_out_log_prob,
    refit,
)
from training.fit.filters import EventSet
from training.fit.mixture import COVARIANCE_FLOOR, EM_STARTS, EVENTS_PER_COMPONENT, SMALLEST_COMPONENT

MASS_SAMPLES = 1_000_000
"""Draws from which the mass outside the box is estimated."""


@dataclass(frozen=True)
class FitRequest:
    """What a base is fitted to, and how."""

    scenario: str
    """Short name or environment id."""
    events: EventSet
    source: Mapping[str, Any]
    """Site, data, publisher, licence and so on, for the file."""
    command: str
    """Command that writes the file."""
    frequency: EventFrequency | None = None
    """How often the events happen; None where nobody counted."""
    system: str | None = None
    """Name of the coordinate system, columns apart left out; None for the one that the events support best."""
    n_refits: int | None = None
    """Number of refits, see `refit`."""
    seed: int = 0
    """Seed of the fits."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the scenario, in the order of x."""
        return tuple(scenario_named(self.scenario).parameters)

    @property
    def systems(self) -> tuple[CoordinateSystem, ...]:
        """Coordinate systems that are tried."""
        return COORDINATE_SYSTEMS[scenario_named(self.scenario).name]


def fit_base(request: FitRequest, report: Callable[[str], None] = lambda _: None) -> FittedDistribution:
    """Return a base fitted to events: coordinates and components chosen, refits, predictive checks, and its record.

    Args:
        request: What it is fitted to, and how.
        report: Told of each fit and refit.

    Raises:
        ValueError: The events are too few, or there is no such coordinate system.
    """
    events, parameters, seed = request.events, request.parameters, request.seed
    apart = compare_apart(request)
    systems = [system.combine(apart.chosen.system) if apart else system for system in request.systems]
    fits = []
    for system in systems:
        report(f"fit in the coordinates {system.name}")
        fits.append(fit_system(events, system, parameters, seed))
    report("held-out events")
    held_out = [held_out_log_prob(events, system, parameters, seed) for system in systems]
    chosen = _choose(request, fits, held_out)
    names = [p.name for p in parameters]
    refits = refit(events, _systems_of_refits(request, apart), parameters, seed, request.n_refits, report)
    return FittedDistribution(
        distribution=chosen.distribution,
        refits=tuple(each.distribution for each in refits),
        events=events.counts,
        family=describe_family(chosen.family, refits),
        frequency=request.frequency,
        checks=check_predictions(scenario_named(request.scenario).name, names, events.joint, chosen.distribution, seed),
        record=_record(request, chosen, fits, held_out, apart),
    )


@dataclass(frozen=True)
class ApartComparison:
    """Fits of the columns apart in several coordinate systems."""

    fits: tuple[SystemFit, ...]
    held_out: tuple[FloatArray, ...]
    """Log density of each event under a fit to the others, see `held_out_log_prob`."""

    @property
    def chosen(self) -> SystemFit:
        """The fit that the events support best."""
        events = np.arange(len(self.held_out[0]))
        return self.fits[choose_system([fit.bic for fit in self.fits], self.held_out, events)]

    @property
    def selection(self) -> list[dict[str, Any]]:
        """The criteria of each, for the file."""
        return [_describe_fit(fit, scores) for fit, scores in zip(self.fits, self.held_out, strict=True)]


def compare_apart(request: FitRequest) -> ApartComparison | None:
    """Return fits of the columns apart, one component each; None where there is only one coordinate system for them.

    Raises:
        ValueError: The events are too few.
    """
    columns, seed = request.events.joint.shape[1], request.seed
    own = request.parameters[columns:]
    systems = [system for p in own for system in SYSTEMS_APART.get(p.name, ())]
    if not systems:
        return None
    events = EventSet(request.events.apart, np.arange(len(request.events.apart)))
    return ApartComparison(
        tuple(fit_system(events, system, own, seed, most=1) for system in systems),
        tuple(held_out_log_prob(events, system, own, seed, most=1) for system in systems),
    )


def _systems_of_refits(request: FitRequest, apart: ApartComparison | None) -> list[CoordinateSystem]:
    """Return the coordinate systems that refits choose from: all, or that asked for with all of the columns apart."""
    systems = [each for each in request.systems if request.system in (None, each.name)]
    return [each.combine(fit.system) for each in systems for fit in apart.fits] if apart else systems


def _choose(request: FitRequest, fits: Sequence[SystemFit], held_out: Sequence[FloatArray]) -> SystemFit:
    """Return the fit in the coordinate system asked for, or in the best supported one."""
    names = [system.name for system in request.systems]
    if request.system is None:
        return fits[choose_system([fit.bic for fit in fits], held_out, request.events.clusters)]
    if request.system not in names:
        raise ValueError(f"Unknown coordinate system {request.system!r}; known are {', '.join(names)}.")
    return fits[names.index(request.system)]


def _record(
    request: FitRequest,
    chosen: SystemFit,
    fits: Sequence[SystemFit],
    held_out: Sequence[FloatArray],
    apart: ApartComparison | None,
) -> dict[str, Any]:
    """Return the record of a fit, for its file."""
    selection = [_describe_fit(fit, scores) for fit, scores in zip(fits, held_out, strict=True)]
    own = selection[fits.index(chosen)]
    return {
        "kind": "fitted to recorded events",
        "coordinates": chosen.system.name,
        "bic": own["bic"],
        "held_out_log_prob": own["held_out_log_prob"],
        "source": dict(request.source),
        "filters": list(request.events.log),
        "selection": selection,
        **({"selection_apart": apart.selection} if apart else {}),
        "settings": {
            "covariance_floor": COVARIANCE_FLOOR,
            "restarts": EM_STARTS,
            "restarts_of_refits": FOLD_STARTS,
            "events_per_component_and_dimension": EVENTS_PER_COMPONENT,
            "smallest_component_per_dimension": SMALLEST_COMPONENT,
            "folds": N_FOLDS,
            "seed": request.seed,
        },
        "mass_outside_box": mass_outside(chosen.distribution),
        "command": request.command,
        "libraries": {name: version(name) for name in ("numpy", "scipy", "scikit-learn")},
    }


def _describe_fit(fit: SystemFit, scores: FloatArray) -> dict[str, Any]:
    """Return the criteria of one coordinate system; null where too few events were left to predict from."""
    known = scores[np.isfinite(scores)]
    return {
        "coordinates": fit.system.name,
        "bic": round(fit.bic, 2),
        "held_out_log_prob": round(float(known.mean()), 4) if len(known) == len(scores) else None,
        "components": [
            {
                "number": candidate.components,
                "bic": round(candidate.bic - (fit.fit.bic - fit.bic), 2),
                "events_in_smallest": round(candidate.smallest, 1),
                "accepted": candidate.accepted,
            }
            for candidate in fit.fit.candidates
        ],
    }


def format_base(scenario: str, content: Mapping[str, Any]) -> str:
    """Return the text of a base file, which `rare_envs.scenarios.base_distributions.load_base` reads.

    Args:
        scenario: Name of the scenario, such as "cut_in".
        content: Entries of the distribution, see its `to_dict`.
    """
    parameters = scenario_named(scenario).parameters
    head = {"names": [p.name for p in parameters], "units": [p.unit for p in parameters]}
    return json.dumps({**head, **content}, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def mass_outside(distribution: CoordinateMixture, seed: int = 0) -> dict[str, Any]:
    """Return the probability that the box cuts away from the mixture without its box.

    Returns:
        `any`: probability that some column of x is outside, with its `standard_error`; `each`: the same per column.
    """
    coordinates = distribution.coordinates
    y = _draw_unbounded(distribution, MASS_SAMPLES, np.random.default_rng(seed))
    x = np.empty_like(y)
    for position, j in enumerate(coordinates.columns):
        x[:, j] = coordinates.unbounded_value(j, y[:, position], x)
    outside = (x < coordinates.low) | (x > coordinates.high)
    p = float(outside.any(axis=1).mean())
    return {
        "any": p,
        "standard_error": float(f"{np.sqrt(p * (1.0 - p) / MASS_SAMPLES):.2g}"),
        "each": [float(f"{value:.3g}") for value in outside.mean(axis=0)],
    }


def _draw_unbounded(distribution: CoordinateMixture, n: int, rng: np.random.Generator) -> FloatArray:
    """Draw coordinates from the mixture without its box, shape (n, d)."""
    counts = rng.multinomial(n, distribution.weights)
    parts = [
        mean + rng.standard_normal((count, distribution.dim)) @ np.linalg.cholesky(covariance).T
        for count, mean, covariance in zip(counts, distribution.means, distribution.covariances, strict=True)
    ]
    return np.concatenate(parts)


CHECK_DRAWS = 200_000
"""Draws from which an expected count is computed; one in 2,000 events then has an error of 10 %."""


@dataclass(frozen=True)
class DangerousState:
    """A condition on three parameters of a scenario."""

    name: str
    occurs: Callable[[FloatArray, FloatArray, FloatArray], NDArray[np.bool_]]
    """Of the three columns that `CHECKED_COLUMNS` names, shape (n,) each."""


DANGEROUS_STATES = (
    DangerousState("TTC < 5 s", lambda v, ahead, gap: v - ahead > gap / 5.0),
    DangerousState("needed deceleration > 1 m/s^2", lambda v, ahead, gap: np.maximum(v - ahead, 0.0) ** 2 > 2.0 * gap),
    DangerousState("gap < 3 m", lambda v, ahead, gap: gap < 3.0),
)
"""Of speed behind, speed ahead [m/s] and gap [m].

The needed deceleration brings a vehicle to the speed ahead within the gap: (closing speed)^2 / (2 gap).
"""
BRAKING_STATES = (
    DangerousState("time headway < 0.5 s", lambda v, deceleration, gap: gap < 0.5 * v),
    DangerousState("deceleration > 3 m/s^2", lambda v, deceleration, gap: deceleration > 3.0),
    DangerousState("gap < 3 m", lambda v, deceleration, gap: gap < 3.0),
)
"""Of the speed of both [m/s], the deceleration ahead [m/s^2] and the gap [m]."""
CHECKED_COLUMNS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "car_following": (("ego_speed", "lead_speed", "gap"),),
    "cut_in": (("ego_speed", "cut_in_speed", "cut_in_gap"), ("cut_in_speed", "lead_speed", "lead_gap")),
    "hard_brake": (("speed", "deceleration", "gap"),),
}
"""Parameters of each pair of vehicles, by scenario."""


def check_predictions(
    scenario: str, names: Sequence[str], events: FloatArray, distribution: Distribution, seed: int = 0
) -> tuple[PredictiveCheck, ...]:
    """Compare recorded with expected counts of dangerous states.

    Args:
        scenario: Name of the scenario.
        names: Its parameters in the order of the columns of x.
        events: Recorded events, shape (n, k), k of the first columns of x.
        distribution: Base distribution of x.
        seed: Seed of the draws.

    Returns:
        One check for each state and pair of vehicles; none for a scenario that is not in `CHECKED_COLUMNS`.
    """
    groups = CHECKED_COLUMNS.get(scenario, ())
    states = BRAKING_STATES if scenario == "hard_brake" else DANGEROUS_STATES
    drawn = np.asarray(distribution.sample(CHECK_DRAWS, np.random.default_rng(seed))) if groups else np.empty((0, 0))
    checks = []
    for group in groups:
        columns = [list(names).index(name) for name in group]
        words = "" if len(groups) == 1 else f", {group[2]}"
        for state in states:
            recorded = int(state.occurs(*events[:, columns].T).sum())
            share = float(state.occurs(*drawn[:, columns].T).mean())
            checks.append(PredictiveCheck(f"{state.name}{words}", recorded, float(f"{share * len(events):.3g}")))
    return tuple(checks)
