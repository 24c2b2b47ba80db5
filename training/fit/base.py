"""Traffic models fitted to events, with all that says what they are worth, as the text of a base file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from typing import Any, cast

import numpy as np

from rare_envs.distributions.events import EventFrequency
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.scenarios.registry import find_scenario
from samplers.bases import find_base_fault
from samplers.problem import FloatArray
from training.fit.checks import check_predictions
from training.fit.coordinates import (
    COORDINATE_SYSTEMS,
    FOLD_STARTS,
    N_FOLDS,
    Asked,
    CoordinateSystem,
    Fit,
    SystemFit,
    choose_system,
    describe_family,
    fit_system,
    held_out_log_prob,
    refit,
)
from training.fit.filters import EventSet, NoSpread, recorded_parameters
from training.fit.mixture import (
    COVARIANCE_FLOOR,
    EM_STARTS,
    EVENTS_PER_COMPONENT,
    SMALLEST_COMPONENT,
)
from training.fit.strata import Neighbours, fit_cut_in, fit_hard_brake, keep_accepted, keep_strata

SETTINGS = {
    "covariance_floor": COVARIANCE_FLOOR,
    "restarts": EM_STARTS,
    "restarts_of_refits": FOLD_STARTS,
    "events_per_component_and_dimension": EVENTS_PER_COMPONENT,
    "smallest_component_per_dimension": SMALLEST_COMPONENT,
    "folds": N_FOLDS,
}
"""What the record of a fit in a chosen coordinate system has of its settings, beside the seed."""


def fit_base(
    scenario: str,
    events: EventSet,
    source: Mapping[str, Any],
    command: str,
    *,
    neighbours: Neighbours | Distribution | None = None,
    frequency: EventFrequency | None = None,
    system: str | None = None,
    n_refits: int | None = None,
    seed: int = 0,
    report: Callable[[str], None] = lambda _: None,
) -> FittedDistribution:
    """Return a base fitted to events: coordinates and components chosen, refits, predictive checks, and its record.

    Brakings of the lead are fitted in strata, and cut-ins where neighbours are given (see `training.fit.strata`).

    Args:
        scenario: Short name or environment id.
        events: What it is fitted to.
        source: Site, data, publisher, licence and so on, for the file.
        command: Command that writes the file.
        neighbours: Of cut-ins, on whom those come who do not look: at random times; or a base made of strata, whose
            `unseen` is taken if there are none. None for one density of all cut-ins.
        frequency: How often the events happen; None if nobody counted.
        system: Name of the coordinate system, columns apart left out; None for the one that the events support best.
        n_refits: Number of refits; None for 30, or 100 where families differ among these.
        seed: Seed of the fits.
        report: Told of each fit and refit.

    Raises:
        ValueError: The events are too few or too alike, or there is no such coordinate system.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> columns = [rng.normal(14, 3, 60), rng.normal(14, 3, 60), rng.lognormal(3, 0.4, 60)]  # m/s, m/s, m
        >>> events = EventSet(np.stack(columns, axis=1), clusters=np.arange(60))
        >>> base = fit_base("car_following", events, {"site": "my road"}, "fit.py", system="plain", n_refits=2)
        >>> base.clusters, len(base.refits)
        (60, 2)
    """
    asked = Asked(n_refits, seed, report)
    if find_scenario(scenario).name == "hard_brake":
        events = keep_strata(events)
        fit = fit_hard_brake(scenario, events, asked)
    elif neighbours is not None:
        events = keep_accepted(events)
        fit = fit_cut_in(scenario, events, neighbours, frequency, asked)
    else:
        fit = _fit_in_best_system(scenario, events, system, asked)
    _check_numbers(scenario, events, fit.distribution)
    record = {
        "kind": "fitted to recorded events",
        **fit.criteria,
        "source": dict(source),
        "filters": list(events.log),
        **fit.entries,
        "settings": {**fit.settings, "seed": seed},
        "command": command,
        "libraries": {name: version(name) for name in ("numpy", "scipy", "scikit-learn")},
    }
    return FittedDistribution(
        distribution=fit.distribution,
        refits=fit.refits,
        events=events.counts,
        family=fit.family,
        frequency=frequency,
        checks=fit.checks,
        record=record,
    )


def _check_numbers(scenario: str, events: EventSet, fitted: Distribution) -> None:
    """Raise a `NoSpread` that names the narrowest parameter if the numbers of a fit are too inexact for estimates."""
    box, fault = recorded_parameters(scenario), find_base_fault(fitted, cast(Any, fitted).dim)
    if fault is not None:
        spreads = [*events.joint.std(axis=0), *events.apart.std(axis=0)]
        pairs = list(zip(spreads, box, strict=False))
        spread, least = min(pairs, key=lambda pair: pair[0] / (pair[1].high - pair[1].low))
        raise NoSpread(
            f"{least.name} varies too little (standard deviation {spread:.2g} {least.unit}, in a range of "
            f"{least.low:g} to {least.high:g}): the numbers of the fitted model are too inexact ({fault}). "
            "Add recordings in which it varies."
        )


def _fit_in_best_system(scenario: str, events: EventSet, system: str | None, asked: Asked) -> Fit:
    """Return one mixture in the coordinate system that the events support best, or in a named one."""
    found = find_scenario(scenario)
    parameters, systems = recorded_parameters(scenario), COORDINATE_SYSTEMS[found.name]
    names = [system.name for system in systems]
    if system not in (None, *names):
        raise ValueError(f"Unknown coordinate system {system!r}; known are {', '.join(names)}.")
    fits, best, selection = _compare_systems(events, systems, parameters, asked)
    best = best if system is None else names.index(system)
    chosen = fits[best]
    refits = refit(events, [each for each in systems if system in (None, each.name)], parameters, asked)
    names = [p.name for p in parameters]
    return Fit(
        distribution=chosen.distribution,
        refits=tuple(each.distribution for each in refits),
        family=describe_family(chosen.family, refits),
        checks=check_predictions(found.name, names, events.joint, chosen.distribution, asked.seed),
        criteria={name: selection[best][name] for name in ("coordinates", "bic", "held_out_log_prob")},
        entries={"selection": selection},
        settings=SETTINGS,
    )


def _compare_systems(
    events: EventSet, systems: Sequence[CoordinateSystem], parameters: Sequence[Parameter], asked: Asked
) -> tuple[list[SystemFit], int, list[dict[str, Any]]]:
    """Return fits in several systems, which is supported best, and criteria for a file."""
    fits = []
    for system in systems:
        asked.report(f"fit in the coordinates {system.name}")
        fits.append(fit_system(events, system, parameters, asked.seed))
    asked.report("held-out events")
    held_out = [held_out_log_prob(events, system, parameters, asked.seed) for system in systems]
    best = choose_system([fit.bic for fit in fits], held_out, events.clusters)
    return fits, best, [_describe_fit(*each) for each in zip(fits, held_out, strict=True)]


def _describe_fit(fit: SystemFit, scores: FloatArray) -> dict[str, Any]:
    """Return the criteria of one coordinate system; null if too few events were left to predict from."""
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
    parameters = find_scenario(scenario).parameters
    head = {"names": [p.name for p in parameters], "units": [p.unit for p in parameters]}
    return json.dumps({**head, **content, **head}, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
