"""Probabilities of the random networks of `samplers.benchmark.highdim_states`, by plain Monte Carlo.

python -m benchmarks.estimators.network_references --draws 4e7
"""

import math
from typing import Annotated

import numpy as np
import typer

from samplers.benchmark.highdim_states import NETWORKS, network_weights


def main(
    draws: Annotated[float, typer.Option(help="Plain draws for each network.")] = 4e7,
    seed: Annotated[int, typer.Option(help="Of the draws.")] = 0,
) -> None:
    """Print P[f <= 0] of the random networks; u W is N(0, W'W), so a draw has one coordinate for each unit."""
    rng, batch = np.random.default_rng(seed), 100_000
    for dim, (limit, *_) in NETWORKS.items():
        first, second = network_weights(dim)
        root = np.linalg.qr(first, mode="r")  # W'W = R'R
        hits = sum(
            int(np.count_nonzero(np.abs(np.tanh(2.0 * z @ root) @ second).max(axis=1) >= limit))
            for z in (rng.standard_normal((batch, len(root))) for _ in range(math.ceil(draws / batch)))
        )
        n = batch * math.ceil(draws / batch)
        print(f"{dim} inputs: p = {hits / n:.5e}, standard error {math.sqrt(hits) / n:.1e}")


if __name__ == "__main__":
    typer.run(main)
