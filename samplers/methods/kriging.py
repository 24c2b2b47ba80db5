"""Kriging of f: a Gaussian process that gives every point a probability of failure.

Made robust against what simulators return:

- *Scale.* Outcomes y = f - gamma are compressed, z = arcsinh(y / c): what is far from gamma matters little.
- *Caps.* Where many outcomes equal the largest (a capped time to collision) or the least one (-1 on collision), the
  process need not pass through them. They are censored: known to be at least the cap, or at most 0, and replaced
  within these bounds by what the others predict there, then by their leave-one-out predictions.
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
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize, minimize_scalar
from scipy.special import log_ndtr

from samplers.problem import FloatArray


class KRIGING:
    """The regression of f (`kriging.py`)."""

    smoothness = 2.5  # nu of the Matern covariance: f is taken as twice differentiable
    outcome_scale = 2.0
    """Outcomes are compressed by arcsinh(y / c) with c = this times the median of |y|, y = f - gamma."""
    tie_share = 0.05
    least_ties = 3  # From these shares and numbers of equal largest (least) outcomes on, these are a cap (floor) of f
    least_uncensored = 5  # With fewer other outcomes, those at a cap or floor are taken as they are at first
    imputations = 2  # Times that outcomes at a cap are replaced by their leave-one-out predictions
    most_inflation = 3.0
    """Standard deviations are inflated by the root mean square of standardised residuals, by no more."""
    hyperparameter_steps = 25  # Steps of L-BFGS in each search for covariance parameters
    refit_growth = 1.4  # Covariance parameters are searched anew each time the points have grown by this factor
    most_points = 200  # Points nearest to the limit state that they are searched with; a step costs their cube


class LEARNING:
    """The points that kriging learns from (`surrogate.py`)."""

    share = 2 / 3  # Largest share of the budget; a third at least is left for the draws of the estimate
    most = 300  # Simulations at most: the cost of kriging grows with their cube
    scales = (1.0, 1.5, 2.2, 3.0)
    """Standard deviations of the first design, a quarter each; at 3 a plane at beta = 4.5 is crossed by one in 15."""
    design_share = 0.25
    """Share of the budget in the first design; it has at most `design_least` + `design_per_dim` d points."""
    design_least = 30
    design_per_dim = 10
    batches = 16  # Batches of the rest of the learning: simulators run the points of one side by side
    least_batch = 6
    random_share = 0.3
    """Share of a batch drawn at random where `Prediction.doubted` leaves both open: points far from the limit state of
    the surrogate, which tell whether it is right there."""
    candidates = 40  # Candidates for each point of a batch
    most_surprise = 1.5
    """Standard errors by which the failures of two batches may differ from those predicted where learning ends early:
    of a surrogate that is wrong at the limit state, all doubtful points fail, or none."""
    forecast_cov = 0.02  # Learning ends where the draws left would give this c.o.v., in two batches one after the other
    common_share = 0.1  # From this share of failing base draws on, plain Monte Carlo is as good


class POOL:
    """The pool of draws that points to simulate are chosen from (`surrogate.py`); none of them costs a simulation."""

    learning_size = 3000  # Draws of the pool in each batch of learning
    final_size = 20_000  # Draws of the last pool; its own error is 1 / sqrt(those that may fail), a part of the c.o.v.
    final_rounds = 3  # Times that the mixture is fitted anew before the last pool
    components = 5  # Gaussians of the mixture at most
    fitted_points = 800  # Points drawn from the pool to fit them to
    widening = 1.2  # Factor on their standard deviations
    shares = (0.2, 0.2, 0.6)  # Shares of base, wide and fitted draws


class PROPOSAL:
    """What the draws of the estimate are drawn from (`surrogate.py`); the surrogate has the rest.

    On the IDM cut-in, 300 simulations, 10 seeds: without doubted draws and random points 8 of 10 intervals held p and
    the gain was 34; with doubted draws alone 10 and 76, with both 10 and 190.
    """

    base_share = 0.1  # Share of base draws: no weight exceeds 1 / base_share, but for the error of the pool
    wide_share = 0.05  # Share of wide draws: they meet regions that the surrogate denies, with small weights
    doubted_share = 0.15
    """Share of draws where the surrogate would see failures if it were doubted (`Prediction.doubted`)."""


class RUN:
    """All of them, and those of the estimate."""

    least_budget = 60  # With fewer simulations all are base draws
    most_dims = 20  # In more dimensions `TwoStage` takes over: distances between points say little there
    largest_batch = 1000  # Draws of a batch at most, so that a run can be stopped
    parts = 2  # Parts of the draws of the estimate; the surrogate learns from one before the next is drawn
    most_learned = 1000
    """Draws of the estimate that the surrogate learns from at most: it costs the cube of their number."""
    target_batch = 0.1  # Draws of a batch as a share of n, where there is a target c.o.v.
    least_ess = 10.0  # Effective failing draws below which the upper end is Bernstein's bound, which is then near 1
    least_skill = 0.5  # Share of the draws proposed by the surrogate that should fail; with less, there is a warning


LARGEST = 1e300
"""Larger outcomes stand for infinite ones."""
IMPUTED_SPREAD = 3.0
"""Replaced outcomes lie at most so many standard deviations beyond their bound."""
JUST_FAILED = 1e-3
"""Least depth of a failing outcome that is replaced, in compressed units."""
LARGEST_SHIFT = 3.0
"""Failure begins at most so many standard deviations of all outcomes from the limit state."""
DOUBT = 4.0
"""Factor on standard deviations of a surrogate that is not believed: points are left out at a learned limit state lie
close together, so that their residuals say little of what is between them."""
NEAR_LIMIT = 6.0
"""Residuals count where the limit state is within so many standard deviations."""


class Prediction(NamedTuple):
    """Prediction of compressed outcomes minus that of gamma, at n points."""

    mean: FloatArray
    """Shape (n,)."""
    sd: FloatArray
    """Standard deviation, noise included, shape (n,)."""

    @property
    def doubted(self) -> "Prediction":
        """The prediction with standard deviations that are DOUBT times as large."""
        return Prediction(self.mean, DOUBT * self.sd)

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
    """A fitted process."""

    process: Any
    """scikit-learn's `GaussianProcessRegressor`, fitted to standardised outcomes."""
    limit: float
    """The limit state in standardised outcomes."""
    inflation: float
    """Factor on standard deviations."""
    scale: float
    """c of the compression of outcomes, chosen when parameters are searched for."""
    n_searched: int
    """Points when covariance parameters were last searched for."""

    def predict(self, u: FloatArray) -> Prediction:
        """Predict at u (n, d)."""
        mean, sd = self.process.predict(u, return_std=True)
        return Prediction(mean - self.limit, np.maximum(sd, 1e-9) * self.inflation)

    def covariance(self, u: FloatArray) -> FloatArray:
        """Return the posterior covariance of f without its noise at u (n, d), shape (n, n)."""
        smooth = self.process.kernel_.k1
        half = solve_triangular(self.process.L_, smooth(u, self.process.X_train_).T, lower=True)
        return np.asarray(self.inflation**2 * (smooth(u) - half.T @ half))

    @property
    def noise(self) -> float:
        """Variance of the nugget."""
        return float(self.inflation**2 * self.process.kernel_.k2.noise_level)


