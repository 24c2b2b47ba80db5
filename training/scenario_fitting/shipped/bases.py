"""Events of the shipped bases: how they are read, where they come from, how often they happen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.fitted import EventFrequency
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.registry import env_id_of, scenario_named, split_version
from samplers.problem import FloatArray
from training.data.brakings import find_standstill_brakings
from training.scenario_fitting.coordinate_systems import COORDINATE_SYSTEMS
from training.scenario_fitting.event_filters import (
    EVENT_RECIPES,
    EventRecipe,
    EventSet,
    filter_events,
    read_events,
)
from training.scenario_fitting.shipped.brakings import load_brakings
from training.scenario_fitting.shipped.cut_ins import (
    CUT_IN_V0,
    CUT_IN_V1,
    read_i80_cut_ins,
    read_i80_timed_cut_ins,
    read_us101_cut_ins,
    read_us101_cut_ins_alone,
    read_us101_timed_cut_ins,
)
from training.scenario_fitting.shipped.frequencies import NEW_LEADERS_I24, NEW_LEADERS_I80, braking_frequency
from training.scenario_fitting.shipped.new_leaders import load_new_leaders

Reader = Callable[[Path], tuple[EventSet, EventFrequency | None]]

PAIRS = ("v_ego", "v_lead", "gap")
I80_PAIRS_FILE = "i80_coifman_pairs.csv"
NGSIM_LICENCE = (
    "CC BY-SA 3.0 (as the data's public record was reported); these parameters are derived from the data and are "
    "offered under the same licence"
)
US101_SOURCE = MappingProxyType(
    {
        "site": "US 101, Los Angeles, 07:50, congested",
        "date": "15 June 2005",
        "data": "Next Generation Simulation (NGSIM) Vehicle Trajectories and Supporting Data, US 101 "
        "(Los Angeles, southbound, 15 June 2005), record 8ect-6jqj",
        "publisher": "U.S. Department of Transportation, Federal Highway Administration (FHWA)",
        "licence": NGSIM_LICENCE,
        "changes": "events extracted from the trajectories, filtered as listed, fitted with a mixture",
    }
)
I80_SOURCE = MappingProxyType(
    {
        "site": "I-80, Emeryville, 16:00, congested",
        "date": "13 April 2005",
        "data": "the data set from Coifman and Li (2017): A Critical Evaluation of the Next Generation Simulation "
        "(NGSIM) Vehicle Trajectory Dataset, Transportation Research Part B 105, 2017, 362-377 (13 April 2005)",
        "publisher": "B. Coifman, L. Li, Ohio State University",
        "licence": "none stated; citation asked for. Parameters only",
        "changes": US101_SOURCE["changes"],
    }
)
I24_SOURCE = MappingProxyType(
    {
        "site": "I-24, Nashville, rush hours, 27 m/s in the median",
        "date": "March and April 2021",
        "data": "CIRCLES, one instrumented car with radar, 26 drives of March and April 2021 "
        "(doi 10.5281/zenodo.6366761)",
        "publisher": "CIRCLES consortium",
        "licence": "none seen; citation asked for. Parameters only",
        "changes": US101_SOURCE["changes"],
    }
)


@dataclass(frozen=True)
class ShippedBase:
    """A base of the package that is fitted to recorded events."""

    scenario: str
    """Short name, or environment id where its scenario has several versions."""
    name: str
    read: Reader
    """Reads its events from the folder of compact tables, and how often they happen."""
    source: MappingProxyType[str, str]
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
    """Return the name of the file of a base in the package, with the version of its scenario if that is not the first.

    Example:
        >>> name_file("rare_envs/CutIn-v0", "us101"), name_file("rare_envs/CutIn-v1", "i80-closing")
        ('cut_in_us101.json', 'cut_in_v1_i80_closing.json')
    """
    version = split_version(env_id_of(scenario))[1]
    parts = (scenario_named(scenario).name, *([f"v{version}"] if version else []), base.replace("-", "_"))
    return "_".join(parts) + ".json"


def _box(scenario: str) -> tuple[Parameter, ...]:
    return tuple(scenario_named(scenario).parameters)


def read_us101_pairs(folder: Path) -> tuple[EventSet, None]:
    """Return pairs of the scenes of US 101 at their first frame; 76 % are the ego's entry into the picture."""
    recipe = EventRecipe("us101_car_following_events.csv", PAIRS, cluster=("scene",))
    return filter_events(read_events(folder / recipe.file, recipe), recipe, _box("car_following")), None


def read_i80_new_leaders(folder: Path) -> tuple[EventSet, EventFrequency]:
    """Return pairs of the I-80 that begin in the picture, at their first frame."""
    recipe = replace(EVENT_RECIPES["car_following"], file=I80_PAIRS_FILE, cluster=("frame",))
    events = filter_events(read_events(folder / recipe.file, recipe), recipe, _box("car_following"))
    return events, NEW_LEADERS_I80


def read_i80_pairs(folder: Path) -> tuple[EventSet, None]:
    """Return all pairs of the I-80 at their first frame; 93 % are the ego's entry into the picture."""
    recipe = EventRecipe(I80_PAIRS_FILE, PAIRS, cluster=("frame",))
    return filter_events(read_events(folder / recipe.file, recipe), recipe, _box("car_following")), None


