"""Filters of events: columns of events files, and the conditions on events that a base distribution is fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import ArrowInvalid, csv

from rare_envs.distributions.fitted import EventCounts
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
    excluded: tuple[str, ...] = ()
    """Columns of truth values that must not hold for any column."""
    phase: str | None = None
    """Value of the column `phase` in the rows that are used; None where the file has no such column."""
    cluster: tuple[str, ...] = ("recording", "frame")
    """Columns whose values together name the cluster of an event; frames count in windows of `CLUSTER_FRAMES`."""

    @property
    def joint(self) -> tuple[str, ...]:
        """The columns that are fitted together."""
        return self.columns[: len(self.columns) - len(self.apart)]


@dataclass(frozen=True)
class EventSet:
    """Usable events of a scenario, columns in the order of its parameters."""

    joint: FloatArray
    """Columns that are fitted together, shape (n, d - a)."""
    clusters: NDArray[np.int64]
    """Number of the cluster of each event, shape (n,): events of one scene or window of time depend on each other."""
    apart: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    """The last columns, independent of the others and from m events of their own, shape (m, a)."""
    cluster: str = "half-minute"
    """Word for a cluster."""
    log: tuple[Mapping[str, Any], ...] = ()
    """What each filter dropped, see `filter_events`."""

    @property
    def counts(self) -> EventCounts:
        """Numbers of events and of clusters."""
        used = (len(self.joint), len(self.apart)) if self.apart.shape[1] else (len(self.joint),)
        return EventCounts(used=used, clusters=len(np.unique(self.clusters)), cluster=self.cluster)


CLUSTER_FRAMES = 300
"""Frames of a window of time whose events form a cluster: 30 s."""
EVENT_RECIPES = {
    "car_following": EventRecipe("car_following_events.csv", ("v_ego", "v_lead", "gap"), excluded=("at_entry",)),
    "cut_in": EventRecipe(
        "cut_in_events.csv",
        ("v_ego", "v_cutin", "v_lead", "gap_ego_cutin", "gap_cutin_lead", "lateral_offset", "duration"),
        apart=("lateral_offset", "duration"),
        required=("start_seen",),
        phase="start",
    ),
    "hard_brake": EventRecipe("hard_brake_events.csv", ("speed", "gap", "deceleration")),
}
"""Recipes by scenario."""
EVENT_DEFINITIONS = {
    "car_following": "a vehicle in the picture gets a new leader, which it follows for 2 s or more",
    "cut_in": "a vehicle changes into the lane ahead of another, gaps within the ranges of the scenario",
    "hard_brake": "the vehicle ahead brakes by 3 m/s or more, to less than 1 m/s",
}
"""What is counted as an event of a scenario."""
FILTER_REASONS = {
    "missing": "no ego behind or no lead ahead was recorded, so the parameter has no value",
    "not at_entry": "the pair was there when the ego came into the picture: following under way, no new leader",
    "start_seen": "the track began during the lane change: speeds and gaps are as good as any, but the vehicle had "
    "already moved across",
    "m/s": "outside the physical range of speeds",
    "m": "outside the physical range: gaps below it are side by side or errors of position and "
    "length, gaps above it no longer concern the ego",
    "m/s^2": "outside the physical range of decelerations",
    "duration is given": "start or end of the lane change was not recorded",
    "duration": "shorter than tyres allow, or so long that the vehicle drifted rather than changed",
    "lateral_offset": "bodies that overlap across (errors of lane position, or an ego far from its "
    "lane's centre), or more than one lane apart",
}
"""Reasons of filters, by kind of filter, unit of the parameter, or its name."""


def read_csv_columns(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return columns of a CSV file.

    Raises:
        ValueError: The file cannot be read or lacks a column.
    """
    try:
        table = csv.read_csv(path)
    except (OSError, ArrowInvalid) as error:
        raise ValueError(f"Cannot read events from {path}: {error}.") from None
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}.")
    return {name: table[name].to_numpy() for name in names}


