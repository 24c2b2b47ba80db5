"""WeightedEstimate: the attributes of an estimate that the analyses read, and functions that they share."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from samplers.problem import Distribution
from samplers.sample import Sample

MIN_UNITS = 5.0
"""Effective number of independent units (draws; paths of chains) that a result must rest on: fewer give a useless t
interval."""


class HasName(Protocol):
    """An object with a name, for messages."""

    @property
    def name(self) -> str:
        """Name on the command line."""


class HasTotal(Protocol):
    """Failing points with their number, for messages."""

    @property
    def total(self) -> int:
        """Number of failing points that were simulated."""


class WeightedEstimate(Protocol):
    """The attributes of an estimate that curves, reweighting and shares by kind read.

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
        """Rule for points where f raised or gave NaN."""

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
    """Return the factor max(1, c.o.v. of the estimate / c.o.v. of its units at gamma); 1 where either is not known."""
    if not math.isfinite(estimate.cov) or not 0 < own_cov < math.inf:
        return 1.0
    return max(1.0, estimate.cov / own_cov)


def no_outcome_weight(estimate: WeightedEstimate, sample: Sample) -> float:
    """Return the weight of points without an outcome if they do not count in the lower end ("bound"); else 0."""
    return float(sample.weights[np.isneginf(sample.f)].sum()) if estimate.on_error == "bound" else 0.0
