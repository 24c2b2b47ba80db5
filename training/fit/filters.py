"""Filters of events: columns of events files, and the conditions on events that a traffic model is fitted to."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import csv

from rare_envs.distributions.events import EventCounts
from rare_envs.distributions.space import Parameter
from rare_envs.files import open_ordinary
from rare_envs.scenarios.registry import find_scenario
from samplers.problem import FloatArray
from training.data.events import ANSWERS


@dataclass(frozen=True)
class EventRecipe:
    """Columns and filters of the events of a scenario."""

    file: str
    columns: tuple[str, ...]
    """Columns in the order of the scenario's parameters."""
    apart: tuple[str, ...] = ()
    """Last of the columns, if they are fitted separately: independent of the others, from events of their own."""
    required: tuple[str, ...] = ()
    """Columns of truth values that must hold for the columns fitted separately."""
    excluded: tuple[str, ...] = ()
    """Columns of truth values that must not hold for any column."""
    answers: tuple[str, ...] = ()
    """Columns of what was recorded after an event, which nothing is fitted to."""
    where: Mapping[str, Any] = field(default_factory=dict)
    """Values of other columns in the rows that are events, such as phase: start."""
    cluster: tuple[str, ...] = ("recording", "frame")
    """Columns whose values together name the cluster of an event; frames count in windows of `CLUSTER_FRAMES`."""

    @property
    def joint(self) -> tuple[str, ...]:
        """The columns that are fitted together."""
        return self.columns[: len(self.columns) - len(self.apart)]


@dataclass(frozen=True)
class EventSet:
    """Usable events of a scenario, columns in the order of its parameters.

    Example:
        >>> EventSet(np.array([[12.0, 11.0, 15.0], [14.0, 12.0, 20.0]]), clusters=np.array([0, 0])).counts.clusters
        1
    """

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
    answers: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    """What was recorded after each event of the columns fitted together, (n, b); NaN if it was not."""

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
        where={"phase": "start"},
        answers=ANSWERS,
    ),
    "hard_brake": EventRecipe("hard_brake_events.csv", ("speed", "gap", "peak", "loss")),
}
"""Recipes by scenario."""
EVENT_DEFINITIONS = {
    "car_following": "a vehicle in the picture gets a new leader, which it follows for 2 s or more",
    "cut_in": "a vehicle changes into the lane ahead of another, gaps within the ranges of the scenario",
    "hard_brake": "the vehicle ahead brakes by 3 m/s or more, to a standstill or not",
}
"""What is counted as an event of a scenario."""
FILTER_REASONS = {
    "missing": "no ego behind or no lead ahead was recorded, so the parameter has no value",
    "not at_entry": "the pair was there when the ego came into the picture: following under way, no new leader",
    "start_seen": "the track began during the lane change: speeds and gaps are valid, but the vehicle had "
    "already moved across",
    "m/s": "outside the physical range of speeds",
    "m": "outside the physical range: gaps below it are side by side or errors of position and "
    "length, gaps above it no longer concern the ego",
    "loss": "less than a braking loses, or more speed than there is",
    "m/s^2": "outside the physical range of decelerations",
    "duration is given": "start or end of the lane change was not recorded",
    "duration": "shorter than tyres allow, or so long that the vehicle drifted rather than changed",
    "lateral_offset": "bodies that overlap across (errors of lane position, or an ego far from its "
    "lane's centre), or more than one lane apart",
}
"""Reasons of filters, by kind of filter, unit of the parameter, or its name."""


LEAST_SPREAD, FEW_EVENTS = 1e-3, 3
"""Share of a parameter's range that the standard deviation of its events reaches if the parameter varies, and number of
events below which it is not looked at: these are too few for any fit."""
LEAST_ACCEPTED_GAP = 1.0
"""Least gap behind of a cutter who looked [m]: as that of `CutIn-v0`."""


def recorded_parameters(scenario: str, least_gap: float = LEAST_ACCEPTED_GAP) -> tuple[Parameter, ...]:
    """Return the parameters of a scenario that are recorded: of cut-ins the first seven, with a least gap behind."""
    found = find_scenario(scenario)
    if found.name != "cut_in":
        return tuple(found.parameters)
    return tuple(replace(p, low=least_gap) if p.name == "cut_in_gap" else p for p in found.parameters[:7])


