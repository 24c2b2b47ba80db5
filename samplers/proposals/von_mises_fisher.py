"""The von Mises-Fisher-Nakagami distribution: a direction and, independent of it, a radius.

N(0, I) is one, with uniform directions and a chi-squared square of the radius. d + 3 parameters describe
a component where a Gaussian needs d (d + 3) / 2.

References:
    Papaioannou, Geyer and Straub, "Improved cross entropy-based importance sampling with a flexible mixture
    model", Reliability Engineering and System Safety 191, 2019.
    Banerjee, Dhillon, Ghosh and Sra, "Clustering on the unit hypersphere using von Mises-Fisher distributions",
    JMLR 6, 2005 (the concentration, equation 4.4).
    NIST Digital Library of Mathematical Functions, 10.41.3 (Bessel functions of large order).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, ive

from samplers.problem import LOG_TWO_PI, FloatArray

LARGEST_RESULTANT = 0.999
"""Mean resultant lengths above this are cut: the concentration would run away on a few close points."""
LEAST_CONCENTRATION = 1e-3
"""Stands for 0, where the direction is uniform: the formulae divide by it."""
LEAST_SHAPE = 0.5
"""Least m of a Nakagami distribution."""
LARGEST_SHAPE = 1e4
"""A radius with a c.o.v. of 0.5 %; points at one radius would give an infinite m."""
LARGE_ORDER = 50.0
"""Order of the Bessel function from which on its asymptotic expansion is used; its logarithm is then exact to 2e-7."""


@dataclass(frozen=True, eq=False)
class VonMisesFisherNakagami:
    """u = r a with a ~ von Mises-Fisher(mu, kappa) on the unit sphere and r ~ Nakagami(m, omega).

    Example:
        >>> import numpy as np
        >>> towards = VonMisesFisherNakagami(mu=np.eye(50)[0], kappa=200.0, m=25.0, omega=50.0)
        >>> u = towards.sample(2000, np.random.default_rng(0))
        >>> radius = np.linalg.norm(u, axis=1)
        >>> round(float((radius**2).mean())), round(float((u[:, 0] / radius).mean()), 1)  # E[r^2], E[mu' a]
        (50, 0.9)
    """

    mu: FloatArray
    """Mean direction, of length 1, shape (d,)."""
    kappa: float
    """Concentration."""
    m: float
    """Shape of the radius: r^2 ~ Gamma(m, omega / m)."""
    omega: float
    """E[r^2]."""

    @classmethod
    def standard(cls, dim: int) -> "VonMisesFisherNakagami":
        """Return N(0, I), but for a concentration that cannot be 0."""
        return cls(np.eye(dim)[0], LEAST_CONCENTRATION, dim / 2, float(dim))

    @classmethod
    def fit(cls, u: FloatArray, weights: FloatArray) -> "VonMisesFisherNakagami":
        """Fit to points u (n, d) with weights (n,): matched mean direction, E[r^2] and E[r^4].

        The squared length of the mean direction is on average 1 / n too large (for one without any; n the
        effective number of points), which in many dimensions would be a concentration of its own: it is taken off.
        """
        weights = weights / weights.sum()
        dim, radius = u.shape[1], np.linalg.norm(u, axis=1)
        resultant = weights @ (u / radius[:, None])
        length = float(np.linalg.norm(resultant))
        mu = resultant / length if length > 0 else np.eye(dim)[0]
        chance = float(weights @ weights)
        length = math.sqrt(max((length**2 - chance) / (1 - chance), 0.0)) if chance < 1 else length
        square = float(weights @ radius**2)
        spread = float(weights @ (radius**2 - square) ** 2)
        shape = min(square * square / spread, LARGEST_SHAPE) if spread > 0 else LARGEST_SHAPE
        return cls(mu, concentration(length, dim), max(shape, LEAST_SHAPE), square)

    def widen(self, factor: float) -> "VonMisesFisherNakagami":
        """Return the same with deviations of direction and radius about `factor` times as large."""
        kappa, m = self.kappa / factor**2, self.m / factor**2
        return VonMisesFisherNakagami(self.mu, max(kappa, LEAST_CONCENTRATION), max(m, LEAST_SHAPE), self.omega)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        radius = np.sqrt(rng.gamma(self.m, self.omega / self.m, n))
        return radius[:, None] * directions(self.mu, self.kappa, n, rng)

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""
        dim = len(self.mu)
        radius = np.maximum(np.linalg.norm(u, axis=1), np.finfo(np.float64).tiny)
        m, omega = self.m, self.omega
        nakagami = (
            math.log(2)
            + m * math.log(m / omega)
            - float(gammaln(m))
            + (2 * m - 1) * np.log(radius)
            - m / omega * radius**2
        )
        fisher = log_normaliser(self.kappa, dim) + self.kappa * ((u @ self.mu) / radius)
        return np.asarray(nakagami + fisher - (dim - 1) * np.log(radius))

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the log density less that of N(0, I) at u (n, d), shape (n,)."""
        return np.asarray(self.log_prob(u) + 0.5 * (np.einsum("ij,ij->i", u, u) + len(self.mu) * LOG_TWO_PI))


def concentration(length: float, dim: int) -> float:
    """Return kappa of the mean resultant length, R (d - R^2) / (1 - R^2)."""
    r = min(length, LARGEST_RESULTANT)
    return max(r * (dim - r * r) / (1 - r * r), LEAST_CONCENTRATION)


def log_normaliser(kappa: float, dim: int) -> float:
    """Return the logarithm of the von Mises-Fisher density's factor before exp(kappa mu' a).

    log kappa^v - log (2 pi)^(v + 1) - log I_v(kappa) with v = d / 2 - 1; for large orders, where I_v
    underflows, by its uniform asymptotic expansion.
    """
    v = dim / 2 - 1
    if v < LARGE_ORDER:
        log_bessel = math.log(float(ive(v, kappa))) + kappa
    else:
        root = math.hypot(v, kappa)
        t = v / root
        series = 1 + (3 * t - 5 * t**3) / (24 * v) + (81 * t**2 - 462 * t**4 + 385 * t**6) / (1152 * v * v)
        log_bessel = root + v * math.log(kappa / (v + root)) - 0.5 * (LOG_TWO_PI + math.log(root)) + math.log(series)
    return v * math.log(kappa) - (v + 1) * LOG_TWO_PI - log_bessel


def directions(mu: FloatArray, kappa: float, n: int, rng: np.random.Generator) -> FloatArray:
    """Draw n directions from the von Mises-Fisher distribution, shape (n, d)."""
    if len(mu) == 1:  # two directions
        with_mu = rng.random(n) < 1 / (1 + math.exp(-2 * kappa))
        return np.asarray(np.where(with_mu, mu[0], -mu[0])[:, None])
    from scipy import stats  # takes a second to import

    distribution = stats.vonmises_fisher(mu, kappa)  # type: ignore[arg-type]  # the stubs ask for a whole kappa
    return np.asarray(distribution.rvs(n, random_state=rng)).reshape(n, len(mu))
