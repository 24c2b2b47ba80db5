"""Proposals: components of mixtures in standard normal space, and their fit to weighted points.

Components of searches by importance sampling have their density ratio to N(0, I). If one is N(0, I) in most directions,
its ratio depends on the few others only, which keeps weights exact and cheap in hundreds of dimensions.

Mixtures are fitted by expectation-maximisation. A covariance that is estimated from few weighted points is drawn
towards N(0, I) with one special direction, for points of one failure region, or towards the present Gaussian of a
search, for a step of it.

References:
    Papaioannou, Geyer and Straub, "Improved cross entropy-based importance sampling with a flexible mixture
    model", Reliability Engineering and System Safety 191, 2019.
    Geyer, Papaioannou and Straub, "Cross entropy-based importance sampling using Gaussian densities revisited",
    Structural Safety 76, 2019 (weighted points).
    Banerjee, Dhillon, Ghosh and Sra, "Clustering on the unit hypersphere using von Mises-Fisher distributions",
    JMLR 6, 2005 (the concentration, equation 4.4).
    NIST Digital Library of Mathematical Functions, 10.41.3 (Bessel functions of large order).
    Ledoit and Wolf, "A well-conditioned estimator for large-dimensional covariance matrices",
    Journal of Multivariate Analysis 88, 2004 (the share of the target).
    Stein, "Lectures on the theory of estimation of many parameters", Journal of Soviet Mathematics 34, 1986
    (eigenvalues; put into order again as by Lin and Perlman, "A Monte Carlo comparison of four estimators of a
    covariance matrix", 1985).
    Dempster, Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", JRSS B 39, 1977.
    Arthur and Vassilvitskii, "k-means++: the advantages of careful seeding", SODA 2007.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression
from scipy.special import gammaln, ive, log_ndtr, logsumexp, ndtri_exp

from samplers.bases import LOG_TWO_PI, Gaussian
from samplers.problem import FloatArray

__all__ = ["Gaussian", "Mixture", "correct_eigenvalues", "fit_proposal_mixture", "fit_shrunk_gaussian"]


class MixtureComponent(Protocol):
    """A distribution in standard normal space with a known density ratio to N(0, I)."""

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return log(q / phi) at u (n, d), shape (n,); -inf if the density q is 0."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""


@dataclass(frozen=True, eq=False)
class IsotropicNormal:
    """N(0, scale^2 I); the base distribution where scale is 1."""

    dim: int
    scale: float = 1.0

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return 0.5 |u|^2 (1 - scale^-2) - d log(scale)."""
        square = np.einsum("ij,ij->i", u, u)
        return np.asarray(0.5 * square * (1 - self.scale**-2) - self.dim * math.log(self.scale))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        return self.scale * rng.standard_normal((n, self.dim))


@dataclass(frozen=True, eq=False)
class SubspaceGaussian:
    """Independent Gaussians along r orthonormal axes, columns (d, r), N(0, 1) in every direction outside their span."""

    axes: FloatArray
    mean: FloatArray  # along the axes, (r,)
    variance: FloatArray  # along the axes, (r,)

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the log ratio; it depends on the coordinates along the axes only."""
        t, mean, variance, axis = u @ self.axes, self.mean, self.variance, 1
        if len(mean) < 8:  # coordinate by coordinate: so few are added in the same order either way
            t, mean, variance, axis = np.ascontiguousarray(t.T), mean[:, None], variance[:, None], 0
        terms = t * t - (t - mean) ** 2 / variance - np.log(variance)
        return np.asarray(0.5 * terms.sum(axis=axis))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        xi = rng.standard_normal((n, len(self.axes)))
        t = xi @ self.axes
        return np.asarray(xi + (self.mean + np.sqrt(self.variance) * t - t) @ self.axes.T)

    def temper(self, power: float) -> SubspaceGaussian:
        """Return q^power phi^(1 - power), normalised; power 1/2 is best for q ~ phi P[fail]."""
        precision = power / self.variance + (1 - power)
        return SubspaceGaussian(self.axes, power * self.mean / self.variance / precision, 1 / precision)


@dataclass(frozen=True, eq=False)
class LiftedComponent:
    """A component in the coordinates of r orthonormal axes, columns (d, r), N(0, 1) outside their span."""

    within: MixtureComponent
    axes: FloatArray

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the log ratio; it depends on the coordinates along the axes only."""
        return self.within.log_ratio(u @ self.axes)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        xi = rng.standard_normal((n, len(self.axes)))
        return np.asarray(xi + (self.within.sample(n, rng) - xi @ self.axes) @ self.axes.T)


