"""Cut-ins of the shipped bases: speeds and gaps of some events, lateral offset and duration of more of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.fitted import EventFrequency
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.registry import scenario_named
from samplers.problem import FloatArray
from training.scenario_fitting.event_filters import (
    FILTER_REASONS,
    EventRecipe,
    EventSet,
    filter_events,
    read_csv_columns,
    read_events,
)
from training.scenario_fitting.shipped.frequencies import CUT_INS_I80, CUT_INS_US101
from training.scenario_fitting.shipped.lane_change_shapes import lane_change_shapes
from training.scenario_fitting.shipped.lateral_offsets import lateral_offsets

CUT_IN_V0, CUT_IN_V1 = "rare_envs/CutIn-v0", "rare_envs/CutIn-v1"
BOX_V0, BOX_V1 = scenario_named(CUT_IN_V0).parameters, scenario_named(CUT_IN_V1).parameters
CUT_INS = ("v_ego", "v_cutin", "v_lead", "gap_ego_cutin", "gap_cutin_lead")
SHAPE_REASON = "start or end of the change was not recorded, or it ended where it began"
OFFSET_REASON = "bodies that overlap across, or more than one lane apart"


def read_us101_cut_ins(folder: Path) -> tuple[EventSet, EventFrequency]:
    """Return cut-ins of the scenes of US 101 at the start of the lane change, with lateral offsets."""
    return _with_offsets(_us101_cut_ins(folder), folder, "us101"), CUT_INS_US101


def read_us101_timed_cut_ins(folder: Path) -> tuple[EventSet, EventFrequency]:
    """Return the same with lateral offsets and durations."""
    return _with_shapes(_us101_cut_ins(folder), folder, "us101"), CUT_INS_US101


def _us101_cut_ins(folder: Path) -> EventSet:
    """Return cut-ins of the scenes of US 101 without the columns that are fitted apart."""
    recipe = EventRecipe("us101_cut_in_events.csv", CUT_INS, phase="start", cluster=("scene",))
    return filter_events(read_events(folder / recipe.file, recipe), recipe, BOX_V0)


def read_us101_cut_ins_alone(folder: Path) -> tuple[EventSet, EventFrequency]:
    """Return cut-ins of the scenes of US 101, with the lateral offsets of the 15 whose start was seen."""
    recipe = EventRecipe(
        "us101_cut_in_events.csv",
        (*CUT_INS, "lateral_offset"),
        apart=("lateral_offset",),
        required=("start_seen",),
        phase="start",
        cluster=("scene",),
    )
    return filter_events(read_events(folder / recipe.file, recipe), recipe, BOX_V0), CUT_INS_US101


def read_i80_cut_ins(folder: Path) -> tuple[EventSet, EventFrequency]:
    """Return settled cut-ins of the I-80, 1.3 s before the crossing, the mean start of those on US 101.

    With lateral offsets.
    """
    return _with_offsets(_i80_cut_ins(folder), folder, "i80"), CUT_INS_I80


def read_i80_timed_cut_ins(folder: Path) -> tuple[EventSet, EventFrequency]:
    """Return the same with lateral offsets and durations."""
    return _with_shapes(_i80_cut_ins(folder), folder, "i80"), CUT_INS_I80


def _i80_cut_ins(folder: Path) -> EventSet:
    """Return settled cut-ins of the I-80 without the columns that are fitted apart."""
    recipe = EventRecipe("i80_coifman_lane_changes.csv", CUT_INS, phase="start", cluster=("frame",))
    rows = read_events(folder / recipe.file, recipe)
    settled = read_csv_columns(folder / recipe.file, ("settled",))["settled"].astype(bool)
    return filter_events({name: values[settled] for name, values in rows.items()}, recipe, BOX_V0)


def _with_offsets(events: EventSet, folder: Path, site: str) -> EventSet:
    """Return events with lateral offsets from the profiles of lane changes of the site."""
    offset = BOX_V0[-1]
    displacements = lateral_offsets(folder, site)
    apart = displacements[(displacements >= offset.low) & (displacements <= offset.high)]
    rules = (
        {
            "rule": f"{offset.low:g} <= displacement <= {offset.high:g} m",
            "reason": OFFSET_REASON,
            "dropped": len(displacements) - len(apart),
        },
        {"rule": "events used", "columns": ["lateral_offset"], "events": len(apart)},
    )
    return replace(events, apart=apart[:, None], log=(*events.log, *rules))


def _with_shapes(events: EventSet, folder: Path, site: str) -> EventSet:
    """Return events with lateral offsets and durations from the profiles of lane changes of the site."""
    offset, duration = BOX_V1[-2:]
    shapes = lane_change_shapes(folder, site)
    keep = np.ones(len(shapes), dtype=bool)
    rules: list[dict[str, Any]] = [{"rule": "lane changes read", "events": len(shapes)}]
    for rule, reason, passes in (
        ("displacement and duration are given", SHAPE_REASON, np.isfinite(shapes).all(axis=1)),
        (_name_range("displacement", offset), OFFSET_REASON, _inside(shapes[:, 0], offset)),
        (_name_range("duration", duration), FILTER_REASONS["duration"], _inside(shapes[:, 1], duration)),
    ):
        rules.append({"rule": rule, "reason": reason, "dropped": int((keep & ~passes).sum())})
        keep &= passes
    rules.append({"rule": "events used", "columns": ["lateral_offset", "duration"], "events": int(keep.sum())})
    return replace(events, apart=shapes[keep], log=(*events.log, *rules))


def _name_range(column: str, p: Parameter) -> str:
    """Return the rule that a column is within the range of a parameter."""
    return f"{p.low:g} <= {column} <= {p.high:g} {p.unit}"


def _inside(values: FloatArray, p: Parameter) -> NDArray[np.bool_]:
    """Return which values are within the range of a parameter."""
    return np.asarray((values >= p.low) & (values <= p.high))
