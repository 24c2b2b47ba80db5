"""The reliability problems of otbenchmark, with their probabilities computed anew.

Problem definitions: otbenchmark (Fekhari, Baudin, Chabridon, Jebroun, "otbenchmark: an open source Python package for
benchmarking and validating uncertainty quantification algorithms", UNCECOMP 2021), which follows Rozsas and Slobbe,
"Repository and black-box reliability challenge 2019"; the four branches are those of Waarts, "Structural reliability
using finite element methods", 2000. All are written in standard normal space. `PUBLISHED` has the probabilities that
otbenchmark states; `samplers.benchmark.public_references` computes those used here.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.special import log_ndtr, ndtr

from samplers.benchmark import public_references as references
from samplers.benchmark.analytic_states import LimitState, PointFunction
from samplers.problem import FloatArray

WEIGHTED = "weighted draws of f"
PRODUCT = "density of the product of two normal variables"
_OTHER_DERIVATIONS: dict[Callable[[], tuple[float, float]], str] = {
    references.rp8: "sum of random variables of OpenTURNS",
    references.rp14: "mean of the conditional probability over draws",
    references.rp22: "Riemann sum of the integral",
    references.rp28: "product of random variables of OpenTURNS",
    references.rp38: "plain draws of the conditional probability",
    references.rp63: "mean over chi-square draws",
    references.rp75: PRODUCT,
    references.rp91: "plain draws of the conditional probability",
    references.rp111: PRODUCT,
}
"""By how p is computed; for all problems otbenchmark's own plain Monte Carlo agrees besides."""


@dataclass(frozen=True)
class PublicState:
    """A problem of otbenchmark.

    Example:
        >>> state = PUBLIC_STATES["rp107_d10"]
        >>> f"{state.make().p:.4e}, published {state.published:.2e}"
        '2.8665e-07, published 2.92e-07'
    """

    f: PointFunction
    dim: int
    probability: Callable[[], tuple[float, float]]
    """Returns p and its standard error, 0 where p is a closed form or an integral."""
    published: float
    """The probability that otbenchmark states."""
    reference: str = "closed form or one-dimensional integral"
    """How p is known, in words."""
    draws: int = 0
    """Behind p; 0 for integrals."""

    @property
    def second(self) -> str:
        """Second derivations, which the tests make."""
        other = _OTHER_DERIVATIONS.get(self.probability)
        return f"{other}; {WEIGHTED}" if other else WEIGHTED

    def make(self) -> LimitState:
        """Return the limit state; p is computed."""
        p, error = self.probability()
        return LimitState(self.f, self.dim, p, error)


def _rp8(u: FloatArray) -> FloatArray:
    x = [references.lognormal(u[:, k], mean, sd) for k, (mean, sd) in enumerate(references.RP8_MARGINALS)]
    return np.asarray(x[0] + 2 * x[1] + 2 * x[2] + x[3] - 5 * x[4] - 5 * x[5])


def _rp14(u: FloatArray) -> FloatArray:
    x1, x2, x4, x5 = 70 + 10 * ndtr(u[:, 0]), 39 + 0.1 * u[:, 1], 400 + 0.1 * u[:, 3], 250_000 + 35_000 * u[:, 4]
    x3 = references.gumbel(u[:, 2], 1500, 350)
    return np.asarray(x1 - 32 / (np.pi * x2**3) * np.sqrt(x3**2 * x4**2 / 16 + x5**2))


def _rp22(u: FloatArray) -> FloatArray:
    return np.asarray(2.5 - (u[:, 0] + u[:, 1]) / math.sqrt(2) + 0.1 * (u[:, 0] - u[:, 1]) ** 2)


def _rp24(u: FloatArray) -> FloatArray:
    x1, x2 = (10 + 3 * u).T
    return np.asarray(2.5 - 0.2357 * (x1 - x2) + 0.00463 * (x1 + x2 - 20) ** 4)


