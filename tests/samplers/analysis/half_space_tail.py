"""Failure beyond a plane at 3: estimates, and what is known of the tail."""

from scipy import stats

import samplers

BETA = 3.0
P = float(stats.norm.sf(BETA))
PHI = float(stats.norm.pdf(BETA))
METHODS = ["adss", "ce", "mc", "two-stage"]


def estimate_half_space(method="two-stage", seed=0, **options):
    """Return an estimate of P = Phi(-3) in two dimensions."""
    return samplers.estimate(samplers.FunctionProblem(lambda x: BETA - x[:, 0], 2), method, seed=seed, **options)
