"""Analyses of an estimate without new simulations: thresholds, base distributions, kinds of failure, sensitivities."""

from samplers.analysis.base_error import BaseUncertainty, RefitBand
from samplers.analysis.expectation import (
    Exceedance,
    FailureExpectation,
    compute_exceedance,
    expect_over_failures,
    expect_under_refits,
)
from samplers.analysis.gate import Pilot, PlannedRun, Verdict
from samplers.analysis.reweight import FittedBase, Reweighted
from samplers.analysis.sensitivity import Sensitivity
from samplers.analysis.weighted import NO_OUTCOME_LABEL, Share, WeightedFailures, sum_by_label, weigh_failures

__all__ = [
    "NO_OUTCOME_LABEL",
    "BaseUncertainty",
    "Exceedance",
    "FailureExpectation",
    "FittedBase",
    "Pilot",
    "PlannedRun",
    "RefitBand",
    "Reweighted",
    "Sensitivity",
    "Share",
    "Verdict",
    "WeightedFailures",
    "compute_exceedance",
    "expect_over_failures",
    "expect_under_refits",
    "sum_by_label",
    "weigh_failures",
]
