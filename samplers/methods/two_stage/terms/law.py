"""Proposals of a search by terms: for each term Gaussians in the subspace of its gradients, N(0, I) across it.

With orthonormal axes V_j (d, r) and a density q_j on R^r, a draw of term j is u = xi + V_j (z - V_j' xi) with
xi ~ N(0, I) and z ~ q_j. The mixture over the terms has the exact density ratio

    q(u) / phi(u) = a_0 + (1 - a_0) sum_j pi_j q_j(V_j' u) / phi_r(V_j' u),

also where the subspaces of the terms differ.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.proposals.components import SubspaceGaussian, draw_counts, log_ratios, mixture_log_ratio
from samplers.proposals.log_sums import log_sum_exp


@dataclass(frozen=True, eq=False)
class ComponentGroup:
    """Components of one stratum: a draw takes one of them at random."""

    share: float
    """Of the term's draws."""
    components: tuple[SubspaceGaussian, ...]
    """In the coordinates of the subspace."""
    weights: FloatArray
    """Adding up to 1, shape (k,)."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points z, shape (n, r)."""
        counts = rng.multinomial(n, self.weights / self.weights.sum())
        return np.concatenate([c.sample(int(k), rng) for c, k in zip(self.components, counts, strict=True)])


@dataclass(frozen=True, eq=False)
class TermLaw:
    """Proposal of one term."""

    axes: FloatArray
    """V, orthonormal columns, shape (d, r)."""
    groups: tuple[ComponentGroup, ...]
    """Their shares add up to 1."""

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return log(q_j / phi) at u (n, d), shape (n,)."""
        z = u @ self.axes
        components = [component for group in self.groups for component in group.components]
        weights = np.concatenate([group.share * group.weights for group in self.groups])
        return mixture_log_ratio(log_ratios(components, z), weights)

    def sample(self, group: int, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points of one group, shape (n, d)."""
        xi = rng.standard_normal((n, len(self.axes)))
        z = self.groups[group].sample(n, rng)
        return np.asarray(xi + (z - xi @ self.axes) @ self.axes.T)


@dataclass(frozen=True, eq=False)
class TermProposal:
    """Mixture of base draws and the proposals of the terms; its strata are the base and every group."""

    dim: int
    base_share: float
    """a_0."""
    laws: tuple[TermLaw, ...]
    shares: FloatArray
    """pi_j, adding up to 1, shape (len(laws),)."""

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return log(q / phi) at u (n, d), shape (n,)."""
        terms = [np.full(len(u), math.log(self.base_share))]
        for share, law in zip(self.shares, self.laws, strict=True):
            terms.append(math.log((1 - self.base_share) * share) + law.log_ratio(u))
        return np.asarray(log_sum_exp(np.array(terms), axis=0))

    @property
    def stratum_shares(self) -> FloatArray:
        """Shares of the base and of every group, shape (k,)."""
        groups = [
            (1 - self.base_share) * share * group.share
            for share, law in zip(self.shares, self.laws, strict=True)
            for group in law.groups
        ]
        return np.array([self.base_share, *groups])

    def draw(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.int64]]:
        """Draw n points, a fixed number from each stratum; return them (n, d) and their strata (n,)."""
        counts = draw_counts(self.stratum_shares, n, rng)
        parts = [rng.standard_normal((int(counts[0]), self.dim))]
        strata = [(law, group) for law in self.laws for group in range(len(law.groups))]
        parts += [law.sample(group, int(k), rng) for (law, group), k in zip(strata, counts[1:], strict=True)]
        return np.concatenate(parts), np.repeat(np.arange(len(counts)), counts)