def _rp25(u: FloatArray) -> FloatArray:
    return np.maximum(u[:, 0] ** 2 - 8 * u[:, 1] + 16, -16 * u[:, 0] + u[:, 1] + 32)


def _rp28(u: FloatArray) -> FloatArray:
    return np.asarray((78_064 + 11_710 * u[:, 0]) * (0.0104 + 0.00156 * u[:, 1]) - 146.14)


def _rp31(u: FloatArray) -> FloatArray:
    return np.asarray(2 - u[:, 1] + 256 * u[:, 0] ** 4)


def _rp33(u: FloatArray) -> FloatArray:
    return np.asarray(np.minimum(3 * math.sqrt(3) - u.sum(axis=1), 3 - u[:, 2]))


def _rp35(u: FloatArray) -> FloatArray:
    x1, x2 = u.T
    return np.asarray(np.minimum(2 - x2 + np.exp(-0.1 * x1**2) + (0.2 * x1) ** 4, 4.5 - x1 * x2))


def _rp38(u: FloatArray) -> FloatArray:
    x1 = references.RP38_MEANS[0] * (1 + 0.1 * u[:, 0])
    return np.asarray(15.59e4 - x1 * references.rp38_factor(u[:, 1:]))


def _rp53(u: FloatArray) -> FloatArray:
    x1, x2 = 1.5 + u[:, 0], 2.5 + u[:, 1]
    return np.asarray(np.sin(2.5 * x1) + 2 - (x1**2 + 4) * (x2 - 1) / 20)


def _rp54(u: FloatArray) -> FloatArray:
    return np.asarray(-log_ndtr(-u).sum(axis=1) - 8.951)


def _rp55(u: FloatArray) -> FloatArray:
    apart = 2 * (ndtr(u[:, 0]) - ndtr(u[:, 1]))
    inner = 0.2 + 0.6 * apart**4 - np.abs(apart) / math.sqrt(2)
    return np.minimum(inner, 5 / math.sqrt(2) - 2.2 - np.abs(apart))


def _rp57(u: FloatArray) -> FloatArray:
    x1, x2 = u.T
    corner = np.maximum(-(x1**2) + x2**3 + 3, 2 - x1 - 8 * x2)
    return np.asarray(np.minimum(corner, (x1 + 3) ** 2 + (x2 + 3) ** 2 - 4))


def _rp60(u: FloatArray) -> FloatArray:
    x1, x2, x3, x4, x5 = (
        references.lognormal(u[:, k], mean, sd) for k, (mean, sd) in enumerate(references.RP60_MARGINALS)
    )
    half = np.minimum(np.minimum(x2, x3), x4) - x5 / 2
    whole = np.maximum(x4 - x5, np.minimum(x2, x3) - x5)
    return np.minimum(x1 - x5, np.maximum(half, whole))


def _rp63(u: FloatArray) -> FloatArray:
    return np.asarray(0.1 * (u[:, 1:] ** 2).sum(axis=1) - u[:, 0] - 4.5)


def _rp75(u: FloatArray) -> FloatArray:
    return np.asarray(3 - u[:, 0] * u[:, 1])


def _rp77(u: FloatArray) -> FloatArray:
    x1, x2, x3 = 10 + 0.5 * u[:, 0], u[:, 1], 4 + u[:, 2]
    return np.where(x3 <= 5, x1 - x2 - x3, x3 - x2)


def _rp89(u: FloatArray) -> FloatArray:
    return np.minimum(-(u[:, 0] ** 2) - u[:, 1] + 8, -u[:, 0] / 5 - u[:, 1] + 6)


def _rp91(u: FloatArray) -> FloatArray:
    x1 = 0.07433 + 0.005 * u[:, 0]
    first, needed = references.rp91_parts(u[:, 1:])
    return np.minimum(first, x1 / needed - 1)


def _rp107(u: FloatArray) -> FloatArray:
    return np.asarray(5 * math.sqrt(10) - u.sum(axis=1))


