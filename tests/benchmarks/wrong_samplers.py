"""Samplers that are wrong on purpose, and one of a third party."""

import sys

import numpy as np

import samplers
from benchmarks.samplers.problems import limit_state


def monte_carlo(problem, seed, max_sim, budget=1.0):
    return samplers.estimate(problem, "mc", seed=seed, max_sim=round(budget * max_sim))


def plain(problem, seed, max_sim):
    """Plain Monte Carlo of a third party."""
    rng = np.random.default_rng(seed)
    f = problem.evaluate(rng.standard_normal((max_sim, problem.dim)))
    p = (f <= 0).mean()
    error = 1.96 * (p * (1 - p) / max_sim) ** 0.5
    return p, p - error, p + error


def hidden(problem, seed, max_sim):
    """The same estimate twice, of which one is stated."""
    monte_carlo(problem, seed + 1000, max_sim, 0.5)
    return monte_carlo(problem, seed, max_sim, 0.5)


def narrow(problem, seed, max_sim):
    """Intervals of half the width."""
    p, low, high = plain(problem, seed, max_sim)
    return p, (p + low) / 2, (p + high) / 2


def informed(problem, seed, max_sim):
    """Reads p of common_d4, and simulates for show."""
    plain(problem, seed, max_sim)
    p = limit_state("common_d4").p
    return 1.01 * p, 0.9 * p, 1.1 * p


def impossible(problem, seed, max_sim):
    """A p for every seed that is none, or is not in its interval."""
    plain(problem, seed, max_sim)
    return [(1.7, 0.0, 2.0), (0.04, 0.05, 0.03), (0.3, 0.03, 0.05), (0.04, 0.03, 0.05, -0.5)][seed % 4]


def endless(problem, seed, max_sim):
    """Never ends."""
    while True:
        problem.evaluate(np.zeros((10_000, problem.dim)))


def spendthrift(problem, seed, max_sim):
    """Twice its budget."""
    return monte_carlo(problem, seed, max_sim, 2.0)


def stubborn(problem, seed, max_sim):
    """The same draws at every seed."""
    return plain(problem, 5, max_sim)


def wordy(problem, seed, max_sim):
    """Two numbers."""
    return (0.1, 0.2)


def leaving(problem, seed, max_sim):
    """Ends the program."""
    return sys.exit("enough | of\nthis")
