"""Bases of the package, from compact tables of recorded traffic (docs/data.md).

    rare-envs fit --data DIR --out rare_envs/data

Their names say the site, and behind a hyphen in what they differ from the one that the events support best: `us101-gap`
(plain gaps) is a test distribution near the p of Tian et al., `us101-15-offsets` has lateral offsets from 15 events,
`i80-all-pairs` has pairs that were under way too.

Rates of recordings that were picked for lane changes are never used: the scenes of US 101 show 42 changes per
vehicle-hour, the complete recording 11. Offset and duration of a lane change belong together (correlation of .36 and
.42 of displacement and log duration), and go with neither the speed nor the gap ahead, so that they are fitted apart.
The positions of US 101 were smoothed at 0.35 Hz, which makes short changes longer: courses of 2, 3, 4 and 5 s over 3 m
look like ones of 3.1, 3.6, 4.3 and 5.1 s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.fitted import EventFrequency
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.registry import env_id_of, scenario_named, split_version
from rare_envs.traffic.state import VEHICLE_LENGTH
from samplers.problem import FloatArray
from training.data.brakings import find_standstill_brakings, track_exposure
from training.data.events import course_durations, time_around_peak, time_between_spans
from training.data.table import DT, VEHICLES_FILE, read_columns
from training.fit.base import FitRequest, fit_base, format_base
from training.fit.coordinates import COORDINATE_SYSTEMS
from training.fit.filters import (
    EVENT_DEFINITIONS,
    EVENT_RECIPES,
    FILTER_REASONS,
    EventRecipe,
    EventSet,
    filter_events,
    read_csv_columns,
    read_events,
)
from training.recipes.highway_bases import CIRCLES_FILE, HIGHWAY_BASES, build_highway_base, check_against_following

COMMAND = "rare-envs fit --data DIR --out rare_envs/data"
FOLLOWING, BRAKING = "car_following", "hard_brake"
CUT_IN_V0, CUT_IN_V1 = "rare_envs/CutIn-v0", "rare_envs/CutIn-v1"
PAIRS = ("v_ego", "v_lead", "gap")
CUT_INS = ("v_ego", "v_cutin", "v_lead", "gap_ego_cutin", "gap_cutin_lead")
I80_PAIRS_FILE = "i80_coifman_pairs.csv"
PROFILES_FILE, CHANGES_FILE = "lane_change_profiles.parquet", "us101_lane_changes.csv"
MIN_LANE_TIME = 3.0
"""Least time in one lane on either side of a change of a single vehicle on US 101 [s]."""
MIN_JUMP, JUMP_TICKS, LEAST_PAUSE = 6.0, 3, 20
"""Change of the gap [m] within so many ticks that shows another leader, and least ticks between two."""
SETTLING_TICKS, STEADY_TICKS, MAX_STEP = 8, 10, 2.0
"""Ticks from a jump to the values that are taken, as the radar takes up its new target; ticks after these in which the
gap changes by at most so much in one [m]."""
NO_LEADER = 252.0
"""Gap that stands for nobody ahead [m]."""

_CHANGES = "events extracted from the trajectories, filtered as listed, fitted with a mixture"
US101_SOURCE = {
    "site": "US 101, Los Angeles, 07:50, congested",
    "date": "15 June 2005",
    "data": "Next Generation Simulation (NGSIM) Vehicle Trajectories and Supporting Data, US 101 "
    "(Los Angeles, southbound, 15 June 2005), record 8ect-6jqj",
    "publisher": "U.S. Department of Transportation, Federal Highway Administration (FHWA)",
    "licence": "CC BY-SA 3.0 (as the data's public record was reported); these parameters are derived from the data "
    "and are offered under the same licence",
    "changes": _CHANGES,
}
I80_SOURCE = {
    "site": "I-80, Emeryville, 16:00, congested",
    "date": "13 April 2005",
    "data": "the data set from Coifman and Li (2017): A Critical Evaluation of the Next Generation Simulation "
    "(NGSIM) Vehicle Trajectory Dataset, Transportation Research Part B 105, 2017, 362-377 (13 April 2005)",
    "publisher": "B. Coifman, L. Li, Ohio State University",
    "licence": "none stated; citation asked for. Parameters only",
    "changes": _CHANGES,
}
I24_SOURCE = {
    "site": "I-24, Nashville, rush hours, 27 m/s in the median",
    "date": "March and April 2021",
    "data": "CIRCLES, one instrumented car with radar, 26 drives of March and April 2021 (doi 10.5281/zenodo.6366761)",
    "publisher": "CIRCLES consortium",
    "licence": "none seen; citation asked for. Parameters only",
    "changes": _CHANGES,
}
US101_PAIRS = {
    **US101_SOURCE,
    "no_frequency": "most of its pairs (76 %) were under way when the ego came into the picture and are no events "
    "of traffic, and the scenes were picked for lane changes, so that the new leaders among them cannot be counted",
}
I80_PAIRS = {
    **I80_SOURCE,
    "no_frequency": "most of its pairs (93 %) were under way when the ego came into the picture and are no events "
    "of traffic; the base 'i80' has the new leaders among them",
}
_COUNTS = (
    "wein2004/lane-change-externality, outputs/tables/02_detection_summary.md: complete NGSIM recordings; lane changes "
    "with a follower in the new lane, stable for 3 s"
)
_COIFMAN = "Coifman and Li 2017, I-80, 16:00, every vehicle of one camera"
NEW_LEADERS_I80 = EventFrequency(
    count=153,
    hours=5.98,
    km=169.7,
    share=152 / 153,
    share_events=153,
    definition=EVENT_DEFINITIONS[FOLLOWING],
    source=_COIFMAN,
)
NEW_LEADERS_I24 = EventFrequency(
    count=123,
    hours=3.87,
    km=336.8,
    share=98 / 123,
    share_events=123,
    definition="the gap to the vehicle ahead jumps by 6 m or more within 0.3 s and a leader is tracked after it",
    source="CIRCLES, one instrumented car on I-24, 60 drives of 2021 (doi 10.5281/zenodo.6366761); the 26 drives with "
    "radar, which the events come from",
)
CUT_INS_US101 = EventFrequency(
    count=1221,
    hours=112.0,
    km=3900.0,
    share=38 / 46,
    share_events=46,
    definition=EVENT_DEFINITIONS["cut_in"],
    source=f"{_COUNTS}; the share with both gaps in range from 46 recorded changes with a follower",
)
CUT_INS_I80 = EventFrequency(
    count=1693,
    hours=122.5,
    km=2860.0,
    share=63 / 77,
    share_events=77,
    definition=EVENT_DEFINITIONS["cut_in"],
    source=f"{_COUNTS}; the share with both gaps in range from 77 changes with a follower, at the crossing: "
    f"1.3 s before it fewer of them are within the picture ({_COIFMAN})",
)

Read = tuple[EventSet, EventFrequency | None]


@dataclass(frozen=True)
class ShippedBase:
    """A base of the package that is fitted to recorded events."""

    scenario: str
    """Short name, or environment id where its scenario has several versions."""
    name: str
    read: Callable[[Path], Read]
    """Reads its events from the folder of compact tables, and how often they happen."""
    source: Mapping[str, str]
    """Site, data, publisher, licence and changes."""
    moment: str
    """Moment of an event at which x is taken."""
    system: str | None = None
    """Name of its coordinate system; None for the one that the events support best."""

    @property
    def file(self) -> str:
        """Name of its file in the package."""
        return name_file(self.scenario, self.name)


def name_file(scenario: str, base: str) -> str:
    """Return the name of the file of a base, with the version of its scenario if that is not the first."""
    version = split_version(env_id_of(scenario))[1]
    parts = (scenario_named(scenario).name, *([f"v{version}"] if version else []), base.replace("-", "_"))
    return "_".join(parts) + ".json"


def fit_shipped_bases(
    data: Path, scenarios: Sequence[str], seed: int = 0, n_refits: int | None = None
) -> Iterator[tuple[str, str]]:
    """Yield name and text of each file of the package for some scenarios, as soon as it is fitted.

    Raises:
        ValueError: A table cannot be read.
    """
    for base in SHIPPED_BASES:
        if scenario_named(base.scenario).name in scenarios:
            yield base.file, fit_shipped_base(base, data, seed, n_refits)
    for scenario in HIGHWAY_BASES:
        if scenario_named(scenario).name in scenarios:
            content = build_highway_base(scenario)
            if scenario == FOLLOWING:
                content = check_against_following(content, data)
            yield name_file(scenario, "highway"), format_base(scenario, content)


def fit_shipped_base(base: ShippedBase, data: Path, seed: int = 0, n_refits: int | None = None) -> str:
    """Return the text of the file of a base of the package, from the folder of compact tables."""
    events, frequency = base.read(data)
    source = {**base.source, "moment": base.moment}
    request = FitRequest(base.scenario, events, source, COMMAND, frequency, base.system, n_refits=n_refits, seed=seed)
    return format_base(base.scenario, fit_base(request).to_dict())


def _filter(folder: Path, recipe: EventRecipe, scenario: str) -> EventSet:
    """Return the usable events of a file of the folder."""
    return filter_events(read_events(folder / recipe.file, recipe), recipe, scenario_named(scenario).parameters)


def _us101_pairs(folder: Path) -> Read:
    """Return pairs of the scenes of US 101 at their first frame; 76 % are the ego's entry into the picture."""
    return _filter(folder, EventRecipe("us101_car_following_events.csv", PAIRS, cluster=("scene",)), FOLLOWING), None


