"""Figures 2 and 3 of the paper in its own axes: two ratios against the threshold, a curve for each search."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.papers.okelly2018.printed import PRINTED_TABLES
from benchmarks.papers.record import DrawnFigure

POINTS = 16
"""Thresholds of a curve."""
_SHOWN_RATIOS = (1e-4, 1e4)
"""Ratios beyond are drawn at the edge: a sample variance of 0 says nothing."""


def list_thresholds(gammas: tuple[float, ...]) -> list[float]:
    """Return the thresholds of the curves, from the rarest in the table to a tenth beyond its last.

    Example:
        >>> thresholds = list_thresholds((0.4, 0.5))
        >>> len(thresholds), thresholds[0], thresholds[-1]
        (16, 0.4, 0.55)
    """
    return [round(float(gamma), 4) for gamma in np.linspace(gammas[0], 1.1 * gammas[-1], POINTS)]


def describe_figures(ego: str, found: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the data of both figures of an ego as a record has them.

    Args:
        ego: "lidar" or "vision".
        found: As `benchmarks.papers.okelly2018.study.summarise_highway` returns it.
    """
    printed = PRINTED_TABLES[ego]
    word = printed.figure.lower().replace(" ", "")
    curves = {name: each["curve"] for name, each in found["searches"].items() if each.get("curve")}
    words = (
        ("a", "number of rare events, sampler / naive Monte Carlo, at equal draws", "events_ratio", printed.events),
        ("b", "variance, naive Monte Carlo / sampler, at equal draws", "variance_ratio", printed.variance),
    )
    return {
        f"{word}{letter}": {
            "title": f"{printed.figure}{letter}: {title}",
            "caption": "A curve for each search; without the rollouts of the search, as in the paper."
            + ("" if curves else " Not run yet."),
            "paper": f"{range_}.",
            "axis": title,
            "curves": {
                name: {"gamma": [p["gamma"] for p in curve], "ratio": [p[key] for p in curve]}
                for name, curve in curves.items()
            },
        }
        for letter, title, key, range_ in words
    }


def make_figures(record: Mapping[str, Any]) -> list[DrawnFigure]:
    """Return the figures of a record, those without curves left out."""
    return [
        DrawnFigure(name, partial(draw_ratios, data=data), (7.0, 4.0))
        for name, data in record["figures"].items()
        if data["curves"]
    ]


def draw_ratios(figure: Figure, data: Mapping[str, Any]) -> None:
    """Draw ratios against the threshold, both as in the paper, the ratio on a logarithmic axis."""
    axes = figure.subplots()
    for name, curve in data["curves"].items():
        known = [(g, r) for g, r in zip(curve["gamma"], curve["ratio"], strict=True) if r]
        gammas, ratios = [g for g, _ in known], [r for _, r in known]
        label = name if known else f"{name}: none can be computed"
        axes.plot(gammas, np.clip(ratios, *_SHOWN_RATIOS), marker="o", markersize=3, label=label)
    axes.axhline(1.0, color="0.6", linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xlabel("threshold gamma [s]")
    axes.set_ylabel("ratio")
    axes.set_title(data["axis"], fontsize=9)
    axes.legend(fontsize=8)
