"""Fitted base distributions with closed forms: p of each refit is known to all digits."""

import functools
from dataclasses import dataclass, field

import numpy as np
from scipy import stats
from scipy.special import logsumexp, ndtri

import samplers

BETA = 3.0
"""The half-space fails where x_1 >= BETA."""


@dataclass(frozen=True, eq=False)
class FirstCoordinate:
    """A mixture of normal distributions in x_1, beside x_2 ~ N(0, 1)."""

    means: np.ndarray
    sds: np.ndarray

    def _cdf(self, x):
        return stats.norm.cdf(x[:, None], self.means, self.sds).mean(axis=1)

    def sample(self, n, rng):
        pick = rng.integers(len(self.means), size=n)
        u = rng.standard_normal((n, 2))
        return np.column_stack([self.means[pick] + self.sds[pick] * u[:, 0], u[:, 1]])

    def log_prob(self, x):
        first = logsumexp(stats.norm.logpdf(x[:, :1], self.means, self.sds), axis=1) - np.log(len(self.means))
        return first + stats.norm.logpdf(x[:, 1])

    def to_standard_normal(self, x):
        return np.column_stack([ndtri(self._cdf(x[:, 0])), x[:, 1]])

    def from_standard_normal(self, u):
        """Bisection of the distribution function."""
        low, high = np.full(len(u), -60.0), np.full(len(u), 60.0)
        for _ in range(80):
            middle = 0.5 * (low + high)
            below = self._cdf(middle) < stats.norm.cdf(u[:, 0])
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.column_stack([low, u[:, 1]])

    @property
    def p(self):
        return float(stats.norm.sf(BETA, self.means, self.sds).mean())


def normal(mean=0.0, sd=1.0):
    return FirstCoordinate(np.array([mean]), np.array([sd]))


@dataclass(frozen=True, eq=False)
class FittedNormal(FirstCoordinate):
    """N(0, 1) in both coordinates, with refits."""

    refits: tuple = ()
    clusters: int = 17
    fitted_to: str = "38 + 15 events of 17 scenes"
    family: str = "1 component, log gaps"
    others: dict = field(default_factory=dict)

    def sibling(self, name):
        if name not in self.others:
            raise ValueError(f"Expected a base distribution of {', '.join(self.others)}, got {name!r}.")
        return self.others[name]


@dataclass(frozen=True, eq=False)
class FittedWithEnsemble(FittedNormal):
    """The same, with the mixture of the refits."""

    def ensemble(self):
        return FirstCoordinate(
            np.array([refit.means[0] for refit in self.refits]), np.array([refit.sds[0] for refit in self.refits])
        )


def fitted(refits=(), kind=FittedNormal, **options):
    return kind(np.zeros(1), np.ones(1), refits=tuple(refits), **options)


def resampled(n, number=30, seed=0):
    """Return refits to n events of N(0, 1): the mean and standard deviation of resampled events."""
    rng = np.random.default_rng(seed)
    return [normal(rng.standard_normal() / n**0.5, (rng.chisquare(n - 1) / n) ** 0.5) for _ in range(number)]


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """f = beta - x_1 + tilt x_2."""

    base: FirstCoordinate
    beta: float = BETA
    tilt: float = 0.0
    dim: int = 2

    def evaluate(self, x):
        return self.beta - x[:, 0] + self.tilt * x[:, 1]


SHIFTED = [normal(mean) for mean in np.linspace(-0.6, 0.6, 30)]
"""30 refits with a spread of log p of about 1.2."""
FAR = [*SHIFTED[:26], *[normal(7.0, 0.2 + 0.01 * i) for i in range(4)]]
"""The same with four that no point of a run under N(0, 1) reaches."""
BASE, FAR_BASE = fitted(SHIFTED), fitted(FAR, FittedWithEnsemble)


@functools.cache
def run(base, method="two-stage", seed=1, max_sim=3000, **options):
    return samplers.estimate(HalfSpace(base), method, seed=seed, max_sim=max_sim, **options)
