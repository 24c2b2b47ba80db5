"""Estimate of a search by terms: final rounds, combined with weights that were fixed beforehand."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from samplers.importance.draws import Draws, weight_warnings, weighted_interval
from samplers.methods.two_stage.terms.settings import DoubtSettings
from samplers.problem import FloatArray, Terms
from samplers.sample import DrawWeights
from samplers.statistics.weights import effective_number, largest_weight_share

MIN_STRATUM_DRAWS = 5
"""Of strata with fewer draws the second moment stands in for the variance."""


@dataclass(frozen=True, eq=False)
class FinalRound:
    """Draws of one proposal that p rests on."""

    x: FloatArray
    """Shape (n, d)."""
    terms: Terms
    log_weights: FloatArray
    """log(phi / q), shape (n,)."""
    strata: NDArray[np.int64]
    """Shape (n,)."""
    factor: float
    """Weight of one of its draws in p, relative to other rounds."""
    first: int
    """Simulations that the run had spent before its first draw."""

    def y(self, gamma: float) -> FloatArray:
        """Weight times indicator of failure, shape (n,)."""
        return np.asarray(np.where(self.terms.f <= gamma, np.exp(self.log_weights), 0.0))

    def variance(self, gamma: float) -> float:
        """Return the variance of the mean of y, from the variances within the strata."""
        y = self.y(gamma)
        n, s1, s2 = (np.bincount(self.strata, weights=w) for w in (np.ones(len(y)), y, y * y))
        many = n >= MIN_STRATUM_DRAWS
        within = ((s2[many] - s1[many] ** 2 / n[many]) * n[many] / (n[many] - 1)).sum() + s2[~many].sum()
        return float(max(within, 0.0) + (y.max() ** 2 if len(y) else 0.0)) / len(y) ** 2


@dataclass(frozen=True, eq=False)
class CombinedRounds:
    """Final rounds as one estimate: p = sum_r c_r p_r, c_r proportional to the draws times their factor."""

    rounds: tuple[FinalRound, ...]
    gamma: float

    @cached_property
    def shares(self) -> FloatArray:
        """c_r, adding up to 1."""
        size = np.array([one.factor * len(one.log_weights) for one in self.rounds])
        return np.asarray(size / size.sum())

    @cached_property
    def means(self) -> FloatArray:
        """p_r."""
        return np.array([one.y(self.gamma).mean() for one in self.rounds])

    @cached_property
    def p(self) -> float:
        """The estimate."""
        return float(self.shares @ self.means)

    def cov(self, between_factor: float) -> float:
        """Return the c.o.v. of p; inf where it is 0.

        The variance is the larger of that within the strata and of `between_factor` sum c_r^2 (p_r - p)^2.
        """
        p, c = self.p, self.shares
        if p == 0:
            return math.inf
        within = float(c**2 @ [one.variance(self.gamma) for one in self.rounds])
        between = between_factor * float(c**2 @ (self.means - p) ** 2)
        return math.sqrt(max(within, between)) / p

    @cached_property
    def draws(self) -> Draws:
        """All draws as those from one proposal, with the same p."""
        n = sum(len(one.log_weights) for one in self.rounds)
        scaled = [
            one.log_weights + math.log(c * n / len(one.log_weights))
            for one, c in zip(self.rounds, self.shares, strict=True)
        ]
        f, x = (np.concatenate(parts) for parts in zip(*((one.terms.f, one.x) for one in self.rounds), strict=True))
        return Draws.from_outcomes(f, np.concatenate(scaled), x, self.gamma)

    @property
    def draw_weights(self) -> tuple[DrawWeights, ...]:
        """Weight of every draw in p."""
        return tuple(
            DrawWeights(first=one.first, log_weights=one.log_weights + math.log(c / len(one.log_weights)))
            for one, c in zip(self.rounds, self.shares, strict=True)
        )

    def interval(self, confidence: float, base_share: float, cov: float, ceiling: float) -> tuple[float, float]:
        """Return the log-normal interval; with t quantiles and Bernstein's bound where few draws carry p.

        Args:
            confidence: Nominal coverage.
            base_share: Share of base draws in every round.
            cov: C.o.v. of p.
            ceiling: Upper end of p by base draws; it stands in for Bernstein's bound where that is larger.
        """
        factors = self.shares / np.array([len(one.log_weights) for one in self.rounds])
        largest = float(factors.max() * sum(len(one.log_weights) for one in self.rounds)) / base_share
        return weighted_interval(self.draws, confidence, largest, cov, ceiling)

    def share_of_others(self, pursued: list[int]) -> float:
        """Return the share of p in failures whose least term was not pursued, and in points without an outcome."""
        total = other = 0.0
        for c, one in zip(self.shares, self.rounds, strict=True):
            y = c * one.y(self.gamma) / len(one.log_weights)
            total += float(y.sum())
            other += float(y[~np.isin(one.terms.least, pursued) | np.isneginf(one.terms.f)].sum())
        return other / total if total > 0 else 0.0


def doubt(combined: CombinedRounds, pursued: list[int], settings: DoubtSettings) -> list[str]:
    """Return the warnings about an estimate."""
    every = "failing draws of all rounds" if len(combined.rounds) > 1 else "failing draws"
    warnings = [text.replace("failing draws", every) for text in weight_warnings(combined.draws)]
    last = combined.rounds[-1].y(combined.gamma)
    ess = effective_number(last)
    if 0 < ess < settings.min_ess:
        warnings.append(
            f"Effective sample size of the last round's failing draws: {ess:.0f}; its standard error is unreliable."
        )
    failing = last[last > 0]
    if len(failing) and largest_weight_share(np.log(failing)) > settings.max_point_share:
        warnings.append(f"One draw carries more than {100 * settings.max_point_share:.0f} % of the last round.")
    other = combined.share_of_others(pursued)
    if other > settings.max_other_share:
        warnings.append(f"{100 * other:.0f} % of p comes from terms without a proposal of their own.")
    return warnings
