"""Tables II and III: as printed, ours, their difference, and the released code."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from benchmarks.papers.record import ComparedValue, ComparisonTable
from benchmarks.papers.tian2024.printed import EXPLANATIONS, MOST_HALF_WIDTH_DRAWS, PRINTED, RELEASED, PrintedRow
from benchmarks.papers.tian2024.replications import (
    ADSS_SIMULATIONS,
    METHOD_ROWS,
    POINTS_OF_A_LEVEL,
    SCENARIO_ROWS,
    SYSTEMS,
    Key,
    ReplicationRun,
)
from benchmarks.papers.tian2024.summary import ReplicationSummary, Summaries, group_runs, summarise_runs

SYSTEM_LABELS = {"IDM": "IDM", "stack": "stack (paper: Apollo)"}


def make_method_tables(runs: Sequence[ReplicationRun]) -> list[ComparisonTable]:
    """Return Tables II and III, as far as there are runs; Monte Carlo is among them wherever another method is."""
    found = summarise_runs(runs)
    levels = {key: sum(run.levels for run in group) / len(group) for key, group in group_runs(runs).items()}
    return [_make_table(scenario, found, levels) for scenario in SCENARIO_ROWS if scenario in {key[0] for key in found}]


def _make_table(scenario: str, found: Summaries, levels: dict[Key, float]) -> ComparisonTable:
    keys = [(scenario, system, method) for system in SYSTEMS for method in METHOD_ROWS]
    values = [
        value
        for key in keys
        if key in found and METHOD_ROWS[key[2]].paper
        for value in _compare(key, METHOD_ROWS[key[2]].paper, found[key], levels[key])
    ]
    used = {reason for value in values for reason in value.reasons}
    return ComparisonTable(
        name=SCENARIO_ROWS[scenario].table,
        title=SCENARIO_ROWS[scenario].title,
        keys=("method", "system under test"),
        values=tuple(values),
        explanations={name: text for name, text in EXPLANATIONS.items() if name in used},
        measured=tuple(_measure(key, found[key]) for key in keys if key in found and not METHOD_ROWS[key[2]].paper),
        measured_title=f"Our methods with {ADSS_SIMULATIONS:,} simulations, and ADSS in its other reading",
    )


def _compare(key: Key, paper: str, ours: ReplicationSummary, levels: float) -> Iterator[ComparedValue]:
    """Yield the numbers of a method that the paper has beside ours."""
    scenario, system, _ = key
    printed = PRINTED.get((scenario, system, paper), PrintedRow())
    stacked = ("system",) if system == "stack" else ()
    spread = {"IS": ("squared", "weights"), "MCS": ("squared", "chance")}.get(
        paper, ("squared", "settings", "limit state", *stacked)
    )
    cost = {"IS": ("weights",), "MCS": ("stop rule", "traffic")}.get(paper, ("traffic", "settings"))
    off = ("weights", "chance") if paper == "IS" else ("chance", *stacked)
    rows: list[tuple[str, float | None, float, tuple[str, ...], dict[str, Any]]] = [
        (
            "mean of p",
            printed.p,
            ours.mean,
            ("traffic", *stacked),
            {"interval": ours.mean_interval, "released": RELEASED[paper]},
        ),
        ("error of the mean against Monte Carlo", printed.error, abs(ours.error), off, {}),
        ("c.o.v. of p", printed.cov, ours.cov, spread, {"interval": ours.cov_interval}),
        (
            'square of the c.o.v. (printed as "COV")',
            printed.squared_cov,
            ours.squared_cov,
            spread,
            {"interval": ours.squared_cov_interval},
        ),
        (
            "simulations, as the paper counts",
            printed.n_sim,
            ours.simulations,
            (*cost, "counting"),
            {"released": _released_cost(paper, printed.p, ours, levels), "ours_all_in": ours.all_simulations},
        ),
        (
            "gain over plain Monte Carlo",
            printed.gain,
            ours.gain,
            (*cost, "counting"),
            {"interval": ours.gain_interval},
        ),
    ]
    for quantity, theirs, mine, reasons, further in rows:
        if paper == "MCS" and quantity.startswith("error"):
            continue  # it is compared with itself
        if not math.isfinite(mine):
            further = {name: value for name, value in further.items() if name != "interval"}
        yield ComparedValue(
            labels=("Monte Carlo" if paper == "MCS" else paper, SYSTEM_LABELS[system]),
            quantity=quantity,
            paper=theirs,
            ours=_finite(mine),
            reasons=(*reasons, "text") if scenario == "cut-in" and theirs is not None else reasons,
            **further,
        )


def _released_cost(paper: str, p: float | None, ours: ReplicationSummary, levels: float) -> str:
    """Return the simulations that the released code would make, in words."""
    if paper == "MCS":
        rule = [f"{MOST_HALF_WIDTH_DRAWS * (1 - each) / each:,.0f}" for each in (p, ours.mean) if each]
        return f"the rule gives {rule[0]} for the printed p, {rule[-1]} for ours" if p else f"the rule gives {rule[-1]}"
    if paper == "SS":
        return f"N in every level: {POINTS_OF_A_LEVEL * levels:,.0f} for the same levels"
    if paper == "ADSS":
        return f"N in every level and once more at the end: {POINTS_OF_A_LEVEL * (levels + 1):,.0f} for the same levels"
    return ""


def _measure(key: Key, ours: ReplicationSummary) -> dict[str, Any]:
    values = {
        "mean of p": ours.mean,
        "error of the mean": abs(ours.error),
        "c.o.v.": ours.cov,
        "square of the c.o.v.": ours.squared_cov,
        "simulations of the estimate": ours.simulations,
        "all simulations": ours.all_simulations,
        "gain over plain Monte Carlo": ours.gain,
        "gain, from": ours.gain_interval[0],
        "to": ours.gain_interval[1],
    }
    labels = (key[2], SYSTEM_LABELS[key[1]])
    return {"labels": labels, "values": {name: _finite(value) for name, value in values.items()}}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