def _rp110(u: FloatArray) -> FloatArray:
    x1, x2 = u.T
    first = np.where(x1 <= 3.5, 0.85 - 0.1 * x1, 4 - x1)
    return np.asarray(np.minimum(first, np.where(x2 <= 2, 2.3 - x2, 0.5 - 0.1 * x2)))


def _rp111(u: FloatArray) -> FloatArray:
    return np.asarray(12.5 - np.abs(u[:, 0] * u[:, 1]))


def _beam(u: FloatArray) -> FloatArray:
    return np.asarray(references.lognormal(u[:, 0], 300, 30) - (75_000 + 5000 * u[:, 1]) / (100 * math.pi))


def _four_branch(u: FloatArray) -> FloatArray:
    s, t = (u[:, 0] - u[:, 1]) / math.sqrt(2), (u[:, 0] + u[:, 1]) / math.sqrt(2)
    return np.minimum(3 + 0.2 * s**2 - np.abs(t), math.sqrt(2) * (3.5 - np.abs(s)))


def _r_minus_s(u: FloatArray) -> FloatArray:
    return np.asarray(2 + u[:, 0] - u[:, 1])


PUBLIC_STATES: dict[str, PublicState] = {
    "rp8_d6": PublicState(_rp8, 6, references.rp8, 7.897927545597477e-4, "convolution of six log-normal densities"),
    "rp14_d5": PublicState(_rp14, 5, references.rp14, 7.7285e-4, "four-dimensional Gauss quadrature"),
    "rp22_d2": PublicState(_rp22, 2, references.rp22, 4.20730551129961794e-3),
    "rp24_d2": PublicState(_rp24, 2, references.rp24, 2.86e-3),
    "rp25_d2": PublicState(_rp25, 2, references.rp25, 4.148566293759747e-05),
    "rp28_d2": PublicState(_rp28, 2, references.rp28, 1.4532945550025393e-07),
    "rp31_d2": PublicState(_rp31, 2, references.rp31, 3.226681209587691e-3),
    "rp33_d3": PublicState(_rp33, 3, references.rp33, 2.57e-3),
    "rp35_d2": PublicState(_rp35, 2, references.rp35, 3.47894632e-3),
    "rp38_d7": PublicState(_rp38, 7, references.rp38, 8.1e-3, references.CONDITIONAL, references.CONDITIONAL_DRAWS),
    "rp53_d2": PublicState(_rp53, 2, references.rp53, 3.13e-2),
    "rp54_d20": PublicState(_rp54, 20, references.rp54, 9.98e-4),
    "rp55_d2": PublicState(_rp55, 2, references.rp55, 5.6001442828637038e-01),
    "rp57_d2": PublicState(_rp57, 2, references.rp57, 2.84e-2),
    "rp60_d5": PublicState(_rp60, 5, references.rp60, 4.56e-2),
    "rp63_d100": PublicState(_rp63, 100, references.rp63, 3.79e-4),
    "rp75_d2": PublicState(_rp75, 2, references.rp75, 9.81929872154689e-3),
    "rp77_d3": PublicState(_rp77, 3, references.rp77, 2.87e-7),
    "rp89_d2": PublicState(_rp89, 2, references.rp89, 5.43e-3),
    "rp91_d5": PublicState(_rp91, 5, references.rp91, 6.97e-4, references.CONDITIONAL, references.CONDITIONAL_DRAWS),
    "rp107_d10": PublicState(_rp107, 10, references.rp107, 2.92e-7),
    "rp110_d2": PublicState(_rp110, 2, references.rp110, 3.19e-5),
    "rp111_d2": PublicState(_rp111, 2, references.rp111, 7.65e-7),
    "beam_d2": PublicState(_beam, 2, references.beam, 2.919819462483095e-2),
    "waarts_d2": PublicState(_four_branch, 2, references.four_branch, 2.222795066194439887e-3),
    "r_minus_s_d2": PublicState(_r_minus_s, 2, references.r_minus_s, float(stats.norm.sf(math.sqrt(2)))),
}
"""By name and dimension."""
