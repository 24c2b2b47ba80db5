"""Tables II and III: as printed, ours, their difference, and the released code."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from benchmarks.papers.record import ComparedValue, ComparisonTable, MeasuredRow
from benchmarks.papers.tian2024.catalogue import (
    ADSS_SIMULATIONS,
    METHOD_ROWS,
    POINTS_OF_A_LEVEL,
    SCENARIO_ROWS,
    SYSTEMS,
)
from benchmarks.papers.tian2024.printed import (
    EXPLANATIONS,
    MOST_HALF_WIDTH_DRAWS,
    PRINTED,
    RELEASED,
    PrintedRow,
)
from benchmarks.papers.tian2024.replications import ReplicationRun
from benchmarks.papers.tian2024.summary import Ends, ReplicationSummary, summarise_runs

SYSTEM_LABELS = {"IDM": "IDM", "stack": "stack (paper: Apollo)"}
METHOD_LABELS = {"MCS": "Monte Carlo", "IS": "IS", "SS": "SS", "ADSS": "ADSS"}
Summaries = Mapping[tuple[str, str, str], ReplicationSummary]


def make_method_tables(runs: Sequence[ReplicationRun]) -> list[ComparisonTable]:
    """Return Tables II and III, as far as there are runs.

    Args:
        runs: Of the methods, Monte Carlo among them wherever another one is.
    """
    found = summarise_runs(runs)
    levels = _mean_levels(runs)
    return [
        _make_table(scenario, found, levels) for scenario in SCENARIO_ROWS if any(key[0] == scenario for key in found)
    ]


def _make_table(scenario: str, found: Summaries, levels: Mapping[tuple[str, str, str], float]) -> ComparisonTable:
    values: list[ComparedValue] = []
    measured: list[MeasuredRow] = []
    for system in SYSTEMS:
        for method, row in METHOD_ROWS.items():
            key = (scenario, system, method)
            if key not in found:
                continue
            if row.paper:
                values += _compare(key, row.paper, found[key], levels[key])
            else:
                measured.append(_measure(key, found[key]))
    used = {reason for value in values for reason in value.reasons}
    return ComparisonTable(
        name=SCENARIO_ROWS[scenario].table,
        title=SCENARIO_ROWS[scenario].title,
        keys=("method", "system under test"),
        values=tuple(values),
        explanations={name: text for name, text in EXPLANATIONS.items() if name in used},
        measured=tuple(measured),
        measured_title=f"Our methods with {ADSS_SIMULATIONS:,} simulations, and ADSS in its other reading",
    )


def _compare(key: tuple[str, str, str], paper: str, ours: ReplicationSummary, levels: float) -> Iterator[ComparedValue]:
    """Yield the numbers of a method that the paper has beside ours."""
    scenario, system, _ = key
    printed = PRINTED.get((scenario, system, paper), PrintedRow())
    only_text = ("text",) if scenario == "cut-in" else ()

    def value(
        quantity: str,
        theirs: float | None,
        mine: float | None,
        reasons: tuple[str, ...],
        interval: Ends | None = None,
        released: str = "",
        all_in: float | None = None,
    ) -> ComparedValue:
        known = _finite(mine)
        return ComparedValue(
            labels=(METHOD_LABELS[paper], SYSTEM_LABELS[system]),
            quantity=quantity,
            paper=theirs,
            ours=known,
            interval=interval if known is not None and interval is not None else None,
            ours_all_in=all_in,
            released=released,
            reasons=(*reasons, *(only_text if theirs is not None else ())),
        )

    stacked = ("system",) if system == "stack" else ()
    level_methods = paper in ("SS", "ADSS")
    spread = {"IS": ("squared", "weights"), "MCS": ("squared", "chance")}.get(
        paper, ("squared", "settings", "limit state", *stacked)
    )
    cost = {"IS": ("weights",), "MCS": ("stop rule", "traffic")}.get(paper, ("traffic", "settings"))
    yield value("mean of p", printed.p, ours.mean, ("traffic", *stacked), ours.mean_interval, RELEASED[paper])
    if paper != "MCS":
        reasons = ("chance", *stacked) if level_methods else ("weights", "chance")
        yield value("error of the mean against Monte Carlo", printed.error, abs(ours.error), reasons)
    yield value("c.o.v. of p", printed.cov, ours.cov, spread, ours.cov_interval)
    yield value(
        'square of the c.o.v. (printed as "COV")', printed.squared_cov, ours.squared_cov, spread,
        ours.squared_cov_interval,
    )  # fmt: skip
    yield value(
        "simulations, as the paper counts", printed.n_sim, ours.simulations, (*cost, "counting"),
        released=_released_cost(paper, printed.p, ours, levels), all_in=ours.all_simulations,
    )  # fmt: skip
    yield value("gain over plain Monte Carlo", printed.gain, ours.gain, (*cost, "counting"), ours.gain_interval)


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


def _measure(key: tuple[str, str, str], ours: ReplicationSummary) -> MeasuredRow:
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
    return MeasuredRow(
        labels=(key[2], SYSTEM_LABELS[key[1]]), values={name: _finite(value) for name, value in values.items()}
    )


def _mean_levels(runs: Sequence[ReplicationRun]) -> dict[tuple[str, str, str], float]:
    groups: dict[tuple[str, str, str], list[int]] = {}
    for run in runs:
        groups.setdefault((run.scenario, run.system, run.method), []).append(run.levels)
    return {key: sum(group) / len(group) for key, group in groups.items()}


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value
