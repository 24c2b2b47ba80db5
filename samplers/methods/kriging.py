"""Kriging of f: a Gaussian process that gives every point a probability of failure.

Made robust against what simulators return:

- *Scale.* Outcomes y = f - gamma are compressed, z = arcsinh(y / c): what is far from gamma matters little.
- *Caps.* If many outcomes equal the largest (a capped time to collision) or the least one (-1 on collision), they
  are censored: known to be at least the cap, or at most 0, and replaced within these bounds by what the others predict
  there, then by their leave-one-out predictions.
- *A jump to failure* (0.5 s, then a collision) moves the limit to where points begin to fail.
- *Noise and jumps* are a nugget whose size is found with the other covariance parameters.
- *Overconfidence.* Standard deviations are inflated by the standardised residuals of leaving each point out.

References:
    Rasmussen and Williams, "Gaussian Processes for Machine Learning", MIT Press, 2006 (5.10 to 5.12: leave-one-out).
"""

import math
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve
from scipy.optimize import minimize, minimize_scalar
from scipy.special import log_ndtr

from samplers.problem import FloatArray

MANY_DIMS = 20  # In more the covariance has one length, and a linear part


class Prediction(NamedTuple):
    """Prediction of compressed outcomes minus that of gamma, at n points."""

    mean: FloatArray  # (n,)
    sd: FloatArray  # standard deviation, noise included, (n,)

    @property
    def log_fail(self) -> FloatArray:
        """Logarithm of P[f <= gamma], shape (n,)."""
        return np.asarray(log_ndtr(-self.mean / self.sd))

    @property
    def log_safe(self) -> FloatArray:
        """Logarithm of P[f > gamma], shape (n,)."""
        return np.asarray(log_ndtr(self.mean / self.sd))


@dataclass(frozen=True, eq=False)
class Kriging:
    """A fitted process: scikit-learn's `GaussianProcessRegressor`, fitted to standardised outcomes."""

    process: Any
    limit: float  # the limit state in standardised outcomes
    inflation: float  # factor on standard deviations
    scale: float  # c of the compression of outcomes, chosen when parameters are searched for
    n_searched: int  # points when covariance parameters were last searched for
    skill: float  # share of the variance of outcomes that is predicted of each from the others

    def predict(self, u: FloatArray) -> Prediction:
        """Predict at u (n, d)."""
        mean, sd = self.process.predict(u, return_std=True)
        return Prediction(mean - self.limit, np.maximum(sd, 1e-9) * self.inflation)


class Outcomes(NamedTuple):
    """Compressed outcomes, shape (n,), and which of them are only bounds."""

    z: FloatArray
    capped: NDArray[np.bool_]
    floored: NDArray[np.bool_]

    def impute(self, predicted: FloatArray) -> FloatArray:
        """Return the outcomes with those that are bounds replaced by predictions within them, shape (n,)."""
        spread = 3.0 * float(self.z.std())  # replaced outcomes lie at most so far beyond their bound
        z = np.where(self.capped, np.clip(predicted, self.z, self.z + spread), self.z)
        return np.where(self.floored, np.clip(predicted, self.z - spread, -1e-3), z)


def fit_kriging(u: FloatArray, y: FloatArray, before: Kriging | None = None) -> Kriging:
    """Fit a process to outcomes y = f - gamma (n,), infinite ones too, at u (n, d), after another of fewer."""
    if before is None or len(y) >= 1.4 * before.n_searched:
        # a search begins afresh: from the last result it may stay where few points had led it
        kernel, scale, n_searched, search = _initial_kernel(u.shape[1]), outcome_scale(y), len(y), True
    else:
        kernel, scale, n_searched, search = before.process.kernel_, before.scale, before.n_searched, False
    outcomes = compress_outcomes(y, scale)
    z, free = outcomes.z, ~(outcomes.capped | outcomes.floored)
    turns = 0 if free.all() else 2  # of replacing those at a cap by what the others predict
    if turns and free.sum() >= 5:  # enough to begin without them
        process, _, mean, sd = _fit_process(kernel, u[free], z[free], search=search)
        kernel, z = process.kernel_, outcomes.impute(mean + sd * process.predict(u))
    for turn in range(1 + turns):
        process, standard, mean, sd = _fit_process(kernel, u, z, search=search and turn == turns)
        precision = np.diag(cho_solve((process.L_, True), np.eye(len(z))))
        left_out, left_out_sd = standard - process.alpha_.ravel() / precision, 1 / np.sqrt(precision)
        if turn < turns:
            z = outcomes.impute(mean + sd * left_out)
    limit, residuals = -mean / sd, (standard - left_out) / left_out_sd
    near = np.abs(left_out - limit) < 6 * left_out_sd
    inflation = math.sqrt(float((residuals[near] ** 2).mean())) if near.any() else 1.0
    inflation = min(max(inflation, 1.0), 3.0)
    if outcomes.floored.any():  # these do not tell where f would be 0
        limit += _find_shift(left_out - limit, inflation * left_out_sd, y <= 0)
    skill = 1 - float(((standard - left_out) ** 2).mean())
    return Kriging(process, limit, inflation, scale, n_searched, skill)


