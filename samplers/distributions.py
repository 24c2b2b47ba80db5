"""Blocks of coordinates, each with the family that cross-entropy searches, the projections on it, and their product.

Equation 2 of O'Kelly et al. (2018) separates by block: the Kullback-Leibler projection of a distribution on a product
of families is the product of the projections of its marginals. The projection of P on an exponential family with
sufficient statistic Gamma and log partition function A maximises theta' E_P[Gamma] - A(theta).

References:
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing
    via rare-event simulation", NeurIPS 2018.
"""

import math
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.special import betainc, betaincc, betainccinv, betaincinv, betaln, digamma, ndtr, ndtri

from samplers.bases import Gaussian, IndependentDistributions
from samplers.problem import Distribution, FloatArray, Inputs, StandardNormal, needs_library
from samplers.proposals import Mixture, expectation_maximisation, move_gaussian, one_hot, posterior

__all__ = ["BetaBlock", "Distribution", "GaussianBlock", "MixtureBlock", "NormalBlock", "Product", "StandardNormal"]


def beta_statistics(alpha: FloatArray, beta: FloatArray) -> FloatArray:
    """Return E[log y] and E[log(1 - y)] for y ~ Beta(alpha, beta), each (m,), as (m, 2): the gradient of log B."""
    together = digamma(alpha + beta)
    return np.stack([digamma(alpha) - together, digamma(beta) - together], axis=-1)


def project_beta(statistics: FloatArray, low: float, high: float) -> FloatArray:
    """Return alpha, beta (m, 2) in [low, high] that maximise (alpha, beta) . statistics - log B, row by row."""

    def loss(parameters: FloatArray) -> tuple[float, FloatArray]:
        theta = parameters.reshape(statistics.shape)
        alpha, beta = theta.T
        slope = beta_statistics(alpha, beta) - statistics
        return float((betaln(alpha, beta) - (theta * statistics).sum(axis=1)).sum()), slope.ravel()

    start = np.full(statistics.size, np.clip(2.0, low, high))
    options: Any = {"maxiter": 1000, "ftol": 1e-15, "gtol": 1e-10}
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=[(low, high)] * len(start), options=options)
    return np.asarray(found.x.reshape(statistics.shape))


def project_mean(target: FloatArray, centre: FloatArray, cholesky: FloatArray, radius: float) -> FloatArray:
    """Return mu (d,) with |mu - centre|_inf <= radius and the least |L^-1 (mu - target)|, L = cholesky (d, d).

    A quadratic programme, solved by OSQP through cvxpy, unless the target is in the box or L diagonal.
    """
    clipped = np.clip(target, centre - radius, centre + radius)
    diagonal = np.count_nonzero(cholesky) == len(centre)
    if diagonal or radius == 0 or (clipped == target).all():
        return clipped
    with needs_library("cvxpy", "A bounded step of a mean whose coordinates are correlated"):
        cp: Any = import_module("cvxpy")  # over a second to import; its functions are not typed
    inverse = solve_triangular(cholesky, np.eye(len(target)), lower=True)
    inverse /= np.abs(inverse).max()  # so that the solver's absolute tolerances do not depend on units
    z = cp.Variable(len(target))
    distance = cp.sum_squares(inverse @ z - inverse @ ((target - centre) / radius))
    programme = cp.Problem(cp.Minimize(distance), [z >= -1, z <= 1])
    programme.solve(solver=cp.OSQP, max_iter=100_000)
    if z.value is None:
        raise RuntimeError(
            f"The projection on the box of the mean was not solved ({programme.status}): its covariance may be close "
            "to singular; take a wider box."
        )
    return centre + radius * np.clip(np.asarray(z.value, dtype=np.float64), -1.0, 1.0)


