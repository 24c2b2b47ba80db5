"""Slopes: the few directions in which f changes at its failures, by finite differences.

In dozens of dimensions some hundred failing points do not show in which directions failures differ from N(0, I).
Gradients of f at a handful of points do, where few directions matter or f is the least or largest of a few nearly
linear functions. Each gradient costs a simulation for each dimension.

References:
    Uribe, Papaioannou, Marzouk and Straub, "Cross-entropy-based importance sampling with failure-informed dimension
    reduction for rare event simulation", SIAM/ASA Journal on Uncertainty Quantification 9, 2021 (eigenvectors of
    E[grad f grad f^T] over failures, there with gradients that the simulator gives).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.regions import ExplorationResult
from samplers.methods.two_stage.settings import SLOPES
from samplers.methods.two_stage.simulator import SimulationSteps, Simulator
from samplers.problem import FloatArray


def find_slopes(
    simulator: Simulator,
    exploration: ExplorationResult,
    gamma: float,
    room: int,
    rng: np.random.Generator,
    high_dim: int,
) -> SimulationSteps[FloatArray | None]:
    """Return orthonormal directions in which f changes around the failures, shape (d, r); None where they are not few.

    The gradients are made in three batches. Later ones go where the known directions explain least, and are not made
    where there are too many directions, or where the batch before was explained by what was known.
    """
    dim = simulator.inputs.dim
    short = exploration.scattered or dim > high_dim
    n = min(int((SLOPES.high_dim_share if short else SLOPES.share) * room / (dim + 1)), SLOPES.most)
    if dim < SLOPES.min_dim or n < SLOPES.least or exploration.noisy or not exploration.regions:
        return None
    points = _collect_points(exploration, gamma, rng)
    first = max(n - n // 2, SLOPES.least)
    chosen = np.argsort(points.turns, kind="stable")[:first]
    slopes = yield from _differentiate(simulator, points.u[chosen], SLOPES.step)
    for size in ((n - first + 1) // 2, (n - first) // 2):
        if not _have_few_directions(slopes):
            return None
        axes, points = _leading_directions(slopes), points.leave_out(chosen)
        chosen = _choose_unexplained(points, size, axes)
        more = yield from _differentiate(simulator, points.u[chosen], SLOPES.step)
        slopes = np.concatenate([slopes, more])
        if ((more @ axes) ** 2).sum() >= SLOPES.explained * len(more):
            break
    return _leading_directions(slopes) if _have_few_directions(slopes) else None


class _Points(NamedTuple):
    """Where gradients may be made."""

    u: FloatArray
    """Shape (n, d)."""
    fails: NDArray[np.bool_]
    """Shape (n,)."""
    turns: NDArray[np.int64]
    """Number of the point among those of its region that fail, or do not, from 0, shape (n,)."""

    def leave_out(self, chosen: NDArray[np.int64]) -> "_Points":
        """Return the others."""
        kept = np.setdiff1d(np.arange(len(self.u)), chosen)
        return _Points(self.u[kept], self.fails[kept], self.turns[kept])


def _collect_points(exploration: ExplorationResult, gamma: float, rng: np.random.Generator) -> _Points:
    """Return the ends of the chains of each region, and points beside it, each in a random order.

    f may be capped within a region or beside it: points whose outcome others share have no gradient. Where failure
    needs several things at once, a point beside the region lacks the one that all points inside may have in plenty.
    """
    groups, fails = list[FloatArray](), list[bool]()
    for region in exploration.regions:
        tied, failing = _find_ties(region.f), region.f <= gamma
        flat = failing.any() and tied[failing].mean() > 0.5
        groups += [region.chains[: 0 if flat else None, -1], region.u[~failing & ~tied]]
        fails += [True, False]
    sizes = [len(u) for u in groups]
    return _Points(
        np.concatenate([rng.permutation(u) for u in groups]),
        np.repeat(fails, sizes),
        np.concatenate([np.arange(size) for size in sizes]),
    )


def _find_ties(f: FloatArray) -> NDArray[np.bool_]:
    """Return which outcomes (n,) others share."""
    _, where, counts = np.unique(f, return_inverse=True, return_counts=True)
    return np.asarray(counts[where] > 1)


def _choose_unexplained(points: _Points, n: int, axes: FloatArray) -> NDArray[np.int64]:
    """Return the indices (k,) of at most n points whose outcomes known directions (d, r) explain least.

    Half of them fail though they are short along these directions, the others are long and do not fail.
    """
    length = np.linalg.norm(points.u @ axes, axis=1)
    shortest = np.argsort(np.where(points.fails, length, np.inf), kind="stable")[: points.fails.sum()]
    longest = np.argsort(np.where(points.fails, np.inf, -length), kind="stable")[: (~points.fails).sum()]
    half = longest[: n // 2]
    return np.concatenate([shortest[: n - len(half)], half])


def _differentiate(simulator: Simulator, u: FloatArray, step: float) -> SimulationSteps[FloatArray]:
    """Return the unit gradients (k, d) of f at those of the points u (n, d) where it has one."""
    n, dim = u.shape
    beside = u[:, None] + step * np.eye(dim)
    f = yield from simulator.evaluate(np.concatenate([u, beside.reshape(-1, dim)]))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # f may be infinite, or flat
        slopes = f[n:].reshape(n, dim) - f[:n, None]
        unit = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    return np.asarray(unit[np.isfinite(unit).all(axis=1)])


def _have_few_directions(slopes: FloatArray) -> bool:
    """Return whether unit gradients (k, d) lie in fewer directions than random ones would.

    The squares s^2 of the singular values of k random directions are worth about k d / (k + d) equal ones: that is
    (sum s^2)^2 / sum s^4.
    """
    k, dim = slopes.shape
    if k < SLOPES.least:
        return False
    squares = np.linalg.svd(slopes, compute_uv=False) ** 2
    return bool(squares.sum() ** 2 / (squares**2).sum() <= SLOPES.few * k * dim / (k + dim))


def _leading_directions(slopes: FloatArray) -> FloatArray:
    """Return the principal directions (d, r) of unit gradients (k, d)."""
    _, sizes, axes = np.linalg.svd(slopes, full_matrices=False)
    used = sizes**2 > SLOPES.least_part * len(slopes)
    return np.asarray(axes[used][: SLOPES.most_axes].T)
