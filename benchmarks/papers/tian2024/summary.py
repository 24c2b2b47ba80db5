"""Figures over the replications of a method, with intervals, and what they say of the paper's statements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from scipy import stats

from benchmarks.papers.record import Finding
from benchmarks.papers.tian2024.replications import FIGURE7_METHOD, Key, ReplicationRun

INTERVAL_CONFIDENCE = 0.95
_UPPER = 0.5 + INTERVAL_CONFIDENCE / 2
_LOWER = 0.5 - INTERVAL_CONFIDENCE / 2
Ends = tuple[float, float]


@dataclass(frozen=True)
class ReplicationSummary:
    """A method on a system in a scenario, over its replications.

    Example:
        >>> summary = ReplicationSummary.of_estimates([1e-4, 3e-4, 2e-4, 2e-4], simulations=1000.0)
        >>> f"{summary.mean:.1e}", round(summary.cov, 3), round(summary.squared_cov, 3)
        ('2.0e-04', 0.408, 0.167)
    """

    replications: int
    mean: float
    """Of the estimates of p."""
    cov: float
    """Standard deviation of the estimates over their mean; NaN where all are 0."""
    simulations: float
    """Mean number of simulations as the paper counts them: without the search of importance sampling."""
    all_simulations: float
    """Mean number of all simulations, counted outside the method."""
    truth: float
    """p by Monte Carlo; its own error is left out."""

    @classmethod
    def of_estimates(
        cls, p: Sequence[float], simulations: float, all_simulations: float | None = None, truth: float | None = None
    ) -> ReplicationSummary:
        """Return the summary of two estimates or more; p is their mean where no truth is given."""
        if len(p) < 2:
            raise ValueError(f"Expected 2 replications at least, got {len(p)}.")
        mean, spread = float(np.mean(p)), float(np.std(p, ddof=1))
        all_simulations = simulations if all_simulations is None else all_simulations
        cov = spread / mean if mean > 0 else math.nan
        return cls(len(p), mean, cov, simulations, all_simulations, mean if truth is None else truth)

    @property
    def squared_cov(self) -> float:
        """What the paper prints as COV."""
        return self.cov**2

    @property
    def mean_interval(self) -> Ends:
        """Interval of the mean by Student's distribution."""
        half = float(stats.t.ppf(_UPPER, self.replications - 1)) * self.cov * self.mean / self.replications**0.5
        return max(self.mean - half, 0.0), self.mean + half

    @property
    def cov_interval(self) -> Ends:
        """Interval of the c.o.v. by the chi-square distribution of the variance of normal estimates."""
        df = self.replications - 1
        low, high = (float(stats.chi2.ppf(share, df)) for share in (_UPPER, _LOWER))
        return self.cov * (df / low) ** 0.5, self.cov * (df / high) ** 0.5

    @property
    def squared_cov_interval(self) -> Ends:
        """Square of `cov_interval`."""
        low, high = self.cov_interval
        return low**2, high**2

    @property
    def error(self) -> float:
        """Mean of the estimates over p by Monte Carlo, less 1."""
        return self.mean / self.truth - 1.0

    @property
    def work(self) -> float:
        """All simulations times the mean square error over p², p by Monte Carlo; less is better."""
        spread = 0.0 if self.mean == 0.0 else (self.cov * self.mean / self.truth) ** 2
        return self.all_simulations * (spread + self.error**2)

    @property
    def gain(self) -> float:
        """Variance of plain Monte Carlo with as many simulations, search included, over the mean square error.

        The c.o.v. alone would praise a method that misses most of p in all of its runs.
        """
        work = self.truth * self.work
        return (1.0 - self.truth) / work if work > 0 else math.nan

    @property
    def gain_interval(self) -> Ends:
        """Interval of the gain by the chi-square distribution of the mean square error of normal estimates."""
        df = self.replications - 1
        low, high = (float(stats.chi2.ppf(share, df)) for share in (_LOWER, _UPPER))
        return self.gain * low / df, self.gain * high / df


Summaries = Mapping[Key, ReplicationSummary]


def group_runs(runs: Iterable[ReplicationRun]) -> dict[Key, list[ReplicationRun]]:
    """Return the runs by scenario, system and method."""
    groups: dict[Key, list[ReplicationRun]] = {}
    for run in runs:
        groups.setdefault(run.row, []).append(run)
    return groups


