"""Tables II and III as printed and over the replications of each method, and the paper's statements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from benchmarks.papers.record import Entry, compare, find, make_table
from benchmarks.papers.tian2024.replications import (
    ADSS_SIMULATIONS,
    FIGURE7_METHOD,
    METHOD_ROWS,
    POINTS_OF_A_LEVEL,
    ROW_COLUMNS,
    SCENARIO_ROWS,
    SYSTEMS,
    Key,
    Run,
)


@dataclass(frozen=True)
class PrintedRow:
    """One row of Table II or III; None where nothing is printed."""

    p: float | None = None
    squared_cov: float | None = None
    """The column "COV", which is the square of a c.o.v.: for MCS and IS it is about (1 - p) / (p N)."""
    n_sim: float | None = None
    error: float | None = None
    """Relative error of the mean against Monte Carlo."""
    mcs: float | None = None
    """p by Monte Carlo."""

    @property
    def cov(self) -> float | None:
        """Root of the printed column."""
        return None if self.squared_cov is None else self.squared_cov**0.5

    @property
    def gain(self) -> float | None:
        """Variance of plain Monte Carlo with as many simulations over the mean square error; see `mcs`."""
        if self.p is None or self.squared_cov is None or self.n_sim is None or self.mcs is None:
            return None
        ratio = self.p / self.mcs
        square_error = self.squared_cov * ratio**2 + (ratio - 1.0) ** 2
        return (1.0 - self.mcs) / (self.mcs * self.n_sim * square_error)


def _table2(p: float, squared_cov: float, n_sim: float, mcs: float) -> PrintedRow:
    return PrintedRow(p, squared_cov, n_sim, None if p == mcs else abs(p / mcs - 1.0), mcs)


PRINTED = {
    ("car-following", "stack", "MCS"): _table2(2.392e-4, 0.009, 4.064e5, 2.392e-4),
    ("car-following", "stack", "SS"): _table2(2.351e-4, 0.213, 4.980e3, 2.392e-4),
    ("car-following", "stack", "ADSS"): _table2(2.347e-4, 0.086, 2.681e3, 2.392e-4),
    ("car-following", "stack", "IS"): _table2(2.013e-4, 0.026, 1.762e5, 2.392e-4),
    ("car-following", "IDM", "MCS"): _table2(8.36e-4, 0.004, 2.351e5, 8.36e-4),
    ("car-following", "IDM", "SS"): _table2(8.03e-4, 0.152, 1.6e3, 8.36e-4),
    ("car-following", "IDM", "ADSS"): _table2(8.16e-4, 0.073, 1.533e3, 8.36e-4),
    ("car-following", "IDM", "IS"): _table2(8.23e-4, 0.012, 9.569e4, 8.36e-4),
    ("cut-in", "stack", "MCS"): PrintedRow(p=2.58e-4),
    ("cut-in", "stack", "SS"): PrintedRow(p=2.49e-4, n_sim=5000, error=0.026),
    ("cut-in", "stack", "ADSS"): PrintedRow(n_sim=237_000 / 112),
    ("cut-in", "stack", "IS"): PrintedRow(p=2.86e-4, n_sim=237_000, error=0.171),
    ("cut-in", "IDM", "IS"): PrintedRow(error=0.038),
}
"""By scenario, system (`stack` for Apollo) and the paper's name of the method.