def _i80_new_leaders(folder: Path) -> Read:
    """Return pairs of the I-80 that begin in the picture, at their first frame."""
    recipe = replace(EVENT_RECIPES[FOLLOWING], file=I80_PAIRS_FILE, cluster=("frame",))
    return _filter(folder, recipe, FOLLOWING), NEW_LEADERS_I80


def _i80_pairs(folder: Path) -> Read:
    """Return all pairs of the I-80 at their first frame; 93 % are the ego's entry into the picture."""
    return _filter(folder, EventRecipe(I80_PAIRS_FILE, PAIRS, cluster=("frame",)), FOLLOWING), None


def _i24_pairs(folder: Path) -> Read:
    """Return new leaders of the instrumented car on the I-24, within the ranges of the scenario.

    A cut-in, an own lane change and a leader that leaves the lane all give the car a new leader; each is the beginning
    of car-following. The record has the speed of the vehicle ahead on drives with radar only.
    """
    rows = read_columns(folder / CIRCLES_FILE, ("drive", "t", "speed", "gap", "rel_speed", "radar"))
    parts, drives = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)]
    for drive in np.unique(rows["drive"][rows["radar"].astype(bool)]):
        chosen = np.flatnonzero(rows["drive"] == drive)
        chosen = chosen[np.argsort(rows["t"][chosen], kind="stable")]
        parts.append(find_new_leaders(*(rows[name][chosen].astype(float) for name in ("speed", "rel_speed", "gap"))))
        drives.append(np.full(len(parts[-1]), drive, dtype=np.int64))
    events, clusters = np.concatenate(parts), np.concatenate(drives)
    box = scenario_named(FOLLOWING).parameters
    inside = np.all([_inside(column, p) for column, p in zip(events.T, box, strict=True)], axis=0)
    rule = {"rule": "within the ranges of the scenario", "reason": "outside the physical range"}
    log = (
        {"rule": "events read", "events": len(events)},
        {**rule, "dropped": int((~inside).sum())},
        {"rule": "events used", "events": int(inside.sum())},
    )
    return EventSet(events[inside], clusters[inside], cluster="drive", log=log), NEW_LEADERS_I24


