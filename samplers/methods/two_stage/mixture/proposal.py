"""Proposal: the mixture that a round or the estimate draws from."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.proposals.components import MixtureComponent, draw_components, draw_counts, log_ratios, mixture_log_ratio

Kind = Literal[
    "base",
    "wide",
    "radial",
    "gaussian",
    "linear",
    "corner",
    "explored",
    "tempered",
    "spread",
    "directional",
]
"""Where a component of a proposal comes from:

    base        N(0, I), which bounds all weights
    wide        N(0, s^2 I)
    directional a direction and a radius, for failures like a shell or a cone
    radial      every direction alike, from the radius of the failures on
    gaussian    fitted to weighted failures
    linear      a half-space and its Gaussian, from linear regression of f
    corner      N(0, I) beyond all of several planes, from regression of f as the greatest of linear functions
    explored    fitted to the chains of the exploration, never changed
    tempered    q^t phi^(1 - t) of a Gaussian q, which bounds weights where q is a bad description
    spread      as wide as the failures in the span of a few gradients of f, N(0, 1) across it
"""

NO_REGION = -1
"""Region of a component that belongs to none in particular."""


class ProposalComponent(NamedTuple):
    """A component of a proposal, and where it comes from."""

    component: MixtureComponent
    kind: Kind
    region: int = NO_REGION


@dataclass(frozen=True)
class MixtureProposal:
    """A mixture sum_k a_k q_k to draw from."""

    candidates: list[ProposalComponent]
    """The components; those of weight 0 are not drawn from."""
    weights: FloatArray
    """a_k, adding up to 1, shape (k,)."""

    @property
    def components(self) -> list[MixtureComponent]:
        """Its components q_k."""
        return [candidate.component for candidate in self.candidates]

    def log_weights(self, u: FloatArray) -> FloatArray:
        """Return log(phi / q) at u (n, d), shape (n,)."""
        log_r, weights = self._log_ratios(u)
        return -mixture_log_ratio(log_r, weights)

    def kind_ratios(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return q_kind / q at u (n, d) for the mixture of the components of each kind, (n, m), and log(phi / q)."""
        log_r, weights = self._log_ratios(u)
        log_q = mixture_log_ratio(log_r, weights)
        kinds = np.array([one.kind for one, a in zip(self.candidates, self.weights, strict=True) if a > 0])
        masses = weights[:, None] * np.exp(log_r - log_q)
        ratios = [masses[kinds == kind].sum(axis=0) / weights[kinds == kind].sum() for kind in dict.fromkeys(kinds)]
        return np.stack(ratios, axis=1), -log_q

    def drawn(self, counts: FloatArray | NDArray[np.int64]) -> "MixtureProposal":
        """Return the mixture that draws come from of which counts (k,) are from each component.

        The same where the first component, the base distribution, has none: it bounds the weights.
        """
        return MixtureProposal(self.candidates, counts / counts.sum()) if counts[0] > 0 else self

    def _log_ratios(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log(q_k / phi) of the components drawn from, shape (m, n), and their weights (m,)."""
        used = self.weights > 0
        return log_ratios([c for c, a in zip(self.components, used, strict=True) if a], u), self.weights[used]

    def draw(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.int64]]:
        """Draw n points (n, d), one component after the other; return them and how many are from which (k,)."""
        counts = draw_counts(self.weights, n, rng)
        return draw_components(self.components, counts, rng), counts
