"""Figures over the replications of a method: mean, c.o.v., its square, error, simulations and gain, with intervals."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from benchmarks.papers.tian2024.replications import ReplicationRun

INTERVAL_CONFIDENCE = 0.95
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
    def of_runs(cls, runs: Sequence[ReplicationRun], truth: float | None = None) -> ReplicationSummary:
        """Return the summary of runs of one method on one system in one scenario."""
        return cls.of_estimates(
            [run.p for run in runs],
            float(np.mean([run.final for run in runs])),
            float(np.mean([run.simulated for run in runs])),
            truth,
        )

    @classmethod
    def of_estimates(
        cls,
        p: Sequence[float],
        simulations: float,
        all_simulations: float | None = None,
        truth: float | None = None,
    ) -> ReplicationSummary:
        """Return the summary of two estimates or more; p is their mean where no truth is given.

        Raises:
            ValueError: There are fewer.
        """
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
        half = float(stats.t.ppf(0.5 + INTERVAL_CONFIDENCE / 2, self.replications - 1)) * self.cov * self.mean
        half /= self.replications**0.5
        return max(self.mean - half, 0.0), self.mean + half

    @property
    def cov_interval(self) -> Ends:
        """Interval of the c.o.v. by the chi-square distribution of the variance of normal estimates."""
        df = self.replications - 1
        low, high = (float(stats.chi2.ppf(0.5 + side * INTERVAL_CONFIDENCE / 2, df)) for side in (1, -1))
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
    def square_error(self) -> float:
        """Mean square error of the estimates over p², p by Monte Carlo."""
        spread = 0.0 if self.mean == 0.0 else (self.cov * self.mean / self.truth) ** 2
        return spread + self.error**2

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
        low, high = (float(stats.chi2.ppf(0.5 + side * INTERVAL_CONFIDENCE / 2, df)) for side in (-1, 1))
        return self.gain * low / df, self.gain * high / df

    @property
    def work(self) -> float:
        """All simulations times the mean square error over p²; less is better."""
        return self.all_simulations * self.square_error


def summarise_runs(runs: Iterable[ReplicationRun]) -> dict[tuple[str, str, str], ReplicationSummary]:
    """Return the summaries by scenario, system and method."""
    groups: Mapping[tuple[str, str, str], list[ReplicationRun]] = defaultdict(list)
    for run in runs:
        groups[run.scenario, run.system, run.method].append(run)
    truths = {
        (scenario, system): ReplicationSummary.of_runs(group).mean
        for (scenario, system, method), group in groups.items()
        if method == "MC"
    }
    return {key: ReplicationSummary.of_runs(group, truths.get(key[:2])) for key, group in groups.items()}


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
    low, high = (float(stats.f.ppf(0.5 + side * INTERVAL_CONFIDENCE / 2, *df)) for side in (1, -1))
    return ratio, (ratio / low, ratio / high)