def _find_shift(mean: FloatArray, sd: FloatArray, fails: NDArray[np.bool_]) -> float:
    """Return where in standardised outcomes failure begins, given each point's prediction without it, shape (n,).

    The highest posterior density with P[fail] = Phi((shift - mean) / sd) and a standard normal prior: where f jumps to
    failure, points fail whose prediction is well above 0.
    """
    sign = np.where(fails, 1.0, -1.0)

    def loss(shift: float) -> float:
        return 0.5 * shift**2 - float(log_ndtr(sign * (shift - mean) / np.maximum(sd, 1e-9)).sum())

    return float(minimize_scalar(loss, bounds=(-3.0, 3.0), method="bounded").x)


def outcome_scale(y: FloatArray) -> float:
    """Return the scale c of outcomes y = f - gamma (n,)."""
    sizes = np.abs(y[(np.abs(y) < 1e300) & (y != 0)])  # larger ones stand for infinity
    return 2 * float(np.median(sizes)) if len(sizes) else 2.0


def compress_outcomes(y: FloatArray, scale: float) -> Outcomes:
    """Return compressed outcomes of y = f - gamma (n,), and which of them stand at a cap or floor of f."""
    size = float(np.abs(y[np.abs(y) < 1e300]).max(initial=0.0)) or 1.0  # stands for infinity
    y = np.clip(y, -size, size)
    ties = max(3, 0.05 * len(y))
    capped, floored = (y == y.max()) & (y > 0), (y == y.min()) & (y <= 0)
    return Outcomes(np.arcsinh(y / scale), capped & (capped.sum() >= ties), floored & (floored.sum() >= ties))


def _initial_kernel(dim: int) -> Any:
    """Return a Matern covariance and a nugget: a length for each coordinate, or one and a linear part for many."""
    from sklearn.gaussian_process.kernels import ConstantKernel, DotProduct, Matern, WhiteKernel  # slow to import

    length = 2.0 * math.sqrt(dim)  # about the distance between two draws
    lengths = np.full(dim, length) if dim <= MANY_DIMS else length
    smooth = ConstantKernel(1.0, (1e-2, 1e3)) * Matern(lengths, (0.2, 100.0), nu=2.5)  # twice differentiable
    if dim > MANY_DIMS:
        smooth += ConstantKernel(1.0 / dim, (1e-5, 1e2)) * DotProduct(0.0, "fixed")
    return smooth + WhiteKernel(1e-4, (1e-8, 1.0))


def _fit_process(kernel: Any, u: FloatArray, z: FloatArray, *, search: bool) -> tuple[Any, FloatArray, float, float]:
    """Return the process of outcomes z (n,) at u (n, d), these standardised, their mean and standard deviation."""
    from sklearn.gaussian_process import GaussianProcessRegressor

    def climb(loss: Any, start: Any, bounds: Any) -> tuple[FloatArray, float]:
        options: Any = {"maxiter": 25}
        found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return found.x, found.fun

    mean, sd = float(z.mean()), max(float(z.std()), 1e-9)
    standard = (z - mean) / sd
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # parameters at their bounds are no concern
        if search:
            nearest = np.argsort(np.abs(z), kind="stable")[:200]  # to the limit state; a step costs their cube
            kernel = GaussianProcessRegressor(kernel, optimizer=climb).fit(u[nearest], standard[nearest]).kernel_
        return GaussianProcessRegressor(kernel, optimizer=None).fit(u, standard), standard, mean, sd
