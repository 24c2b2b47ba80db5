"""Gaussian mixtures fitted to events; the Bayesian information criterion selects the number of components."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from samplers.problem import FloatArray
from training.fit.expectation_maximisation import EmFit, fit_mixture_of_starts

MAX_COMPONENTS = 5
"""Most components that are tried."""
EVENTS_PER_COMPONENT = 10
"""Events per component and dimension that a number of components needs to be tried."""
SMALLEST_COMPONENT = 5
"""Events per dimension below which a component has collapsed on a handful of them."""
COVARIANCE_FLOOR = 0.01
"""Added to variances of standardised data: a tenth of a standard deviation."""
EM_STARTS = 20
"""Starts of expectation maximisation for each number of components."""


@dataclass(frozen=True)
class MixtureCandidate:
    """A fit with one number of components."""

    components: int
    bic: float
    """Bayesian information criterion in the units of the points, smaller is better."""
    smallest: float
    """Events in the smallest component (sum of its responsibilities)."""
    accepted: bool
    """False if a component has collapsed on a handful of events."""


class Components(NamedTuple):
    """Components of a Gaussian mixture, heaviest first."""

    weights: FloatArray
    """Shape (K,), sum 1."""
    means: FloatArray
    """Shape (K, d)."""
    covariances: FloatArray
    """Shape (K, d, d)."""


@dataclass(frozen=True)
class MixtureFit:
    """A fitted mixture, and the fits that it was selected from.

    Example:
        >>> points = np.random.default_rng(0).standard_normal((60, 2))
        >>> fit = select_mixture(points)
        >>> [candidate.components for candidate in fit.candidates]
        [1, 2, 3]
    """

    components: Components
    candidates: tuple[MixtureCandidate, ...]

    @property
    def bic(self) -> float:
        """Bayesian information criterion of the mixture that was selected."""
        return min(candidate.bic for candidate in self.candidates if candidate.accepted)


def select_mixture(
    points: FloatArray,
    seed: int = 0,
    most: int = MAX_COMPONENTS,
    starts: int | None = None,
    names: Sequence[str] = (),
) -> MixtureFit:
    """Return the Gaussian mixture with the least BIC.

    For K = 1, 2, ... while there are `EVENTS_PER_COMPONENT` d events per component: expectation maximisation on
    standardised data from several seeded starts, with a floor under the covariances. Fits with a component of
    fewer than `SMALLEST_COMPONENT` d events are rejected.

    Args:
        points: Events, shape (n, d), with n > d.
        seed: Seed of the starts; the same seed gives the same fit.
        most: Largest number of components to try.
        starts: Starts for each number of components; `EM_STARTS` if None.
        names: Of the parameters, for messages; parameter 0, parameter 1 and so on by default.

    Raises:
        ValueError: There are no more events than parameters, or one of them does not vary.

    Example:
        >>> points = np.random.default_rng(0).standard_normal((60, 2))
        >>> select_mixture(points).components.weights.tolist()
        [1.0]
    """
    n, d = points.shape
    if n <= d:
        raise ValueError(f"{n} events are too few to fit {d} parameters; more than {d} are needed.")
    centre, scale = points.mean(axis=0), points.std(axis=0)
    if (scale == 0).any():
        which, value = int(np.argmin(scale)), float(centre[np.argmin(scale)])
        name = names[which] if names else f"parameter {which}"
        raise ValueError(f"Expected {name} to vary, got {value:.6g} in all {n} events.")
    standard = (points - centre) / scale
    most = int(np.clip(n // (EVENTS_PER_COMPONENT * d), 1, most))
    starts = EM_STARTS if starts is None else starts
    models = [fit_mixture_of_starts(standard, k, COVARIANCE_FLOOR, seed, starts) for k in range(1, most + 1)]
    # A density in units of the points is smaller by the product of the scales.
    units = 2.0 * n * float(np.log(scale).sum())
    candidates = tuple(_assess(model, n, units) for model in models)
    accepted = [i for i, candidate in enumerate(candidates) if candidate.accepted]
    best = models[min(accepted, key=lambda i: candidates[i].bic)]
    covariances = best.covariances * np.outer(scale, scale)
    return MixtureFit(_round_components(best.weights, centre + best.means * scale, covariances), candidates)


def _assess(model: EmFit, n: int, units: float) -> MixtureCandidate:
    """Return BIC and smallest component of a model of n points."""
    k, d = model.means.shape
    smallest = float(model.weights.min() * n)
    accepted = k == 1 or smallest >= SMALLEST_COMPONENT * d
    free = k - 1 + k * d + k * d * (d + 1) // 2
    bic = -2.0 * model.log_likelihood + free * float(np.log(n))
    return MixtureCandidate(k, bic + units, smallest, accepted)


def _round_components(weights: FloatArray, means: FloatArray, covariances: FloatArray) -> Components:
    """Return components to six significant digits, heaviest first.

    More digits would say nothing about the traffic and differ between machines.
    """
    order = np.argsort(-weights)
    shares = np.round(weights[order], 6)
    shares[0] = 1.0 - shares[1:].sum()
    symmetric = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    return Components(shares, _round_significant(means[order]), _round_significant(symmetric[order]))


def _round_significant(values: FloatArray) -> FloatArray:
    """Return values to six significant digits."""
    rounded = np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[np.float64])(values)
    return np.asarray(rounded, dtype=np.float64)


def append_independent(joint: Components, apart: Components) -> Components:
    """Return the joint distribution of two independent parts: a mixture, followed by one of a single component."""
    k, own = joint.means.shape
    d = own + apart.means.shape[1]
    covariances = np.zeros((k, d, d))
    covariances[:, :own, :own] = joint.covariances
    covariances[:, own:, own:] = apart.covariances
    return Components(joint.weights, np.hstack([joint.means, np.repeat(apart.means, k, axis=0)]), covariances)
