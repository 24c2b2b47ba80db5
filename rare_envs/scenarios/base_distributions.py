"""Base distributions of scenarios: shipped, in a JSON file, or the user's own; and the trial of a scenario."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from rare_envs.distributions.fitted import FITTED_KEYS, FileDistribution, FittedDistribution, read_distribution
from rare_envs.distributions.space import Distribution
from rare_envs.files import parse_json_object
from rare_envs.plugins import did_you_mean
from rare_envs.scenarios.base import Scenario
from rare_envs.traffic.state import State

_TRIAL_DRAWS = 1000
"""Draws by which a user's distribution is tried before it is used."""
DISTRIBUTION_METHODS = ("sample", "log_prob", "to_standard_normal", "from_standard_normal")


@runtime_checkable
class TextFile(Protocol):
    """A file of the package or a path."""

    def read_text(self, encoding: str | None = None) -> str:
        """Return the content."""


def load_base(scenario: Scenario, base: str | PathLike[str] | Distribution | None = None) -> Distribution:
    """Return the base distribution of a scenario.

    A JSON file holds what the shipped ones do: names, low, high, weights, means, covariances, and if wanted units,
    provenance, coordinates and order (see `CoordinateMixture`); or, for independent Beta variables, names, low, high,
    alpha and beta, one for each column of x (see `BetaDistribution`). A file with refits, events, family, frequency or
    checks gives a `FittedDistribution`, see its `from_dict`.

    Args:
        scenario: The scenario.
        base: The name of one of `scenario.bases`, a path to a JSON file, or an object with the four methods of
            `Distribution`; None for the scenario's default, which is its first.

    Raises:
        ValueError: There is no such file, or it does not fit the scenario.

    Example:
        >>> from rare_envs.scenarios import scenario_named
        >>> load_base(scenario_named("hard_brake"), "us101").dim
        3
    """
    base = scenario.default_base if base is None else base
    if not isinstance(base, str | PathLike):
        return _check_object(scenario, base)
    source, names = str(base), tuple(p.name for p in scenario.parameters)
    found = scenario.bases.get(source, Path(base))
    if isinstance(found, Mapping):
        box = scenario.column_parameters
        own = {"names": list(names), "low": [p.low for p in box], "high": [p.high for p in box]}
        return _fit_to(scenario, source, _read(scenario.name, names, source, {**own, **found}))
    if not isinstance(found, TextFile):
        return _check_object(scenario, found)
    if isinstance(found, Path) and not found.is_file():
        raise ValueError(
            f"No base distribution {source!r} for {scenario.name}"
            f"{did_you_mean(source, scenario.bases)}: neither one of {', '.join(scenario.bases)} nor a file."
        )
    try:
        text = found.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"Cannot read the base distribution {found}: {error}.") from None
    return _fit_to(scenario, source, _read_text(scenario.name, names, source, text))


@lru_cache(maxsize=64)
def _read_text(scenario: str, wanted: tuple[str, ...], source: str, text: str) -> FileDistribution | FittedDistribution:
    """Return the distribution of a text. It is kept: a file has some 100 refits, an environment is made often."""
    return _read(scenario, wanted, source, parse_json_object(text, f"Base distribution {source}"))


def _read(
    scenario: str, wanted: tuple[str, ...], source: str, data: Mapping[str, Any]
) -> FileDistribution | FittedDistribution:
    """Return the distribution of a file, a fitted one if the file says what it was fitted to."""
    names = data.get("names")
    if names != list(wanted):
        raise ValueError(
            f"Base distribution {source} does not fit {scenario}: "
            f"expected names {list(wanted)} in this order, got {names}."
        )
    try:
        if any(key in data for key in FITTED_KEYS):
            return FittedDistribution.from_dict(data)
        return read_distribution(data)
    except ValueError as error:
        raise ValueError(f"Base distribution {source}: {error}") from None


