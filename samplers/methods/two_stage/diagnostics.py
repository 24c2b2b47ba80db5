"""Diagnostics of an estimate: what else was simulated would show if a failure region had been missed."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import bdtrc

from samplers.importance.draws import Draws
from samplers.methods.two_stage.discovery.unseen import Discovery
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, DiagnosticSettings
from samplers.methods.two_stage.stratified import StratifiedSample
from samplers.statistics.weights import effective_sample_size


def check_base_draws(
    p: float, hits: int, n: int, settings: DiagnosticSettings = DEFAULT_SETTINGS.diagnostics
) -> list[str]:
    """Return a warning if more of n base draws failed than an estimate p allows, by a binomial test.

    Base draws do not depend on the proposal: they hit a missed region as often as any other of its probability.
    """
    if hits == 0 or bdtrc(hits - 1, n, min(p, 1.0)) > settings.false_alarm:
        return []
    expected = n * p
    return [f"{hits} of {n:,} base draws failed, but p = {p:.2e} predicts {expected:.2g}: a failure region was missed."]


def check_rounds(
    final: StratifiedSample, rounds: Sequence[Draws], settings: DiagnosticSettings = DEFAULT_SETTINGS.diagnostics
) -> list[str]:
    """Return a warning if the rounds before, each weighted by its own proposal, contradict the estimate.

    Weighted as draws from the mixture of all rounds' proposals they would be worth more, but give a p that is often too
    low by a third, for later proposals depend on earlier draws.
    """
    n = sum(draws.n for draws in rounds)
    log_weights = np.concatenate([np.empty(0), *(draws.log_weights for draws in rounds)])
    if len(final.draws.f) == 0 or effective_sample_size(log_weights) < settings.min_rounds_ess:
        return []
    w = np.exp(log_weights)
    before, error = float(w.sum()) / n, math.sqrt(float((w * w).sum())) / n
    apart = abs(before - final.p) / math.hypot(error, final.cov * final.p)
    if apart < settings.max_deviation:
        return []
    return [f"The search rounds give p = {before:.2e}, {apart:.1f} standard errors from the final estimate."]


def check_efficiency(final: StratifiedSample, settings: DiagnosticSettings = DEFAULT_SETTINGS.diagnostics) -> list[str]:
    """Return a warning if the draws are worth so few failures that there may be weights heavier than any met."""
    draws = final.draws
    if len(draws.f) == 0 or draws.ess >= settings.min_final_rate * draws.n:
        return []
    return [f"Effective sample size of {draws.n:,} draws: {draws.ess:.0f} failures; larger weights may be missing."]


def check_regions(final: StratifiedSample, settings: DiagnosticSettings = DEFAULT_SETTINGS.diagnostics) -> list[str]:
    """Return a warning if a point of the exploration in some region would be a large share of p as a draw.

    The proposal does not describe such a region, and that the final draws met hardly any of that weight says nothing.
    """
    share = final.typical / max(final.draws.n * final.p, 1e-300)
    lost = int((share > settings.max_point_share).sum())
    if lost == 0 or len(final.draws.f) == 0:
        return []
    return [
        f"The proposal barely covers {lost} of {len(share)} regions found: one draw there adds {share.max():.0%} of p."
    ]


def check_discovery(
    p: float, discovery: Discovery, confidence: float, settings: DiagnosticSettings = DEFAULT_SETTINGS.diagnostics
) -> list[str]:
    """Return a warning if so few lineages reached failure that much of p may be in regions that were not found."""
    share = discovery.unseen_share(confidence)
    if share <= settings.max_unseen_share:
        return []
    searches = f"{discovery.lineages:.0f}"
    size = f"with probability up to {p * share / (1 - share):.1e} ({share:.0%} of p)" if p else "of unknown probability"
    return [
        f"Only {searches} independent search{'' if searches == '1' else 'es'} reached failure: further failure regions "
        f"{size} cannot be excluded."
    ]
