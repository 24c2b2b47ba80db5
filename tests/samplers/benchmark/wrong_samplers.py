"""Samplers that are wrong on purpose, and one of a third party."""

from dataclasses import replace

import numpy as np

import samplers


def biased(problem, seed, max_sim):
    """All numbers a fifth too high."""
    found = samplers.estimate(problem, "two-stage", seed=seed, max_sim=max_sim)
    low, high = found.interval
    return replace(found, p=1.2 * found.p, interval=(1.2 * low, 1.2 * high))


def hidden(problem, seed, max_sim):
    """The same estimate twice, of which one is stated."""
    samplers.estimate(problem, "two-stage", seed=seed + 1000, max_sim=max_sim // 2)
    return samplers.estimate(problem, "two-stage", seed=seed, max_sim=max_sim // 2)


def spendthrift(problem, seed, max_sim):
    """Twice its budget."""
    return samplers.estimate(problem, "two-stage", seed=seed, max_sim=2 * max_sim)


def plain(problem, seed, max_sim):
    """Plain Monte Carlo of a third party, asked and told."""
    rng = np.random.default_rng(seed)
    f = problem.evaluate(rng.standard_normal((max_sim, problem.dim)))
    p = (f <= 0).mean()
    error = 1.96 * (p * (1 - p) / max_sim) ** 0.5
    return p, p - error, p + error


def narrow(problem, seed, max_sim):
    """Intervals of half the width."""
    p, low, high = plain(problem, seed, max_sim)
    return p, (p + low) / 2, (p + high) / 2


def endless(problem, seed, max_sim):
    while True:
        problem.evaluate(np.zeros((10_000, problem.dim)))


def wordy(problem, seed, max_sim):
    return 0.1, 0.2