PAPERS_BOX = (1.5, 7.0)
"""Range of alpha and beta in O'Kelly et al. 2018; their released code has [0.5, 5]."""
SMALLEST = float(np.finfo(np.float64).tiny)
"""Stands for 0 if the logarithm is taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BetaBlock:
    """Independent coordinates low + (high - low) Beta(alpha, beta), the parameters in a box.

    Sufficient statistics log y and log(1 - y) of y = (x - low) / (high - low).

    Args:
        alpha: First parameter, positive; a number or shape (b,), as all four.
        beta: Second parameter.
        low: Lower bound of the support.
        high: Upper bound.
        box: Bounds of both parameters throughout the family.

    Raises:
        ValueError: If a parameter is not in the box, the box not in (0, inf) or low not < high.

    Example:
        >>> import numpy as np
        >>> from samplers.distributions import BetaBlock
        >>> gap = BetaBlock(alpha=2.0, beta=2.0, low=0.0, high=40.0)  # [m]
        >>> gap.from_standard_normal(np.array([[0.0]]))
        array([[20.]])
        >>> near = gap.project(np.array([[2.0], [4.0]]), np.array([0.5, 0.5]), alpha=0.8)
        >>> near.alpha.round(2), near.beta.round(2)  # towards small gaps
        (array([1.5]), array([6.31]))
    """

    alpha: FloatArray
    beta: FloatArray
    low: FloatArray
    high: FloatArray
    box: tuple[float, float] = PAPERS_BOX

    def __post_init__(self) -> None:
        """Bring the parameters to one shape and check them."""
        names = ("alpha", "beta", "low", "high")
        # fields by name
        arrays = np.broadcast_arrays(*(np.atleast_1d(np.asarray(getattr(self, n), np.float64)) for n in names))
        parameters = dict(zip(names, arrays, strict=True))
        for name, array in parameters.items():
            object.__setattr__(self, name, array)
        least, most = self.box
        inside = all(((array >= least) & (array <= most)).all() for array in arrays[:2])
        if not (0 < least < most < math.inf and inside and (self.low < self.high).all() and self.low.ndim == 1):
            raise ValueError(
                f"BetaBlock: expected alpha and beta in the box [{least}, {most}] with positive bounds and "
                f"low < high, all of shape (b,), got {', '.join(f'{n} {a}' for n, a in parameters.items())}."
            )

    @property
    def dim(self) -> int:
        """Number of coordinates b."""
        return len(self.alpha)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, b)."""
        return self._to_interval(rng.beta(self.alpha, self.beta, size=(n, self.dim)))

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, b), shape (n,); -inf outside the support."""
        inside = ((x >= self.low) & (x <= self.high)).all(axis=1)
        log_y, log_rest = self._logs(x)
        logs = (self.alpha - 1) * log_y + (self.beta - 1) * log_rest
        constant = betaln(self.alpha, self.beta) + np.log(self.high - self.low)
        return np.where(inside, (logs - constant).sum(axis=1), -np.inf)

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Return Phi^-1 of the distribution function of each coordinate, by the nearer tail."""
        y = (x - self.low) / (self.high - self.low)
        below, above = betainc(self.alpha, self.beta, y), betaincc(self.alpha, self.beta, y)
        return np.where(below < above, ndtri(below), -ndtri(above))

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        y = np.where(u < 0, betaincinv(self.alpha, self.beta, ndtr(u)), betainccinv(self.alpha, self.beta, ndtr(-u)))
        return self._to_interval(y)

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "BetaBlock":
        """Return the projection of alpha Q + (1 - alpha) P in the box, see `project_beta`."""
        elite = np.stack([weights @ logs for logs in self._logs(x)], axis=-1)
        target = alpha * elite + (1 - alpha) * beta_statistics(self.alpha, self.beta)
        parameters = project_beta(target, *self.box)
        return replace(self, alpha=parameters[:, 0], beta=parameters[:, 1])

    def widen(self, factor: float) -> "BetaBlock":
        """Return the same means with `factor` times the standard deviations, as far as the box allows."""
        total = self.alpha + self.beta  # the variance is mean (1 - mean) / (total + 1)
        shrink = np.maximum((total + 1) / factor**2 - 1, 0.0) / total
        return replace(self, alpha=np.clip(shrink * self.alpha, *self.box), beta=np.clip(shrink * self.beta, *self.box))

    def _to_interval(self, y: FloatArray) -> FloatArray:
        """Return low + (high - low) y, one float inside the support, where the statistics are finite."""
        x = self.low + (self.high - self.low) * y
        return np.clip(x, np.nextafter(self.low, self.high), np.nextafter(self.high, self.low))

    def _logs(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log y and log(1 - y) of x (n, b), shape (n, b) each."""
        y, rest = (x - self.low) / (self.high - self.low), (self.high - x) / (self.high - self.low)
        return np.log(np.maximum(y, SMALLEST)), np.log(np.maximum(rest, SMALLEST))


EMPTY = float(np.finfo(np.float64).eps)
"""A component with less weight has no points left."""


def fit_mixture_towards(present: Mixture, k: int, x: FloatArray, weights: FloatArray, alpha: float) -> Mixture:
    """Return a mixture of at most k Gaussians nearer to alpha Q + (1 - alpha) P than P, the present one.

    Q has the points x (n, d) with weights (n,), shared anew in every step; the mass of P stays with its components.
    One component becomes k copies, and the points are first shared by k-means.
    """
    if len(present.components) == 1:
        from sklearn.cluster import KMeans  # over a second to import

        k = min(k, len(np.unique(x, axis=0)))
        clusters = KMeans(k, n_init=3, random_state=0).fit(x, sample_weight=weights)  # one may put two into one region
        start = one_hot(np.asarray(clusters.labels_, dtype=np.int64), k)
        present = Mixture(np.full(k, 1 / k), [present.components[0]] * k)
    else:
        start = posterior(present.log_terms(x))

    def maximise(responsibilities: FloatArray) -> Mixture:
        """Return weights, means and covariances; a component without any weight stays as it is."""
        shares, components = [], []
        parts = zip(present.weights, present.components, weights * responsibilities, strict=True)
        for weight, component, mass in parts:
            total = float(mass.sum())
            share = alpha * total + (1 - alpha) * weight
            shares.append(share)
            if share >= EMPTY:
                mass = mass / total if total > 0 else np.full(len(x), 1 / len(x))
                component = move_gaussian(component, x, mass, alpha * total / share)
            components.append(component)
        return Mixture(np.maximum(shares, np.finfo(np.float64).tiny) / sum(shares), components)

    mixture, _ = expectation_maximisation(  # always ten steps, each of which raises the objective
        maximise, lambda mixture: mixture.log_terms(x), start, weights, 10, lambda _: -np.inf
    )
    used = mixture.weights > EMPTY
    components = [component for component, kept in zip(mixture.components, used, strict=True) if kept]
    return Mixture(mixture.weights[used] / mixture.weights[used].sum(), components)


@dataclass(frozen=True, eq=False)
class _GaussianInBase:
    """Common part of the blocks that are Gaussian in the base distribution, N(mean, L L')."""

    gaussian: Gaussian

    @property
    def _present(self) -> Gaussian | Mixture:
        return self.gaussian

    @property
    def dim(self) -> int:
        """Number of coordinates b."""
        return self.gaussian.dim

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, b)."""
        return self._present.sample(n, rng)

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, b), shape (n,)."""
        return self._present.log_prob(x)

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Return L^-1 (x - mean)."""
        return self.gaussian.to_standard_normal(x)

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Return mean + L u."""
        return self.gaussian.from_standard_normal(u)

    def widen(self, factor: float) -> Any:
        """Return the block with `factor` times the standard deviations."""
        return replace(self, gaussian=self.gaussian.widen(factor))


@dataclass(frozen=True, eq=False)
class NormalBlock(_GaussianInBase):
    """A Normal with fixed covariance whose mean may move in a box |mean - centre|_inf <= radius.

    Args:
        gaussian: The present Gaussian; in the base distribution the one to start from.
        radius: In the units of x (0.01 in the paper); inf for no box, 0 for a block that stays.
        centre: Centre of the box; None takes the mean of `gaussian`.

    Example:
        >>> import numpy as np
        >>> from samplers.distributions import NormalBlock
        >>> from samplers.proposals import Gaussian
        >>> block = NormalBlock(Gaussian.standard(2), radius=0.5)
        >>> elite = np.array([[3.0, 0.1], [1.0, 0.1]])
        >>> block.project(elite, np.array([0.5, 0.5]), alpha=1.0).gaussian.mean
        array([0.5, 0.1])
    """

    radius: float = math.inf
    centre: FloatArray | None = None

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "NormalBlock":
        """Return the projection of alpha Q + (1 - alpha) P in the box, see `project_mean`."""
        centre = self.gaussian.mean if self.centre is None else self.centre
        target = alpha * (weights @ x) + (1 - alpha) * self.gaussian.mean
        mean = project_mean(target, centre, self.gaussian.cholesky, self.radius)
        return replace(self, gaussian=Gaussian(mean, self.gaussian.cholesky), centre=centre)


@dataclass(frozen=True, eq=False)
class GaussianBlock(_GaussianInBase):
    """A Gaussian whose mean and covariance may move: E[x] and E[x x'] are matched.

    The covariance is drawn towards the present one, see `samplers.proposals.move_gaussian`.

    Example:
        Ten points in one place have no covariance; the present one counts as three points.

        >>> import numpy as np
        >>> from samplers.distributions import GaussianBlock
        >>> from samplers.proposals import Gaussian
        >>> elite = np.tile([2.0, 1.0], (10, 1))
        >>> block = GaussianBlock(Gaussian.standard(2)).project(elite, np.full(10, 0.1), alpha=1.0)
        >>> block.gaussian.mean, block.gaussian.covariance.diagonal().round(3)
        (array([2., 1.]), array([0.231, 0.231]))
    """

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "GaussianBlock":
        """Return the projection of alpha Q + (1 - alpha) P, its covariance pulled back."""
        return GaussianBlock(move_gaussian(self.gaussian, x, weights, alpha))


@dataclass(frozen=True, eq=False)
class MixtureBlock(_GaussianInBase):
    """A mixture of k Gaussians, moved by expectation-maximisation, see `fit_mixture_towards`.

    Args:
        gaussian: The Gaussian of the base distribution.
        k: Number of components at most.
        mixture: The present mixture; None stands for `gaussian`.

    Example:
        >>> import numpy as np
        >>> from samplers.distributions import MixtureBlock
        >>> from samplers.proposals import Gaussian
        >>> elite = np.repeat([[4.0, 0.0], [-4.0, 0.0]], 100, axis=0)
        >>> block = MixtureBlock(Gaussian.standard(2), k=2).project(elite, np.full(200, 1 / 200), alpha=1.0)
        >>> sorted(float(component.mean[0].round(2)) for component in block.mixture.components)
        [-4.0, 4.0]
    """

    k: int
    mixture: Mixture | None = None

    @property
    def _present(self) -> Mixture:
        return Mixture(np.ones(1), (self.gaussian,)) if self.mixture is None else self.mixture

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "MixtureBlock":
        """Return a mixture nearer to alpha Q + (1 - alpha) P."""
        return replace(self, mixture=fit_mixture_towards(self._present, self.k, x, weights, alpha))

    def widen(self, factor: float) -> "MixtureBlock":
        """Return the block with `factor` times the standard deviations of every component."""
        return replace(self, mixture=self._present.widen(factor))


@dataclass(frozen=True, eq=False, repr=False)
class Product(IndependentDistributions):
    """Independent blocks of consecutive coordinates: a base distribution, or a proposal of the search.

    As a base distribution it announces its blocks to `CrossEntropy(family="blocks")`.

    Args:
        blocks: In the order of the coordinates: those of this module, or objects with the same methods.

    Raises:
        ValueError: If there is no block, or one is none.

    Example:
        >>> import numpy as np
        >>> from samplers.distributions import BetaBlock, NormalBlock, Product
        >>> from samplers.proposals import Gaussian
        >>> gap = BetaBlock(alpha=2.0, beta=2.0, low=1.0, high=40.0)
        >>> base = Product((gap, NormalBlock(Gaussian.standard(3))))
        >>> base.dim, base.sample(5, np.random.default_rng(0)).shape
        (4, (5, 4))
        >>> base.from_standard_normal(np.zeros((1, 4)))
        array([[20.5,  0. ,  0. ,  0. ]])
    """

    def __post_init__(self) -> None:
        """Make a tuple of the blocks."""
        object.__setattr__(self, "blocks", tuple(self.blocks))
        if not self.blocks or not all(hasattr(block, "project") for block in self.blocks):
            raise ValueError(f"Product: expected one block or more, got {self.blocks!r}.")

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "Product":
        """Return the projection of alpha Q + (1 - alpha) P, block by block (equation 2).

        Q has the points x (n, d) with weights (blocks, n) for each block, rows that add up to 1.
        """
        return Product(
            tuple(block.project(part, w, alpha) for (block, part), w in zip(self.split(x), weights, strict=True))
        )

    def widen(self, factor: float) -> "Product":
        """Return independent blocks with standard deviations multiplied by about `factor`."""
        return Product(tuple(block.widen(factor) for block in self.blocks))


def announced_blocks(inputs: Inputs) -> Product:
    """Return the base distribution of some inputs as the product of the blocks in its attribute `blocks`.

    An entry is a block, or has alpha, beta, low, high (and box), or mean and covariance (and radius). A ValueError
    says what is missing, or that their product is not the base distribution.
    """
    announced = getattr(inputs.base, "blocks", None)  # the user's own class
    if not announced:
        raise ValueError(
            f'CrossEntropy: family "blocks" needs a base distribution with an attribute blocks, as Product has; '
            f'{type(inputs.base).__name__} has none. The family "gaussian" works with any.'
        )
    product = Product(tuple(_as_block(entry) for entry in announced))
    trial = product.sample(4, np.random.default_rng(0))
    if product.dim != inputs.dim or not np.allclose(product.log_prob(trial), inputs.base.log_prob(trial)):
        raise ValueError(
            f"CrossEntropy: the blocks of {type(inputs.base).__name__} are not its distribution: correct `blocks`, or "
            'take family="gaussian", which works with any.'
        )
    return product


def _as_block(entry: Any) -> Any:
    """Return the block that an entry describes, one of the classes here or of another package."""
    if hasattr(entry, "project"):
        return entry
    if all(hasattr(entry, name) for name in ("alpha", "beta", "low", "high")):
        box = getattr(entry, "box", PAPERS_BOX)
        return BetaBlock(alpha=entry.alpha, beta=entry.beta, low=entry.low, high=entry.high, box=box)
    if hasattr(entry, "mean") and hasattr(entry, "covariance"):
        gaussian = Gaussian.from_covariance(entry.mean, entry.covariance)
        return NormalBlock(gaussian, getattr(entry, "radius", math.inf))
    raise ValueError(
        "CrossEntropy: expected a block with alpha, beta, low and high or with mean and covariance, "
        f'got {type(entry).__name__}; the family "gaussian" works with any base.'
    )
