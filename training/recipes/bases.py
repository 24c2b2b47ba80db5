"""Bases of the package, from compact tables of recorded traffic (docs/data.md).

    rare-envs fit --data DIR --out rare_envs/data

Their names say the site, and behind a hyphen in what they differ from the one that the events support best: `us101-gap`
(plain gaps) is a test distribution near the p of Tian et al., `us101-15-offsets` has lateral offsets from 15 events,
`i80-all-pairs` has pairs that were under way too. What a file says in words (source, licence, moment of x) and the
frequencies that others counted stand in the file itself; a new fit keeps them.

Rates of recordings that were picked for lane changes are never used: the scenes of US 101 show 42 changes per
vehicle-hour, the complete recording 11. Offset and duration of a lane change belong together (correlation of .36 and
.42 of displacement and log duration), and go with neither the speed nor the gap ahead, so that they are fitted apart.
The positions of US 101 were smoothed at 0.35 Hz, which makes short changes longer: courses of 2, 3, 4 and 5 s over 3 m
look like ones of 3.1, 3.6, 4.3 and 5.1 s.

`highway` is free-flow traffic, assembled and not fitted, and its files are their own source: naturalistic data (highD)
may not be passed on. Means are published: cars drive 30 m/s and trucks 24, headways have their mode at 1 to 1.5 s (38 m
at 30 m/s is 1.27 s), a lane change takes 6.28 s. Spreads and correlations are chosen such that the IDM ego collides
with a probability between 1e-4 and 1e-3, as in Tian et al. 2024, who fitted mixtures to highD.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.events import EventFrequency
from rare_envs.distributions.fitted import join_independent
from rare_envs.distributions.stratified import CutNormals
from rare_envs.scenarios.registry import find_scenario
from rare_envs.traffic.state import VEHICLE_LENGTH
from samplers.problem import FloatArray
from training.data.events import (
    ANSWERS,
    braking_exposure,
    course_durations,
    find_brakings,
    measure_answers,
    time_around_peak,
    time_between_spans,
)
from training.data.table import DT, NOBODY, SCENES_FILE, VEHICLES_FILE, read_columns
from training.fit.base import fit_base, format_base
from training.fit.coordinates import COORDINATE_SYSTEMS
from training.fit.filters import (
    CLUSTER_FRAMES,
    EVENT_RECIPES,
    FILTER_REASONS,
    EventRecipe,
    EventSet,
    Rule,
    drop_events,
    filter_events,
    range_rule,
    read_csv_columns,
    read_events,
    recorded_parameters,
)
from training.fit.strata import (
    ATTITUDES,
    NEAR_IF_UNSEEN,
    Neighbours,
    find_neighbours,
    keep_neighbours,
)

COMMAND = "rare-envs fit --data DIR --out rare_envs/data"
FOLLOWING, CUT_IN_V0, CUT_IN_V1, BRAKING = "car_following", "rare_envs/CutIn-v0", "rare_envs/CutIn-v1", "hard_brake"
TEST_KIND = "test distribution: cutters as nobody drives, of gaps that drivers refuse too; fitted to recorded events"
CIRCLES_FILE, PROFILES_FILE = "i24_circles_following.parquet", "lane_change_profiles.parquet"
CHANGES_FILE = "us101_lane_changes.csv"
COIFMAN_FILE = "i80_coifman.parquet"
US101_LANES, I80_LANES = 5, 6
"""Lanes of the main road."""
MIN_LANE_TIME = 3.0
"""Least time in one lane on either side of a change of a single vehicle on US 101 [s]."""
MIN_JUMP, JUMP_TICKS, LEAST_PAUSE = 6.0, 3, 20
"""Change of the gap [m] within so many ticks that shows another leader, and least ticks between two."""
SETTLING_TICKS, STEADY_TICKS, MAX_STEP = 8, 10, 2.0
"""Ticks from a jump to the values that are taken, as the radar takes up its new target; ticks after these in which the
gap changes by at most so much in one [m]."""
MOST_VEHICLES, TICK_MS = 10**6, 100
"""Numbers of vehicles are below; milliseconds of a tick."""
NO_LEADER = 252.0
"""Gap that stands for nobody ahead [m]."""

PAIRS = ("v_ego", "v_lead", "gap")
CUT_INS = ("v_ego", "v_cutin", "v_lead", "gap_ego_cutin", "gap_cutin_lead")
US101_PAIRS = EventRecipe("us101_car_following_events.csv", PAIRS, cluster=("scene",))
I80_PAIRS = EventRecipe("i80_coifman_pairs.csv", PAIRS, cluster=("frame",))
US101_CUT_INS = EventRecipe("us101_cut_in_events.csv", CUT_INS, where={"phase": "start"}, cluster=("scene",))
I80_CUT_INS = EventRecipe(
    "i80_coifman_lane_changes.csv", CUT_INS, where={"phase": "start", "settled": True}, cluster=("frame",)
)
US101_OFFSETS = replace(
    US101_CUT_INS, columns=(*CUT_INS, "lateral_offset"), apart=("lateral_offset",), required=("start_seen",)
)

Read = tuple[EventSet, dict[str, Any]]
"""Usable events, and what was counted of their frequency."""


@dataclass(frozen=True)
class ShippedBase:
    """A base of the package that is fitted to recorded events."""

    scenario: str
    """Short name, or environment id where its scenario has several versions."""
    name: str
    events: EventRecipe | Callable[[Path], Read]
    """Columns and filters of a file in the folder of compact tables, or a function that reads them from it."""
    answers: Callable[[Path], FloatArray] | None = None
    """What reads how ego and cutter went on from each row of that file, (rows, 4), see `ANSWERS`."""
    changes: str | None = None
    """Site whose lane changes have the columns apart."""
    system: str | None = None
    """Name of its coordinate system; None for the one that the events support best."""
    test: bool = False
    """Whether it is a base of `CutIn-v1` without strata, whose cutters refuse no gap."""

    @property
    def file(self) -> str:
        """Name of its file in the package."""
        return Path(str(find_scenario(self.scenario).bases[self.name])).name

    def read(self, folder: Path) -> Read:
        """Return its events from the folder of compact tables."""
        if not isinstance(self.events, EventRecipe):
            return self.events(folder)
        box, recipe = recorded_parameters(self.scenario), self.events
        columns = read_events(folder / recipe.file, recipe)
        if self.answers:
            recipe = replace(recipe, answers=ANSWERS)
            columns |= dict(zip(ANSWERS, self.answers(folder).T, strict=True))
        events = filter_events(columns, recipe, box)
        if self.changes:
            events = _add_changes(events, read_lane_changes(folder, self.changes), box[len(CUT_INS) :])
        return events, {}


def fit_shipped_bases(
    data: Path, scenarios: Sequence[str], seed: int = 0, n_refits: int | None = None
) -> Iterator[tuple[str, str]]:
    """Yield name and text of each file of the package for some scenarios, as soon as it is fitted."""
    for base in SHIPPED_BASES:
        if find_scenario(base.scenario).name in scenarios:
            yield base.file, fit_shipped_base(base, data, seed, n_refits)


def fit_shipped_base(base: ShippedBase, data: Path, seed: int = 0, n_refits: int | None = None) -> str:
    """Return the text of the file of a base of the package, from the folder of compact tables."""
    file: Any = find_scenario(base.scenario).bases[base.name]
    shipped = json.loads(file.read_text(encoding="utf-8"))
    source, known = shipped["provenance"]["source"], shipped["frequency"]
    events, counted = base.read(data)
    frequency = None if known is None else replace(EventFrequency(**known), **counted)
    asked: dict[str, Any] = {"frequency": frequency, "n_refits": n_refits, "seed": seed}
    stratified = base.scenario == CUT_IN_V1 and not base.test
    asked |= {"neighbours": read_neighbours(data, str(base.changes))} if stratified else {}
    fitted = fit_base(base.scenario, events, source, COMMAND, system=base.system, **asked)
    if base.test or base.scenario == CUT_IN_V0:
        fitted = replace(fitted, record={**fitted.record, "kind": TEST_KIND})
    free = np.full(ATTITUDES, np.inf)  # attitudes of cutters who refuse no gap
    whole: Any = join_independent(fitted, CutNormals(-free, free)) if base.test else fitted
    return format_base(base.scenario, whole.to_dict())


def read_neighbours(folder: Path, site: str) -> Neighbours:
    """Return neighbours at random times of a site ("us101" or "i80"), every second of scenes or every other one."""
    if site == "us101":
        rows = read_columns(folder / SCENES_FILE, ("scene", "t", "lane", "y_along", "length", "speed"))
        chosen = (rows["lane"] <= US101_LANES) & (np.round(rows["t"] / DT).astype(int) % 10 == 0)
        rows = {name: values[chosen] for name, values in rows.items()}
        front, cluster = rows["y_along"].astype(float), rows["scene"].astype(np.int64)
        moment, rear = cluster * 10_000 + np.round(rows["t"] / DT).astype(int), front - rows["length"].astype(float)
    else:
        rows = read_columns(folder / COIFMAN_FILE, ("frame", "lane", "y_rear", "length", "speed"))
        chosen = (rows["lane"] <= I80_LANES) & (rows["frame"] % 20 == 0)
        rows = {name: values[chosen] for name, values in rows.items()}
        length = rows["length"].astype(float)
        rear, moment = rows["y_rear"].astype(float), rows["frame"]
        front, cluster = rear + np.where(np.isnan(length), VEHICLE_LENGTH, length), moment // CLUSTER_FRAMES
    found, own = find_neighbours(moment, rows["lane"], rear, front, rows["speed"].astype(float))
    return keep_neighbours(CUT_IN_V1, found, np.asarray(cluster[own], dtype=np.int64), NEAR_IF_UNSEEN[site])


def _us101_answers(folder: Path) -> FloatArray:
    """Return how ego and cutter went on from each row of the table of cut-ins on US 101, (rows, 4)."""
    events = read_csv_columns(folder / US101_CUT_INS.file, ("scene", "epoch_ms", "ego", "vehicle"))
    rows = read_columns(folder / SCENES_FILE, ("scene", "vehicle", "epoch_ms", "y_along", "speed"))
    track, ego, cutter = (
        each["scene"].astype(np.int64) * MOST_VEHICLES + np.nan_to_num(each[who], nan=NOBODY).astype(np.int64)
        for each, who in ((rows, "vehicle"), (events, "ego"), (events, "vehicle"))
    )
    moments = [each["epoch_ms"] // TICK_MS for each in (rows, events)]
    return _find_answers(track, moments[0], rows["y_along"], rows["speed"], (ego, cutter), moments[1])


def _i80_answers(folder: Path) -> FloatArray:
    """Return the same of I-80."""
    events = read_csv_columns(folder / I80_CUT_INS.file, ("frame", "ego", "vehicle"))
    rows = read_columns(folder / COIFMAN_FILE, ("vehicle", "frame", "y_rear", "speed"))
    who = events["ego"], events["vehicle"]
    return _find_answers(rows["vehicle"], rows["frame"], rows["y_rear"], rows["speed"], who, events["frame"])


def _find_answers(
    track: NDArray[Any],
    moment: NDArray[Any],
    position: NDArray[Any],
    speed: NDArray[Any],
    wanted: Sequence[NDArray[Any]],
    at: NDArray[Any],
) -> FloatArray:
    """Return what follows in wanted tracks at moments [ticks], side by side, of columns of tracks in any order."""
    first, length = moment.min(), int(np.ptp(moment)) + 2
    order = np.lexsort([moment, track])
    keys = (track.astype(np.int64) * length + moment - first)[order]
    breaks = np.append(0, 1 + np.flatnonzero(np.diff(keys) != 1))
    found = []
    for who in wanted:
        key = who.astype(np.int64) * length + at - first
        place = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        row = np.where(keys[place] == key, place, NOBODY)
        found.append(measure_answers(breaks, position[order].astype(float), speed[order].astype(float), row))
    return np.hstack(found)


def _read_i24_leaders(folder: Path) -> Read:
    """Return new leaders of the instrumented car on the I-24, each the beginning of car-following, within the ranges.

    The record has the speed of the vehicle ahead on drives with radar only.
    """
    rows = read_columns(folder / CIRCLES_FILE, ("drive", "t", "speed", "gap", "rel_speed", "radar"))
    parts, drives = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)]
    for drive in np.unique(rows["drive"][rows["radar"].astype(bool)]):
        chosen = np.flatnonzero(rows["drive"] == drive)
        chosen = chosen[np.argsort(rows["t"][chosen], kind="stable")]
        parts.append(find_new_leaders(*(rows[name][chosen].astype(float) for name in ("speed", "rel_speed", "gap"))))
        drives.append(np.full(len(parts[-1]), drive, dtype=np.int64))
    events, clusters = np.concatenate(parts), np.concatenate(drives)
    box, keep = find_scenario(FOLLOWING).parameters, np.ones(len(events), dtype=bool)
    inside = np.asarray(((events >= [p.low for p in box]) & (events <= [p.high for p in box])).all(axis=1))
    rule = ("within the ranges of the scenario", "outside the physical range", inside)
    log = ({"rule": "events read", "events": len(events)}, *drop_events(keep, [rule]))
    return EventSet(events[keep], clusters[keep], cluster="drive", log=log), {}


def find_new_leaders(speed: FloatArray, relative_speed: FloatArray, gap: FloatArray) -> FloatArray:
    """Return own speed, speed ahead and gap [m/s, m/s, m] of new leaders once tracked, (n, 3), of columns (T,).

    The relative speed is that ahead less the own, NaN where it is not known; the gap is NaN if nobody is.
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


