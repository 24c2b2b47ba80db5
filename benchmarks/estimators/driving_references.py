"""Reference probabilities of collision in `samplers.benchmark.driving_models`, by importance sampling of their own.

    python -m benchmarks.estimators.driving_references --draws 2e6

A mixture of Gaussians is fitted to the failures among wide draws; the answer comes from fresh draws, 30 % of them from
N(0, I), so that no weight exceeds 1 / 0.3 and no region can be left out.
"""

from typing import Annotated

import numpy as np
import typer
from rich.progress import track
from scipy.stats import multivariate_normal
from sklearn.mixture import GaussianMixture

from samplers.benchmark.analytic_states import LimitState, PointFunction
from samplers.benchmark.driving_models import car_following, cut_in

REFERENCE_CHUNK = 50_000
BASE_SHARE = 0.3
WIDE = 1.7
"""Standard deviation of the draws that the mixture is fitted to."""


def reference(state: LimitState, draws: int, seed: int) -> tuple[float, float]:
    """Return p and its standard error from `draws` draws, and a fifth as many for the fit."""
    rng = np.random.default_rng(seed)
    mixture = _fit_mixture(state.f, state.dim, draws // 5, rng)
    base = multivariate_normal(np.zeros(state.dim))
    weights = []
    for size in track(_chunks(draws), description=f"d = {state.dim}"):
        from_base = rng.random((size, 1)) < BASE_SHARE
        u = np.where(from_base, rng.standard_normal((size, state.dim)), mixture.sample(size)[0])
        density = BASE_SHARE * base.pdf(u) + (1 - BASE_SHARE) * np.exp(mixture.score_samples(u))
        weights.append(np.where(state.f(u) <= 0, base.pdf(u) / density, 0.0))
    values = np.concatenate(weights)
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def _fit_mixture(f: PointFunction, dim: int, draws: int, rng: np.random.Generator) -> GaussianMixture:
    """Return a mixture fitted to U given failure, from wide draws that are drawn again by their weights."""
    found, weights = [], []
    for size in _chunks(draws):
        u = WIDE * rng.standard_normal((size, dim))
        failing = u[f(u) <= 0]
        found.append(failing)
        weights.append(np.exp(-0.5 * np.sum(failing**2, axis=1) * (1 - WIDE**-2)))
    points, weight = np.concatenate(found), np.concatenate(weights)
    resampled = points[rng.choice(len(points), 10_000, p=weight / weight.sum())]
    random_state = np.random.RandomState(rng.integers(2**31))  # with a plain seed all samples would be the same
    return GaussianMixture(6, reg_covar=1e-3, random_state=random_state).fit(resampled)


def _chunks(total: int) -> list[int]:
    return [min(REFERENCE_CHUNK, total - first) for first in range(0, total, REFERENCE_CHUNK)]


def main(draws: Annotated[float, typer.Option(help="Draws for each model.")] = 2e6, seed: int = 2026) -> None:
    """Print p and its standard error for both models."""
    for state in (car_following(), cut_in()):
        p, error = reference(state, int(draws), seed)
        print(f"d = {state.dim}: p = {p:.5e}, standard error {error:.1e}; in the code {state.p:.5e}")


if __name__ == "__main__":
    typer.run(main)