Of Table III only what the text repeats: p and n_sim of single runs with Apollo, the errors over 20 replications, and
that ADSS is 112 times faster than IS, from which its n_sim is derived.
"""

RELEASED = {
    "MCS": "stops where the 95 % interval is p (1 ± 0.2): N = 96 (1 - p) / p",
    "IS": "does not run as released; adds weighted draws of the tilt and unweighted base draws in one mean",
    "SS": "does not run as released; 5,000 points a level (text: 500); maps to normal space by marginals",
    "ADSS": "AR-1 proposals without a Metropolis ratio; first step 0.6 of the base's spread (text: of the seeds')",
}
"""What the code does that the paper names as its source, by method."""
MOST_HALF_WIDTH_DRAWS = 96.04
"""(1.96 / 0.2)^2: draws of the stop rule times p / (1 - p)."""
EXPLANATIONS = {
    "traffic": (
        "The paper draws scenarios from Gaussian mixtures fitted to 30,292 car-followings and 993 cut-ins of highD, "
        "which are not public. Ours is the base `highway`, assembled from published statistics of such traffic. p is "
        "therefore another probability; what can be compared is how far a method is from Monte Carlo and what it costs."
    ),
    "system": (
        "Apollo 7.0 in LGSVL is replaced by `noisy:idm`: the IDM behind errors of perception, latency and lagging "
        "actuators. Its noise is part of x here (175 and 275 further dimensions), so that f is a function and every "
        "failure replays; Apollo's noise comes anew with each simulation."
    ),
    "limit state": (
        "f is the same by definition: -1 with a collision, else the least time to collision. The released code takes "
        "the time to every vehicle ahead, whatever its lane, ours to the one in the ego's way: other levels, the same "
        "failures. Episodes last 5 s in steps of 0.1 s in both."
    ),
    "squared": (
        "The printed column COV is the square of a c.o.v.: (1 - p) / (p N), that of plain Monte Carlo, is 0.0103, "
        "0.0051, 0.0282 and 0.0127 for MCS and IS with Apollo and the IDM, where 0.009, 0.004, 0.026 and 0.012 are "
        "printed. The paper's c.o.v. in this table is its root."
    ),
    "weights": (
        "The printed COV of IS is about that of as many plain Monte Carlo draws: its tilt reduces no variance. Ours "
        "weights every draw by the density of the mixture that it came from. With the stack a tilt of hundreds of "
        "coordinates leads nowhere, which our method sees and then draws from the base distribution."
    ),
    "settings": (
        "500 points a level, as the text has it, make at most 2,000 simulations in four levels. The printed 4,980 of "
        "SS with Apollo needs more points, and with them a smaller c.o.v. The released code of ADSS makes N further "
        "ones after its last level, which no estimate uses: 2,500 in four levels, 3,000 in five, around the printed "
        "2,681."
    ),
    "stop rule": (
        "Monte Carlo stops at 20 % relative half-width, which is (1 - p) / p times 96 draws; the printed number with "
        "the IDM is twice what the rule gives for its p. Ours looks after every 10,000 draws."
    ),
    "counting": (
        "All simulations are counted outside the methods, the search of IS included. The released code makes N of "
        "them in every level: ADSS simulates the seeds again, SS leaves them out of its chains. Ours keeps their "
        "outcome: 0.9 N."
    ),
    "chance": (
        "The mean of 20 replications with a c.o.v. of 0.3 to 0.5 has a standard error of 7 to 11 %: printed errors of "
        "2 or 3 % are smaller than chance explains, and ours differ from them by chance as well. "
        "The c.o.v. of few replications is itself uncertain: see its interval."
    ),
    "text": "Table III itself is not in the text at hand: single runs and figures that the text repeats, see above.",
}
"""Why numbers differ, by the words in the table."""

_LOWER, _UPPER = 0.025, 0.975
Ends = tuple[float, float]


def summarise_runs(runs: Sequence[Run]) -> pd.DataFrame:
    """Return figures over the replications of each method; the truth of a system is p by its Monte Carlo."""
    frame = pd.DataFrame(runs, columns=[*ROW_COLUMNS, "p", "final", "simulated", "levels"])
    groups = frame.groupby(list(ROW_COLUMNS), sort=False)
    found = groups["p"].agg(replications="size", mean="mean", spread="std")
    found[["simulations", "all_simulations", "levels"]] = groups[["final", "simulated", "levels"]].mean()
    truths = {key[:2]: mean for key, mean in found["mean"].items() if key[2] == "MC"}
    found["truth"] = [truths.get(key[:2], mean) for key, mean in found["mean"].items()]
    return derive(found)


def derive(found: pd.DataFrame) -> pd.DataFrame:
    """Return summaries with what follows from them.

    Given are replications, mean and spread (standard deviation) of the estimates of p; simulations (mean number as the
    paper counts them, without the search of importance sampling) and all_simulations (counted outside the method); and
    truth (p by Monte Carlo; its own error is left out).

    Added are cov, the spread over the mean; squared_cov, what the paper prints as COV; error, the mean over the truth,
    less 1; work, all simulations times the mean square error over p², less is better; gain, the variance of plain Monte
    Carlo with as many simulations, search included, over the mean square error (the c.o.v. alone would praise a method
    that misses most of p in all of its runs); and intervals: of the mean by Student's distribution, of c.o.v. and gain
    by the chi-square distribution of the variance and the mean square error of normal estimates.
    """
    found = found.copy()
    df = found["replications"] - 1
    low, high = (stats.chi2.ppf(share, df) for share in (_LOWER, _UPPER))
    half = stats.t.ppf(_UPPER, df) * found["spread"] / found["replications"] ** 0.5
    found["mean_low"], found["mean_high"] = np.maximum(found["mean"] - half, 0.0), found["mean"] + half
    found["cov"] = found["spread"] / found["mean"]
    found["cov_low"], found["cov_high"] = found["cov"] * (df / high) ** 0.5, found["cov"] * (df / low) ** 0.5
    for name in ("cov", "cov_low", "cov_high"):
        found[f"squared_{name}"] = found[name] ** 2
    found["error"] = found["mean"] / found["truth"] - 1.0
    found["work"] = found["all_simulations"] * ((found["spread"] / found["truth"]) ** 2 + found["error"] ** 2)
    found["gain"] = (1.0 - found["truth"]) / (found["truth"] * found["work"]).replace(0.0, np.nan)
    found["gain_low"], found["gain_high"] = found["gain"] * low / df, found["gain"] * high / df
    return found


def ends_of(ours: pd.Series, name: str) -> Ends:
    """Return the interval of a figure."""
    return float(ours[f"{name}_low"]), float(ours[f"{name}_high"])


def ratio_of_work(one: pd.Series, other: pd.Series) -> tuple[float, Ends]:
    """Return the work of one method over that of another, and its interval by the F distribution of two variances."""
    ratio = float(one["work"] / other["work"])
    df = one["replications"] - 1, other["replications"] - 1
    low, high = (float(stats.f.ppf(share, *df)) for share in (_UPPER, _LOWER))
    return ratio, (ratio / low, ratio / high)


SYSTEM_LABELS = {"IDM": "IDM", "stack": "stack (paper: Apollo)"}
MEASURED = {
    "mean of p": "mean",
    "error of the mean": "error",
    "c.o.v.": "cov",
    "square of the c.o.v.": "squared_cov",
    "simulations of the estimate": "simulations",
    "all simulations": "all_simulations",
    "gain over plain Monte Carlo": "gain",
    "gain, from": "gain_low",
    "to": "gain_high",
}
"""Columns of the summaries of methods that the paper does not have, by their heads."""


def make_method_tables(runs: Sequence[Run]) -> list[Entry]:
    """Return Tables II and III, as far as there are runs; Monte Carlo is among them wherever another method is."""
    found = summarise_runs(runs)
    tables = []
    for scenario, row in SCENARIO_ROWS.items():
        keys = [
            key for system in SYSTEMS for method in METHOD_ROWS if (key := (scenario, system, method)) in found.index
        ]
        if not keys:
            continue
        own = [key for key in keys if not METHOD_ROWS[key[2]].paper]
        table = make_table(
            row.table,
            row.title,
            ("method", "system under test"),
            [value for key in keys if key not in own for value in _compare(key, found.loc[key])],
            EXPLANATIONS,
            measured=[_measure(key, found.loc[key]) for key in own],
            measured_title=f"Our methods with {ADSS_SIMULATIONS:,} simulations, and ADSS in its other reading",
        )
        tables.append(table)
    return tables


def _compare(key: Key, ours: pd.Series) -> Iterator[Entry]:
    """Yield the numbers of a method that the paper has beside ours."""
    scenario, system, method = key
    paper = METHOD_ROWS[method].paper
    printed = PRINTED.get((scenario, system, paper), PrintedRow())
    stacked = ("system",) if system == "stack" else ()
    off = ("weights", "chance") if paper == "IS" else ("chance", *stacked)
    spread = {"IS": ("squared", "weights"), "MCS": ("squared", "chance")}.get(
        paper, ("squared", "settings", "limit state", *stacked)
    )
    cost = {"IS": ("weights",), "MCS": ("stop rule", "traffic")}.get(paper, ("traffic", "settings"))
    rows: tuple[tuple[str, str, float | None, tuple[str, ...], Entry], ...] = (
        ("mean", "mean of p", printed.p, ("traffic", *stacked), {"released": RELEASED[paper]}),
        ("error", "error of the mean against Monte Carlo", printed.error, off, {}),
        ("cov", "c.o.v. of p", printed.cov, spread, {}),
        ("squared_cov", 'square of the c.o.v. (printed as "COV")', printed.squared_cov, spread, {}),
        (
            "simulations",
            "simulations, as the paper counts",
            printed.n_sim,
            (*cost, "counting"),
            {"released": _released_cost(paper, printed.p, ours), "ours_all_in": float(ours["all_simulations"])},
        ),
        ("gain", "gain over plain Monte Carlo", printed.gain, (*cost, "counting"), {}),
    )
    for name, quantity, theirs, reasons, further in rows:
        if paper == "MCS" and name == "error":
            continue  # it is compared with itself
        yield compare(
            ("Monte Carlo" if paper == "MCS" else paper, SYSTEM_LABELS[system]),
            quantity,
            theirs,
            ours=_finite(abs(ours[name])),
            interval=ends_of(ours, name) if f"{name}_low" in ours and math.isfinite(ours[name]) else None,
            reasons=(*reasons, "text") if scenario == "cut-in" and theirs is not None else reasons,
            **further,
        )


def _released_cost(paper: str, p: float | None, ours: pd.Series) -> str:
    """Return the simulations that the released code would make, in words."""
    if paper == "MCS":
        rule = [f"{MOST_HALF_WIDTH_DRAWS * (1 - each) / each:,.0f}" for each in (p, ours["mean"]) if each]
        return f"the rule gives {rule[0]} for the printed p, {rule[-1]} for ours" if p else f"the rule gives {rule[-1]}"
    levels = POINTS_OF_A_LEVEL * ours["levels"]
    return {
        "SS": f"N in every level: {levels:,.0f} for the same levels",
        "ADSS": f"N in every level and once more at the end: {levels + POINTS_OF_A_LEVEL:,.0f} for the same levels",
    }.get(paper, "")


def _measure(key: Key, ours: pd.Series) -> Entry:
    """Return the figures of a method that the paper does not have."""
    values = {head: abs(ours[name]) if name == "error" else ours[name] for head, name in MEASURED.items()}
    return {"labels": (key[2], SYSTEM_LABELS[key[1]]), "values": {head: _finite(v) for head, v in values.items()}}


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None


def assess_claims(runs: Sequence[Run]) -> list[Entry]:
    """Return the paper's statements with what the replications say about them, as far as there are runs."""
    found = summarise_runs(runs)
    return [*_efficiency(found, "SS"), *_efficiency(found, "IS"), *_accuracy(found), *_moves(runs)]


