"""Estimates of a threshold: naive Monte Carlo, importance sampling, and how they compare, as a record has them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.stats.contingency import relative_risk

from samplers.problem import FloatArray
from samplers.sample import clopper_pearson, effective_sample_size


def estimate_naive(f: FloatArray, gamma: float) -> dict[str, Any]:
    """Return P[f <= gamma] from outcomes f (n,): n, events, p, standard error as in the paper, 95 % interval."""
    n, events = len(f), int(np.count_nonzero(f <= gamma))
    p, interval = events / n, clopper_pearson(events, n, 0.95)
    found = {"gamma": gamma, "n": n, "events": events, "p": p, "standard_error": math.sqrt(p * (1 - p) / n)}
    return {**found, "interval": interval, "ess": None}


def estimate_weighted(f: FloatArray, log_ratios: FloatArray, gamma: float) -> dict[str, Any]:
    """Return the same as the mean of likelihood ratio times indicator, with the effective number of events."""
    n, fails = len(f), f <= gamma
    terms = np.where(fails, np.exp(log_ratios), 0.0)
    return {
        "gamma": gamma,
        "n": n,
        "events": int(fails.sum()),
        "p": float(terms.mean()),
        "standard_error": float(terms.std()) / math.sqrt(n),
        "interval": None,
        "ess": effective_sample_size(log_ratios[fails]),
    }


def compare_with_naive(found: Mapping[str, Any], reference: Mapping[str, Any], search: int) -> dict[str, Any]:
    """Compare an estimate from a sampler with the longest naive one; None where that cannot be said.

    Returns:
        gamma: The threshold of both.
        events_ratio, events_interval: Rare events in as many draws, sampler over base distribution (the paper's first
            figure), and the 95 % interval of that (Katz et al., 1978).
        variance_ratio: p (1 - p) / n of naive Monte Carlo over the sample variance of the weighted mean (their second).
        all_in: Likewise with the rollouts of the search counted: at equal total cost.
        error_ratio: The same with the squared distance from the longest naive estimate beside the sample variance: what
            is left of the gain if the sampler has missed failures.
        errors_off: Distance of the two estimates in their joint standard error.
    """
    p, error = reference["p"], found["standard_error"]
    distance, variance = found["p"] - p, p * (1.0 - p)
    all_in = variance / (found["n"] + search)
    ratios = {
        "variance_ratio": (variance / found["n"], error**2),
        "all_in": (all_in, error**2),
        "error_ratio": (all_in, distance**2 + error**2),
        "errors_off": (distance, math.hypot(error, reference["standard_error"])),
    }
    return {
        "gamma": found["gamma"],
        **_compare_events(found, reference),
        **{name: value / by if p > 0.0 and by > 0.0 else None for name, (value, by) in ratios.items()},
    }


def _compare_events(found: Mapping[str, Any], reference: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ratio of the shares of events, and its interval."""
    if not found["events"] or not reference["events"]:
        return {"events_ratio": 0.0 if reference["events"] else None, "events_interval": None}
    risk = relative_risk(found["events"], found["n"], reference["events"], reference["n"])
    interval = risk.confidence_interval(0.95)
    return {
        "events_ratio": float(risk.relative_risk),
        "events_interval": (float(interval.low), float(interval.high)),
    }
