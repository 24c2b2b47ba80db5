"""Statements of the paper, each with a statistic of the replications and its interval."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import stats

from benchmarks.papers.record import TestedClaim
from benchmarks.papers.tian2024.replications import FIGURE7_METHOD, ReplicationRun
from benchmarks.papers.tian2024.summary import (
    INTERVAL_CONFIDENCE,
    Ends,
    ReplicationSummary,
    ratio_of_work,
    summarise_runs,
)

_V2, _GAP = 1, 3
"""Columns of the cut-in: speed of the cutter and gap to it."""


def assess_claims(runs: Sequence[ReplicationRun]) -> list[TestedClaim]:
    """Return the paper's statements with what the replications say about them, as far as there are runs."""
    found = summarise_runs(runs)
    return [*_efficiency(found), *_accuracy(found), *_moves(runs)]


def _efficiency(found: dict[tuple[str, str, str], ReplicationSummary]) -> Iterator[TestedClaim]:
    for other, claim in (
        ("SS", "ADSS needs fewer simulations than SS"),
        ("IS", "ADSS needs fewer simulations than IS"),
    ):
        for scenario, system, method in found:
            if method != "ADSS" or (scenario, system, other) not in found:
                continue
            ratio, ends = ratio_of_work(found[scenario, system, other], found[scenario, system, "ADSS"])
            yield TestedClaim(
                claim=f"{claim} ({scenario}, {system})",
                statistic=f"all simulations times mean square error of {other} over that of ADSS",
                value=ratio,
                interval=ends,
                verdict=_judge(ends, 1.0),
            )


def _accuracy(found: dict[tuple[str, str, str], ReplicationSummary]) -> Iterator[TestedClaim]:
    for (scenario, system, method), ours in found.items():
        if method != "IS" or (scenario, system, "MC") not in found:
            continue
        truth = found[scenario, system, "MC"]
        ratio = 1.0 + ours.error
        error = ratio * (ours.cov**2 / ours.replications + truth.cov**2 / truth.replications) ** 0.5
        half = float(stats.t.ppf(0.5 + INTERVAL_CONFIDENCE / 2, ours.replications - 1)) * error
        ends = ratio - half, ratio + half
        yield TestedClaim(
            claim=f"IS is off by 2 to 17 % ({scenario}, {system})",
            statistic="mean of p by IS over that by Monte Carlo",
            value=ratio,
            interval=ends,
            verdict="no error to be seen" if ends[0] <= 1.0 <= ends[1] else f"off by {100 * (ratio - 1):+.0f} %",
        )


def _moves(runs: Sequence[ReplicationRun]) -> Iterator[TestedClaim]:
    for system in dict.fromkeys(run.system for run in runs):
        means = [
            run.level_means
            for run in runs
            if (run.scenario, run.system, run.method) == ("cut-in", system, FIGURE7_METHOD) and len(run.level_means) > 1
        ]
        if len(means) < 2:
            continue
        for column, sign, claim in (
            (_V2, 1.0, "the cutter's speed v2 increases from subset to subset"),
            (_GAP, -1.0, "the gap dis1x to it decreases from subset to subset"),
        ):
            moved = np.array([levels[-1][column] - levels[0][column] for levels in means])
            half = (
                float(stats.t.ppf(0.5 + INTERVAL_CONFIDENCE / 2, len(moved) - 1))
                * moved.std(ddof=1)
                / len(moved) ** 0.5
            )
            ends = float(moved.mean() - half), float(moved.mean() + half)
            yield TestedClaim(
                claim=f"{claim} (cut-in, {system})",
                statistic=f"mean in the last subset less that in the first [{'m/s' if column == _V2 else 'm'}]",
                value=float(moved.mean()),
                interval=ends,
                verdict=_judge(ends if sign > 0 else (-ends[1], -ends[0]), 0.0),
            )


def _judge(ends: Ends, bound: float) -> str:
    """Return whether a statistic that the statement has above a bound is so."""
    if ends[0] > bound:
        return "holds"
    return "the opposite holds" if ends[1] < bound else "cannot be told from these replications"
