"""Spread: the c.o.v. that the last draws should have, by a regression of f, beside the one that they show.

The variance of the mean of n draws of a proposal q is that of their weights. Draws that hardly reach a part of the
failures do not show it: with v(u), the share of p that u would be as one of them (`predicted_failures.py`),

    (c.o.v. of p)^2 = E[v(U) | U fails] - 1 / n,    U ~ N(0, I)

and where v is 0.1, a tenth of p lies where one draw in ten runs comes.
"""

import math
from typing import NamedTuple

import numpy as np

from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, PieceSettings
from samplers.methods.two_stage.response_surface.predicted_failures import (
    PlannedDraws,
    Simulated,
    believe_surface,
    walk_failures,
)
from samplers.methods.two_stage.response_surface.settings import DEFAULT_SURFACE_SETTINGS, SurfaceSettings
from samplers.problem import FloatArray


class LastDraws(NamedTuple):
    """The draws of the last proposal."""

    draws: PlannedDraws
    cov: float
    """Their c.o.v. as that of independent draws, as the predicted one is."""
    kept: Simulated
    """The first ones."""


def check_spread(
    last: LastDraws,
    searched: Simulated,
    axes: FloatArray | None,
    rng: np.random.Generator,
    settings: SurfaceSettings = DEFAULT_SURFACE_SETTINGS,
    pieces: PieceSettings = DEFAULT_MIXTURE_SETTINGS.pieces,
) -> list[str]:
    """Return a warning if a regression of f predicts a c.o.v. far above that of the draws.

    Arguments as of `predict_cov`.
    """
    predicted = predict_cov(last, searched, axes, rng, settings, pieces)
    if predicted is None or not predicted > settings.max_ratio * last.cov:
        return []
    return [
        f"Failures lie where hardly a final draw comes: a regression of f predicts a c.o.v. of {predicted:.2g} where "
        f"the draws show {last.cov:.2g}; p may be too low."
    ]


def predict_cov(
    last: LastDraws,
    searched: Simulated,
    axes: FloatArray | None,
    rng: np.random.Generator,
    settings: SurfaceSettings = DEFAULT_SURFACE_SETTINGS,
    pieces: PieceSettings = DEFAULT_MIXTURE_SETTINGS.pieces,
) -> float | None:
    """Return the c.o.v. by a regression of f; None where too few failures are heavy or no regression is believed.

    Args:
        last: Draws of the last proposal.
        searched: All else that was simulated.
        axes: Orthonormal directions in which f changes, shape (d, r); None for all coordinates.
        rng: Source of randomness of the fits and of the chains.
        settings: When the regression is believed.
        pieces: Of the regression by pieces.
    """
    draws, starts = last.draws, last.kept.failing
    if draws.p == 0 or len(starts) == 0:
        return None
    known = Simulated.join([searched, last.kept])
    predict = believe_surface(known, draws, axes, rng, settings, pieces)
    if predict is None:
        return None
    weights = draws.shares(starts)
    first = starts[rng.choice(len(starts), settings.chains, p=weights / weights.sum())]
    means = [float(draws.shares(states).mean()) for states in walk_failures(predict, first, settings.steps, rng)]
    return math.sqrt(max(float(np.mean(means)) - 1 / draws.n, 0.0))
