"""p over the threshold, for the answer: thresholds from gamma up to where half of all scenarios lie."""

from __future__ import annotations

import numpy as np

import samplers
from samplers.sample import Sample

N_THRESHOLDS = 25
REACH = 0.5
"""P[f <= g] at the largest threshold."""


def compute_threshold_curve(estimate: samplers.Estimate) -> samplers.Curve | None:
    """Return p over thresholds with its band; None where the run does not tell it."""
    if estimate.sample is None or estimate.p <= 0:
        return None
    top = _find_quantile(estimate.sample)
    if not np.isfinite(top) or top <= estimate.gamma:
        return None
    try:
        return estimate.curve(np.linspace(estimate.gamma, top, N_THRESHOLDS))
    except ValueError:  # too few failing points
        return None


def _find_quantile(sample: Sample) -> float:
    """Return the f below which `REACH` of the weight lies."""
    order = np.argsort(sample.f, kind="stable")
    below = np.cumsum(sample.weights[order])
    place = min(int(np.searchsorted(below, REACH * below[-1])), len(order) - 1)
    return float(sample.f[order][place])
