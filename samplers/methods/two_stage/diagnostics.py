"""Checks of a `TwoStage` estimate against what else was simulated: what would show had a region been missed."""

import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

from samplers.importance.draws import Draws
from samplers.methods.two_stage.stratified import StratifiedSample
from samplers.statistics.weights import effective_sample_size

FALSE_ALARM = 1e-3
"""Probability with which a check warns of a right estimate."""
ROUNDS_APART = 4.0
"""Standard errors between the rounds and the estimate."""
ENOUGH_ESS = 30.0
LOW_RATE = 0.025
"""Independent failures for each final draw. With less, weights are so uneven that heavy ones may not have been met."""
LEFT_OUT = 0.05
"""Share of p that a single draw in a region may stand for."""


def check_base_draws(p: float, hits: int, n: int) -> list[str]:
    """Warn where more of n plain base draws fail than an estimate p allows.

    Base draws know of no proposal: they hit a missed region as often as any other.
    """
    if hits == 0 or stats.binom.sf(hits - 1, n, min(p, 1.0)) > FALSE_ALARM:
        return []
    expected = n * p
    return [f"{hits} of {n:,} base draws failed where p = {p:.2e} lets expect {expected:.2g}: p misses failures."]


def check_rounds(strata: StratifiedSample, rounds: Sequence[Draws]) -> list[str]:
    """Warn where the rounds before, each weighed by its own proposal, together say something else.

    Weighed as draws from all rounds' proposals together they would be worth more, but are often too low by a third:
    later proposals depend on earlier draws.
    """
    n = sum(draws.n for draws in rounds)
    log_weights = np.concatenate([np.empty(0), *(draws.log_weights for draws in rounds)])
    if len(strata.draws.f) == 0 or effective_sample_size(log_weights) < ENOUGH_ESS:
        return []
    w = np.exp(log_weights)
    before, error = float(w.sum()) / n, math.sqrt(float((w * w).sum())) / n
    apart = abs(before - strata.p) / math.hypot(error, strata.cov * strata.p)
    if apart < ROUNDS_APART:
        return []
    return [f"The rounds before the estimate say {before:.2e}, {apart:.1f} standard errors from it."]


def check_efficiency(strata: StratifiedSample) -> list[str]:
    """Warn where the draws are worth so little that the weights may have a tail that none of them has met."""
    draws = strata.draws
    if len(draws.f) == 0 or draws.ess >= LOW_RATE * draws.n:
        return []
    return [f"{draws.n:,} draws are worth {draws.ess:.0f} failures: there may be heavier weights than any met."]


def check_regions(strata: StratifiedSample) -> list[str]:
    """Warn of regions where the points that the exploration found have weights that p cannot do without.

    Where one draw is worth some per cent of p, the proposal does not describe the region, and that the final draws
    met hardly any of that weight says nothing.
    """
    share = strata.typical / max(strata.draws.n * strata.p, 1e-300)
    lost = int((share > LEFT_OUT).sum())
    if lost == 0 or len(strata.draws.f) == 0:
        return []
    return [
        f"The draws hardly reach {lost} of {len(share)} regions found: a point there would be {share.max():.0%} of p."
    ]
