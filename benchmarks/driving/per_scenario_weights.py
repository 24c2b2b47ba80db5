"""Drivers with weights of their own for every scenario: one batched pass against a loop over networks.

    python -m benchmarks.driving.per_scenario_weights [--batch 256] [--vehicles 5]

Both sides sample actions for the same features, weights and noise; the least process time of several calls, in turn, on
one core. The speed does not depend on what the networks have learned, so their weights are random.
"""

from typing import Annotated

import torch
import typer
from torch import Tensor

from agents import LearnedDriver
from agents.learned.coloured_noise import AutoregressiveNoise
from agents.learned.driver import replace_head
from agents.learned.networks import ACTION_SIZE, FEATURE_SIZE, HEAD_SIZE, Policy, Scaling, head_weights
from benchmarks.simulation.timing import seconds
from rare_envs.threads import use_one_thread

FLOOR = 20.0


def compare_passes(batch: int, vehicles: int, rounds: int = 20) -> dict[str, float]:
    """Return times [ms] of one tick both ways, their ratio, and the largest difference of an action."""
    generator = torch.Generator().manual_seed(0)
    scaling = Scaling(
        torch.zeros(FEATURE_SIZE), torch.ones(FEATURE_SIZE), torch.zeros(ACTION_SIZE), torch.ones(ACTION_SIZE)
    )
    driver = LearnedDriver(Policy(scaling).requires_grad_(False), colour=AutoregressiveNoise((0.95, 0.95)))
    weights = head_weights(driver.policy) + 0.01 * torch.randn(batch, HEAD_SIZE, generator=generator)
    drivers = [LearnedDriver(replace_head(driver.policy, row), colour=driver.colour) for row in weights]
    features = torch.randn(batch, vehicles, FEATURE_SIZE, generator=generator)
    innovations = torch.randn(batch, vehicles, ACTION_SIZE, generator=generator)
    memory = driver.begin(torch.randn(batch, vehicles, ACTION_SIZE, 2, generator=generator))

    def at_once() -> Tensor:
        return driver.act(features, weights, innovations, memory)[0]

    def in_a_loop() -> Tensor:
        rows = zip(drivers, features[:, None], innovations[:, None], memory[:, None], strict=True)
        return torch.cat([one.act(x, None, xi, eps)[0] for one, x, xi, eps in rows])

    with torch.inference_mode():
        difference = float((at_once() - in_a_loop()).abs().max())
        times = [(seconds(at_once, 5), seconds(in_a_loop)) for _ in range(rounds)]
    fast, slow = (1e3 * min(column) for column in zip(*times, strict=True))
    return {"batched_ms": fast, "loop_ms": slow, "ratio": slow / fast, "largest_difference": difference}


@use_one_thread()
def main(
    batch: Annotated[int, typer.Option(help="Scenarios.")] = 256,
    vehicles: Annotated[int, typer.Option(help="Learned drivers in each.")] = 5,
) -> None:
    """Print the comparison; exits with 1 if the batched pass is less than 20 times as fast, or another policy."""
    result = compare_passes(batch, vehicles)
    print(f"{batch} scenarios of {vehicles} drivers: " + ", ".join(f"{name} {v:.3g}" for name, v in result.items()))
    raise typer.Exit(int(result["ratio"] < FLOOR or result["largest_difference"] > 1e-5))


if __name__ == "__main__":
    typer.run(main)
