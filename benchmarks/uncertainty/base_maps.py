"""How long do maps from standard normal space take? Compiled, by NumPy and in logarithms, in turn in one process.

    OMP_NUM_THREADS=1 python -m benchmarks.uncertainty.base_maps

Processor time for the points of an estimate: batches of 25 rows and one of 2,000, most of them out in a tail.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import typer

from benchmarks.simulation.timing import seconds
from rare_envs.distributions import mixture_conditionals, pooled_mixture, truncated_normal
from rare_envs.distributions.quantiles import column_quantiles, mixture_quantile
from rare_envs.distributions.space import Distribution
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import find_scenario

SMALL_BATCHES, SMALL, LARGE = 80, 25, 2000
ROUNDS = 5
BASES = (
    ("rare_envs/CarFollowing-v0", "us101-gap", False),
    ("rare_envs/CarFollowing-v0", "us101", True),
    ("rare_envs/HardBrake-v0", "us101", True),
    ("rare_envs/CutIn-v0", "us101-15-offsets", False),
)
"""Scenario, base, and whether it is the pool of its refits that is mapped."""


def by_logarithms(column: mixture_quantile.MixtureColumn, u: Any) -> column_quantiles.Quantiles:
    """Return no quantiles, so that all rows are left to logarithms."""
    return np.zeros(len(u)), np.zeros(len(u), dtype=np.bool_)


WAYS: dict[str, Callable[..., column_quantiles.Quantiles]] = {
    "compiled": column_quantiles.find_quantiles,
    "NumPy": mixture_quantile.search_quantiles,
    "logarithms": by_logarithms,
}


@contextmanager
def use(way: str) -> Iterator[None]:
    """Let mixtures and pools find quantiles in one way."""
    find_compiled = mixture_conditionals.find_compiled
    if way != "compiled":
        mixture_conditionals.find_compiled = lambda: None  # else whole rows at once
    for module in (truncated_normal, pooled_mixture):
        module.find_quantiles = WAYS[way]
    yield
    mixture_conditionals.find_compiled = find_compiled
    for module in (truncated_normal, pooled_mixture):
        module.find_quantiles = column_quantiles.find_quantiles


def batches(dim: int) -> list[np.ndarray[Any, Any]]:
    """Return points like those of an estimate: a first draw, and chains that have moved 4 standard deviations out."""
    rng = np.random.default_rng(0)
    out = 4.0 / np.sqrt(dim)
    small = [rng.standard_normal((SMALL, dim)) + out * rng.choice([-1.0, 1.0], dim) for _ in range(SMALL_BATCHES)]
    return [rng.standard_normal((LARGE, dim)), *small]


def time_ways(base: Distribution, points: list[np.ndarray[Any, Any]]) -> dict[str, float]:
    """Return the least time of each way over rounds in which each has its turn [s]."""
    times = dict.fromkeys(WAYS, np.inf)
    for _ in range(ROUNDS + 1):  # the first one compiles
        for way in WAYS:
            with use(way):
                times[way] = min(times[way], seconds(lambda: [base.from_standard_normal(u) for u in points]))
    return times


def main() -> None:
    """Print a line for each base."""
    import numba  # noqa: F401  (compiled quantiles are used where it is imported)

    for env_id, name, is_pool in BASES:
        base: Any = load_base(find_scenario(env_id), name)
        mapped = base.covering_ensemble() if is_pool else base
        points = batches(mapped.dim)
        times = time_ways(mapped, points)
        text = ", ".join(f"{way} {1e3 * taken:.0f} ms" for way, taken in times.items())
        print(f"{env_id}, {name}{', pooled refits' if is_pool else ''}, {sum(map(len, points)):,} points: {text}")


if __name__ == "__main__":
    typer.run(main)