def read_events(path: Path, recipe: EventRecipe) -> dict[str, NDArray[Any]]:
    """Return the columns of an events file, numbers as float64 with NaN where a value is missing.

    Raises:
        ValueError: The file cannot be read or lacks a column.
    """
    others = (*recipe.required, *recipe.excluded, *(("phase",) if recipe.phase else ()), *recipe.cluster)
    events = read_csv_columns(path, (*recipe.columns, *others))
    return events | {name: np.asarray(events[name], dtype=np.float64) for name in recipe.columns}


def filter_events(events: Mapping[str, NDArray[Any]], recipe: EventRecipe, box: Sequence[Parameter]) -> EventSet:
    """Return the usable events, with a record of what each filter dropped.

    Args:
        events: Columns of an events file.
        recipe: Columns and filters.
        box: Parameters of the scenario with their ranges.

    Returns:
        The events; `log` has per filter its rule, its reason and the number of events it dropped of those that passed
        the filters before. The filters of the separate columns come last.
    """
    keep = np.ones(len(events[recipe.columns[0]]), dtype=bool)
    if recipe.phase is not None:
        keep &= events["phase"] == recipe.phase
    log: list[dict[str, Any]] = [{"rule": "events read", "events": int(keep.sum())}]

    def apply(rule: str, reason: str, passes: NDArray[np.bool_]) -> None:
        dropped = int((keep & ~passes).sum())
        log.append({"rule": rule, "reason": reason, "dropped": dropped})
        np.logical_and(keep, passes, out=keep)

    def apply_given(column: str) -> None:
        rule = f"{column} is given"
        apply(rule, FILTER_REASONS.get(rule, FILTER_REASONS["missing"]), ~np.isnan(events[column]))

    def apply_range(column: str, p: Parameter) -> None:
        inside = (events[column] >= p.low) & (events[column] <= p.high)
        reason = FILTER_REASONS[p.name if p.name in FILTER_REASONS else p.unit]
        apply(f"{p.low:g} <= {column} <= {p.high:g} {p.unit}", reason, inside)

    for column in recipe.excluded:
        apply(f"not {column}", FILTER_REASONS[f"not {column}"], ~events[column].astype(bool))
    for column in recipe.joint:
        apply_given(column)
    for column, p in zip(recipe.joint, box, strict=False):
        apply_range(column, p)
    log.append({"rule": "events used", "columns": list(recipe.joint), "events": int(keep.sum())})
    joint, clusters = (
        np.column_stack([events[column][keep] for column in recipe.joint]),
        number_clusters(events, recipe),
    )
    clusters = clusters[keep]
    for column in recipe.required:
        apply(column, FILTER_REASONS[column], events[column].astype(bool))
    for column in recipe.apart:
        apply_given(column)
    for column, p in zip(recipe.apart, box[len(recipe.joint) :], strict=False):
        apply_range(column, p)
    if recipe.apart:
        log.append({"rule": "events used", "columns": list(recipe.apart), "events": int(keep.sum())})
    apart = np.empty((int(keep.sum()), len(recipe.apart)))
    for j, column in enumerate(recipe.apart):
        apart[:, j] = events[column][keep]
    word = "scene" if recipe.cluster == ("scene",) else "half-minute"
    return EventSet(joint, clusters, apart, word, tuple(log))


def number_clusters(events: Mapping[str, NDArray[Any]], recipe: EventRecipe) -> NDArray[np.int64]:
    """Return the number of the cluster of each event, shape (n,)."""
    labels = []
    for column in recipe.cluster:
        values = events[column] // CLUSTER_FRAMES if column == "frame" else events[column]
        labels.append(np.unique(values, return_inverse=True)[1].ravel())
    clusters: NDArray[np.int64] = np.unique(np.column_stack(labels), axis=0, return_inverse=True)[1].ravel()
    return clusters
