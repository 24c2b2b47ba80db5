"""Rollouts a second of processor time by both cores, and estimates beside their simulations: tables of docs/speed.md.

OMP_NUM_THREADS=1 python -m benchmarks.simulation.core_rates
"""

from typing import Annotated, Any

import numpy as np
import typer

import agents
import rare_envs
import samplers
from benchmarks.simulation.throughput import (
    ANSWER_BASES,
    ANSWER_SIMULATIONS,
    CAR_FOLLOWING,
    CUT_IN,
    HIGHWAY,
    ppo,
    simulate_by_operators,
)
from benchmarks.simulation.timing import seconds
from rare_envs.threads import use_one_thread

CORES = ("torch", "numba")
HARD_BRAKE = "rare_envs/HardBrake-v0"
DRIVERS = ("mgail?rules=0", "mgail")
"""Of the traffic on the highway: without and with lane changes by rule."""


def measure_rates(env_id: str, rows: int, terms: bool = False, **settings: Any) -> str:
    """Return rollouts a second by torch and by numba."""
    rates = []
    for core in CORES:
        problem = rare_envs.DrivingProblem(env_id, core=core, **settings)
        x = problem.base.sample(rows, np.random.default_rng(0))
        simulate = problem.terms if terms else problem.evaluate
        simulate(x[:5])  # compiles
        rates.append(rows / seconds(lambda simulate=simulate, x=x: simulate(x), repeat=2))
    return " / ".join(f"{rate:,.0f}" for rate in rates)


def measure_answers(env_id: str, core: str, seeds: int = 4) -> str:
    """Return the times of estimates in those of their simulations in one call of torch's operators."""
    problem, plain = (
        rare_envs.DrivingProblem(env_id, base=ANSWER_BASES[env_id], core=each) for each in (core, "torch")
    )
    x = plain.base.sample(ANSWER_SIMULATIONS, np.random.default_rng(0))
    call = seconds(lambda: simulate_by_operators(plain, x), repeat=4)
    samplers.estimate(problem, seed=0, max_sim=ANSWER_SIMULATIONS)  # imports and compiles
    taken = [seconds(lambda k=k: samplers.estimate(problem, seed=k, max_sim=ANSWER_SIMULATIONS)) for k in range(seeds)]
    return ", ".join(f"{each / call:.1f}" for each in taken)


@use_one_thread()
def main(
    only_answers: Annotated[bool, typer.Option(help="Estimates alone.")] = False,
    only_highway: Annotated[bool, typer.Option(help="Rates on the highway alone.")] = False,
) -> None:
    """Measure and print."""
    if not (only_answers or only_highway):
        print_rates()
    if not only_answers:
        print_highway_rates()
    if only_highway:
        return
    for env_id in (CUT_IN, CAR_FOLLOWING):
        for core in ("auto", "torch"):
            print(f"{env_id}, estimates, core {core}: {measure_answers(env_id, core)}", flush=True)


def print_rates() -> None:
    """Measure and print rollouts a second of the scripted scenarios."""
    for rows in (25, 6000, 100_000):
        for env_id in (CAR_FOLLOWING, CUT_IN, HARD_BRAKE):
            print(f"{env_id}, {rows:,} rows: {measure_rates(env_id, rows)}")
    for rows in (25, 6000):
        for env_id in (CAR_FOLLOWING, CUT_IN):
            print(f"{env_id}, PPO ego, {rows:,} rows: {measure_rates(env_id, rows, ego=ppo(env_id))}")


def print_highway_rates() -> None:
    """Measure and print rollouts a second of the highway."""
    for rows in (25, 100, 1024):
        learned = agents.load_ego("imitation")
        print(f"{HIGHWAY}, ttc, {rows:,} rows: {measure_rates(HIGHWAY, rows)}")
        print(f"{HIGHWAY}, ttc with terms, {rows:,} rows: {measure_rates(HIGHWAY, rows, terms=True)}")
        found = measure_rates(HIGHWAY, rows, measure="lidar_ttc", ego=learned)
        print(f"{HIGHWAY}, lidar_ttc, learned ego, {rows:,} rows: {found}")
        for drivers in DRIVERS:
            found = measure_rates(HIGHWAY, rows, drivers=drivers)
            print(f"{HIGHWAY}, ttc, {drivers}, {rows:,} rows: {found}", flush=True)


if __name__ == "__main__":
    typer.run(main)
