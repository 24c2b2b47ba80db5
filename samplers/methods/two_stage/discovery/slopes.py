"""Slopes: the few directions in which f changes at its failures, by finite differences.

In dozens of dimensions some hundred failing points do not show in which directions failures differ from N(0, I).
Gradients of f at a handful of points do, where few directions matter or f is the least or largest of a few nearly
linear functions. Each gradient costs a simulation for each dimension.

References:
    Uribe, Papaioannou, Marzouk and Straub, "Cross-entropy-based importance sampling with failure-informed dimension
    reduction for rare event simulation", SIAM/ASA Journal on Uncertainty Quantification 9, 2021 (eigenvectors of
    E[grad f grad f^T] over failures, there with gradients that the simulator gives).
"""

import numpy as np

from samplers.methods.two_stage.regions import ExplorationResult
from samplers.methods.two_stage.settings import SlopeSettings
from samplers.methods.two_stage.simulator import SimulationSteps, Simulator
from samplers.problem import FloatArray


def find_slopes(
    simulator: Simulator,
    exploration: ExplorationResult,
    gamma: float,
    room: int,
    rng: np.random.Generator,
    settings: SlopeSettings,
    high_dim: int,
) -> SimulationSteps[FloatArray | None]:
    """Return orthonormal directions in which f changes around the failures, shape (d, r); None where they are not few.

    The gradients are made in three batches. Later ones go where the known directions explain least, and are not made
    where there are too many directions, or where the batch before was explained by what was known.

    Args:
        simulator: Gives outcomes.
        exploration: Regions of failure.
        gamma: Threshold of failure.
        room: Simulations left of the budget.
        rng: Source of randomness.
        settings: Dimensions, simulations, step.
        high_dim: Above so many dimensions a component has one direction without slopes.
    """
    dim = simulator.inputs.dim
    short = exploration.scattered or dim > high_dim
    n = min(int((settings.high_dim_share if short else settings.share) * room / (dim + 1)), settings.most)
    if dim < settings.min_dim or n < settings.least or exploration.noisy or not exploration.regions:
        return None
    first = max(n - n // 2, settings.least)
    points = _choose_points(exploration, first, gamma, rng)
    slopes = yield from _differentiate(simulator, points, settings.step)
    for size in ((n - first + 1) // 2, (n - first) // 2):
        if not _have_few_directions(slopes, settings):
            return None
        axes = _leading_directions(slopes, settings)
        points = _choose_unexplained(exploration, size, gamma, axes)
        more = yield from _differentiate(simulator, points, settings.step)
        slopes = np.concatenate([slopes, more])
        if ((more @ axes) ** 2).sum() >= settings.explained * len(more):
            break
    return _leading_directions(slopes, settings) if _have_few_directions(slopes, settings) else None


def _choose_points(exploration: ExplorationResult, n: int, gamma: float, rng: np.random.Generator) -> FloatArray:
    """Return at most n points (k, d), in turn the end of a chain of each region and a point beside each.

    f may be capped within a region or beside it; and where failure needs several things at once, a point beside it
    lacks the one that all points inside may have in plenty.
    """
    inside = [region.chains[:, -1] for region in exploration.regions]
    beside = [region.u[region.f > gamma] for region in exploration.regions]
    groups = [rng.permutation(u) for u in (*inside, *beside)]
    turns = np.concatenate([np.arange(len(u)) for u in groups])
    return np.asarray(np.concatenate(groups)[np.argsort(turns, kind="stable")[:n]])


def _choose_unexplained(exploration: ExplorationResult, n: int, gamma: float, axes: FloatArray) -> FloatArray:
    """Return n points whose outcomes known directions (d, r) explain least, shape (n, d).

    Half of them fail though they are short along these directions, the others are long and do not fail.
    """
    inside = np.concatenate([region.chains[:, -1] for region in exploration.regions])
    beside = np.concatenate([region.u[region.f > gamma] for region in exploration.regions])
    shortest = np.argsort(np.linalg.norm(inside @ axes, axis=1), kind="stable")[: n - n // 2]
    longest = np.argsort(-np.linalg.norm(beside @ axes, axis=1), kind="stable")[: n // 2]
    return np.concatenate([inside[shortest], beside[longest]])


def _differentiate(simulator: Simulator, u: FloatArray, step: float) -> SimulationSteps[FloatArray]:
    """Return the unit gradients (k, d) of f at those of the points u (n, d) where it has one."""
    n, dim = u.shape
    beside = u[:, None] + step * np.eye(dim)
    f = yield from simulator.evaluate(np.concatenate([u, beside.reshape(-1, dim)]))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # f may be infinite, or flat
        slopes = f[n:].reshape(n, dim) - f[:n, None]
        unit = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    return np.asarray(unit[np.isfinite(unit).all(axis=1)])


def _have_few_directions(slopes: FloatArray, settings: SlopeSettings) -> bool:
    """Return whether unit gradients (k, d) lie in fewer directions than random ones would.

    Of k random directions the squares of the singular values are worth k d / (k + d) equal ones: (sum s^2)^2 / sum s^4.
    """
    k, dim = slopes.shape
    if k < settings.least:
        return False
    squares = np.linalg.svd(slopes, compute_uv=False) ** 2
    return bool(squares.sum() ** 2 / (squares**2).sum() <= settings.few * k * dim / (k + dim))


def _leading_directions(slopes: FloatArray, settings: SlopeSettings) -> FloatArray:
    """Return the principal directions (d, r) of unit gradients (k, d)."""
    _, sizes, axes = np.linalg.svd(slopes, full_matrices=False)
    used = sizes**2 > settings.least_part * len(slopes)
    return np.asarray(axes[used][: settings.most_axes].T)