def summarise_runs(runs: Iterable[ReplicationRun]) -> dict[Key, ReplicationSummary]:
    """Return the summaries by scenario, system and method; the truth of a system is its Monte Carlo."""
    groups = group_runs(runs)
    truths = {key[:2]: float(np.mean([run.p for run in group])) for key, group in groups.items() if key[2] == "MC"}
    return {
        key: ReplicationSummary.of_estimates(
            [run.p for run in group],
            float(np.mean([run.final for run in group])),
            float(np.mean([run.simulated for run in group])),
            truths.get(key[:2]),
        )
        for key, group in groups.items()
    }


def ratio_of_work(one: ReplicationSummary, other: ReplicationSummary) -> tuple[float, Ends]:
    """Return the work of one method over that of another, and its interval by the F distribution of two variances.

    Example:
        >>> noisy = ReplicationSummary(20, 1e-4, 0.4, 2000.0, 2000.0, truth=1e-4)
        >>> exact = ReplicationSummary(20, 1e-4, 0.2, 1000.0, 1000.0, truth=1e-4)
        >>> ratio, (low, high) = ratio_of_work(noisy, exact)
        >>> round(ratio, 3), round(low, 2), round(high, 1)
        (8.0, 3.17, 20.2)
    """
    ratio = one.work / other.work
    df = one.replications - 1, other.replications - 1
    low, high = (float(stats.f.ppf(share, *df)) for share in (_UPPER, _LOWER))
    return ratio, (ratio / low, ratio / high)


def assess_claims(runs: Sequence[ReplicationRun]) -> list[Finding]:
    """Return the paper's statements with what the replications say about them, as far as there are runs."""
    found = summarise_runs(runs)
    return [*_efficiency(found, "SS"), *_efficiency(found, "IS"), *_accuracy(found), *_moves(runs)]


def _efficiency(found: Summaries, other: str) -> Iterator[Finding]:
    for scenario, system, method in found:
        if method == "ADSS" and (scenario, system, other) in found:
            ratio, ends = ratio_of_work(found[scenario, system, other], found[scenario, system, "ADSS"])
            yield Finding(
                claim=f"ADSS needs fewer simulations than {other} ({scenario}, {system})",
                statistic=f"all simulations times mean square error of {other} over that of ADSS",
                value=ratio,
                interval=ends,
                verdict=_judge(ends, 1.0),
            )


def _accuracy(found: Summaries) -> Iterator[Finding]:
    for (scenario, system, method), ours in found.items():
        if method != "IS" or (scenario, system, "MC") not in found:
            continue
        truth = found[scenario, system, "MC"]
        ratio = 1.0 + ours.error
        error = ratio * (ours.cov**2 / ours.replications + truth.cov**2 / truth.replications) ** 0.5
        half = float(stats.t.ppf(_UPPER, ours.replications - 1)) * error
        ends = ratio - half, ratio + half
        yield Finding(
            claim=f"IS is off by 2 to 17 % ({scenario}, {system})",
            statistic="mean of p by IS over that by Monte Carlo",
            value=ratio,
            interval=ends,
            verdict="no error to be seen" if ends[0] <= 1.0 <= ends[1] else f"off by {100 * (ratio - 1):+.0f} %",
        )


_MOVES = (
    (1, 1.0, "the cutter's speed v2 increases from subset to subset", "m/s"),
    (3, -1.0, "the gap dis1x to it decreases from subset to subset", "m"),
)
"""Columns of the cut-in, the signs of their moves, the paper's statements and units."""


def _moves(runs: Sequence[ReplicationRun]) -> Iterator[Finding]:
    for system, group in groupby(sorted(runs, key=lambda run: run.system), lambda run: run.system):
        means = [
            run.level_means
            for run in group
            if (run.scenario, run.method) == ("cut-in", FIGURE7_METHOD) and len(run.level_means) > 1
        ]
        for column, sign, claim, unit in _MOVES if len(means) > 1 else ():
            moved = np.array([levels[-1][column] - levels[0][column] for levels in means])
            error = moved.std(ddof=1) / len(moved) ** 0.5
            half = float(stats.t.ppf(_UPPER, len(moved) - 1)) * error
            ends = float(moved.mean() - half), float(moved.mean() + half)
            yield Finding(
                claim=f"{claim} (cut-in, {system})",
                statistic=f"mean in the last subset less that in the first [{unit}]",
                value=float(moved.mean()),
                interval=ends,
                verdict=_judge(ends if sign > 0 else (-ends[1], -ends[0]), 0.0),
            )


def _judge(ends: Ends, bound: float) -> str:
    """Return whether a statistic that the statement has above a bound is so."""
    if ends[0] > bound:
        return "holds"
    return "the opposite holds" if ends[1] < bound else "cannot be told from these replications"
