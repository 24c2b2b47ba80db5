"""Does the interval hold the true p where nothing is chosen? One Gaussian by moments, p by quadrature.

    python -m benchmarks.uncertainty.moment_coverage

The worlds and draws of events of `recipe_coverage` with one component; coordinates and the number of components are
given, a fit takes a millisecond and p has no sampling error. It tells chance from fault where few draws of the whole
recipe were affordable.
"""

import json
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.special import ndtr

from benchmarks import RESULTS
from benchmarks.uncertainty.recipe_coverage import RECIPE_WORLDS, RecipeWorld
from samplers.analysis.base_uncertainty import FIT_BIAS
from samplers.statistics.refit_families import refit_quantile

MOMENT_RESULT = RESULTS / "moment_coverage.json"
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(60)

Array = NDArray[np.float64]


def probability(world: RecipeWorld, mean: Array, covariance: Array) -> Array:
    """Return P[closing speed / gap > limit], shape (...), of a Gaussian in (v, log gap, closing speed / sqrt(gap)).

    The mean over log gaps, by Gauss-Hermite quadrature, of the normal tail of the third coordinate. The box, which cuts
    off few states, is left out.

    Args:
        world: Its limit [1/s].
        mean: Shape (..., 3).
        covariance: Shape (..., 3, 3).
    """
    gap_scale = np.sqrt(covariance[..., 1, 1])
    slope = covariance[..., 2, 1] / gap_scale
    log_gap = mean[..., 1, None] + gap_scale[..., None] * NODES
    centre = mean[..., 2, None] + slope[..., None] * NODES
    scale = np.sqrt(covariance[..., 2, 2] - slope**2)[..., None]
    tail = ndtr((centre - world.limit * np.exp(log_gap / 2)) / scale)
    return np.asarray((WEIGHTS * tail).sum(-1) / WEIGHTS.sum())


def log_error_and_half_width(world: RecipeWorld, seed: int, n_refits: int) -> tuple[float, float]:
    """Return log p of a fit less that of the world, and half the width of the interval for the base distribution."""
    x, scene = (
        (drawn := world.draw(np.random.default_rng([seed, world.events, world.components]))).joint,
        drawn.clusters,
    )
    y = np.stack((x[:, 0], np.log(x[:, 2]), (x[:, 0] - x[:, 1]) / np.sqrt(x[:, 2])), axis=1)
    members = [y[scene == number] for number in range(world.scenes)]
    sizes = np.array([float(len(each)) for each in members])
    sums, squares = np.stack([each.sum(0) for each in members]), np.stack([each.T @ each for each in members])

    def log_p(counts: Array) -> Array:
        total = (counts @ sizes)[..., None]
        mean = counts @ sums / total
        second = np.tensordot(counts, squares, 1) / total[..., None]
        return np.log(probability(world, mean, second - mean[..., :, None] * mean[..., None, :]))

    resampled = np.random.default_rng(seed).multinomial(world.scenes, np.full(world.scenes, 1 / world.scenes), n_refits)
    spread = float(log_p(resampled.astype(np.float64)).std(ddof=1))
    truth = world.truth()
    error = log_p(np.ones(world.scenes)) - np.log(probability(world, truth.means[0], truth.covariances[0]))
    return float(error), refit_quantile(0.95, n_refits - 1, world.scenes) * math.hypot(spread, FIT_BIAS)


def measure_world(world: RecipeWorld, repetitions: int, n_refits: int = 100) -> dict[str, Any]:
    """Return the coverage over the draws of events of the first seeds."""
    found = np.array([log_error_and_half_width(world, seed, n_refits) for seed in range(repetitions)])
    error, half = found.T
    return {
        "name": world.name,
        "events": world.events,
        "scenes": world.scenes,
        "repetitions": repetitions,
        "covered": float((np.abs(error) <= half).mean()),
        "below": float((error < -half).mean()),
        "missed_seeds": np.flatnonzero(np.abs(error) > half).tolist(),
    }


def main(
    repetitions: Annotated[int, typer.Option(help="Draws of events for each world.")] = 2000,
    out: Annotated[Path, typer.Option(help="Where the result goes.")] = MOMENT_RESULT,
) -> None:
    """Measure the worlds of one component and write the result."""
    worlds = [measure_world(world, repetitions) for world in RECIPE_WORLDS if world.components == 1]
    command = f"python -m benchmarks.uncertainty.moment_coverage --repetitions {repetitions}"
    out.write_text(json.dumps({"command": command, "worlds": worlds}, indent=1) + "\n")
    for world in worlds:
        print(f"{world['events']} events: {world['covered']:.1%} hold p, {world['below']:.1%} lie below it")


if __name__ == "__main__":
    typer.run(main)
