"""Terms and their gradients in standard normal space, and the count of what they cost."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from samplers.method import TermsOffer, request_gradients, request_terms, whole_simulations
from samplers.methods.noise_coordinates import noise_mask
from samplers.methods.two_stage.simulator import SimulationSteps
from samplers.problem import (
    Distribution,
    FloatArray,
    Inputs,
    StandardNormal,
    Terms,
)

DIFFERENCE = 1e-4
"""Standard deviations of a central difference: its error is 1e-8, that of rounding 1e-12."""
POINTS_AT_ONCE = 4
"""Points at which T is differentiated at once: 4 with 386 groups of 1,448 coordinates take 70 MB."""
PATTERN_POINTS = 3
"""Points at which it is seen which coordinates of u a coordinate of x depends on."""


class TermSimulator:
    """The way from standard normal space to terms and gradients; it counts simulations and is changed in place.

    Attributes:
        inputs: All of x.
        offer: What the run answers.
        n_sim: Simulations made so far, gradients at their cost.
    """

    def __init__(self, inputs: Inputs, offer: TermsOffer) -> None:
        self.inputs, self.offer = inputs, offer
        self.n_sim = 0
        self._slopes: TransformSlopes | None = None

    def terms(self, u: FloatArray) -> SimulationSteps[Terms]:
        """Return the terms at u (n, d), n > 0."""
        terms = yield from request_terms(self.inputs.base.from_standard_normal(u))
        self.n_sim += len(u)
        return terms

    def gradients(
        self, u: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64]
    ) -> SimulationSteps[FloatArray]:
        """Return the gradients with respect to u of one term at each of the points u (n, d), shape (n, d).

        Args:
            u: Points; none give no request.
            term: Number of the term, shape (n,).
            ticks: When it is attained, shape (n,).
        """
        if len(u) == 0:
            return np.empty_like(u)
        answer = yield from request_gradients(self.inputs.base.from_standard_normal(u), term, ticks)
        self.n_sim += whole_simulations(answer.cost)
        if self._slopes is None:
            self._slopes = TransformSlopes(self.inputs)
        return self._slopes.pull_back(u, answer.values)


@runtime_checkable
class DifferentiableDistribution(Distribution, Protocol):
    """A distribution that knows the derivatives of its map from standard normal space."""

    def pull_back(self, u: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return gradients J' g with respect to u of gradients g with respect to x, both (n, d).

        Args:
            u: Points, shape (n, d), at which J = dx / du.
            gradients: At x = T(u), shape (n, d).
        """


@runtime_checkable
class HasBlocks(Protocol):
    """A base distribution of independent blocks side by side."""

    @property
    def blocks(self) -> Sequence[Any]:
        """Distributions with `dim`, in the order of the columns of x."""


class TransformSlopes:
    """Derivatives of x = T(u), the map from standard normal space, block by block: no simulation.

    A block that is a `DifferentiableDistribution` has its own; others are differentiated by `DifferencedMap`.
    """

    def __init__(self, inputs: Inputs) -> None:
        base, noise = inputs.base, noise_mask(inputs)
        self._identity = isinstance(base, StandardNormal)
        blocks = tuple(base.blocks) if isinstance(base, HasBlocks) else ()
        dims = [block.dim for block in blocks]
        if sum(dims) != inputs.dim or not all(isinstance(block, Distribution) for block in blocks):
            blocks, dims = (base,), [inputs.dim]
        self._ends = np.cumsum(dims)[:-1]
        self._maps = [
            block if isinstance(block, DifferentiableDistribution) else DifferencedMap(block, own)
            for block, own in zip(blocks, np.split(noise, self._ends), strict=True)
        ]

    def pull_back(self, u: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return the gradients (n, d) with respect to x at T(u), u (n, d), as gradients with respect to u."""
        if self._identity:
            return gradients
        parts = (np.split(points, self._ends, axis=1) for points in (u, gradients))
        return np.hstack([each.pull_back(*part) for each, *part in zip(self._maps, *parts, strict=True)])


class DifferencedMap:
    """Derivatives of x = T(u) by finite differences of it.

    Coordinates of noise are themselves. Others that no coordinate of x depends on together are moved at the same time,
    as Curtis, Powell and Reid ("On the estimation of sparse Jacobian matrices", 1974) do: where each x depends on its
    own u alone, one difference gives all of them.
    """

    def __init__(self, base: Distribution, noise: NDArray[np.bool_]) -> None:
        self._base = base
        self._moved = np.flatnonzero(~noise)
        self._groups: list[NDArray[np.int64]] | None = None
        self._pattern = np.zeros((0, len(noise)), dtype=bool)

    def pull_back(self, u: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return the gradients (n, d) with respect to x at T(u), u (n, d), as gradients with respect to u."""
        if self._groups is None:
            self._find_pattern(u[:PATTERN_POINTS])
        result = gradients.copy()  # noise, where dx / du = I
        for first in range(0, len(u), POINTS_AT_ONCE):
            self._pull_back(u[first : first + POINTS_AT_ONCE], result[first : first + POINTS_AT_ONCE])
        return result

    def _pull_back(self, u: FloatArray, gradients: FloatArray) -> None:
        """Replace the gradients at some points by J' g, with J = dx / du."""
        assert self._groups is not None
        given = gradients.copy()
        slopes = self._differences(u, [self._moved[group] for group in self._groups])
        for group, slope in zip(self._groups, slopes, strict=True):
            gradients[:, self._moved[group]] = (slope * given) @ self._pattern[group].T

    def _find_pattern(self, u: FloatArray) -> None:
        """Find which coordinates of x each moved coordinate of u changes, and groups of them that do not meet."""
        self._pattern = (self._differences(u, list(self._moved[:, None])) != 0).any(axis=1)
        groups, taken = list[list[int]](), list[NDArray[np.bool_]]()
        for number, row in enumerate(self._pattern):
            k = next((k for k, seen in enumerate(taken) if not (seen & row).any()), len(groups))
            if k == len(groups):
                groups.append([])
                taken.append(np.zeros_like(row))
            groups[k].append(number)
            taken[k] = taken[k] | row
        self._groups = [np.array(group) for group in groups]

    def _differences(self, u: FloatArray, groups: list[NDArray[np.int64]]) -> FloatArray:
        """Return central differences of T at u (n, d), with the coordinates of each group moved together, (k, n, d)."""
        steps = np.zeros((len(groups), 1, u.shape[1]))
        for row, group in zip(steps, groups, strict=True):
            row[0, group] = DIFFERENCE
        x = self._base.from_standard_normal(np.concatenate([u + steps, u - steps]).reshape(-1, u.shape[1]))
        ahead, behind = x.reshape(2, len(groups), *u.shape)
        return np.asarray((ahead - behind) / (2 * DIFFERENCE))