class _Outcomes(NamedTuple):
    """Compressed outcomes, shape (n,), and which of them are only bounds."""

    z: FloatArray
    capped: NDArray[np.bool_]
    floored: NDArray[np.bool_]


def fit_kriging(u: FloatArray, y: FloatArray, before: Kriging | None = None) -> Kriging:
    """Fit a process to outcomes y = f - gamma (n,), which may be infinite, at points u (n, d).

    The covariance parameters of `before`, fitted to some of them, are kept unless there are many more points.
    """
    search = before is None or len(y) >= KRIGING.refit_growth * before.n_searched
    scale = outcome_scale(y) if before is None or search else before.scale
    outcomes = compress_outcomes(y, scale)
    # a search begins afresh: from the last result it may stay where few points had led it
    kernel = before.process.kernel_ if before is not None and not search else _initial_kernel(u.shape[1])
    z, censored = outcomes.z, outcomes.capped | outcomes.floored
    if censored.any() and (~censored).sum() >= KRIGING.least_uncensored:
        kernel, z = _impute_first(kernel, u, outcomes, search=search)
    turns = KRIGING.imputations if censored.any() else 0
    for turn in range(1 + turns):
        standard, mean, sd = _standardise(z)
        if search and turn == turns:
            nearest = np.argsort(np.abs(z), kind="stable")[: KRIGING.most_points]
            kernel = _search_kernel(kernel, u[nearest], standard[nearest])
        process = _condition(kernel, u, standard)
        left_out, left_out_sd = _leave_one_out(process, standard)
        residuals = (standard - left_out) / left_out_sd
        if turn < turns:
            z = _impute(outcomes, mean + sd * left_out)
    limit = -mean / sd
    near = np.abs(left_out - limit) < NEAR_LIMIT * left_out_sd
    inflation = math.sqrt(float((residuals[near] ** 2).mean())) if near.any() else 1.0
    n_searched = len(y) if before is None or search else before.n_searched
    inflation = min(max(inflation, 1.0), KRIGING.most_inflation)
    if outcomes.floored.any():  # these do not tell where f would be 0
        limit += _find_shift(left_out - limit, inflation * left_out_sd, y <= 0)
    return Kriging(process, limit, inflation, scale, n_searched)


