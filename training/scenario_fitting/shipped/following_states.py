"""States of following in the record of one instrumented car, which the assembled `highway` base is checked against."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rare_envs.distributions.fitted import read_distribution
from rare_envs.scenarios.registry import scenario_named
from samplers.problem import FloatArray
from training.data.table import read_columns
from training.scenario_fitting.predictive_checks import check_predictions
from training.scenario_fitting.shipped.new_leaders import CIRCLES_FILE

STATE_TICKS = 100
"""Ticks between two states: 10 s, after which gap and closing speed are nearly independent."""


def load_following_states(folder: Path) -> FloatArray:
    """Return own speed, speed ahead and gap [m/s, m/s, m] every `STATE_TICKS` of the drives with radar, shape (n, 3).

    States outside the ranges of car-following are left out.

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    rows = read_columns(folder / CIRCLES_FILE, ("t", "speed", "gap", "rel_speed", "radar"))
    chosen = rows["radar"].astype(bool) & (np.round(10.0 * rows["t"]).astype(np.int64) % STATE_TICKS == 0)
    speed, gap, relative = (rows[name][chosen].astype(float) for name in ("speed", "gap", "rel_speed"))
    states = np.column_stack([speed, speed + relative, gap])
    box = scenario_named("car_following").parameters
    low, high = np.array([p.low for p in box]), np.array([p.high for p in box])
    return np.asarray(states[((states >= low) & (states <= high)).all(axis=1)])  # NaN is in no range


def check_against_following(content: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return an assembled base of car-following with predictive checks against the recorded states in its provenance.

    Args:
        content: Entries of the base.
        folder: Folder of the compact tables.

    Raises:
        ValueError: The file is missing or lacks a column.
    """
    states = load_following_states(folder)
    names = [p.name for p in scenario_named("car_following").parameters]
    checks = check_predictions("car_following", names, states, read_distribution(content))
    provenance = {
        **content["provenance"],
        "checked_against": f"{len(states):,} states of following on I-24, {STATE_TICKS // 10} s apart, by radar",
        "checks": [{"name": each.name, "recorded": each.recorded, "expected": each.expected} for each in checks],
    }
    return {**content, "provenance": provenance}
