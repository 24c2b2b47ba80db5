"""Figures 6, 7 and 8: their data from the replications, and the drawings in the paper's axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from benchmarks.papers.record import Drawings, Entry
from benchmarks.papers.tian2024.replications import FIGURE7_METHOD, SCENARIO_ROWS, SYSTEMS, Run
from rare_envs.study.plots import HIT_COLOUR, LINE_COLOUR, ORDINARY_COLOUR

_ROMAN = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII")
_COLOURS = (LINE_COLOUR, HIT_COLOUR, "#2e8b57", "#8e44ad", "#b25b00")
_PANELS_IN_A_ROW = 2
_SHOWN_COLUMNS = (0, 1, 5)
"""Of the cut-in's parameters: v1, v2 and dis1y."""
FIGURE8_METHODS = ("SS", "ADSS", "two-stage")
FIGURE8_LINES = ("MC", "IS")


def collect_figures(runs: Sequence[Run]) -> dict[str, Entry]:
    """Return the data of the figures, with captions, as a record has them."""
    first = min((run["seed"] for run in runs), default=0)
    beginning = [run for run in runs if run["seed"] == first]
    shown = [run for run in runs if (run["scenario"], run["system"]) == ("cut-in", "stack")]
    subset_runs = [run for run in shown if (run["method"], run["seed"]) == (FIGURE7_METHOD, first)]
    subsets = [level for run in subset_runs for level in run["level_points"]]
    return {
        "figure6": {
            "title": "Figure 6: collision rates by Monte Carlo.",
            "caption": "Share of collisions over the simulations so far, with its 95 % band, first replication.",
            "paper": "the same of Apollo alone, with 20 % relative half-width at the end.",
            "lines": [
                {"scenario": run["scenario"], "system": run["system"], **_line(run)}
                for run in beginning
                if run["method"] == "MC"
            ],
        },
        "figure7": {
            "title": "Figure 7: the subsets of subset simulation.",
            "caption": (
                "Simulated points inside each subset of SS in the cut-in with the stack, first replication; "
                "axes v1 and v2 [m/s] and dis1y [m]."
            ),
            "paper": "the same axes with Apollo; its text says that v2 increases and dis1x decreases from I to IV.",
            "levels": [[[row[j] for j in _SHOWN_COLUMNS] for row in level] for level in subsets],
        },
        "figure8": {
            "title": "Figure 8: collision rate over simulations in the cut-in.",
            "caption": (
                "Stack, cut-in: Monte Carlo and IS on their way (first replication), and the end of every replication "
                "of SS, ADSS and two-stage; all simulations counted."
            ),
            "paper": "Apollo: about 237,000 simulations of IS, 5,000 of SS and half as many of ADSS.",
            "lines": [
                {"method": run["method"], **_line(run)}
                for run in shown
                if run["method"] in FIGURE8_LINES and run["seed"] == first
            ],
            "ends": {
                method: [[run["simulated"], run["p"]] for run in shown if run["method"] == method]
                for method in FIGURE8_METHODS
            },
        },
    }


def draw_figures(figures: Mapping[str, Mapping[str, Any]]) -> Drawings:
    """Return the drawings of what `collect_figures` returns; none of a figure without data."""
    rates, subsets, comparison = (figures[f"figure{number}"] for number in (6, 7, 8))
    rows = -(-len(subsets["levels"]) // _PANELS_IN_A_ROW)
    compared = comparison["lines"] or any(comparison["ends"].values())
    drawings: Drawings = {
        "figure6": (partial(_draw_rates, data=rates), (8.0, 3.2)),
        "figure7": (partial(_draw_subsets, levels=subsets["levels"]), (7.2, 3.4 * rows)),
        "figure8": (partial(_draw_comparison, data=comparison), (6.4, 3.8)),
    }
    known = {"figure6": rates["lines"], "figure7": subsets["levels"], "figure8": compared}
    return {name: drawing for name, drawing in drawings.items() if known[name]}


def _line(run: Run) -> dict[str, list[float]]:
    """Return the estimates of p on the way, those of other thresholds left out."""
    reached = [(n, p) for n, p, threshold in run["trace"] if threshold <= 0.0]
    return {"n": [n for n, _ in reached], "p": [p for _, p in reached]}


def _draw_rates(figure: Figure, data: Mapping[str, Any]) -> None:
    panels = figure.subplots(1, len(SCENARIO_ROWS), squeeze=False)[0]
    for axes, scenario in zip(panels, SCENARIO_ROWS, strict=True):
        for system, colour in zip(SYSTEMS, _COLOURS, strict=False):
            for line in (each for each in data["lines"] if (each["scenario"], each["system"]) == (scenario, system)):
                n, p = np.array(line["n"]), np.array(line["p"])
                half = 1.96 * np.sqrt(p * (1.0 - p) / n)
                axes.plot(n, p, color=colour, label=system)
                axes.fill_between(n, p - half, p + half, color=colour, alpha=0.15, linewidth=0)
        axes.set_title(scenario, fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axes.set_xlabel("number of simulations")
        axes.set_ylabel("collision rate")
        axes.set_ylim(bottom=0.0)
        axes.legend(frameon=False, fontsize=8)


def _draw_subsets(figure: Figure, levels: Sequence[Sequence[Sequence[float]]]) -> None:
    rows = -(-len(levels) // _PANELS_IN_A_ROW)
    everything = np.array([row for level in levels for row in level])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = np.where(high > low, 0.02 * (high - low), 0.5)
    for number, level in enumerate(levels):
        axes: Any = figure.add_subplot(rows, _PANELS_IN_A_ROW, number + 1, projection="3d")
        v1, v2, dis1y = zip(*level, strict=True) if level else ((), (), ())
        axes.scatter(v1, v2, dis1y, s=4, color=HIT_COLOUR if number == len(levels) - 1 else ORDINARY_COLOUR)
        axes.set(**dict(zip(("xlim", "ylim", "zlim"), zip(low - margin, high + margin, strict=True), strict=True)))
        axes.set_title(f"subset {_ROMAN[number] if number < len(_ROMAN) else number + 1}", fontsize=9)
        axes.tick_params(labelsize=6)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_major_locator(MaxNLocator(4))
        axes.set_box_aspect(None, zoom=0.85)
        axes.set_xlabel("v1 [m/s]", fontsize=7)
        axes.set_ylabel("v2 [m/s]", fontsize=7)
        axes.set_zlabel("dis1y [m]", fontsize=7)


def _draw_comparison(figure: Figure, data: Mapping[str, Any]) -> None:
    axes = figure.subplots()
    colours = iter(_COLOURS)
    for line in data["lines"]:
        axes.plot(line["n"], line["p"], color=next(colours), label=line["method"])
    for method, ends in data["ends"].items():
        if ends:
            axes.scatter([n for n, _ in ends], [p for _, p in ends], s=12, color=next(colours), label=method)
    axes.set_xscale("log")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("number of simulations")
    axes.set_ylabel("collision rate")
    axes.legend(frameon=False, fontsize=8)
