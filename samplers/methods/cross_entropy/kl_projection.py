"""Kullback-Leibler projections onto exponential families whose parameters lie in a box.

The projection of any distribution P on a family with sufficient statistic Gamma and log partition
function A maximises theta' E_P[Gamma] - A(theta): it depends on P through E_P[Gamma] alone
(O'Kelly et al. 2018, equation 2).

References:
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing
    via rare-event simulation", NeurIPS 2018.
    Bertsekas, "Projected Newton methods for optimization problems with simple constraints", SIAM
    Journal on Control and Optimization 20, 1982.
"""

from importlib import import_module
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import betaln, digamma, polygamma

from samplers.problem import FloatArray
from samplers.system.optional_libraries import needs_library

NEWTON_STEPS = 100
"""Far more than a concave function of two variables takes (about 10)."""
GRADIENT = 1e-10
"""Largest entry of the free gradient at which Newton's iteration ends."""


HALVINGS = 40
"""Of a step at most; 2^-40 of a step is rounding."""
ARMIJO = 1e-4
"""Share of the promised rise that a step must reach (Nocedal and Wright, "Numerical Optimization", section 3.1)."""
RELATIVE_ROUNDING = 1e-14
"""Relative error of the likelihood, in which a rise near the top is lost."""


def beta_statistics(alpha: FloatArray, beta: FloatArray) -> FloatArray:
    """Return E[log y] and E[log(1 - y)] for y ~ Beta(alpha, beta), each (m,), as (m, 2): the gradient of log B."""
    together = digamma(alpha + beta)
    return np.stack([digamma(alpha) - together, digamma(beta) - together], axis=-1)


def project_beta(statistics: FloatArray, low: float, high: float) -> FloatArray:
    """Return the Beta distributions in a box whose likelihood for the given statistics is largest.

    Maximises (alpha, beta) . statistics - log B(alpha, beta) over low <= alpha, beta <= high, for
    each row on its own, by Newton's method with the exact Hessian: coordinates at a bound whose
    gradient points outwards are held, the others take a Newton step, projected on the box and
    halved until it ascends (Bertsekas 1982).

    Args:
        statistics: E[log y] and E[log(1 - y)], negative and finite, shape (m, 2).
        low: Lower bound of both parameters, positive.
        high: Upper bound.

    Returns:
        alpha and beta, shape (m, 2).
    """
    theta = np.full(statistics.shape, np.clip(2.0, low, high))
    for _ in range(NEWTON_STEPS):
        gradient = statistics - beta_statistics(theta[:, 0], theta[:, 1])
        held = ((theta <= low) & (gradient < 0)) | ((theta >= high) & (gradient > 0))
        gradient = np.where(held, 0.0, gradient)
        if np.abs(gradient).max() <= GRADIENT:
            break
        step = np.asarray(np.linalg.solve(_beta_curvature(theta, held), gradient[..., None])[..., 0], np.float64)
        theta = _line_search(theta, step, gradient, statistics, low, high)
    return theta


def _beta_curvature(theta: FloatArray, held: np.ndarray) -> FloatArray:
    """Return the Hessian of log B at theta (m, 2), shape (m, 2, 2), with unit rows and columns where held."""
    coupling = np.where(held.any(axis=1), 0.0, -polygamma(1, theta.sum(axis=1)))
    diagonal = np.where(held, 1.0, polygamma(1, theta) - polygamma(1, theta.sum(axis=1))[:, None])
    hessian = np.empty((len(theta), 2, 2))
    hessian[:, 0, 0], hessian[:, 1, 1] = diagonal.T
    hessian[:, 0, 1] = hessian[:, 1, 0] = coupling
    return hessian


def _line_search(
    theta: FloatArray, step: FloatArray, gradient: FloatArray, statistics: FloatArray, low: float, high: float
) -> FloatArray:
    """Return theta + size * step, projected on the box, with size 1, 1/2, ... until the likelihood rises enough."""

    def likelihood(at: FloatArray) -> FloatArray:
        return np.asarray((at * statistics).sum(axis=1) - betaln(at[:, 0], at[:, 1]))

    start = likelihood(theta)
    size = np.ones(len(theta))
    for _ in range(HALVINGS):
        trial = np.clip(theta + size[:, None] * step, low, high)
        promised = (gradient * (trial - theta)).sum(axis=1)
        risen = likelihood(trial) - start >= ARMIJO * promised - RELATIVE_ROUNDING * np.abs(start)
        if risen.all():
            break
        size = np.where(risen, size, size / 2)
    return trial


def project_mean(target: FloatArray, centre: FloatArray, cholesky: FloatArray, radius: float) -> FloatArray:
    """Return the mean of the Normal with fixed covariance, in a box around `centre`, nearest to a distribution.

    Maximises mu' S^-1 m - mu' S^-1 mu / 2 over |mu - centre|_inf <= radius, where m is the distribution's
    mean and S = L L' the covariance. A mean inside the box is its own projection and a diagonal S
    clips each coordinate; otherwise a quadratic programme, solved by OSQP through cvxpy.

    Args:
        target: m, shape (d,).
        centre: Shape (d,).
        cholesky: L, lower triangular, shape (d, d).
        radius: Half the width of the box; inf for none.
    """
    clipped = np.clip(target, centre - radius, centre + radius)
    diagonal = np.count_nonzero(cholesky) == len(centre)
    if diagonal or radius == 0 or (clipped == target).all():
        return clipped
    return centre + radius * _box_least_squares(cholesky, (target - centre) / radius)


def _box_least_squares(cholesky: FloatArray, target: FloatArray) -> FloatArray:
    """Return z in [-1, 1]^d with the smallest |L^-1 (z - target)|.

    The objective is scaled so that the solver's absolute tolerances do not depend on units.
    """
    with needs_library("cvxpy", "A bounded step of a mean whose coordinates are correlated"):
        cp: Any = import_module("cvxpy")  # over a second to import; its functions are not typed
    inverse = solve_triangular(cholesky, np.eye(len(target)), lower=True)
    inverse /= np.abs(inverse).max()
    z = cp.Variable(len(target))
    programme = cp.Problem(cp.Minimize(cp.sum_squares(inverse @ z - inverse @ target)), [z >= -1, z <= 1])
    programme.solve(solver=cp.OSQP, max_iter=100_000)
    if z.value is None:
        raise RuntimeError(
            f"The projection on the box of the mean was not solved ({programme.status}): its covariance may be close "
            "to singular; take a wider box."
        )
    return np.clip(np.asarray(z.value, dtype=np.float64), -1.0, 1.0)