def _efficiency(found: pd.DataFrame, other: str) -> Iterator[Entry]:
    for scenario, system, method in found.index:
        if method == "ADSS" and (scenario, system, other) in found.index:
            ratio, ends = ratio_of_work(found.loc[scenario, system, other], found.loc[scenario, system, "ADSS"])
            claim = f"ADSS needs fewer simulations than {other} ({scenario}, {system})"
            statistic = f"all simulations times mean square error of {other} over that of ADSS"
            yield find(claim, statistic, _judge(ends, 1.0), ratio, ends)


def _accuracy(found: pd.DataFrame) -> Iterator[Entry]:
    for scenario, system, method in found.index:
        if method != "IS" or (scenario, system, "MC") not in found.index:
            continue
        ours, truth = found.loc[scenario, system, "IS"], found.loc[scenario, system, "MC"]
        ratio = 1.0 + float(ours["error"])
        error = ratio * (ours["cov"] ** 2 / ours["replications"] + truth["cov"] ** 2 / truth["replications"]) ** 0.5
        ends = _around(ratio, float(error), int(ours["replications"]))
        verdict = "no error to be seen" if ends[0] <= 1.0 <= ends[1] else f"off by {100 * (ratio - 1):+.0f} %"
        claim = f"IS is off by 2 to 17 % ({scenario}, {system})"
        yield find(claim, "mean of p by IS over that by Monte Carlo", verdict, ratio, ends)


