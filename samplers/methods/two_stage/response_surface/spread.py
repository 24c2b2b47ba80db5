"""Spread: the c.o.v. that the last draws should have, by a regression of f, beside the one that they show.

The variance of the mean of n draws of a proposal q is that of their weights. Draws that hardly reach a part of the
failures do not show it: with v(u) = phi(u) / (q(u) n p), the share of p that u would be as one of them,

    (c.o.v. of p)^2 = E[v(U) | U fails] - 1 / n,    U ~ N(0, I)

and where v is 0.1, a tenth of p lies where one draw in ten runs comes. v is known everywhere, which points fail is not:
a regression of f says it, and chains on the regression draw U given failure. The regression has to prove itself: at
points near the limit state that it has not seen, at all simulated points that it says fail, and at those of them where
v is large. So a place counts only where simulations of the search have failed.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from samplers.methods.two_stage.mixture.proposal import MixtureProposal
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, PieceSettings
from samplers.methods.two_stage.response_surface.settings import DEFAULT_SURFACE_SETTINGS, SurfaceSettings
from samplers.methods.two_stage.response_surface.surfaces import Predictor, fit_surface
from samplers.methods.two_stage.stratified import MAX_LOG_WEIGHT
from samplers.problem import FloatArray

ACCEPTANCE = 0.4
"""Acceptance that the step of the chains is adapted to (0.44 in one dimension; Papaioannou et al. 2015) ..."""
MIN_STEP = 0.05
"""... and its least value."""


class Simulated(NamedTuple):
    """Points and their outcomes."""

    u: FloatArray
    """Shape (n, d)."""
    y: FloatArray
    """f - gamma, shape (n,)."""

    @classmethod
    def none(cls, dim: int) -> "Simulated":
        """Return no points in d dimensions."""
        return cls(np.empty((0, dim)), np.empty(0))

    @classmethod
    def of(cls, u: FloatArray, f: FloatArray, gamma: float) -> "Simulated":
        """Return those of the points u (n, d) whose outcomes f (n,) are finite."""
        finite = np.isfinite(f)
        return cls(u[finite], f[finite] - gamma)

    @classmethod
    def join(cls, parts: Sequence["Simulated"]) -> "Simulated":
        """Return the points of several parts, one or more."""
        return cls(np.concatenate([part.u for part in parts]), np.concatenate([part.y for part in parts]))

    @property
    def failing(self) -> FloatArray:
        """The failing points, shape (k, d)."""
        return np.asarray(self.u[self.y <= 0])


class LastDraws(NamedTuple):
    """The draws of the last proposal."""

    proposal: MixtureProposal
    n: int
    """How many there are."""
    p: float
    """The estimate."""
    cov: float
    """Their own c.o.v."""
    kept: Simulated
    """The first ones."""

    def shares(self, u: FloatArray) -> FloatArray:
        """Return v, the share of p that each point u (k, d) would be as one of the draws, shape (k,)."""
        return np.asarray(np.exp(np.minimum(self.proposal.log_weights(u), MAX_LOG_WEIGHT)) / (self.n * self.p))


def check_spread(
    draws: LastDraws,
    searched: Simulated,
    axes: FloatArray | None,
    rng: np.random.Generator,
    settings: SurfaceSettings = DEFAULT_SURFACE_SETTINGS,
    pieces: PieceSettings = DEFAULT_MIXTURE_SETTINGS.pieces,
) -> list[str]:
    """Return a warning if a regression of f predicts a c.o.v. far above that of the draws.

    Arguments as of `predict_cov`.
    """
    predicted = predict_cov(draws, searched, axes, rng, settings, pieces)
    if predicted is None or not predicted > settings.max_ratio * draws.cov:
        return []
    return [
        f"Failures lie where hardly a final draw comes: a regression of f predicts a c.o.v. of {predicted:.2g} where "
        f"the draws show {draws.cov:.2g}; p may be too low."
    ]


def predict_cov(
    draws: LastDraws,
    searched: Simulated,
    axes: FloatArray | None,
    rng: np.random.Generator,
    settings: SurfaceSettings = DEFAULT_SURFACE_SETTINGS,
    pieces: PieceSettings = DEFAULT_MIXTURE_SETTINGS.pieces,
) -> float | None:
    """Return the c.o.v. by a regression of f; None where too few failures are heavy or no regression is believed.

    Args:
        draws: Of the last proposal.
        searched: All else that was simulated.
        axes: Orthonormal directions in which f changes, shape (d, r); None for all coordinates.
        rng: Source of randomness of the fits and of the chains.
        settings: When the regression is believed.
        pieces: Of the regression by pieces.
    """
    starts = draws.kept.failing
    if draws.p == 0 or len(starts) == 0:
        return None
    known = Simulated.join([searched, draws.kept])
    if np.count_nonzero(draws.shares(known.failing) > settings.heavy_share) < settings.least_heavy:
        return None

    def project(u: FloatArray) -> FloatArray:
        return u if axes is None else u @ axes

    surface = fit_surface(project(known.u), known.y, rng, settings, pieces)
    if surface is None or surface.accuracy < settings.min_accuracy:
        return None

    def predict(u: FloatArray) -> FloatArray:
        return surface.predict(project(u))

    if not _is_right(predict, known, draws, settings):
        return None
    weights = draws.shares(starts)
    first = starts[rng.choice(len(starts), settings.chains, p=weights / weights.sum())]
    means = [float(draws.shares(states).mean()) for states in _walk(predict, first, settings.steps, rng)]
    return math.sqrt(max(float(np.mean(means)) - 1 / draws.n, 0.0))


def _is_right(predict: Predictor, known: Simulated, draws: LastDraws, settings: SurfaceSettings) -> bool:
    """Return whether the simulated points that should fail do, those that are heavy as well."""
    said = predict(known.u) <= 0
    if not said.any():
        return False
    fails, heavy = known.y[said] <= 0, draws.shares(known.u[said]) > settings.heavy_share
    enough = np.count_nonzero(heavy) >= settings.least_heavy
    return bool(fails.mean() >= settings.min_accuracy and enough and fails[heavy].mean() >= settings.min_heavy_accuracy)


def _walk(predict: Predictor, u: FloatArray, steps: int, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Yield states (k, d) of chains from u (k, d) given that they should fail, in the second half of their steps.

    Conditional sampling v = sqrt(1 - s^2) u + s xi, xi ~ N(0, I), as in subset simulation, all at one s.
    """
    step = 0.5
    for k in range(steps):
        proposed = math.sqrt(1 - step * step) * u + step * rng.standard_normal(u.shape)
        fails = predict(proposed) <= 0
        u = np.where(fails[:, None], proposed, u)
        step = min(max(step * math.exp(0.5 * (float(fails.mean()) - ACCEPTANCE)), MIN_STEP), 1.0)
        if k >= steps // 2:
            yield u
