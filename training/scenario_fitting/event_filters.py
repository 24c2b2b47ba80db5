"""Filters of events: columns of events files, and the conditions on events that a base distribution is fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import ArrowInvalid, csv

from rare_envs.distributions.space import Parameter
from samplers.problem import FloatArray


@dataclass(frozen=True)
class EventRecipe:
    """Columns and filters of the events of a scenario.

    Example:
        >>> EventRecipe("pairs.csv", ("v_ego", "v_lead", "gap")).apart
        ()
    """

    file: str
    columns: tuple[str, ...]
    """Columns in the order of the scenario's parameters."""
    apart: tuple[str, ...] = ()
    """Last of the columns, if they are fitted separately: independent of the others, from events of their own."""
    required: tuple[str, ...] = ()
    """Columns of truth values that must hold for the columns fitted separately."""
    logarithmic: tuple[str, ...] = ()
    """Columns whose logarithms are fitted."""
    phase: str | None = None
    """Value of the column `phase` in the rows that are used; None where the file has no such column."""


EVENT_RECIPES = {
    "car_following": EventRecipe("us101_car_following_events.csv", ("v_ego", "v_lead", "gap")),
    "cut_in": EventRecipe(
        "us101_cut_in_events.csv",
        ("v_ego", "v_cutin", "v_lead", "gap_ego_cutin", "gap_cutin_lead", "lateral_offset"),
        apart=("lateral_offset",),
        required=("start_seen",),
        # So few events allow one component only, and a normal distribution is not skewed as gaps are: fitted to plain
        # gaps it has a BIC 63 higher, a quarter of its mass outside the box, and gaps that were never recorded.
        logarithmic=("gap_ego_cutin", "gap_cutin_lead"),
        phase="start",
    ),
}
"""Recipes by scenario."""
FILTER_REASONS = {
    "missing": "no ego behind or no lead ahead was recorded, so the parameter has no value",
    "start_seen": "the track began during the lane change: speeds and gaps are as good as any, but the vehicle had "
    "already moved across",
    "m/s": "outside the physical range of speeds",
    "m": "outside the physical range: gaps below it are side by side or errors of position and "
    "length, gaps above it no longer concern the ego",
    "lateral_offset": "bodies that overlap across (errors of lane position, or an ego far from its "
    "lane's centre), or more than one lane apart",
}
"""Reasons of filters, by kind of filter, unit of the parameter, or its name."""


def read_events(path: Path, recipe: EventRecipe) -> dict[str, NDArray[Any]]:
    """Return the columns of an events file, numbers as float64 with NaN where a value is missing.

    Raises:
        ValueError: The file cannot be read or lacks a column.
    """
    try:
        table = csv.read_csv(path)
    except (OSError, ArrowInvalid) as error:
        raise ValueError(f"Cannot read events from {path}: {error}.") from None
    wanted = (*recipe.columns, *recipe.required, *(("phase",) if recipe.phase else ()))
    missing = [name for name in wanted if name not in table.column_names]
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}.")
    numbers = {name: table[name].cast("float64").to_numpy() for name in recipe.columns}
    return numbers | {name: table[name].to_numpy() for name in wanted[len(recipe.columns) :]}


def filter_events(
    events: Mapping[str, NDArray[Any]], recipe: EventRecipe, box: Sequence[Parameter]
) -> tuple[tuple[FloatArray, FloatArray], list[dict[str, Any]]]:
    """Return the usable events, and a record of what each filter dropped.

    Args:
        events: Columns of an events file.
        recipe: Columns and filters.
        box: Parameters of the scenario with their ranges.

    Returns:
        Events of the joint columns, shape (n, d - a), and of the a columns fitted separately, shape (m, a); and per
        filter its rule, its reason and the number of events it dropped of those that passed the filters before. The
        filters of the separate columns come last.
    """
    keep = np.ones(len(events[recipe.columns[0]]), dtype=bool)
    if recipe.phase is not None:
        keep &= events["phase"] == recipe.phase
    log: list[dict[str, Any]] = [{"rule": "events read", "events": int(keep.sum())}]

    def apply(rule: str, reason: str, passes: NDArray[np.bool_]) -> None:
        dropped = int((keep & ~passes).sum())
        log.append({"rule": rule, "reason": reason, "dropped": dropped})
        np.logical_and(keep, passes, out=keep)

    def apply_range(column: str, p: Parameter) -> None:
        inside = (events[column] >= p.low) & (events[column] <= p.high)
        reason = FILTER_REASONS.get(p.name, FILTER_REASONS[p.unit])
        apply(f"{p.low:g} <= {column} <= {p.high:g} {p.unit}", reason, inside)

    joint = recipe.columns[: len(recipe.columns) - len(recipe.apart)]
    for column in recipe.columns:
        apply(f"{column} is given", FILTER_REASONS["missing"], ~np.isnan(events[column]))
    for column, p in zip(joint, box, strict=False):
        apply_range(column, p)
    log.append({"rule": "events used", "columns": list(joint), "events": int(keep.sum())})
    together = np.column_stack([events[column][keep] for column in joint])
    for column in recipe.required:
        apply(column, FILTER_REASONS[column], events[column].astype(bool))
    for column, p in zip(recipe.apart, box[len(joint) :], strict=True):
        apply_range(column, p)
    if recipe.apart:
        log.append({"rule": "events used", "columns": list(recipe.apart), "events": int(keep.sum())})
    own = np.empty((int(keep.sum()), len(recipe.apart)))
    for j, column in enumerate(recipe.apart):
        own[:, j] = events[column][keep]
    return (together, own), log
