"""Multiple importance sampling: draws of several proposals, weighted as draws from the mixture of all of them.

With n_k draws from component q_k and n in all, every draw has the weight phi / sum_k (n_k / n) q_k (deterministic
mixture weights, the balance heuristic): no weight is larger than n / n_0 where n_0 draws are from phi itself.

References:
    Veach and Guibas, "Optimally combining sampling techniques for Monte Carlo rendering", SIGGRAPH 1995.
    Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from samplers.importance.draws import Draws
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FloatArray, Inputs
from samplers.proposals.components import MixtureComponent, log_ratios, mixture_log_ratio


@dataclass(frozen=True, eq=False)
class MultipleImportanceSample:
    """All draws of a run from known components; `add` returns the sample with another batch.

    Later proposals depend on earlier draws, so that p from these weights is biased low by some per cent: they serve to
    fit the next proposal and for a run that is stopped early, not for the estimate.
    """

    u: FloatArray
    """The failing draws, shape (k, d)."""
    log_weights: FloatArray
    """log(phi / q) - log(n) at the failing draws, shape (k,): their exponentials add up to an estimate of p."""
    batches: tuple[ComponentDraws, ...] = ()
    components: tuple[MixtureComponent, ...] = ()
    """Those drawn from, one for each batch that it was part of."""
    counts: FloatArray = field(default_factory=lambda: np.empty(0))
    """Draws of each of `components`."""

    @classmethod
    def empty(cls, dim: int) -> "MultipleImportanceSample":
        """Return a sample without draws in d dimensions."""
        return cls(np.empty((0, dim)), np.empty(0))

    @property
    def n(self) -> int:
        """Number of draws."""
        return sum(len(batch.f) for batch in self.batches)

    def add(self, batch: ComponentDraws, gamma: float) -> "MultipleImportanceSample":
        """Return the sample with another batch; the failing ones are those with f <= gamma."""
        used = tuple(c for c, n in zip(batch.components, batch.counts, strict=True) if n > 0)
        used_counts = batch.counts[batch.counts > 0].astype(np.float64)
        components, counts = self.components + used, np.concatenate([self.counts, used_counts])
        failing = batch.u[batch.f <= gamma]
        known = np.logaddexp(-self.log_weights, mixture_log_ratio(log_ratios(used, self.u), used_counts))
        added = mixture_log_ratio(log_ratios(components, failing), counts)
        return MultipleImportanceSample(
            np.concatenate([self.u, failing]),
            -np.append(known, added),
            (*self.batches, batch),
            components,
            counts,
        )

    def within(self, axes: FloatArray) -> "MultipleImportanceSample":
        """Return the failing draws alone, in the coordinates of orthonormal axes (d, r)."""
        return MultipleImportanceSample(self.u @ axes, self.log_weights)

    def all_draws(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return all draws, failing or not: u (n, d), f (n,) and log(phi / q) - log(n), shape (n,)."""
        u = np.concatenate([batch.u for batch in self.batches])
        f = np.concatenate([batch.f for batch in self.batches])
        return u, f, -mixture_log_ratio(log_ratios(self.components, u), self.counts)

    def to_draws(self, inputs: Inputs, gamma: float) -> Draws:
        """Return all draws as those from one proposal."""
        u, f, log_weights = self.all_draws()
        return Draws.from_outcomes(f, log_weights + math.log(self.n), inputs.base.from_standard_normal(u), gamma)
