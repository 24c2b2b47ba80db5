"""Checks of a `TwoStage` estimate against what else was simulated: what would show had a region been missed."""

import math

import numpy as np
from scipy import stats

from samplers.problem import FloatArray
from samplers.proposal import NO_REGION, Proposal
from samplers.stratified import Strata
from samplers.weights import effective_sample_size

FALSE_ALARM = 1e-3
"""Probability with which a check warns of a right estimate."""
ROUNDS_APART = 4.0
"""Standard errors between the rounds and the estimate."""
ENOUGH_ESS = 30.0
ENOUGH_DRAWS = 30


def against_base_draws(p: float, hits: int, n: int) -> list[str]:
    """Warn where more of n plain base draws fail than an estimate p allows.

    Base draws know of no proposal: they hit a missed region as often as any other.
    """
    if hits == 0 or stats.binom.sf(hits - 1, n, min(p, 1.0)) > FALSE_ALARM:
        return []
    expected = n * p
    return [f"{hits} of {n:,} base draws failed where p = {p:.2e} lets expect {expected:.2g}: p misses failures."]


def against_rounds(strata: Strata, log_weights: FloatArray) -> list[str]:
    """Warn where the rounds before, whose failing draws have these log weights (k,), together say something else."""
    if len(log_weights) == 0 or len(strata.draws.f) == 0 or effective_sample_size(log_weights) < ENOUGH_ESS:
        return []
    w = np.exp(log_weights)
    before, error = float(w.sum()), math.sqrt(float((w * w).sum()))
    apart = abs(before - strata.p) / math.hypot(error, strata.cov * strata.p)
    if apart < ROUNDS_APART:
        return []
    return [f"The rounds before the estimate say {before:.2e}, {apart:.1f} standard errors from it."]


def regions_lost(strata: Strata, proposal: Proposal) -> list[str]:
    """Warn of regions that the exploration found and where hardly a final draw made for them fails."""
    regions = np.array([candidate.region for candidate in proposal.candidates])
    lost = 0
    for region in set(regions.tolist()) - {NO_REGION}:
        own = regions == region
        lost += int(strata.counts[own].sum() >= ENOUGH_DRAWS and not strata.sums[own].any())
    return [f"{lost} of the regions found are not met again by the draws made for them."] if lost else []