def find_new_leaders(speed: FloatArray, relative_speed: FloatArray, gap: FloatArray) -> FloatArray:
    """Return the new leaders of one drive: own speed, speed ahead and gap [m/s, m/s, m] once tracked, shape (n, 3).

    Args:
        speed: Own speed at consecutive ticks [m/s], shape (T,).
        relative_speed: Speed ahead less own speed [m/s], NaN where it is not known, shape (T,).
        gap: Distance to the vehicle ahead [m], NaN where nobody is, shape (T,).
    """
    filled = np.where(np.isnan(gap), NO_LEADER, gap)
    jumps = np.abs(filled[JUMP_TICKS:] - filled[:-JUMP_TICKS]) > MIN_JUMP
    found, last = [], -LEAST_PAUSE - 1
    for onset in np.flatnonzero(jumps & ~np.append(False, jumps[:-1])).tolist():
        if onset - last <= LEAST_PAUSE:
            continue
        first, last = onset + SETTLING_TICKS, onset
        window = slice(first, first + STEADY_TICKS)
        tracked = len(filled) > window.stop and np.isfinite(gap[window] + relative_speed[window]).all()
        if tracked and np.abs(np.diff(gap[window])).max() < MAX_STEP:
            found.append((speed[first], speed[first] + relative_speed[window].mean(), gap[first]))
    return np.array(found).reshape(-1, 3)