def read_csv_columns(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return columns of a CSV file; a ValueError if it cannot be read or lacks one."""
    try:
        with open_ordinary(path) as file:
            table = csv.read_csv(file)
    except (OSError, ValueError) as error:
        raise ValueError(f"Cannot read events from {path}: {error}.") from None
    if missing := [name for name in names if name not in table.column_names]:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}.")
    return {name: table[name].to_numpy() for name in names}


def read_events(path: Path, recipe: EventRecipe) -> dict[str, NDArray[Any]]:
    """Return the columns of an events file, numbers as float64 with NaN if a value is missing."""
    others = (*recipe.required, *recipe.excluded, *recipe.where, *recipe.cluster)
    numbers = (*recipe.columns, *recipe.answers)
    events = read_csv_columns(path, (*numbers, *others))
    return events | {name: np.asarray(events[name], dtype=np.float64) for name in numbers}


Rule = tuple[str, str, NDArray[np.bool_]]
"""Words of a filter, its reason, and which events pass, shape (n,)."""


def range_rule(column: str, values: FloatArray, p: Parameter, reason: str = "") -> Rule:
    """Return the rule that values (n,) lie within the range of a parameter."""
    reason = reason or FILTER_REASONS.get(p.name) or FILTER_REASONS[p.unit]
    return f"{p.low:g} <= {column} <= {p.high:g} {p.unit}", reason, (values >= p.low) & (values <= p.high)


def drop_events(keep: NDArray[np.bool_], rules: Iterable[Rule], columns: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Clear `keep` (n,) where a rule does not pass; return what each dropped of those before it, and how many stay."""
    log: list[dict[str, Any]] = []
    for rule, reason, passes in rules:
        log.append({"rule": rule, "reason": reason, "dropped": int((keep & ~passes).sum())})
        keep &= passes
    return [*log, {"rule": "events used", **({"columns": [*columns]} if columns else {}), "events": int(keep.sum())}]


def filter_events(events: Mapping[str, NDArray[Any]], recipe: EventRecipe, box: Sequence[Parameter]) -> EventSet:
    """Return the usable events of columns by name, for parameters in a box, and what each filter dropped."""

    def usual_rules(columns: Sequence[str], ranges: Sequence[Parameter]) -> Iterator[Rule]:
        for column in columns:
            given = f"{column} is given"
            yield given, FILTER_REASONS.get(given, FILTER_REASONS["missing"]), ~np.isnan(events[column])
        for column, p in zip(columns, ranges, strict=False):
            yield range_rule(column, events[column], p)

    def flag_rules(columns: Sequence[str], words: str, wanted: bool) -> Iterator[Rule]:
        for column in columns:
            yield f"{words}{column}", FILTER_REASONS[f"{words}{column}"], events[column].astype(bool) == wanted

    joint = recipe.joint
    keep = np.ones(len(events[joint[0]]), dtype=bool)
    for column, value in recipe.where.items():
        keep &= events[column] == value
    log = [{"rule": "events read", "events": int(keep.sum())}]
    log += drop_events(keep, [*flag_rules(recipe.excluded, "not ", False), *usual_rules(joint, box)], joint)
    points, clusters = _table_of(events, joint, keep), _number_clusters(events, recipe)[keep]
    answers = _table_of(events, recipe.answers, keep)
    if recipe.apart:
        rules = [*flag_rules(recipe.required, "", True), *usual_rules(recipe.apart, box[len(joint) :])]
        log += drop_events(keep, rules, recipe.apart)
    word = "scene" if recipe.cluster == ("scene",) else "half-minute"
    return EventSet(points, clusters, _table_of(events, recipe.apart, keep), word, tuple(log), answers)


class NoSpread(ValueError):
    """A parameter has nearly one value in all events, so that no density can be fitted."""


def find_constant(x: FloatArray, box: Sequence[Parameter]) -> int | None:
    """Return the first column of events (n, d) that varies by less than `LEAST_SPREAD`; None if there is none."""
    size = np.array([p.high - p.low for p in box[: x.shape[1]]])
    if len(x) < FEW_EVENTS:
        return None
    flat = np.flatnonzero(x.std(axis=0) < LEAST_SPREAD * size)
    return int(flat[0]) if len(flat) else None


def check_spread(x: FloatArray, box: Sequence[Parameter]) -> None:
    """Raise a `NoSpread` that names a parameter with nearly one value in all events (n, d)."""
    which = find_constant(x, box)
    if which is not None:
        p, value = box[which], x[:, which].mean()
        raise NoSpread(
            f"{p.name} is {value:.4g} {p.unit} in nearly all of {len(x):,} events (standard deviation "
            f"{x[:, which].std():.1g}), expected one of {LEAST_SPREAD * (p.high - p.low):.1g} or more: check this "
            "column and its unit in the recordings, add recordings in which it varies, or choose scenarios by "
            "--scenario."
        )


def _table_of(events: Mapping[str, NDArray[Any]], columns: Sequence[str], keep: NDArray[np.bool_]) -> FloatArray:
    """Return columns of the kept events side by side, shape (n, d)."""
    return np.array([events[column][keep] for column in columns]).reshape(len(columns), int(keep.sum())).T


def _number_clusters(events: Mapping[str, NDArray[Any]], recipe: EventRecipe) -> NDArray[np.int64]:
    """Return the number of the cluster of each event, shape (n,)."""
    values = [events[name] // CLUSTER_FRAMES if name == "frame" else events[name] for name in recipe.cluster]
    labels = [np.unique(column, return_inverse=True)[1].ravel() for column in values]
    return np.asarray(np.unique(np.column_stack(labels), axis=0, return_inverse=True)[1].ravel(), dtype=np.int64)
