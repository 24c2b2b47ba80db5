"""Whole rollouts of the scripted scenarios with the IDM as ego: scenarios to f, by the loops that suit them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rare_envs.compilation import single
from rare_envs.control.idm import IDM
from rare_envs.scenarios.cut_in import CUTTER_IDM
from rare_envs.simulation.compiled.equations import IDMNumbers, RoadNumbers
from rare_envs.simulation.compiled.rollouts import SingleArray, drive_behind_lead, drive_cut_in
from rare_envs.simulation.compiled.rows_side_by_side import (
    CutterRows,
    EgoRows,
    LeadRows,
    can_stand_side_by_side,
    drive_behind_leads,
    drive_cut_ins,
    make_rows,
)
from rare_envs.traffic.road import Road

LEAST_ROWS = 12
"""Fewer are sooner driven one after the other; f has the same bits."""


def drive_by_idm(script: str, x: NDArray[np.float64], ego: IDM, road: Road, dt: float, ticks: int) -> SingleArray:
    """Return f of scenarios, shape (B,).

    Args:
        script: "car_following", "cut_in" or "hard_brake".
        x: Scenarios within the physical box, shape (B, d).
        ego: Its parameters.
        road: A straight road with equal lanes.
        dt: Tick [s].
        ticks: Length of an episode.
    """
    columns = np.ascontiguousarray(x.T, dtype=np.float32)
    idm, numbers, (tick,) = IDMNumbers.of(ego), RoadNumbers.of(road), single(dt)
    f: SingleArray = np.empty(len(x), dtype=np.float32)
    if script == "cut_in":
        cutter_idm = IDMNumbers.of(CUTTER_IDM)
        arguments = (columns, idm, cutter_idm, numbers, tick, ticks, f)
        if len(x) >= LEAST_ROWS and can_stand_side_by_side(idm, cutter_idm, road=numbers):
            drive_cut_ins(*arguments, make_rows(EgoRows), make_rows(CutterRows), make_rows(LeadRows))
        else:
            drive_cut_in(*arguments)
        return f
    if script == "car_following":
        ego_speed, lead_speed, gap = columns
        acceleration = np.zeros_like(gap)
    else:
        ego_speed, gap, deceleration = columns
        lead_speed, acceleration = ego_speed, -deceleration
    pairs = (ego_speed, lead_speed, gap, acceleration, idm, numbers, tick, ticks, f)
    if len(x) >= LEAST_ROWS and can_stand_side_by_side(idm, road=numbers):
        drive_behind_leads(*pairs, make_rows(EgoRows), make_rows(LeadRows))
    else:
        drive_behind_lead(*pairs)
    return f
