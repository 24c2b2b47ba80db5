"""Estimating p with fresh draws from a mixture, so many from each of its components."""

import math
from dataclasses import dataclass

import numpy as np

from samplers.importance.draws import Draws
from samplers.methods.two_stage.mixture.proposal import MixtureProposal
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FloatArray, Inputs
from samplers.sample import Sample

MIN_STRATUM_DRAWS = 10
"""Components with fewer draws than this are one stratum."""


@dataclass(frozen=True, eq=False)
class StratifiedSample:
    """Draws from a proposal, with the sums that the variance needs for each component."""

    draws: Draws
    counts: FloatArray
    """Draws of each component, shape (k,)."""
    sums: FloatArray
    """Of weight times indicator of failure, shape (k,)."""
    squares: FloatArray
    """Sums of their squares, shape (k,)."""
    acceptance_cov: float
    """What else is not exact: see `MixtureProposal.acceptance_cov`."""
    expected: FloatArray
    """Weights to be expected, whether or not a draw has shown them: one for each region found, shape (m,)."""
    u_safe: FloatArray
    """The draws that did not fail, in the order of `draws.f_safe`, shape (m, d)."""

    @classmethod
    def empty(cls, k: int, dim: int, expected: FloatArray) -> "StratifiedSample":
        """No draws yet from a proposal of k components in d dimensions."""
        zero = np.zeros(k)
        return cls(Draws(0, np.empty(0), np.empty(0)), zero, zero, zero, 0.0, expected, np.empty((0, dim)))

    def add(self, batch: ComponentDraws, proposal: MixtureProposal, inputs: Inputs, gamma: float) -> "StratifiedSample":
        """Return these draws and another batch from the same proposal."""
        fails = batch.f <= gamma
        log_weights = proposal.log_weights(batch.u)
        y = np.where(fails, np.exp(np.minimum(log_weights, 700.0)), 0.0)
        owner, k = np.repeat(np.arange(len(batch.counts)), batch.counts), len(batch.counts)
        x = inputs.base.from_standard_normal(batch.u)
        return StratifiedSample(
            self.draws.join(Draws.from_outcomes(batch.f, log_weights, x, gamma)),
            self.counts + batch.counts,
            self.sums + np.bincount(owner, weights=y, minlength=k),
            self.squares + np.bincount(owner, weights=y * y, minlength=k),
            proposal.acceptance_cov,
            self.expected,
            np.concatenate([self.u_safe, batch.u[~fails]]),
        )

    @property
    def p(self) -> float:
        """Mean of weight times indicator of failure."""
        return self.draws.p

    @property
    def cov(self) -> float:
        """Coefficient of variation of `p`; inf without a failing draw.

        The variance within the components: how many draws come from which is no matter of chance. The square of
        the largest term, seen or expected of a region, is added, for what draws as heavy as that have not shown yet.
        """
        if len(self.draws.f) == 0:
            return math.inf
        many = self.counts >= MIN_STRATUM_DRAWS
        n, s1, s2 = self.counts[many], self.sums[many], self.squares[many]
        within = float(((s2 - s1 * s1 / n) * n / (n - 1)).sum()) + float(self.squares[~many].sum())
        largest = max(math.exp(float(self.draws.log_weights.max())), float(self.expected.max(initial=0.0)))
        return math.hypot(
            math.sqrt(max(within, 0.0) + largest * largest) / (self.draws.n * self.p), self.acceptance_cov
        )

    def to_sample(self, proposal: MixtureProposal, base_f: FloatArray, base_u: FloatArray, gamma: float) -> Sample:
        """Return the weighted points behind p: failing draws as they are, the others with the first base draws.

        Thresholds above gamma rest on draws that did not fail; of those, few are made where f is large, and the base
        draws f (n0,), u (n0, d) of the exploration help.
        """
        n, n_base = self.draws.n, len(base_f)
        more = base_f > gamma
        u = np.concatenate([self.u_safe, base_u[more]])
        log_density = np.logaddexp(math.log(n) - proposal.log_weights(u), _log(n_base))
        k = len(self.draws.f)
        units = np.concatenate([np.arange(n), n + np.flatnonzero(more)])
        return Sample(
            f=np.concatenate([self.draws.f, self.draws.f_safe, base_f[more]]),
            weights=np.concatenate([np.exp(self.draws.log_weights) / n, np.exp(-log_density)]),
            units=units[: k + len(u)],
            n_units=n + n_base,
            x=self.draws.x,
        )


def _log(n: int) -> float:
    return math.log(n) if n else -math.inf