@dataclass(frozen=True, eq=False)
class HalfSpaceIntersection:
    """The half-space beyond a plane, or the corner beyond several: N(0, 1) cut to it, one coordinate after the other.

    In orthonormal coordinates t, of which the first k span the axes in their order, plane i asks for t_i >= low_i,
    where low_i depends on the coordinates before it (Genz, "Numerical computation of multivariate normal
    probabilities", Journal of Computational and Graphical Statistics 1, 1992). The density is phi(u) / prod_i
    Phi(-low_i) within the corner. It is N(0, I) cut to the corner where the axes are orthogonal, and near it elsewhere;
    1 / density never exceeds 1 / phi(u). Axes are linearly independent unit vectors (k, d), first those that are the
    least likely to be passed, starts (k,) the distances of the planes from the origin.
    """

    axes: FloatArray
    starts: FloatArray

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return -sum_i log Phi(-low_i) within the corner, -inf outside."""
        across, along = self._coordinates()
        t, ratio = u @ across, np.zeros(len(u))
        for i in range(len(self.starts)):
            low = (self.starts[i] - t[:, :i] @ along[i, :i]) / along[i, i]
            ratio = np.where(t[:, i] >= low, ratio - log_ndtr(-low), -np.inf)
        return ratio

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        across, along = self._coordinates()
        xi, t = rng.standard_normal((n, len(across))), np.empty((n, len(self.starts)))
        for i in range(len(self.starts)):
            low = (self.starts[i] - t[:, :i] @ along[i, :i]) / along[i, i]
            t[:, i] = -ndtri_exp(np.log1p(-rng.random(n)) + log_ndtr(-low))
        return np.asarray(xi + (t - xi @ across) @ across.T)

    def _coordinates(self) -> tuple[FloatArray, FloatArray]:
        """Return the directions of t, columns (d, k), and each axis in them, lower triangular (k, k)."""
        q, r = np.linalg.qr(self.axes.T)
        signs = np.sign(np.diag(r))
        return q * signs, (r * signs[:, None]).T


@dataclass(frozen=True, eq=False)
class RadialLaw:
    """Uniform directions with |u|^2 = start + Gamma(shape, scale): for failure beyond a radius."""

    dim: int
    start: float
    shape: float
    scale: float

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the log ratio of the densities of |u|^2: shifted Gamma over chi-squared with d degrees of freedom."""
        square = np.einsum("ij,ij->i", u, u)
        beyond = square > self.start
        ratio = np.full(len(u), -np.inf)
        r, s, half = square[beyond], square[beyond] - self.start, self.dim / 2
        log_chi2 = (half - 1) * np.log(r) - r / 2 - half * math.log(2) - gammaln(half)
        log_gamma = (self.shape - 1) * np.log(s) - s / self.scale - gammaln(self.shape)
        ratio[beyond] = log_gamma - self.shape * math.log(self.scale) - log_chi2
        return ratio

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        direction = rng.standard_normal((n, self.dim))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return np.asarray(direction * np.sqrt(self.start + self.scale * rng.gamma(self.shape, size=n))[:, None])


def log_ratios(components: Sequence[MixtureComponent], u: FloatArray) -> FloatArray:
    """Return the log ratios of k components at u (n, d), shape (k, n)."""
    return np.array([component.log_ratio(u) for component in components]).reshape(len(components), len(u))