def _read_us101_brakings(folder: Path) -> Read:
    """Return brakings of single vehicles on US 101, at their beginning."""
    table = read_columns(folder / VEHICLES_FILE, ("vehicle", "frame", "epoch_ms", "y_along", "space_headway"))
    order = np.lexsort([table["frame"], table["vehicle"]])
    edges = np.flatnonzero((np.diff(table["vehicle"][order]) != 0) | (np.diff(table["frame"][order]) != 1)) + 1
    tracks = np.split(order, edges)
    positions = [table["y_along"][track] for track in tracks]
    parts, frames = [], []
    for track, position in zip(tracks, positions, strict=True):
        events, onsets = find_brakings(position, table["space_headway"][track] - VEHICLE_LENGTH)
        parts.append(events)
        frames.append(table["epoch_ms"][track][onsets] // 100)
    recipe = replace(EVENT_RECIPES[BRAKING], cluster=("frame",))  # stop waves brake one vehicle after the other
    columns = dict(zip(recipe.columns, np.concatenate(parts).T, strict=True))
    found = filter_events({"frame": np.concatenate(frames), **columns}, recipe, recorded_parameters(BRAKING))
    # Without columns apart nothing is drawn for them, so that the refits stay those of the published file.
    found = replace(found, apart=np.empty((0, 0)))
    seconds, metres = braking_exposure(positions)
    return found, {"count": len(found.joint), "hours": round(seconds / 3600.0, 3), "km": round(metres / 1000.0, 1)}


def read_lane_changes(folder: Path, site: str) -> FloatArray:
    """Return displacement [m] and duration [s] of the recorded lane changes of a site ("i80" or "us101"), shape (n, 2).

    One table for each site, since two of US 101 may hold the same changes: of I-80 the 165 changes that were smoothed
    and cut out by their author, of US 101 the 302 of single vehicles that stay 3 s or more in one lane on either side.
    The displacement is that of the changing vehicle, of US 101 between 4 s before and after the crossing, 3 s where the
    track is shorter. NaN if a value is not known.
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


def _add_changes(events: EventSet, changes: FloatArray, box: Sequence[Any]) -> EventSet:
    """Return events with the columns apart, lateral offset and perhaps duration, from lane changes (n, 2)."""
    rules: list[Rule] = []
    log: list[dict[str, Any]] = []
    if len(box) == 1:  # a displacement that is not known was no change of the table
        changes = changes[~np.isnan(changes[:, 0]), :1]
    else:
        log.append({"rule": "lane changes read", "events": len(changes)})
        reason = "start or end of the change was not recorded, or it ended where it began"
        rules.append(("displacement and duration are given", reason, np.asarray(np.isfinite(changes).all(axis=1))))
    reasons = ("bodies that overlap across, or more than one lane apart", FILTER_REASONS["duration"])
    for j, (name, p) in enumerate(zip(("displacement", "duration"), box, strict=False)):
        rules.append(range_rule(name, changes[:, j], p, reasons[j]))
    keep = np.ones(len(changes), dtype=bool)
    log += drop_events(keep, rules, [p.name for p in box])
    return replace(events, apart=changes[keep], log=(*events.log, *log))


_CLOSING = COORDINATE_SYSTEMS["cut_in"][2].name
CUT_IN_SITES = (("us101", US101_CUT_INS, _us101_answers), ("i80", I80_CUT_INS, _i80_answers))
SHIPPED_BASES = (
    ShippedBase(FOLLOWING, "us101", US101_PAIRS),
    ShippedBase(FOLLOWING, "us101-gap", US101_PAIRS, system="plain"),
    ShippedBase(FOLLOWING, "us101-log-gap", US101_PAIRS, system="log gap"),
    ShippedBase(FOLLOWING, "i80", replace(I80_PAIRS, excluded=("at_entry",))),
    ShippedBase(FOLLOWING, "i80-all-pairs", I80_PAIRS),
    ShippedBase(FOLLOWING, "i24", _read_i24_leaders),
    *(ShippedBase(CUT_IN_V1, site, recipe, answers, site) for site, recipe, answers in CUT_IN_SITES),
    ShippedBase(CUT_IN_V1, "us101-test", US101_CUT_INS, changes="us101", test=True),
    *(
        ShippedBase(CUT_IN_V0, site + ending, recipe, None, site, system)
        for site, recipe, _ in CUT_IN_SITES
        for ending, system in (("", None), ("-closing", _CLOSING))
    ),
    ShippedBase(CUT_IN_V0, "us101-15-offsets", US101_OFFSETS, system="log gaps"),
    ShippedBase(BRAKING, "us101", _read_us101_brakings),
)
"""Bases of the package that are fitted to recorded events."""
