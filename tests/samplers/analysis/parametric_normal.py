"""A normal base distribution with parameters, and a half-space under it, for the tests of sensitivities."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy import stats

import samplers

BETA = 3.0
ALPHA = np.array([0.8, 0.6, 0.0])
HAZARD = float(stats.norm.pdf(BETA) / stats.norm.sf(BETA))
"""phi(beta) / Phi(-beta), the mean of a standard normal variable beyond beta."""


class NormalParameter(NamedTuple):
    name: str
    value: float
    change: float
    change_name: str
    columns: tuple[int, ...]


class ParametricNormal:
    """Independent normal coordinates; parameters are their means and standard deviations."""

    refits: tuple[Any, ...] = ()
    clusters = 20
    fitted_to = "40 events of 20 scenes"
    family = "normal"

    def __init__(self, mean, sd):
        self.mean, self.sd = np.array(mean, dtype=float), np.array(sd, dtype=float)

    def sample(self, n, rng):
        return self.from_standard_normal(rng.standard_normal((n, len(self.mean))))

    def log_prob(self, x):
        return stats.norm.logpdf(x, self.mean, self.sd).sum(axis=1)

    def to_standard_normal(self, x):
        return (x - self.mean) / self.sd

    def from_standard_normal(self, u):
        return self.mean + self.sd * u

    def parameters(self, names=(), like=None):
        names = names or [f"x{j + 1}" for j in range(len(self.mean))]
        rows = list(enumerate(zip(names, self.mean, self.sd, strict=True)))
        means = (NormalParameter(f"mean of {name}", mean, sd, "1 sd", (j,)) for j, (name, mean, sd) in rows)
        return (*means, *(NormalParameter(f"sd of {name}", sd, 0.1 * sd, "10 %", (j,)) for j, (name, _, sd) in rows))

    def with_parameters(self, values):
        return ParametricNormal(*np.split(np.asarray(values), 2))


class HalfSpace:
    """{alpha . (x - mean) / sd >= beta} for the means and standard deviations of the base."""

    def __init__(self, base, beta=BETA):
        self.base, self.dim, self.beta = base, len(base.mean), beta

    def evaluate(self, x):
        return self.beta - self.base.to_standard_normal(x) @ ALPHA


BASE = ParametricNormal([10.0, -2.0, 0.0], [4.0, 0.5, 1.0])


def run(base=BASE, method="two-stage", seed=0, **options):
    return samplers.estimate(HalfSpace(base), method, seed=seed, **options)


def fitted(n_refits=30, seed=0, components=None):
    """Return the base with refits of which only the first column's mean and the second's sd vary."""
    rng = np.random.default_rng(seed)
    base = ParametricNormal(BASE.mean, BASE.sd)
    values, changes = (np.array([each[k] for each in base.parameters()]) for k in (1, 2))
    refits = []
    for _ in range(n_refits):
        move = np.zeros(6)
        move[0], move[4] = 0.3 * rng.standard_normal(), rng.standard_normal()
        refits.append(base.with_parameters(values + move * changes))
    base.refits = tuple(refits)
    return base
