"""The mixtures that `TwoStage` draws from."""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.screening import FailureScreen, draw_screened
from samplers.problem import FloatArray
from samplers.proposals.components import MixtureComponent, draw_components, draw_counts, log_ratios, mixture_log_ratio

NO_REGION = -1
ACCEPTANCE_DRAWS = 15_000
"""Draws that find what a screen lets through; they are not simulated."""


class ProposalComponent(NamedTuple):
    """A component that may become part of the proposal."""

    component: MixtureComponent
    kind: str
    region: int = NO_REGION


@dataclass(frozen=True)
class MixtureProposal:
    """A mixture to draw from."""

    candidates: list[ProposalComponent]
    weights: FloatArray
    """Adding up to 1, shape (k,)."""
    screen: FailureScreen | None = None
    acceptance: FloatArray = field(default_factory=lambda: np.ones(0))
    """Share of each component's draws that the screen lets through, shape (k,)."""
    acceptance_cov: float = 0.0
    """What the error of `acceptance` adds to the c.o.v. of p, as far as it is known before the draws.

    Its square is sum_k r_k^2 c_k^2, with r_k the component's share of p and c_k the c.o.v. of `acceptance`. The
    `weights` stand in for the r_k, which makes a difference of a fifth at most where it was measured.
    """

    @property
    def components(self) -> list[MixtureComponent]:
        """Its components."""
        return [candidate.component for candidate in self.candidates]

    def log_weights(self, u: FloatArray) -> FloatArray:
        """log(phi / q) at u (n, d), shape (n,)."""
        used = self.weights > 0
        log_r = log_ratios([c for c, a in zip(self.components, used, strict=True) if a], u)
        if self.screen is not None:
            log_r = log_r + np.where(
                self.screened[used, None], np.log(self.screen(u)) - np.log(self.acceptance)[used, None], 0.0
            )
        return -mixture_log_ratio(log_r, self.weights[used])

    @property
    def screened(self) -> NDArray[np.bool_]:
        """Which components the screen thins: not those that guard against what the classifier does not know."""
        return np.array([candidate.kind not in ("base", "wide") for candidate in self.candidates])

    def draw(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.int64]]:
        """Draw n points (n, d), one component after the other; return them and how many are from which."""
        counts = draw_counts(self.weights, n, rng)
        if self.screen is None:
            return draw_components(self.components, counts, rng), counts
        return np.concatenate(
            [
                draw_screened(self.screen, component, int(k), rng) if screened else component.sample(int(k), rng)
                for component, k, screened in zip(self.components, counts, self.screened, strict=True)
                if k > 0
            ]
        ), counts

    def with_screen(self, screen: FailureScreen, rng: np.random.Generator) -> "MixtureProposal":
        """Return the same with a screen; what it lets through of each component is found by drawing, not simulating."""
        acceptance, error = np.ones(len(self.weights)), 0.0
        for k, component in enumerate(self.components):
            if self.screened[k] and self.weights[k] > 0:
                accepted = screen(component.sample(max(int(self.weights[k] * ACCEPTANCE_DRAWS), 500), rng))
                acceptance[k] = accepted.mean()
                error += (self.weights[k] / acceptance[k]) ** 2 * float(accepted.var()) / len(accepted)
        return replace(self, screen=screen, acceptance=acceptance, acceptance_cov=math.sqrt(error))