def read_i24_pairs(folder: Path) -> tuple[EventSet, EventFrequency]:
    """Return new leaders of the instrumented car on the I-24, within the box of the scenario."""
    events, drives = load_new_leaders(folder)
    return _within_box("car_following", events, drives, "drive"), NEW_LEADERS_I24


def read_us101_brakings(folder: Path) -> tuple[EventSet, EventFrequency]:
    """Return brakings to a standstill of single vehicles on US 101, at their beginning."""
    brakings = load_brakings(folder, find_standstill_brakings)
    recipe = replace(EVENT_RECIPES["hard_brake"], cluster=("frame",))  # stop waves brake one vehicle after the other
    rows = {"frame": brakings.frames, **dict(zip(recipe.columns, brakings.events.T, strict=True))}
    # Without columns apart nothing is drawn for them, so that the refits stay those of the published file.
    events = replace(filter_events(rows, recipe, _box("hard_brake")), apart=np.empty((0, 0)))
    source = "NGSIM, US 101, 370 vehicles over 640 m each, counted on the vehicles themselves"
    return events, braking_frequency(len(events.joint), round(brakings.hours, 3), round(brakings.km, 1), source)


def _within_box(scenario: str, events: FloatArray, clusters: NDArray[np.int64], cluster: str) -> EventSet:
    """Return the events within the ranges of the scenario, and the count of those that are not."""
    inside = np.ones(len(events), dtype=bool)
    for column, p in zip(events.T, _box(scenario), strict=True):
        inside &= (column >= p.low) & (column <= p.high)
    log = (
        {"rule": "events read", "events": len(events)},
        {
            "rule": "within the ranges of the scenario",
            "reason": "outside the physical range",
            "dropped": int((~inside).sum()),
        },
        {"rule": "events used", "events": int(inside.sum())},
    )
    return EventSet(events[inside], clusters[inside], cluster=cluster, log=log)


CLOSING_GAPS = COORDINATE_SYSTEMS["cut_in"][2].name
FIRST_FRAME = "first frame of the pair"
US101_PAIRS = MappingProxyType(
    {
        **US101_SOURCE,
        "no_frequency": "most of its pairs (76 %) were under way when the ego came into the picture and are no events "
        "of traffic, and the scenes were picked for lane changes, so that the new leaders among them cannot be counted",
    }
)
I80_PAIRS = MappingProxyType(
    {
        **I80_SOURCE,
        "no_frequency": "most of its pairs (93 %) were under way when the ego came into the picture and are no events "
        "of traffic; the base 'i80' has the new leaders among them",
    }
)
CHANGE_STARTS = "start of the lane change"
BEFORE_CROSSING = "1.3 s before the crossing"
SHIPPED_BASES = (
    ShippedBase("car_following", "us101", read_us101_pairs, US101_PAIRS, FIRST_FRAME),
    ShippedBase("car_following", "us101-gap", read_us101_pairs, US101_PAIRS, FIRST_FRAME, system="plain"),
    ShippedBase("car_following", "us101-log-gap", read_us101_pairs, US101_PAIRS, FIRST_FRAME, system="log gap"),
    ShippedBase("car_following", "i80", read_i80_new_leaders, I80_SOURCE, FIRST_FRAME),
    ShippedBase("car_following", "i80-all-pairs", read_i80_pairs, I80_PAIRS, FIRST_FRAME),
    ShippedBase("car_following", "i24", read_i24_pairs, I24_SOURCE, "0.8 s after the gap began to jump"),
    ShippedBase(CUT_IN_V1, "us101", read_us101_timed_cut_ins, US101_SOURCE, CHANGE_STARTS),
    ShippedBase(CUT_IN_V1, "us101-closing", read_us101_timed_cut_ins, US101_SOURCE, CHANGE_STARTS, system=CLOSING_GAPS),
    ShippedBase(CUT_IN_V1, "i80", read_i80_timed_cut_ins, I80_SOURCE, BEFORE_CROSSING),
    ShippedBase(CUT_IN_V1, "i80-closing", read_i80_timed_cut_ins, I80_SOURCE, BEFORE_CROSSING, system=CLOSING_GAPS),
    ShippedBase(CUT_IN_V0, "us101", read_us101_cut_ins, US101_SOURCE, CHANGE_STARTS),
    ShippedBase(CUT_IN_V0, "us101-closing", read_us101_cut_ins, US101_SOURCE, CHANGE_STARTS, system=CLOSING_GAPS),
    ShippedBase(
        CUT_IN_V0, "us101-15-offsets", read_us101_cut_ins_alone, US101_SOURCE, CHANGE_STARTS, system="log gaps"
    ),
    ShippedBase(CUT_IN_V0, "i80", read_i80_cut_ins, I80_SOURCE, BEFORE_CROSSING),
    ShippedBase(CUT_IN_V0, "i80-closing", read_i80_cut_ins, I80_SOURCE, BEFORE_CROSSING, system=CLOSING_GAPS),
    ShippedBase("hard_brake", "us101", read_us101_brakings, US101_SOURCE, "beginning of the braking"),
)
"""Bases of the package that are fitted to recorded events.

Their names say the site, and behind a hyphen in what they differ from the one that the events support best: `us101-gap`
(plain gaps) is a test distribution near the p of Tian et al., `us101-15-offsets` has lateral offsets from 15 events,
`i80-all-pairs` has pairs that were under way too.
"""
