"""WeightedEstimate: the attributes of an estimate that the analyses read, and functions that they share."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from samplers.problem import Distribution, FloatArray
from samplers.sample import Sample

MIN_UNITS = 5.0
"""Effective number of independent units (draws; paths of chains) that a result must rest on: fewer give a useless t
interval."""


@dataclass(eq=False)
class RatioStore:
    """Logarithms of density ratios at the failing points of a run, kept once they were computed.

    Example:
        >>> store, of = RatioStore(), (object(), object())
        >>> store.find(of) is None
        True
        >>> store.keep(of, np.zeros((2, 3)))
        >>> store.find(of).shape
        (2, 3)
    """

    _of: tuple[object, ...] = ()
    _ratios: FloatArray = field(default_factory=lambda: np.empty((0, 0)), repr=False)

    def find(self, of: tuple[object, ...]) -> FloatArray | None:
        """Return what was kept for these very objects; None if it was for others."""
        same = len(of) == len(self._of) > 0 and all(a is b for a, b in zip(of, self._of, strict=True))
        return self._ratios if same else None

    def keep(self, of: tuple[object, ...], ratios: FloatArray) -> None:
        """Keep the ratios that belong to these objects, and forget those before."""
        self._of, self._ratios = of, ratios


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
    def interval(self) -> tuple[float, float]:
        """Interval of p."""

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

    @property
    def refit_ratios(self) -> RatioStore:
        """Density ratios of the refits of the base, once they were asked for."""


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
