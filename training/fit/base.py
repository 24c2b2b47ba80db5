"""Base distributions fitted to events, with all that says what they are worth, as the text of a base file.

Predictive checks compare dangerous initial states, counted in the recorded events, with what a base distribution
expects: one fitted to the bulk of the events may still expect more or fewer, and the probability of a collision depends
on these states alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.events import EventFrequency, PredictiveCheck
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.mixture import TruncatedGaussianMixture
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
from training.fit.filters import EventSet, recorded_parameters
from training.fit.mixture import (
    COVARIANCE_FLOOR,
    EM_STARTS,
    EVENTS_PER_COMPONENT,
    MAX_COMPONENTS,
    SMALLEST_COMPONENT,
)

MASS_SAMPLES = 1_000_000
"""Draws from which the mass outside the box is estimated."""
SETTINGS = {
    "covariance_floor": COVARIANCE_FLOOR,
    "restarts": EM_STARTS,
    "restarts_of_refits": FOLD_STARTS,
    "events_per_component_and_dimension": EVENTS_PER_COMPONENT,
    "smallest_component_per_dimension": SMALLEST_COMPONENT,
    "folds": N_FOLDS,
}
"""What the record of a fit has of its settings, beside the seed."""


def fit_base(
    scenario: str,
    events: EventSet,
    source: Mapping[str, Any],
    command: str,
    *,
    frequency: EventFrequency | None = None,
    system: str | None = None,
    n_refits: int | None = None,
    seed: int = 0,
    report: Callable[[str], None] = lambda _: None,
) -> FittedDistribution:
    """Return a base fitted to events: coordinates and components chosen, refits, predictive checks, and its record.

    Args:
        scenario: Short name or environment id.
        events: What it is fitted to.
        source: Site, data, publisher, licence and so on, for the file.
        command: Command that writes the file.
        frequency: How often the events happen; None where nobody counted.
        system: Name of the coordinate system, columns apart left out; None for the one that the events support best.
        n_refits: Number of refits, see `refit`.
        seed: Seed of the fits.
        report: Told of each fit and refit.

    Raises:
        ValueError: The events are too few, or there is no such coordinate system.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> columns = [rng.normal(14, 3, 60), rng.normal(14, 3, 60), rng.lognormal(3, 0.4, 60)]  # m/s, m/s, m
        >>> events = EventSet(np.stack(columns, axis=1), clusters=np.arange(60))
        >>> base = fit_base("car_following", events, {"site": "my road"}, "fit.py", system="plain", n_refits=2)
        >>> base.clusters, len(base.refits)
        (60, 2)
    """
    found = scenario_named(scenario)
    parameters, systems = recorded_parameters(scenario), COORDINATE_SYSTEMS[found.name]
    names = [system.name for system in systems]
    if system not in (None, *names):
        raise ValueError(f"Unknown coordinate system {system!r}; known are {', '.join(names)}.")
    own = parameters[events.joint.shape[1] :]
    refitted = [each for each in systems if system in (None, each.name)]
    selections: dict[str, Any] = {}
    if systems_apart := [each for p in own for each in SYSTEMS_APART.get(p.name, ())]:
        alone = EventSet(events.apart, np.arange(len(events.apart)))
        fits, best, selections["selection_apart"] = compare_systems(alone, systems_apart, own, seed, report, most=1)
        systems = tuple(each.combine(fits[best].system) for each in systems)
        refitted = [each.combine(other) for each in refitted for other in systems_apart]
    fits, best, selection = compare_systems(events, systems, parameters, seed, report)
    best = best if system is None else names.index(system)
    chosen = fits[best]
    refits = refit(events, refitted, parameters, seed, n_refits, report)
    record = {
        "kind": "fitted to recorded events",
        **{name: selection[best][name] for name in ("coordinates", "bic", "held_out_log_prob")},
        "source": dict(source),
        "filters": list(events.log),
        "selection": selection,
        **selections,
        "settings": {**SETTINGS, "seed": seed},
        "mass_outside_box": mass_outside(chosen.distribution),
        "command": command,
        "libraries": {name: version(name) for name in ("numpy", "scipy", "scikit-learn")},
    }
    return FittedDistribution(
        distribution=chosen.distribution,
        refits=tuple(each.distribution for each in refits),
        events=events.counts,
        family=describe_family(chosen.family, refits),
        frequency=frequency,
        checks=check_predictions(found.name, [p.name for p in parameters], events.joint, chosen.distribution, seed),
        record=record,
    )


def compare_systems(
    events: EventSet,
    systems: Sequence[CoordinateSystem],
    parameters: Sequence[Parameter],
    seed: int,
    report: Callable[[str], None],
    most: int = MAX_COMPONENTS,
) -> tuple[list[SystemFit], int, list[dict[str, Any]]]:
    """Return fits of `most` components at most in several systems, which is supported best, and criteria for a file."""
    fits = []
    for system in systems:
        report(f"fit in the coordinates {system.name}")
        fits.append(fit_system(events, system, parameters, seed, most=most))
    report("held-out events")
    held_out = [held_out_log_prob(events, system, parameters, seed, most) for system in systems]
    best = choose_system([fit.bic for fit in fits], held_out, events.clusters)
    return fits, best, [_describe_fit(*each) for each in zip(fits, held_out, strict=True)]


def _describe_fit(fit: SystemFit, scores: FloatArray) -> dict[str, Any]:
    """Return the criteria of one coordinate system; null where too few events were left to predict from."""
    return {
        "coordinates": fit.system.name,
        "bic": round(fit.bic, 2),
        "held_out_log_prob": round(float(scores.mean()), 4) if np.isfinite(scores).all() else None,
        "components": [
            {
                "number": candidate.number,
                "bic": round(candidate.bic, 2),
                "events_in_smallest": round(candidate.smallest, 1),
                "accepted": candidate.accepted,
            }
            for candidate in fit.candidates
        ],
    }


def format_base(scenario: str, content: Mapping[str, Any]) -> str:
    """Return the text of a base file, which `load_base` reads, from the entries of a distribution's `to_dict`."""
    parameters = scenario_named(scenario).parameters
    head = {"names": [p.name for p in parameters], "units": [p.unit for p in parameters]}
    return json.dumps({**head, **content, **head}, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def mass_outside(distribution: TruncatedGaussianMixture, seed: int = 0) -> dict[str, Any]:
    """Return the probability that the box cuts away from the mixture, by any column and by each."""
    coordinates, rng = distribution.coordinates, np.random.default_rng(seed)
    counts = rng.multinomial(MASS_SAMPLES, distribution.weights)
    parts = [
        mean + rng.standard_normal((count, distribution.dim)) @ np.linalg.cholesky(covariance).T
        for count, mean, covariance in zip(counts, distribution.means, distribution.covariances, strict=True)
    ]
    y = np.concatenate(parts)
    x = np.empty_like(y)
    for position, j in enumerate(coordinates.columns):
        x[:, j] = coordinates.value(j, y[:, position], x)
    outside = (x < coordinates.low) | (x > coordinates.high)
    p = float(outside.any(axis=1).mean())
    return {
        "any": p,
        "standard_error": float(f"{np.sqrt(p * (1.0 - p) / MASS_SAMPLES):.2g}"),
        "each": [float(f"{value:.3g}") for value in outside.mean(axis=0)],
    }


CHECK_DRAWS = 200_000
"""Draws from which an expected count is computed; one in 2,000 events then has an error of 10 %."""
State = Callable[[FloatArray, FloatArray, FloatArray], NDArray[np.bool_]]
DANGEROUS_STATES: dict[str, State] = {
    "TTC < 5 s": lambda v, ahead, gap: v - ahead > gap / 5.0,
    "needed deceleration > 1 m/s^2": lambda v, ahead, gap: np.maximum(v - ahead, 0.0) ** 2 > 2.0 * gap,
    "gap < 3 m": lambda v, ahead, gap: gap < 3.0,
}
"""Of speed behind, speed ahead [m/s] and gap [m], shape (n,) each.

The needed deceleration brings a vehicle to the speed ahead within the gap: (closing speed)^2 / (2 gap).
"""
CHECKED: dict[str, tuple[dict[str, State], tuple[tuple[str, str, str], ...]]] = {
    "car_following": (DANGEROUS_STATES, (("ego_speed", "lead_speed", "gap"),)),
    "cut_in": (
        DANGEROUS_STATES,
        (("ego_speed", "cut_in_speed", "cut_in_gap"), ("cut_in_speed", "lead_speed", "lead_gap")),
    ),
}
"""States of each scenario, and the parameters of each pair of vehicles that they are of."""


def check_predictions(
    scenario: str, names: Sequence[str], events: FloatArray, distribution: Distribution, seed: int = 0
) -> tuple[PredictiveCheck, ...]:
    """Return recorded and expected counts of dangerous states of events (n, k), the first k named columns."""
    if scenario not in CHECKED:
        return ()
    states, groups = CHECKED[scenario]
    drawn = np.asarray(distribution.sample(CHECK_DRAWS, np.random.default_rng(seed)))
    checks = []
    for group in groups:
        columns = [list(names).index(name) for name in group]
        words = "" if len(groups) == 1 else f", {group[2]}"
        for name, occurs in states.items():
            recorded = int(occurs(*events[:, columns].T).sum())
            share = float(occurs(*drawn[:, columns].T).mean())
            checks.append(PredictiveCheck(f"{name}{words}", recorded, float(f"{share * len(events):.3g}")))
    return tuple(checks)