def _find_shift(mean: FloatArray, sd: FloatArray, fails: NDArray[np.bool_]) -> float:
    """Return where in standardised outcomes failure begins, given each point's prediction without it, shape (n,).

    Where f jumps to failure (a time to collision of 0.5 s, then -1), points fail whose prediction is well above 0. The
    shift has the highest posterior density with P[fail] = Phi((shift - mean) / sd) and
    a standard normal prior.
    """
    sign = np.where(fails, 1.0, -1.0)

    def loss(shift: float) -> float:
        return 0.5 * shift**2 - float(log_ndtr(sign * (shift - mean) / np.maximum(sd, 1e-9)).sum())

    return float(minimize_scalar(loss, bounds=(-LARGEST_SHIFT, LARGEST_SHIFT), method="bounded").x)


def outcome_scale(y: FloatArray) -> float:
    """Return the scale c of outcomes y = f - gamma (n,)."""
    sizes = np.abs(y[(np.abs(y) < LARGEST) & (y != 0)])
    return KRIGING.outcome_scale * (float(np.median(sizes)) if len(sizes) else 1.0)


def compress_outcomes(y: FloatArray, scale: float) -> _Outcomes:
    """Return compressed outcomes of y = f - gamma (n,), and which of them stand at a cap or floor of f."""
    size = float(np.abs(y[np.abs(y) < LARGEST]).max(initial=0.0)) or 1.0  # stands for infinity
    y = np.clip(y, -size, size)
    ties = max(KRIGING.least_ties, KRIGING.tie_share * len(y))
    capped, floored = (y == y.max()) & (y > 0), (y == y.min()) & (y <= 0)
    return _Outcomes(np.arcsinh(y / scale), capped & (capped.sum() >= ties), floored & (floored.sum() >= ties))


def _impute_first(kernel: Any, u: FloatArray, outcomes: _Outcomes, *, search: bool) -> tuple[Any, FloatArray]:
    """Return covariance and outcomes (n,) where censored ones are predicted from all others."""
    free = ~(outcomes.capped | outcomes.floored)
    standard, mean, sd = _standardise(outcomes.z[free])
    if search:
        nearest = np.argsort(np.abs(outcomes.z[free]), kind="stable")[: KRIGING.most_points]
        kernel = _search_kernel(kernel, u[free][nearest], standard[nearest])
    predicted = _condition(kernel, u[free], standard).predict(u)
    return kernel, _impute(outcomes, mean + sd * predicted)


def _impute(outcomes: _Outcomes, predicted: FloatArray) -> FloatArray:
    """Return the outcomes with censored ones replaced by predictions within their bounds, shape (n,)."""
    z, spread = outcomes.z, IMPUTED_SPREAD * float(outcomes.z.std())
    z = np.where(outcomes.capped, np.clip(predicted, z, z + spread), z)
    return np.where(outcomes.floored, np.clip(predicted, outcomes.z - spread, -JUST_FAILED), z)


def _standardise(z: FloatArray) -> tuple[FloatArray, float, float]:
    """Return z (n,) with mean 0 and standard deviation 1, and both before."""
    mean, sd = float(z.mean()), max(float(z.std()), 1e-9)
    return (z - mean) / sd, mean, sd


def _initial_kernel(dim: int) -> Any:
    """Return a Matern covariance with a length for each coordinate, and a nugget."""
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel  # slow to import

    lengths = np.full(dim, 2.0 * math.sqrt(dim))  # about the distance between two draws
    smooth = ConstantKernel(1.0, (1e-2, 1e3)) * Matern(lengths, (0.2, 100.0), nu=KRIGING.smoothness)
    return smooth + WhiteKernel(1e-4, (1e-8, 1.0))


def _search_kernel(kernel: Any, u: FloatArray, z: FloatArray) -> Any:
    """Return the covariance whose parameters have the highest likelihood near those of `kernel`."""

    def climb(loss: Any, start: Any, bounds: Any) -> tuple[FloatArray, float]:
        options: Any = {"maxiter": KRIGING.hyperparameter_steps}
        found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return found.x, found.fun

    return _condition(kernel, u, z, climb).kernel_


def _condition(kernel: Any, u: FloatArray, z: FloatArray, optimiser: Any = None) -> Any:
    """Return the process given outcomes z (n,) at u (n, d), its covariance parameters kept or searched."""
    from sklearn.gaussian_process import GaussianProcessRegressor

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # parameters at their bounds are no concern
        return GaussianProcessRegressor(kernel, optimizer=optimiser).fit(u, z)


def _leave_one_out(process: Any, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation of each outcome z (n,) given all others."""
    precision = np.diag(cho_solve((process.L_, True), np.eye(len(z))))
    return z - process.alpha_.ravel() / precision, 1 / np.sqrt(precision)
