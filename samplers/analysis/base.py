"""WeightedEstimate: the part of an estimate that the analyses read, and what they share."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from samplers.problem import Distribution
from samplers.sample import Sample


class HasName(Protocol):
    """A method, as far as messages name it."""

    @property
    def name(self) -> str:
        """Name on the command line."""


class HasTotal(Protocol):
    """Failing points, as far as messages count them."""

    @property
    def total(self) -> int:
        """How many failing points were simulated."""


class WeightedEstimate(Protocol):
    """An estimate with its weighted points, as far as a curve, a reweighting or shares by kind need it.

    `samplers.Estimate` is one; each attribute is described there.
    """

    @property
    def p(self) -> float:
        """Estimated probability."""

    @property
    def cov(self) -> float:
        """Coefficient of variation of p."""

    @property
    def gamma(self) -> float:
        """Threshold of failure."""

    @property
    def confidence(self) -> float:
        """Nominal coverage of the interval."""

    @property
    def seed(self) -> int:
        """Seed of the run."""

    @property
    def on_error(self) -> str:
        """What was done where f raised or gave NaN."""

    @property
    def method(self) -> HasName:
        """The method."""

    @property
    def sample(self) -> Sample | None:
        """The weighted points behind p."""

    @property
    def base(self) -> Distribution | None:
        """Distribution of X."""

    @property
    def failures(self) -> HasTotal:
        """Failing points that were kept."""


def require_sample(estimate: WeightedEstimate) -> Sample:
    """Return the weighted points of an estimate, or raise a ValueError that says there are none."""
    if estimate.sample is None:
        raise ValueError(
            f"The method {estimate.method.name!r} gave no weighted points (Outcome.sample), which this needs; "
            "or the run was stopped before there were any."
        )
    return estimate.sample


def cov_inflation(estimate: WeightedEstimate, own_cov: float) -> float:
    """Return by what the c.o.v. of units at gamma must grow to be the estimate's own; 1 where it is larger."""
    if not math.isfinite(estimate.cov) or not 0 < own_cov < math.inf:
        return 1.0
    return max(1.0, estimate.cov / own_cov)


def no_outcome_weight(estimate: WeightedEstimate, sample: Sample) -> float:
    """Return the weight of points without an outcome, where these do not count in the lower end; else 0."""
    return float(sample.weights[np.isneginf(sample.f)].sum()) if estimate.on_error == "bound" else 0.0
