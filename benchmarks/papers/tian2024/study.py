"""The reproduction in a folder: replications as lines of a file, then record, page, and Figures 6 to 8."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from benchmarks.papers.record import Drawings, Entry, check_folder, make_record, write_record
from benchmarks.papers.tian2024.replications import (
    ADSS_SIMULATIONS,
    EPISODE_SECONDS,
    FIGURE7_METHOD,
    POINTS_OF_A_LEVEL,
    ROW_COLUMNS,
    RUN_COLUMNS,
    SCENARIO_ROWS,
    SYSTEMS,
    TRAFFIC_BASE,
    Key,
    Run,
    TianPlan,
    open_replications,
    row_of,
    run_replication,
)
from benchmarks.papers.tian2024.summary import assess_claims, make_method_tables
from benchmarks.samplers.runs import map_jobs
from rare_envs.study.plots import HIT_COLOUR, LINE_COLOUR, ORDINARY_COLOUR

TIAN_SOURCE = (
    "Tian, Fu, Zhang, Tang, Sun: Accelerated verification of autonomous driving systems based on adaptive subset "
    "simulation. IEEE Transactions on Intelligent Vehicles, 2024, doi:10.1109/TIV.2024.3449947."
)


_ROMAN = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII")
_COLOURS = (LINE_COLOUR, HIT_COLOUR, "#2e8b57", "#8e44ad", "#b25b00")
_PANELS_IN_A_ROW = 2
_SHOWN_COLUMNS = (0, 1, 5)
"""Of the cut-in's parameters: v1, v2 and dis1y."""
FIGURE8_METHODS = ("SS", "ADSS", "two-stage")
FIGURE8_LINES = ("MC", "IS")


def reproduce_tian2024(
    plan: TianPlan, out: Path, command: str, workers: int = 1, progress: bool = False
) -> dict[str, Any]:
    """Make the replications that a folder lacks, write record and figures; BadInput if it has other ones."""
    check_folder(out, plan.identity)
    out.mkdir(parents=True, exist_ok=True)
    lines = open_replications(out, plan)
    runs = lines.complete(
        plan.jobs(), lambda missing: map_jobs(run_replication, missing, workers), progress, "replications"
    )
    record = record_replications(plan, runs, command)
    write_record(out, record, draw_figures(record["figures"]))
    return record


def record_replications(plan: TianPlan, runs: Sequence[Run], command: str) -> dict[str, Any]:
    """Return the record of some replications."""
    return make_record(
        {
            "replications": plan.replications,
            "seeds": f"{plan.seed} to {plan.seed + plan.replications - 1}",
            "base": TRAFFIC_BASE,
            "horizon": EPISODE_SECONDS,
        },
        title="Tian et al. 2024: adaptive subset simulation",
        source=TIAN_SOURCE,
        command=command,
        notes=_describe_setting(plan),
        tables=make_method_tables(runs),
        figures=collect_figures(runs),
        findings=assess_claims(runs),
        runs=_list_runs(runs),
    )


def _describe_setting(plan: TianPlan) -> list[str]:
    return [
        f"Every figure is over {plan.replications} replications (the paper has 20 and does not say how many of Monte "
        "Carlo); intervals are 95 %: of a mean by Student's distribution, of a c.o.v. by the chi-square distribution.",
        "Failure is a collision of the ego within 5 s. Systems under test: the IDM with the paper's parameters, and "
        "`noisy:idm`, an imperfect stack around it, where the paper has Apollo.",
        f"SS and ADSS have {POINTS_OF_A_LEVEL} points a level; Monte Carlo and IS stop at 20 % relative half-width; "
        f"our methods get {ADSS_SIMULATIONS:,} simulations, what the paper prints for ADSS with Apollo.",
        "Of Table III the paper's text at hand has only: Monte Carlo 2.58e-4, SS 2.49e-4 with about 5,000 simulations "
        "and IS 2.86e-4 with 237,000 (single runs, Apollo); errors of IS of 17.1 % (Apollo) and 3.8 % (IDM) and of SS "
        "of 2.6 % over 20 replications; ADSS 112 times faster than IS.",
        "The gain is the variance of plain Monte Carlo with as many simulations over the mean square error about p by "
        "Monte Carlo. Plain Monte Carlo has 1 whatever p is, so that it can be compared across papers. The error of "
        "Monte Carlo's own mean (a few percent) is left out: gains of methods that are as exact as it are understated.",
    ]


def _list_runs(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the runs of each method on each system in each scenario, a list for each of their figures."""
    groups: dict[Key, list[Run]] = {}
    for run in runs:
        groups.setdefault(row_of(run), []).append(run)
    return [
        {
            **dict(zip(ROW_COLUMNS, key, strict=True)),
            **{name: [run[name] for run in group] for name in RUN_COLUMNS},
            "warnings": [len(run["warnings"]) for run in group],
        }
        for key, group in groups.items()
    ]


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