def _us101_brakings(folder: Path) -> Read:
    """Return brakings to a standstill of single vehicles on US 101, at their beginning."""
    table = read_columns(folder / VEHICLES_FILE, ("vehicle", "frame", "epoch_ms", "y_along", "space_headway"))
    parts, frames, seconds, metres = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)], 0.0, 0.0
    for vehicle in np.unique(table["vehicle"]):
        rows = np.flatnonzero(table["vehicle"] == vehicle)
        rows = rows[np.argsort(table["frame"][rows], kind="stable")]
        for track in np.split(rows, np.flatnonzero(np.diff(table["frame"][rows]) != 1) + 1):
            position = table["y_along"][track]
            events, onsets = find_standstill_brakings(position, table["space_headway"][track] - VEHICLE_LENGTH)
            parts.append(events)
            frames.append(table["epoch_ms"][track][onsets] // 100)
            track_seconds, track_metres = track_exposure(position)
            seconds, metres = seconds + track_seconds, metres + track_metres
    recipe = replace(EVENT_RECIPES[BRAKING], cluster=("frame",))  # stop waves brake one vehicle after the other
    columns = dict(zip(recipe.columns, np.concatenate(parts).T, strict=True))
    found = filter_events({"frame": np.concatenate(frames), **columns}, recipe, scenario_named(BRAKING).parameters)
    # Without columns apart nothing is drawn for them, so that the refits stay those of the published file.
    found = replace(found, apart=np.empty((0, 0)))
    frequency = EventFrequency(
        count=len(found.joint),
        hours=round(seconds / 3600.0, 3),
        km=round(metres / 1000.0, 1),
        definition=EVENT_DEFINITIONS[BRAKING],
        source="NGSIM, US 101, 370 vehicles over 640 m each, counted on the vehicles themselves",
    )
    return found, frequency


def _us101_cut_ins(folder: Path) -> EventSet:
    """Return cut-ins of the scenes of US 101 without the columns that are fitted apart."""
    recipe = EventRecipe("us101_cut_in_events.csv", CUT_INS, phase="start", cluster=("scene",))
    return _filter(folder, recipe, CUT_IN_V0)


def _us101_cut_ins_alone(folder: Path) -> Read:
    """Return cut-ins of the scenes of US 101, with the lateral offsets of the 15 whose start was seen."""
    recipe = EventRecipe(
        "us101_cut_in_events.csv",
        (*CUT_INS, "lateral_offset"),
        apart=("lateral_offset",),
        required=("start_seen",),
        phase="start",
        cluster=("scene",),
    )
    return _filter(folder, recipe, CUT_IN_V0), CUT_INS_US101


def _i80_cut_ins(folder: Path) -> EventSet:
    """Return settled cut-ins of the I-80, 1.3 s before the crossing, the mean start of those on US 101."""
    recipe = EventRecipe("i80_coifman_lane_changes.csv", CUT_INS, phase="start", cluster=("frame",))
    rows = read_events(folder / recipe.file, recipe)
    settled = read_csv_columns(folder / recipe.file, ("settled",))["settled"].astype(bool)
    chosen = {name: values[settled] for name, values in rows.items()}
    return filter_events(chosen, recipe, scenario_named(CUT_IN_V0).parameters)


def lane_change_shapes(folder: Path, site: str) -> FloatArray:
    """Return displacement [m] and duration [s] of the recorded lane changes of a site ("i80" or "us101"), shape (n, 2).

    One table for each site, since two of US 101 may hold the same changes: of I-80 the 165 changes that were smoothed
    and cut out by their author, of US 101 the 302 of single vehicles that stay 3 s or more in one lane on either side.
    The displacement is that of the changing vehicle, of US 101 between 4 s before and after the crossing, 3 s where the
    track is shorter. NaN where a value is not known.
    """
    above, displacement = (_us101_changes if site == "us101" else _i80_changes)(folder)
    return np.column_stack([displacement, course_durations(above, displacement)])


def _i80_changes(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Return the time above the least speed across [s] and the displacement [m] of the changes of I-80."""
    rows = read_columns(folder / PROFILES_FILE, ("site", "side", "change", "t", "across", "v_across"))
    chosen = np.flatnonzero(rows["site"] == "i80")
    chosen = chosen[np.lexsort([rows[name][chosen] for name in ("t", "change", "side")])]
    side, change = rows["side"][chosen], rows["change"][chosen]
    found = []
    for profile in np.split(chosen, np.flatnonzero((side[1:] != side[:-1]) | (change[1:] != change[:-1])) + 1):
        direction = 1.0 if rows["side"][profile[0]] == "right" else -1.0
        across, speed = (direction * rows[name][profile] for name in ("across", "v_across"))
        found.append((time_around_peak(speed, rows["t"][profile]), across[-1] - across[0]))
    above, displacement = np.array(found).T
    return above, displacement


def _us101_changes(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Return the same of the settled changes of single vehicles on US 101."""
    ends = ("across_-4s", "across_+4s", "across_-3s", "across_+3s")
    seen = ("start_seen", "end_seen", "start_s", "end_s")
    rows = read_csv_columns(folder / CHANGES_FILE, ("before_s", "after_s", *seen, *ends))
    settled = (rows["before_s"] >= MIN_LANE_TIME) & (rows["after_s"] >= MIN_LANE_TIME)
    rows = {name: values[settled] for name, values in rows.items()}
    above = time_between_spans(np.round(rows["start_s"] / DT), np.round(rows["end_s"] / DT))
    above = np.where(rows["start_seen"].astype(bool) & rows["end_seen"].astype(bool), above, np.nan)
    wide, narrow = rows[ends[1]] - rows[ends[0]], rows[ends[3]] - rows[ends[2]]
    return above, np.where(np.isnan(wide), narrow, wide)


def _inside(values: FloatArray, p: Parameter) -> NDArray[np.bool_]:
    """Return which values are within the range of a parameter."""
    return np.asarray((values >= p.low) & (values <= p.high))


def _with_shapes(events: EventSet, shapes: FloatArray, columns: tuple[Parameter, ...]) -> EventSet:
    """Return events with the columns fitted apart, lateral offset and perhaps duration, from shapes of lane changes."""
    names = ("displacement", "duration")[: len(columns)]
    reasons = ("bodies that overlap across, or more than one lane apart", FILTER_REASONS["duration"])
    rules: list[dict[str, Any]] = []
    keep = np.ones(len(shapes), dtype=bool)

    def apply(rule: str, reason: str, passes: Any) -> None:
        rules.append({"rule": rule, "reason": reason, "dropped": int((keep & ~passes).sum())})
        np.logical_and(keep, passes, out=keep)

    if len(columns) == 1:  # a displacement that is not known was no change of the table
        shapes = shapes[~np.isnan(shapes[:, 0]), :1]
        keep = np.ones(len(shapes), dtype=bool)
    else:
        rules.append({"rule": "lane changes read", "events": len(shapes)})
        reason = "start or end of the change was not recorded, or it ended where it began"
        apply("displacement and duration are given", reason, np.isfinite(shapes).all(axis=1))
    for j, (name, p) in enumerate(zip(names, columns, strict=True)):
        apply(f"{p.low:g} <= {name} <= {p.high:g} {p.unit}", reasons[j], _inside(shapes[:, j], p))
    rules.append({"rule": "events used", "columns": [p.name for p in columns], "events": int(keep.sum())})
    return replace(events, apart=shapes[keep], log=(*events.log, *rules))


def _cut_ins(scenario: str, site: str) -> Callable[[Path], Read]:
    """Return the reader of cut-ins of a site, with the shapes of its lane changes."""

    def read(folder: Path) -> Read:
        events, frequency = (
            (_us101_cut_ins(folder), CUT_INS_US101) if site == "us101" else (_i80_cut_ins(folder), CUT_INS_I80)
        )
        columns = tuple(scenario_named(scenario).parameters)[len(CUT_INS) :]
        return _with_shapes(events, lane_change_shapes(folder, site), columns), frequency

    return read


_CLOSING_GAPS = COORDINATE_SYSTEMS["cut_in"][2].name
_FIRST_FRAME = "first frame of the pair"
_MOMENTS = {"us101": "start of the lane change", "i80": "1.3 s before the crossing"}


def _cut_in_bases(scenario: str) -> Iterator[ShippedBase]:
    """Yield the bases of one version of the cut-in, of each site in the best coordinates and in closing speeds."""
    for site, source in (("us101", US101_SOURCE), ("i80", I80_SOURCE)):
        read = _cut_ins(scenario, site)
        yield ShippedBase(scenario, site, read, source, _MOMENTS[site])
        yield ShippedBase(scenario, f"{site}-closing", read, source, _MOMENTS[site], _CLOSING_GAPS)


SHIPPED_BASES = (
    ShippedBase(FOLLOWING, "us101", _us101_pairs, US101_PAIRS, _FIRST_FRAME),
    ShippedBase(FOLLOWING, "us101-gap", _us101_pairs, US101_PAIRS, _FIRST_FRAME, "plain"),
    ShippedBase(FOLLOWING, "us101-log-gap", _us101_pairs, US101_PAIRS, _FIRST_FRAME, "log gap"),
    ShippedBase(FOLLOWING, "i80", _i80_new_leaders, I80_SOURCE, _FIRST_FRAME),
    ShippedBase(FOLLOWING, "i80-all-pairs", _i80_pairs, I80_PAIRS, _FIRST_FRAME),
    ShippedBase(FOLLOWING, "i24", _i24_pairs, I24_SOURCE, "0.8 s after the gap began to jump"),
    *_cut_in_bases(CUT_IN_V1),
    *_cut_in_bases(CUT_IN_V0),
    ShippedBase(CUT_IN_V0, "us101-15-offsets", _us101_cut_ins_alone, US101_SOURCE, _MOMENTS["us101"], "log gaps"),
    ShippedBase(BRAKING, "us101", _us101_brakings, US101_SOURCE, "beginning of the braking"),
)
"""Bases of the package that are fitted to recorded events."""
