"""Analyses of an estimate without new simulations: thresholds, base distributions, kinds of failure, sensitivities."""

from samplers.analysis.base_uncertainty import BaseUncertainty
from samplers.analysis.curve import Curve
from samplers.analysis.exceedance import Exceedance, compute_exceedance
from samplers.analysis.failure_expectation import (
    FailureExpectation,
    FurtherFailures,
    expect_over_failures,
    expect_under_refits,
)
from samplers.analysis.failure_modes import NO_OUTCOME_LABEL, Share, sum_by_label
from samplers.analysis.failure_weights import WeightedFailures, weigh_failures
from samplers.analysis.ratio_uncertainty import RatioUncertainty
from samplers.analysis.refit_band import RefitBand
from samplers.analysis.reweighting import Reweighted
from samplers.analysis.sensitivity import Sensitivity

__all__ = [
    "NO_OUTCOME_LABEL",
    "BaseUncertainty",
    "Curve",
    "Exceedance",
    "FailureExpectation",
    "FurtherFailures",
    "RatioUncertainty",
    "RefitBand",
    "Reweighted",
    "Sensitivity",
    "Share",
    "WeightedFailures",
    "compute_exceedance",
    "expect_over_failures",
    "expect_under_refits",
    "sum_by_label",
    "weigh_failures",
]
