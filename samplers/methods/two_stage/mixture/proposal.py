"""Proposal: the mixture that a round or the estimate draws from, with a screen if one pays."""

import math
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.screening import FailureScreen, draw_screened
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, ScreeningSettings
from samplers.problem import FloatArray
from samplers.proposals.components import MixtureComponent, draw_components, draw_counts, log_ratios, mixture_log_ratio

Kind = Literal[
    "base", "wide", "radial", "gaussian", "linear", "explored", "tempered", "half-space", "spread", "directional"
]
"""Where a component of a proposal comes from:

    base        N(0, I), which bounds all weights
    wide        N(0, s^2 I)
    directional a direction and a radius, for failures like a shell or a cone
    radial      every direction alike, from the radius of the failures on
    gaussian    fitted to weighted failures
    linear      a half-space and its Gaussian, from linear regression of f
    explored    fitted to the chains of the exploration, never changed
    tempered    q^t phi^(1 - t) of a Gaussian q, which bounds weights where q is a bad description
    spread      as wide as the failures in the span of a few gradients of f, N(0, 1) across it
    half-space  N(0, I) beyond the edge of a Gaussian's failures
"""

NO_REGION = -1
"""Region of a component that belongs to none in particular."""
UNSCREENED = ("base", "wide")
"""Kinds that no screen thins: they guard against what the classifier does not know."""


class ProposalComponent(NamedTuple):
    """A component of a proposal, and where it comes from."""

    component: MixtureComponent
    kind: Kind
    region: int = NO_REGION


@dataclass(frozen=True)
class MixtureProposal:
    """A mixture sum_k a_k q_k to draw from; behind a screen each q_k becomes q_k a(u) / E_qk[a]."""

    candidates: list[ProposalComponent]
    """The components; those of weight 0 are not drawn from."""
    weights: FloatArray
    """a_k, adding up to 1, shape (k,)."""
    screen: FailureScreen | None = None
    acceptance: FloatArray = field(default_factory=lambda: np.ones(0))
    """E_qk[a], the share of each component's draws that the screen accepts, shape (k,)."""
    acceptance_cov: float = 0.0
    """What the error of `acceptance` adds to the c.o.v. of p, as far as it is known before the draws.

    Its square is sum_k r_k^2 c_k^2, with r_k the component's share of p and c_k the c.o.v. of `acceptance`. The
    `weights` stand in for the r_k, which makes a difference of a fifth at most where it was measured.
    """

    @property
    def components(self) -> list[MixtureComponent]:
        """Its components q_k."""
        return [candidate.component for candidate in self.candidates]

    @property
    def screened(self) -> NDArray[np.bool_]:
        """Which components the screen thins, shape (k,)."""
        return np.array([candidate.kind not in UNSCREENED for candidate in self.candidates])

    def log_weights(self, u: FloatArray) -> FloatArray:
        """Return log(phi / q) at u (n, d), shape (n,)."""
        used = self.weights > 0
        log_r = log_ratios([c for c, a in zip(self.components, used, strict=True) if a], u)
        if self.screen is not None:
            thinned = np.log(self.screen(u)) - np.log(self.acceptance)[used, None]
            log_r = log_r + np.where(self.screened[used, None], thinned, 0.0)
        return -mixture_log_ratio(log_r, self.weights[used])

    def draw(
        self,
        n: int,
        rng: np.random.Generator,
        settings: ScreeningSettings = DEFAULT_MIXTURE_SETTINGS.screening,
    ) -> tuple[FloatArray, NDArray[np.int64]]:
        """Draw n points (n, d), one component after the other; return them and how many are from which (k,)."""
        counts = draw_counts(self.weights, n, rng)
        if self.screen is None:
            return draw_components(self.components, counts, rng), counts
        parts = [
            draw_screened(self.screen, component, int(k), rng, settings) if screened else component.sample(int(k), rng)
            for component, k, screened in zip(self.components, counts, self.screened, strict=True)
            if k > 0
        ]
        return np.concatenate(parts), counts

    def with_screen(
        self,
        screen: FailureScreen,
        rng: np.random.Generator,
        settings: ScreeningSettings = DEFAULT_MIXTURE_SETTINGS.screening,
    ) -> "MixtureProposal":
        """Return the mixture behind a screen; what it accepts of each component is found by draws, not simulations."""
        acceptance, error = np.ones(len(self.weights)), 0.0
        for k, component in enumerate(self.components):
            if self.screened[k] and self.weights[k] > 0:
                n = max(int(self.weights[k] * settings.acceptance_draws), settings.min_acceptance_draws)
                accepted = screen(component.sample(n, rng))
                acceptance[k] = accepted.mean()
                error += (self.weights[k] / acceptance[k]) ** 2 * float(accepted.var()) / len(accepted)
        return replace(self, screen=screen, acceptance=acceptance, acceptance_cov=math.sqrt(error))
