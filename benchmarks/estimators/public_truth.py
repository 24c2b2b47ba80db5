"""Probabilities of two public problems that have no one-dimensional integral, by scrambled Sobol draws.

    python -m benchmarks.estimators.public_truth

One variable is integrated in closed form (`rp38_conditional`, `rp91_conditional` of
`samplers.benchmark.public_references`); the others are drawn. The standard error is that of the mean of independent
scramblings.
"""

from typing import Annotated

import numpy as np
import typer
from rich.progress import track
from scipy.special import ndtri
from scipy.stats import qmc

from samplers.benchmark.public_references import rp38, rp38_conditional, rp91, rp91_conditional

SCRAMBLINGS = 32


def main(
    power: Annotated[int, typer.Option(help="Draws of a scrambling, as a power of 2.")] = 20, seed: int = 2026
) -> None:
    """Print p and its standard error for both problems."""
    rng = np.random.default_rng(seed)
    for name, conditional, dim, known in (("rp38", rp38_conditional, 6, rp38), ("rp91", rp91_conditional, 4, rp91)):
        means = []
        for _ in track(range(SCRAMBLINGS), description=name):
            uniform = qmc.Sobol(dim, rng=rng).random_base2(power)
            means.append(conditional(ndtri(np.clip(uniform, 1e-16, 1 - 1e-16))).mean())
        p, error = float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(SCRAMBLINGS))
        print(f"{name}: p = {p:.8e}, standard error {error:.1e}; in the code {known()[0]:.8e}")


if __name__ == "__main__":
    typer.run(main)