def mixture_log_ratio(log_r: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the log ratio of sum_k weights_k q_k from those of the q_k (k, n), shape (n,)."""
    return np.asarray(logsumexp(log_r, axis=0, b=weights[:, None]))


def draw_counts(weights: FloatArray, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Share n draws among components: n weights_k rounded up or down, n weights_k on average (systematic sampling)."""
    bounds = np.floor(np.cumsum(weights / weights.sum() * n) + rng.random())
    bounds[-1] = n  # but for rounding errors
    return np.diff(np.concatenate([[0.0], np.minimum(bounds, n)])).astype(np.int64)


def draw_components(
    components: Sequence[MixtureComponent], counts: NDArray[np.int64], rng: np.random.Generator
) -> FloatArray:
    """Draw counts_k points from each component, one component after the other."""
    return np.concatenate([c.sample(int(k), rng) for c, k in zip(components, counts, strict=True)])


LEAST_CONCENTRATION = 1e-3  # Stands for 0, where the direction is uniform: the formulae divide by it
LEAST_SHAPE = 0.5  # Least m of a Nakagami distribution
LARGEST_SHAPE = 1e4  # A radius with a c.o.v. of 0.5 %; points at one radius would give an infinite m


@dataclass(frozen=True, eq=False)
class VonMisesFisherNakagami:
    """u = r a with a ~ von Mises-Fisher(mu, kappa) on the unit sphere and r ~ Nakagami(m, omega).

    mu (d,) is the mean direction, of length 1, kappa the concentration; r^2 ~ Gamma(m, omega / m), omega = E[r^2].
    N(0, I) is one; d + 3 parameters describe a component where a Gaussian needs d (d + 3) / 2.
    """

    mu: FloatArray
    kappa: float
    m: float
    omega: float

    @classmethod
    def fit(cls, u: FloatArray, weights: FloatArray) -> VonMisesFisherNakagami:
        """Fit mean direction, less its length by chance, E[r^2] and E[r^4] of u (n, d) with weights (n,)."""
        weights = weights / weights.sum()
        dim, radius = u.shape[1], np.linalg.norm(u, axis=1)
        resultant = weights @ (u / radius[:, None])
        length = float(np.linalg.norm(resultant))
        mu = resultant / length if length > 0 else np.eye(dim)[0]
        chance = float(weights @ weights)
        length = math.sqrt(max((length**2 - chance) / (1 - chance), 0.0)) if chance < 1 else length
        r = min(length, 0.999)  # a few close points would make kappa run away
        kappa = max(r * (dim - r * r) / (1 - r * r), LEAST_CONCENTRATION)  # Banerjee et al., equation 4.4
        square = float(weights @ radius**2)
        spread = float(weights @ (radius**2 - square) ** 2)
        shape = min(square * square / spread, LARGEST_SHAPE) if spread > 0 else LARGEST_SHAPE
        return cls(mu, kappa, max(shape, LEAST_SHAPE), square)

    def widen(self, factor: float) -> VonMisesFisherNakagami:
        """Return the same with deviations of direction and radius about `factor` times as large."""
        kappa, m = self.kappa / factor**2, self.m / factor**2
        return VonMisesFisherNakagami(self.mu, max(kappa, LEAST_CONCENTRATION), max(m, LEAST_SHAPE), self.omega)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        radius = np.sqrt(rng.gamma(self.m, self.omega / self.m, n))
        if len(self.mu) == 1:  # two directions
            with_mu = rng.random(n) < 1 / (1 + math.exp(-2 * self.kappa))
            return np.asarray((radius * np.where(with_mu, self.mu[0], -self.mu[0]))[:, None])
        from scipy import stats  # takes a second to import

        law = stats.vonmises_fisher(self.mu, self.kappa)  # type: ignore[arg-type]  # the stubs ask for a whole kappa
        directions = np.asarray(law.rvs(n, random_state=rng)).reshape(n, len(self.mu))
        return np.asarray(radius[:, None] * directions)

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""
        dim = len(self.mu)
        radius = np.maximum(np.linalg.norm(u, axis=1), np.finfo(np.float64).tiny)
        m, omega = self.m, self.omega
        nakagami = math.log(2) + m * math.log(m / omega) - float(gammaln(m))
        nakagami = nakagami + (2 * m - 1) * np.log(radius) - m / omega * radius**2
        v, kappa = dim / 2 - 1, self.kappa
        if v < 50:
            log_bessel = math.log(float(ive(v, kappa))) + kappa
        else:  # the asymptotic expansion is exact to 2e-7
            root = math.hypot(v, kappa)
            t = v / root
            series = 1 + (3 * t - 5 * t**3) / (24 * v) + (81 * t**2 - 462 * t**4 + 385 * t**6) / (1152 * v * v)
            log_root = 0.5 * (LOG_TWO_PI + math.log(root))
            log_bessel = root + v * math.log(kappa / (v + root)) - log_root + math.log(series)
        log_constant = v * math.log(kappa) - (v + 1) * LOG_TWO_PI - log_bessel
        fisher = log_constant + kappa * ((u @ self.mu) / radius)
        return np.asarray(nakagami + fisher - (dim - 1) * np.log(radius))

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the log density less that of N(0, I) at u (n, d), shape (n,)."""
        return np.asarray(self.log_prob(u) + 0.5 * (np.einsum("ij,ij->i", u, u) + len(self.mu) * LOG_TWO_PI))


LEAST_VARIANCE = 1e-8
"""Stands for 0 in a direction, or is added to it: points may coincide."""


def shrink_covariance(
    covariance: FloatArray, direction: FloatArray, along: float, n: float
) -> tuple[FloatArray, float]:
    """Return the covariance S (d, d) drawn towards T = I + (along - 1) v v', and the share of T.

    T is that of N(0, I) beyond a plane with normal v (d,). Its share is the expected square error of S, of n points,
    over the square distance of S and T (Ledoit and Wolf), at least that of (d + 1) / 2 points beside n. From 5 d
    points on the logarithms are averaged: between a narrow variance and 1 a tenth of the way is not a tenth of 1.
    """
    dim = len(direction)
    target = np.eye(dim) + (along - 1) * np.outer(direction, direction)
    noise = (float(np.trace(covariance)) ** 2 + float((covariance * covariance).sum())) / n
    distance = float(((covariance - target) ** 2).sum())
    share = max(noise / distance if distance > noise else 1.0, (dim + 1) / (2 * (dim + 1 + n)))
    if n < 5 * dim:
        return (1 - share) * covariance + share * target, share
    values, axes = np.linalg.eigh(covariance)
    log_s = (axes * np.log(np.maximum(values, LEAST_VARIANCE))) @ axes.T
    log_t = math.log(max(along, LEAST_VARIANCE)) * np.outer(direction, direction)
    values, axes = np.linalg.eigh((1 - share) * log_s + share * log_t)
    return (axes * np.exp(values)) @ axes.T, share


def start_from_centres(x: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
    """Return to which of at most k distant centres (k-means++) each of x (n, d) is nearest, as 0 and 1 (k, n)."""
    odds, distances, nearest = weights, list[FloatArray](), np.full(len(x), np.inf)
    while len(distances) < k and odds.sum() > 0:
        centre = x[int(rng.choice(len(x), p=odds / odds.sum()))]
        distances.append(((x - centre) ** 2).sum(axis=1))
        nearest = np.minimum(nearest, distances[-1])
        odds = weights * nearest
    return one_hot(np.stack(distances).argmin(axis=0), k)


MixtureT = TypeVar("MixtureT")


def expectation_maximisation(
    maximise: Callable[[FloatArray], MixtureT],
    log_terms: Callable[[MixtureT], FloatArray],
    responsibilities: FloatArray,
    weights: FloatArray,
    max_steps: int,
    least_gain: Callable[[float], float],
) -> tuple[MixtureT, float]:
    """Return the mixture reached from some responsibilities (k, n) of points with weights (n,), and its log likelihood.

    `maximise` (M-step) may drop components, `log_terms` has shape (k, n); it ends where a step gains < `least_gain`.
    """
    reached = -np.inf
    for _ in range(max_steps):
        mixture = maximise(responsibilities)
        terms = log_terms(mixture)
        total = logsumexp(terms, axis=0)
        log_likelihood = float(weights @ total)
        if log_likelihood - reached < least_gain(log_likelihood):
            break
        reached, responsibilities = log_likelihood, np.exp(terms - total)
    return mixture, log_likelihood


def posterior(terms: FloatArray) -> FloatArray:
    """Return how likely each point comes from each component, from log(weight_j q_j), both of shape (k, n)."""
    return np.asarray(np.exp(terms - logsumexp(terms, axis=0)))


def one_hot(labels: NDArray[np.int64], k: int) -> FloatArray:
    """Return responsibilities (k, n) of 0 and 1 from labels (n,)."""
    return np.equal(labels, np.arange(k)[:, None]).astype(np.float64)


class ProposalDistribution(Protocol):
    """A distribution that can be drawn from and whose density is known; all that importance sampling needs."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of k distributions with weights (k,) that add up to 1; those that are widened can `widen`."""

    weights: FloatArray
    components: Sequence[Any]  # each a ProposalDistribution

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        counts = rng.multinomial(n, self.weights)
        parts = [c.sample(int(k), rng) for c, k in zip(self.components, counts, strict=True)]
        return rng.permutation(np.concatenate(parts))

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""
        return np.asarray(logsumexp(self.log_terms(u), axis=0))

    def log_terms(self, u: FloatArray) -> FloatArray:
        """Return log(weight_j q_j) of the components at u (n, d), shape (k, n)."""
        return np.stack([np.log(w) + c.log_prob(u) for w, c in zip(self.weights, self.components, strict=True)])

    def widen(self, factor: float) -> Mixture:
        """Return the mixture with every component more spread out by about this factor."""
        return Mixture(self.weights, [component.widen(factor) for component in self.components])


PRIOR_DIM = 10
"""Above this many dimensions the present covariance counts as more than d + 1 points, in proportion to d."""


def correct_eigenvalues(values: FloatArray, n: float) -> FloatArray:
    """Return the eigenvalues l (d,) of a covariance of n > d points, increasing, without their bias, by Stein.

    Each is divided by 1 - (d - 1) / n + (2 / n) sum_j l_i / (l_i - l_j).
    """
    gaps = values[:, None] - values
    gaps[gaps == 0] = np.inf  # its own, and equal ones
    factors = 1 - (len(values) - 1) / n + (2 / n) * (values[:, None] / gaps).sum(axis=1)
    logs = np.log(values) - np.log(np.where(factors > 0, factors, 1.0))
    return np.asarray(np.exp(isotonic_regression(logs).x))


def fit_shrunk_gaussian(u: FloatArray, weights: FloatArray) -> Gaussian:
    """Return the Gaussian of points u (n, d) with weights (n,), its covariance shrunk by `shrink_covariance`."""
    mean = weights @ u
    covariance = (u * weights[:, None]).T @ u - np.outer(mean, mean)
    v = mean / max(float(np.linalg.norm(mean)), np.finfo(np.float64).tiny)
    along = max(float(v @ covariance @ v), LEAST_VARIANCE)
    shrunk, _ = shrink_covariance(covariance, v, along, 1 / float(weights @ weights))
    return Gaussian.from_covariance(mean, shrunk + LEAST_VARIANCE * np.eye(len(mean)))


def move_gaussian(present: Gaussian, u: FloatArray, weights: FloatArray, share: float) -> Gaussian:
    """Return the Gaussian with the moments of share Q + (1 - share) P, its covariance drawn towards P, the present.

    Q has points u (n, d) with weights (n,); P counts as (d + 1) max(1, d / PRIOR_DIM) points beside the effective ones
    of Q: in many dimensions the noise of a covariance ruins importance weights.
    """
    own = present.covariance
    mean = share * (weights @ u) + (1 - share) * present.mean
    square = share * ((u * weights[:, None]).T @ u) + (1 - share) * (own + np.outer(present.mean, present.mean))
    prior = (present.dim + 1) * max(1.0, present.dim / PRIOR_DIM)
    pull = prior / (prior + 1 / float(weights @ weights))
    return Gaussian.from_covariance(mean, (1 - pull) * (square - np.outer(mean, mean)) + pull * own)


Fit = Callable[[FloatArray, FloatArray], Any]
"""Fits one component, which can `widen`, to points (n, d) with weights (n,) that add up to 1."""


def fit_proposal_mixture(
    fit: Fit, u: FloatArray, weights: FloatArray, most: int, size: int, rng: np.random.Generator
) -> Mixture:
    """Return the mixture of 1 to `most` components, fitted to u (n, d) with weights (n,), by the best BIC.

    The criterion counts the effective number of points, and `size` parameters a component.
    """
    points = 1 / float(weights @ weights)
    best, highest = Mixture(np.ones(1), [fit(u, weights)]), -np.inf
    for k in range(1, most + 1):
        if k * size >= points:  # the criterion means nothing there
            break
        mixture = best if k == 1 else _fit_mixture_of_size(fit, u, weights, k, rng)
        score = points * float(weights @ mixture.log_prob(u)) - 0.5 * (k * size + k - 1) * np.log(points)
        if score <= highest:
            break
        best, highest = mixture, score
    return best


def _fit_mixture_of_size(fit: Fit, u: FloatArray, weights: FloatArray, k: int, rng: np.random.Generator) -> Mixture:
    """Return a mixture of at most k components by expectation-maximisation, from distant first centres."""

    def maximise(responsibilities: FloatArray) -> Mixture:
        mass = weights * responsibilities
        totals = mass.sum(axis=1)
        kept = totals > min(0.01, 0.5 / k)  # of 1000 points fewer than 10; the heaviest one always stays
        components = [fit(u, part / part.sum()) for part in mass[kept]]
        return Mixture(totals[kept] / totals[kept].sum(), components)

    # Separate regions of failure lie in separate directions from the origin.
    directions = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    start = start_from_centres(directions, weights, k, rng)
    mixture, _ = expectation_maximisation(
        maximise, lambda mixture: mixture.log_terms(u), start, weights, 50, lambda _: 1e-3
    )
    return mixture
