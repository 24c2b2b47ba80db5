"""All draws of a run from known components, and what they say together."""

import math

import numpy as np

from samplers.importance.draws import Draws
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FloatArray, Inputs
from samplers.proposals.components import MixtureComponent, log_ratios, mixture_log_ratio


class MultipleImportanceSample:
    """All draws from known components, weighed as draws from the mixture of all of them (Owen and Zhou 2000)."""

    def __init__(self, dim: int) -> None:
        self.u = np.empty((0, dim))
        """The failing ones, shape (k, d)."""
        self.batches: list[ComponentDraws] = []
        self._log_density = np.empty(0)
        self._components: list[MixtureComponent] = []
        self._counts = np.empty(0)

    @property
    def n(self) -> int:
        """Number of draws."""
        return sum(len(batch.f) for batch in self.batches)

    @property
    def log_weights(self) -> FloatArray:
        """log(phi / q) - log(n) at the failing draws, shape (k,): their sum is an estimate of p."""
        return -self._log_density

    def add(self, batch: ComponentDraws, gamma: float) -> None:
        """Take in a batch of draws."""
        used = [c for c, n in zip(batch.components, batch.counts, strict=True) if n > 0]
        counts = batch.counts[batch.counts > 0].astype(np.float64)
        self._log_density = np.logaddexp(self._log_density, mixture_log_ratio(log_ratios(used, self.u), counts))
        self._components += used
        self._counts = np.concatenate([self._counts, counts])
        self.batches.append(batch)
        found = batch.u[batch.f <= gamma]
        self._log_density = np.append(
            self._log_density, mixture_log_ratio(log_ratios(self._components, found), self._counts)
        )
        self.u = np.concatenate([self.u, found])

    def everything(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return all draws, failing or not: u (n, d), f (n,) and log(phi / q) - log(n), shape (n,)."""
        u = np.concatenate([batch.u for batch in self.batches])
        f = np.concatenate([batch.f for batch in self.batches])
        return u, f, -mixture_log_ratio(log_ratios(self._components, u), self._counts)

    def draws(self, inputs: Inputs, gamma: float) -> Draws:
        """Return all draws as those from one proposal."""
        u, f, log_weights = self.everything()
        return Draws.from_outcomes(f, log_weights + math.log(self.n), inputs.base.from_standard_normal(u), gamma)
