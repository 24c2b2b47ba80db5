"""History of a search by terms: simulated points in standard normal space, and the weights of those from proposals."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from samplers.execution.executors.packing import join_terms
from samplers.methods.two_stage.terms.law import TermProposal
from samplers.problem import FloatArray, Terms
from samplers.sample import DrawWeights


@dataclass(frozen=True, eq=False)
class TermHistory:
    """Base draws and all draws of proposals, weighted as draws from the mixture of all of them (balance heuristic).

    Later proposals depend on earlier draws, so that p from these weights is 10 to 15 % low on Highway-v0: they serve to
    fit the next proposal and for a run that is stopped early, not for the estimate.
    """

    u: FloatArray
    """Shape (n, d)."""
    terms: Terms
    log_density: FloatArray
    """log(sum_k n_k q_k / phi) over the proposals so far, base draws being one, shape (n,)."""
    proposals: tuple[tuple[int, TermProposal], ...] = field(default=())
    """Draws of each proposal, and the proposal."""
    n_base: int = 0
    """Base draws, the first of all."""
    firsts: tuple[int, ...] = ()
    """Simulations that the run had spent before each proposal's draws."""

    @classmethod
    def of_base_draws(cls, u: FloatArray, terms: Terms) -> "TermHistory":
        """Return the history of base draws u (n, d) alone."""
        return cls(u, terms, np.full(len(u), np.log(len(u))), (), len(u))

    @property
    def log_weights(self) -> FloatArray:
        """log(phi / q) - log(n), shape (n,): exp of them over some points adds up to their probability."""
        return -self.log_density

    @property
    def draw_weights(self) -> tuple[DrawWeights, ...]:
        """Weight of every draw in the p of all of them."""
        sizes = (self.n_base, *(n for n, _ in self.proposals))
        whole = DrawWeights(first=0, log_weights=self.log_weights)
        return whole.split(*zip((0, *self.firsts), sizes, strict=True))

    def add(self, u: FloatArray, terms: Terms, proposal: TermProposal, first: int) -> "TermHistory":
        """Return the history with draws u (m, d) of a proposal, before which the run had spent `first` simulations."""
        count = np.log(len(u))
        old = np.logaddexp(self.log_density, count + proposal.log_ratio(self.u))
        new = np.full(len(u), np.log(self.n_base))
        for n, earlier in (*self.proposals, (len(u), proposal)):
            new = np.logaddexp(new, np.log(n) + earlier.log_ratio(u))
        return TermHistory(
            np.concatenate([self.u, u]),
            join_terms([self.terms, terms]),
            np.concatenate([old, new]),
            (*self.proposals, (len(u), proposal)),
            self.n_base,
            (*self.firsts, first),
        )

    def failing(self, gamma: float) -> NDArray[np.bool_]:
        """Return which points have f <= gamma, shape (n,)."""
        return np.asarray(self.terms.f <= gamma)
