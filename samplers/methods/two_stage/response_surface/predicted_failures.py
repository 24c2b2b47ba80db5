"""Predicted failures: states of chains on a regression of f, where the regression has proved itself.

v(u) = phi(u) / (q(u) n p) is the share of p that a failing point u would be as one of n draws of a proposal q. It is
known everywhere; which points fail is not. A regression of f says it, and chains on the regression draw U ~ N(0, I)
given failure. The regression has to prove itself: at points near the limit state that it has not seen, at all simulated
points that it says fail, and at those of them where v is large. So a place counts only where simulations of the search
have failed.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from samplers.methods.two_stage.mixture.proposal import MixtureProposal
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, PieceSettings
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.refinement import RefinementState
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

    @classmethod
    def of_search(cls, history: MultipleImportanceSample, refinement: RefinementState) -> "Simulated":
        """Return all draws of the search, and what was proposed to the chains of the regions."""
        drawn = [cls.of(batch.u, batch.f, refinement.gamma) for batch in history.batches]
        return cls.join([*drawn, *(cls.of(region.u, region.f, refinement.gamma) for region in refinement.regions)])

    @property
    def distinct(self) -> "Simulated":
        """The first of equal points: a point that several regions share must not test the fit that it was part of."""
        first = np.sort(np.unique(self.u, axis=0, return_index=True)[1])
        return Simulated(self.u[first], self.y[first])

    @property
    def failing(self) -> FloatArray:
        """The failing points, shape (k, d)."""
        return np.asarray(self.u[self.y <= 0])


class PlannedDraws(NamedTuple):
    """Draws of a proposal, made or to be made."""

    proposal: MixtureProposal
    n: int
    """How many there are."""
    p: float
    """The estimate."""

    def shares(self, u: FloatArray) -> FloatArray:
        """Return v, the share of p that each point u (k, d) would be as one of the draws, shape (k,)."""
        return np.asarray(np.exp(np.minimum(self.proposal.log_weights(u), MAX_LOG_WEIGHT)) / (self.n * self.p))


def believe_surface(
    known: Simulated,
    draws: PlannedDraws,
    axes: FloatArray | None,
    rng: np.random.Generator,
    settings: SurfaceSettings = DEFAULT_SURFACE_SETTINGS,
    pieces: PieceSettings = DEFAULT_MIXTURE_SETTINGS.pieces,
) -> Predictor | None:
    """Return a regression of f in all coordinates; None where too few failures are heavy, or where it is not believed.

    Args:
        known: What was simulated.
        draws: A failure is heavy as one of these.
        axes: Orthonormal directions in which f changes, shape (d, r); None for all coordinates.
        rng: Source of randomness of the fits.
        settings: When the regression is believed.
        pieces: Of the regression by pieces.
    """
    known = known.distinct
    if np.count_nonzero(draws.shares(known.failing) > settings.heavy_share) < settings.least_heavy:
        return None

    def project(u: FloatArray) -> FloatArray:
        return u if axes is None else u @ axes

    surface = fit_surface(project(known.u), known.y, rng, settings, pieces)
    if surface is None or surface.accuracy < settings.min_accuracy:
        return None

    def predict(u: FloatArray) -> FloatArray:
        return surface.predict(project(u))

    return predict if _is_right(predict, known, draws, settings) else None


def _is_right(predict: Predictor, known: Simulated, draws: PlannedDraws, settings: SurfaceSettings) -> bool:
    """Return whether the simulated points that should fail do, those that are heavy as well."""
    said = predict(known.u) <= 0
    if not said.any():
        return False
    fails, heavy = known.y[said] <= 0, draws.shares(known.u[said]) > settings.heavy_share
    enough = np.count_nonzero(heavy) >= settings.least_heavy
    return bool(fails.mean() >= settings.min_accuracy and enough and fails[heavy].mean() >= settings.min_heavy_accuracy)


def walk_failures(predict: Predictor, u: FloatArray, steps: int, rng: np.random.Generator) -> Iterator[FloatArray]:
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
