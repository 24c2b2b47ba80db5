"""Limit states of the two kinds on which runs of two-stage were far off without a warning, with other numbers.

    python -m benchmarks.estimators.two_stage.repeated_seeds --first-seed 3000 --seeds 40 \
        --set benchmarks/estimators/two_stage/far_off_states.py --json benchmarks/results/two_stage_far_off.json

Sums of loads with heavy tails beyond a limit, and series systems of correlated planes of unlike steepness. The check by
a regression of f (`samplers/methods/two_stage/response_surface`) was chosen on two others, loads_d7 and series6_d25.
All fail where f <= 0 in N(0, I).
"""

from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr, ndtr

from benchmarks.estimators.two_stage.blind_states import Make, any_of, integrate, rotate
from samplers.problem import FloatArray


class Loads(NamedTuple):
    """Lognormal and Weibull loads that fail where their sum exceeds a limit."""

    lognormal: tuple[tuple[float, float], ...]
    """Median and standard deviation of the logarithm of each."""
    weibull: tuple[tuple[float, float], ...]
    """Scale and shape of each."""
    limit: float
    p: float
    """By `estimate_loads` with 2 million draws and seed 5, good to 0.5 % or better."""

    @property
    def dim(self) -> int:
        """Number of loads."""
        return len(self.lognormal) + len(self.weibull)

    def evaluate(self, u: FloatArray) -> FloatArray:
        """Return the loads at u (n, d), shape (n, d)."""
        loads = [median * np.exp(sd * u[:, k]) for k, (median, sd) in enumerate(self.lognormal)]
        first = len(loads)
        loads += [c * (-log_ndtr(-u[:, first + k])) ** (1 / a) for k, (c, a) in enumerate(self.weibull)]
        return np.stack(loads, axis=1)

    def exceed(self, k: int, x: FloatArray) -> FloatArray:
        """Return P[load k > x] at x (n,), shape (n,)."""
        x, first = np.maximum(x, 1e-300), len(self.lognormal)
        if k < first:
            return np.asarray(ndtr(-np.log(x / self.lognormal[k][0]) / self.lognormal[k][1]))
        scale, shape = self.weibull[k - first]
        return np.asarray(np.exp(-((x / scale) ** shape)))

    def make(self) -> Make:
        """Return f, dimension and p."""
        return lambda u: self.limit - self.evaluate(u).sum(axis=1), self.dim, self.p


class Series(NamedTuple):
    """Any of several planes at distances beta with correlation rho, each bent by sinh and of its own steepness."""

    betas: tuple[float, ...]
    steepness: tuple[float, ...]
    rho: float
    dim: int
    bend: float = 0.8

    def make(self) -> Make:
        """Return f, dimension and p, by quadrature over the common factor."""
        beta, steep, q = np.array(self.betas), np.array(self.steepness), rotate(self.dim, 100 + self.dim)
        common, own = np.sqrt(self.rho), np.sqrt(1 - self.rho)

        def f(u: FloatArray) -> FloatArray:
            v = u @ q
            z = beta - common * v[:, :1] - own * v[:, 1 : 1 + len(beta)]
            return np.asarray((steep * np.sinh(self.bend * z)).min(axis=1))

        return f, self.dim, integrate(lambda z: any_of(*ndtr((common * z - beta) / own)))


LOADS = {
    "loads4": Loads(((1.0, 0.6), (0.5, 0.9)), ((0.5, 0.8), (0.6, 0.9)), 13.0, 5.22116e-4),
    "loads5": Loads(((1.0, 0.5), (0.8, 0.6), (0.6, 0.7), (0.5, 0.8), (0.4, 0.9)), (), 17.0, 8.51640e-5),
    "loads6": Loads(((1.0, 0.3), (0.9, 0.4)), ((0.5, 0.7), (0.4, 0.65), (0.3, 0.6), (0.6, 0.8)), 17.0, 2.92934e-4),
    "loads10": Loads(
        ((1.0, 0.5), (0.6, 0.7), (1.2, 0.4), (0.4, 0.8), (0.7, 0.6)),
        ((0.5, 0.8), (0.3, 0.7), (0.8, 1.1), (0.4, 0.75), (0.6, 0.9)),
        19.0,
        9.94566e-5,
    ),
}
SERIES = {
    "series8_d20": Series(
        (3.5, 3.5, 3.6, 3.7, 3.8, 3.9, 4.0, 4.1), (1.0, 0.4, 2.0, 0.7, 3.0, 0.5, 1.5, 0.8), rho=0.25, dim=20
    ),
    "series5_d30": Series((3.3, 3.4, 3.6, 3.8, 4.0), (1.0, 5.0, 0.2, 2.0, 0.5), rho=0.4, dim=30, bend=0.6),
    "series6_d10": Series((3.2, 3.4, 3.6, 3.8, 4.0, 4.1), (1.0, 0.3, 2.0, 0.7, 3.0, 0.5), rho=0.3, dim=10),
}


def estimate_loads(loads: Loads, n: int, seed: int) -> tuple[float, float]:
    """Return p of a sum of loads and its standard error, by the estimator of Asmussen and Kroese.

    The sum over k of P[load k is the largest and takes the sum beyond the limit], given the others.

    References:
        Asmussen and Kroese, "Improved algorithms for rare event simulation with heavy tails", Advances in Applied
        Probability 38, 2006.
    """
    rng, batch, values = np.random.default_rng(seed), 100_000, list[FloatArray]()
    for start in range(0, n, batch):
        x = loads.evaluate(rng.standard_normal((min(batch, n - start), loads.dim)))
        y = np.zeros(len(x))
        for k in range(loads.dim):
            others = np.delete(x, k, axis=1)
            y += loads.exceed(k, np.maximum(others.max(axis=1), loads.limit - others.sum(axis=1)))
        values.append(y)
    every = np.concatenate(values)
    return float(every.mean()), float(every.std() / np.sqrt(n))


def make() -> dict[str, Make]:
    """Return all of them by name."""
    return {name: state.make() for name, state in (LOADS | SERIES).items()}


if __name__ == "__main__":
    for name, loads in LOADS.items():
        p, error = estimate_loads(loads, 2_000_000, 5)
        print(f"{name}: {p:.5e} +- {error:.1e}")
