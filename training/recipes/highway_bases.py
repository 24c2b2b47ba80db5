"""Base distributions `highway`: free-flow traffic, assembled from published statistics, not fitted.

Naturalistic free-flow data (highD) may not be passed on, and nothing is fitted to them here. Their published summary
numbers determine the means. Spreads and correlations, which those summaries do not give, are chosen such that the
IDM ego collides with a probability between 1e-4 and 1e-3 (as in Tian et al. 2024, who fitted mixtures to highD).
Each number below says which of the two it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rare_envs.distributions.coordinates import CoordinateKind, Coordinates
from rare_envs.distributions.fitted import read_distribution
from rare_envs.distributions.mixture import CoordinateMixture, TruncatedGaussianMixture
from rare_envs.scenarios.registry import scenario_named
from samplers.problem import FloatArray
from training.data.table import read_columns
from training.fit.base import check_predictions, mass_outside

STATE_TICKS = 100
"""Ticks between two states: 10 s, after which gap and closing speed are nearly independent."""
CIRCLES_FILE = "i24_circles_following.parquet"
HIGHWAY_BASES = ("car_following", "rare_envs/CutIn-v0", "rare_envs/CutIn-v1")
"""Scenarios that have one."""
CAR_SPEED = 30.0
"""Speed of cars [m/s], published for highD."""
TRUCK_SPEED = 24.0
"""Speed of trucks [m/s], published for highD."""
CHANGE_DURATION = 6.28
"""Mean duration of a lane change [s], published for 16 commuters."""
PUBLISHED_DURATION = {
    "a lane change takes 6.28 s in the mean": "7,192 single lane changes of 16 commuters "
    "(Lee, Olsen, Wierwille, DOT HS 809 702, 2004)",
}
"""Provenance of the duration of a cut-in."""
PROVENANCE: dict[str, Any] = {
    "kind": "assembled from published statistics and stated choices, NOT fitted to data",
    "published": {
        "cars drive at about 30 m/s, trucks at about 24 m/s": "summary statistics of highD "
        "(Krajewski, Bock, Kloeker, Eckstein, ITSC 2018), as commonly quoted, not recomputed",
        "the mode of the time headway is about 1 to 1.5 s": "same",
        "a motorway lane is about 3.75 m wide": "German design standards",
        "an IDM ego collides with a probability of the order of 1e-4": "Tian et al. 2024, on mixtures fitted to highD",
    },
    "chosen": "component weights, standard deviations, correlations, the mean gaps of cut-ins: so "
    "that the IDM ego's collision probability is between 1e-4 and 1e-3",
}
"""Provenance of both files."""


@dataclass(frozen=True)
class TrafficSituation:
    """One kind of situation: a Gaussian given by weight, means, standard deviations and correlations."""

    meaning: str
    weight: float
    mean: tuple[float, ...]
    deviation: tuple[float, ...]
    correlation: Mapping[tuple[int, int], float]
    """Correlations of pairs of parameters, by their numbers; others are 0."""

    def covariance(self) -> FloatArray:
        """Return the covariance matrix, shape (d, d)."""
        correlation = np.eye(len(self.mean))
        for (i, j), value in self.correlation.items():
            correlation[i, j] = correlation[j, i] = value
        return np.asarray(np.outer(self.deviation, self.deviation) * correlation, dtype=np.float64)


def _following_correlation(speeds: float) -> dict[tuple[int, int], float]:
    """Return correlations of car following: the two speeds go together, and a gap grows a little with both."""
    return {(0, 1): speeds, (0, 2): 0.2, (1, 2): 0.2}


def _cut_in_correlation(speeds: float) -> dict[tuple[int, int], float]:
    """Return correlations of cut-ins: the three speeds go together, and a fast ego has a little more room."""
    return {(0, 1): speeds, (0, 2): speeds, (1, 2): speeds, (0, 3): 0.2}


SITUATIONS: dict[str, tuple[TrafficSituation, ...]] = {
    # ego_speed, lead_speed, gap: 38 m at 30 m/s is a headway of 1.27 s, in the published mode;
    # 75 m (2.5 s) stands for the long tail; trucks keep 40 m (1.67 s).
    "car_following": (
        TrafficSituation(
            "car behind car, close",
            0.45,
            (CAR_SPEED, CAR_SPEED, 38.0),
            (3.5, 3.5, 14.0),
            _following_correlation(0.6),
        ),
        TrafficSituation(
            "car behind car, loose",
            0.25,
            (CAR_SPEED, CAR_SPEED, 75.0),
            (3.5, 3.5, 25.0),
            _following_correlation(0.6),
        ),
        TrafficSituation(
            "truck behind truck",
            0.2,
            (TRUCK_SPEED, TRUCK_SPEED, 40.0),
            (1.5, 1.5, 14.0),
            _following_correlation(0.8),
        ),
        TrafficSituation(
            "car closing on a truck",
            0.1,
            (28.0, TRUCK_SPEED, 45.0),
            (2.5, 1.5, 16.0),
            _following_correlation(0.5),
        ),
    ),
    # ego_speed, cut_in_speed, lead_speed, cut_in_gap, lead_gap, lateral_offset, duration: 30 m at 30 m/s is
    # a headway of 1 s, 45 m one of 1.5 s: the ends of the published mode. CutIn-v0 has no duration.
    "cut_in": (
        TrafficSituation(
            "car changes lane between cars",
            0.6,
            (CAR_SPEED, CAR_SPEED, 31.0, 30.0, 40.0, 3.75, CHANGE_DURATION),
            (3.0, 3.0, 3.0, 12.0, 18.0, 0.3, 2.0),
            _cut_in_correlation(0.6),
        ),
        TrafficSituation(
            "slower car pulls out to overtake",
            0.4,
            (CAR_SPEED, 26.0, 28.0, 45.0, 45.0, 3.75, CHANGE_DURATION),
            (3.0, 2.5, 2.5, 16.0, 18.0, 0.3, 2.0),
            _cut_in_correlation(0.6),
        ),
    ),
}
"""Situations of each scenario, the components of its mixture."""


def build_highway_base(scenario: str) -> dict[str, Any]:
    """Return the entries of the assembled base of a scenario, by short name or id, its provenance included."""
    components, box = SITUATIONS[scenario_named(scenario).name], scenario_named(scenario).parameters
    d = len(box)
    low, high = np.array([p.low for p in box]), np.array([p.high for p in box])
    arrays = (
        np.array([component.weight for component in components]),
        np.array([component.mean[:d] for component in components]),
        np.array([component.covariance()[:d, :d] for component in components]),
    )
    kinds: list[CoordinateKind] = ["plain" for _ in box]
    plain = Coordinates(low, high, tuple(kinds))
    published = {**PROVENANCE["published"], **(PUBLISHED_DURATION if box[-1].name == "duration" else {})}
    provenance = {
        **PROVENANCE,
        "published": published,
        "components": [component.meaning for component in components],
        "mass_outside_box": mass_outside(CoordinateMixture(plain, *arrays)),
    }
    return {**TruncatedGaussianMixture(*arrays, low, high).to_dict(), "provenance": provenance}


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
