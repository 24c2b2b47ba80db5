"""Algorithm 1 of the paper: a search that is told outcomes and gives the next sampler.

Draws come from the sampler alone, as in the paper; `samplers.CrossEntropy`, the package's own form, adds draws from the
base distribution.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.papers.okelly2018.scales import SearchSettings
from samplers.methods.blocks import BetaBlock, NormalBlock, Product, announced_blocks
from samplers.problem import FloatArray, Inputs
from samplers.statistics import effective_sample_size, normalise_weights


class SearchStep(NamedTuple):
    """One iteration: what the draws from a sampler have shown."""

    sampler: Product
    quantile: float
    """The rho-quantile of f under the sampler; the paper keeps the sampler with the lowest."""
    level: float
    """gamma_k: the quantile, but not below gamma."""
    elite: int
    """Draws with f <= level."""
    ess: float
    """Effective number of them under the weights of equation 3."""


def make_base(inputs: Inputs, settings: SearchSettings) -> Product:
    """Return P_0 as the product that a search moves.

    Args:
        inputs: Of the problem.
        settings: With `weights_move` false the Normal blocks stay where they are.
    """
    base = announced_blocks(inputs)
    if settings.weights_move:
        return base
    fixed = (replace(block, radius=0.0) if isinstance(block, NormalBlock) else block for block in base.blocks)
    return Product(tuple(fixed))


def draw_chunk(sampler: Product, n: int, seed: int, key: str) -> FloatArray:
    """Return n scenarios, shape (n, d), that a sampler, a seed and the key of a chunk determine."""
    return sampler.sample(n, np.random.default_rng([seed, *key.encode()]))


def find_log_ratios(base: Product, sampler: Product, x: FloatArray) -> FloatArray:
    """Return log(p_0 / p_theta) of scenarios x (n, d), all blocks together (equation 3), shape (n,)."""
    return base.log_prob(x) - sampler.log_prob(x)


def take_step(
    base: Product, sampler: Product, x: FloatArray, f: FloatArray, settings: SearchSettings, gamma: float
) -> tuple[SearchStep, Product]:
    """Return what the draws of an iteration show, and the next sampler (equation 2).

    Args:
        base: P_0.
        sampler: P_theta_k, where the draws are from.
        x: Draws, shape (n, d).
        f: Their outcomes, shape (n,).
        settings: Of the search.
        gamma: Threshold that the search is for.
    """
    rank = math.ceil(settings.rho * len(f)) - 1
    quantile = float(np.partition(f, rank)[rank])
    level = max(quantile, gamma)
    elite = x[f <= level]
    log_ratios = find_log_ratios(base, sampler, elite)
    weights = np.tile(normalise_weights(log_ratios), (len(base.blocks), 1))
    step = SearchStep(sampler, quantile, level, len(elite), effective_sample_size(log_ratios))
    return step, sampler.project(elite, weights, settings.alpha)


def choose_sampler(steps: list[SearchStep]) -> int:
    """Return the number of the step whose sampler has the lowest quantile, the earliest of equals."""
    return int(np.argmin([step.quantile for step in steps]))


def describe_sampler(base: Product, sampler: Product) -> dict[str, list[float] | float]:
    """Return the parameters of a sampler as plain values, and how far its Normal block has moved.

    Returns:
        alpha, beta: Of the Beta variables, in the order of x.
        mean, variance: Of these variables, in their units.
        largest_shift: Of the mean of a weight.
        shift: Of the mean of all weights, in standard deviations of the base distribution (its Mahalanobis length).
    """
    found: dict[str, list[float] | float] = {}
    for before, after in zip(base.blocks, sampler.blocks, strict=True):
        if isinstance(before, BetaBlock) and isinstance(after, BetaBlock):
            total, width = after.alpha + after.beta, after.high - after.low
            variance = width**2 * after.alpha * after.beta / (total**2 * (total + 1.0))
            found["alpha"], found["beta"] = after.alpha.tolist(), after.beta.tolist()
            found["mean"] = (after.low + width * after.alpha / total).tolist()
            found["variance"] = variance.tolist()
        if isinstance(before, NormalBlock) and isinstance(after, NormalBlock):
            moved = after.gaussian.mean - before.gaussian.mean
            found["largest_shift"] = float(np.abs(moved).max())
            found["shift"] = float(np.linalg.norm(before.to_standard_normal(after.gaussian.mean[None])))
    return found
