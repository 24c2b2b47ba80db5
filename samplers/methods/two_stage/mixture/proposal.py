"""The mixtures that `TwoStage` draws from."""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.screening import Gate, draw_through
from samplers.problem import FloatArray
from samplers.proposals.components import Component, draw, draw_counts, log_ratios, mixed

NO_REGION = -1
GATE_DRAWS = 15_000
"""Draws that find what a gate lets through; they are not simulated."""


class Candidate(NamedTuple):
    """A component that may become part of the proposal."""

    component: Component
    kind: str
    region: int = NO_REGION


@dataclass(frozen=True)
class Proposal:
    """A mixture to draw from."""

    candidates: list[Candidate]
    weights: FloatArray
    """Adding up to 1, shape (k,)."""
    gate: Gate | None = None
    mass: FloatArray = field(default_factory=lambda: np.ones(0))
    """Share of each component's draws that the gate lets through, shape (k,)."""
    mass_cov: float = 0.0
    """What the error of `mass` adds to the c.o.v. of p, as far as it is known before the draws.

    Exact are the components' shares r_k of p: the square is sum_k r_k^2 c_k^2 with c_k the c.o.v. of `mass`. Their
    `weights` stand in for them, which makes a difference of a fifth at most where it was measured.
    """

    @property
    def components(self) -> list[Component]:
        """Its components."""
        return [candidate.component for candidate in self.candidates]

    def log_weights(self, u: FloatArray) -> FloatArray:
        """log(phi / q) at u (n, d), shape (n,)."""
        used = self.weights > 0
        log_r = log_ratios([c for c, a in zip(self.components, used, strict=True) if a], u)
        if self.gate is not None:
            log_r = log_r + np.where(self.gated[used, None], np.log(self.gate(u)) - np.log(self.mass)[used, None], 0.0)
        return -mixed(log_r, self.weights[used])

    @property
    def gated(self) -> NDArray[np.bool_]:
        """Which components the gate thins: not those that guard against what the classifier does not know."""
        return np.array([candidate.kind not in ("base", "wide") for candidate in self.candidates])

    def drawn(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.int64]]:
        """Draw n points (n, d), one component after the other; return them and how many are from which."""
        counts = draw_counts(self.weights, n, rng)
        if self.gate is None:
            return draw(self.components, counts, rng), counts
        return np.concatenate(
            [
                draw_through(self.gate, component, int(k), rng) if gated else component.sample(int(k), rng)
                for component, k, gated in zip(self.components, counts, self.gated, strict=True)
                if k > 0
            ]
        ), counts

    def behind(self, gate: Gate, rng: np.random.Generator) -> "Proposal":
        """Return the same with a gate; what it lets through of each component is found by drawing, not simulating."""
        mass, error = np.ones(len(self.weights)), 0.0
        for k, component in enumerate(self.components):
            if self.gated[k] and self.weights[k] > 0:
                let_through = gate(component.sample(max(int(self.weights[k] * GATE_DRAWS), 500), rng))
                mass[k] = let_through.mean()
                error += (self.weights[k] / mass[k]) ** 2 * float(let_through.var()) / len(let_through)
        return replace(self, gate=gate, mass=mass, mass_cov=math.sqrt(error))