def _fit_to(scenario: Scenario, source: str, distribution: FileDistribution | FittedDistribution) -> Distribution:
    """Return the distribution as one of a scenario, with its size and range checked."""
    columns = len(scenario.column_parameters)
    if distribution.dim != columns:
        raise ValueError(
            f"Base distribution {source} does not fit {scenario.name}: "
            f"expected {columns} columns, got {distribution.dim}."
        )
    for p, low, high in zip(scenario.column_parameters, distribution.low, distribution.high, strict=True):
        if low < p.low or high > p.high:
            raise ValueError(
                f"Base distribution {source} gives {p.name} the range [{low:g}, {high:g}] {p.unit}; {scenario.name} "
                f"allows [{p.low:g}, {p.high:g}]."
            )
    if isinstance(distribution, FittedDistribution):
        return replace(distribution, siblings=partial(load_base, scenario))
    return distribution


def _check_object(scenario: Scenario, base: object) -> Distribution:
    # an object of the user's: the message says which it lacks
    missing = [name for name in DISTRIBUTION_METHODS if not callable(getattr(base, name, None))]
    if missing:
        raise ValueError(
            f"A base distribution must be one of {', '.join(scenario.bases)}, a path to a JSON file, or an "
            f"object with {', '.join(DISTRIBUTION_METHODS)}; got {type(base).__name__} without "
            f"{', '.join(missing)}."
        )
    distribution = cast(Distribution, base)
    box = scenario.column_parameters
    draws = np.asarray(distribution.sample(_TRIAL_DRAWS, np.random.default_rng(0)), dtype=np.float64)
    wrong = f"Base distribution {type(base).__name__} does not fit {scenario.name}: "
    if draws.shape != (_TRIAL_DRAWS, len(box)):
        raise ValueError(
            f"{wrong}sample({_TRIAL_DRAWS}, rng) must have shape ({_TRIAL_DRAWS}, {len(box)}), one column for each "
            f"of {', '.join(p.name for p in box)}; got {draws.shape}."
        )
    for p, column in zip(box, draws.T, strict=True):
        if not ((column >= p.low) & (column <= p.high)).all():  # NaN is outside too
            raise ValueError(f"{wrong}it draws {p.name} outside [{p.low:g}, {p.high:g}] {p.unit}; truncate it.")
    return distribution


_DRAWS = 8
"""Episodes of the trial."""
_DT = 0.1
"""Its tick [s], the default of environments."""


def try_scenario(scenario: Scenario) -> None:
    """Start a few episodes and move the vehicles around the ego by one tick, by the script and by commands."""
    for name in scenario.bases:
        load_base(scenario, name)
    x = torch.from_numpy(load_base(scenario).sample(_DRAWS, np.random.default_rng(0))).float()
    n = scenario.vehicles
    state = scenario.initial(x)
    if not isinstance(state, State):
        raise ValueError(
            f"Scenario {scenario.name!r}: expected initial(x) to give a State, got {type(state).__name__}."
        )
    _check(scenario, "initial(x)", state[:4], n)
    if len(state.theta) != _DRAWS:
        raise ValueError(
            f"Scenario {scenario.name!r}: expected theta of {_DRAWS} rows, got {tuple(state.theta.shape)}."
        )
    _check(scenario, "others(state, dt)", scenario.others(state, _DT), n - 1)
    action = torch.zeros_like(state.x[:, 1:, None]).expand(-1, -1, 2)
    _check(scenario, "driven(state, action, dt)", scenario.driven(state, action, _DT), n - 1)


def _check(scenario: Scenario, what: str, fields: tuple[Tensor, ...], vehicles: int) -> None:
    """Check that fields are tensors (B, vehicles) of finite numbers."""
    if not isinstance(fields, tuple) or not all(isinstance(field, Tensor) for field in fields[:4]) or len(fields) < 4:
        raise ValueError(
            f"Scenario {scenario.name!r}: expected {what} to give x, y, heading and speed, as State or Others; "
            f"got {fields!r}."
        )
    for name, field in zip(State._fields, fields, strict=False):
        if field.shape != (_DRAWS, vehicles):
            raise ValueError(
                f"Scenario {scenario.name!r}: expected {name} of shape (B, {vehicles}) from {what}, got "
                f"{tuple(field.shape)} for B = {_DRAWS}."
            )
        if not bool(torch.isfinite(field).all()):
            raise ValueError(f"Scenario {scenario.name!r}: {name} from {what} is not finite.")