_MOVES = (
    (1, 1.0, "the cutter's speed v2 increases from subset to subset", "m/s"),
    (3, -1.0, "the gap dis1x to it decreases from subset to subset", "m"),
)
"""Columns of the cut-in, the signs of their moves, the paper's statements and units."""


def _moves(runs: Sequence[Run]) -> Iterator[Entry]:
    shown = [run for run in runs if (run["scenario"], run["method"]) == ("cut-in", FIGURE7_METHOD)]
    shown = [run for run in shown if len(run["level_means"]) > 1]
    for system, group in groupby(sorted(shown, key=lambda run: run["system"]), lambda run: run["system"]):
        moves = np.array([np.subtract(run["level_means"][-1], run["level_means"][0]) for run in group])
        for column, sign, claim, unit in _MOVES if len(moves) > 1 else ():
            moved = moves[:, column]
            mean, error = float(moved.mean()), float(moved.std(ddof=1)) / len(moved) ** 0.5
            ends = _around(mean, error, len(moved))
            verdict = _judge(ends if sign > 0 else (-ends[1], -ends[0]), 0.0)
            statistic = f"mean in the last subset less that in the first [{unit}]"
            yield find(f"{claim} (cut-in, {system})", statistic, verdict, mean, ends)


def _around(mean: float, error: float, n: int) -> Ends:
    """Return the interval of a mean of n values with a standard error, by Student's distribution."""
    half = float(stats.t.ppf(_UPPER, n - 1)) * error
    return mean - half, mean + half


def _judge(ends: Ends, bound: float) -> str:
    """Return whether a statistic that the statement has above a bound is so."""
    if ends[0] > bound:
        return "holds"
    return "the opposite holds" if ends[1] < bound else "cannot be told from these replications"
