"""Printed numbers of O'Kelly et al.: their tables, the ranges of their figures and their settings.

References:
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
    simulation", NeurIPS 2018, section 4.
"""

from __future__ import annotations

import math
from typing import Any

PRINTED_TABLES: dict[str, dict[str, Any]] = {
    "lidar": {
        "table": "Table 1",
        "figure": "Figure 2",
        "thresholds": [0.14, 0.15, 0.19, 0.20],
        "draws": {"naive": 1_300_000, "cross-entropy": 100_000, "naive, equal draws": 100_000},
        "rows": {
            "naive": [[12.4e-6, 3.1e-6], [80.6e-6, 7.91e-6], [133e-5, 3.2e-5], [186e-5, 3.79e-5]],
            "cross-entropy": [[19.8e-6, 8.88e-6], [66.1e-6, 15e-6], [108e-5, 9.51e-5], [164e-5, 14e-5]],
            "naive, equal draws": [[20e-6, 14.1e-6], [100e-6, 31.6e-6], [132e-5, 11.5e-5], [185e-5, 13.6e-5]],
        },
        "search": 500_000,
        "events": "3 to 10 times",
        "variance": "2 to 16 times",
    },
    "vision": {
        "table": "Table 2",
        "figure": "Figure 3",
        "thresholds": [0.22, 0.23, 0.24, 0.25],
        "draws": {"naive": 50_000, "cross-entropy": 50_000},
        "rows": {
            "naive": [[11.3e-5, 4.6e-5], [20.6e-5, 6.22e-5], [43.2e-5, 9e-5], [6.75e-4, 1.13e-4]],
            "cross-entropy": [[5.87e-5, 1.82e-5], [13.0e-5, 2.94e-5], [19.0e-5, 3.14e-5], [4.52e-4, 1.35e-4]],
        },
        "search": 20_000,
        "events": "up to 18 times",
        "variance": "lower, no number is printed",
    },
}
"""The tables by ego.

Thresholds are their gamma [s]; draws the rollouts behind each row, without those of the search, which their table
leaves out; a row has an estimate and its standard error for each threshold; events and variance are what their figure
shows, in words.
"""


def find_variance_ratio(ego: str, j: int) -> float:
    """Return the variance of naive Monte Carlo over that of cross-entropy at equal draws and the j-th threshold.

    That of naive Monte Carlo is p (1 - p) / n with p of its longest row.
    """
    rows, n = PRINTED_TABLES[ego]["rows"], PRINTED_TABLES[ego]["draws"]["cross-entropy"]
    p, error = float(rows["naive"][j][0]), float(rows["cross-entropy"][j][1])
    return p * (1.0 - p) / n / error**2


def find_errors_off(ego: str, j: int) -> float:
    """Return the distance of cross-entropy from the longest naive row, in their joint standard error."""
    (p, error), (found, own) = (PRINTED_TABLES[ego]["rows"][row][j] for row in ("naive", "cross-entropy"))
    return float((found - p) / math.hypot(error, own))


def describe_printed(ego: str) -> dict[str, Any]:
    """Return a table of the paper, with what follows from it."""
    table = PRINTED_TABLES[ego]
    return {**table, "variance_ratios": [find_variance_ratio(ego, j) for j in range(len(table["thresholds"]))]}
