"""What a rollout costs against the batch and the number of vehicles, and a method's own time against dimension.

    OMP_NUM_THREADS=1 python -m benchmarks.simulation.cost_curves --out benchmarks/results/cost_curves.json \
        --figure docs/images/cost_curves.svg

All are processor times on one core, the least of some repetitions; HighwayEnv's objects are timed in the same run.
With `--from FILE` the figure is drawn of an earlier record.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

import rare_envs
import samplers
from benchmarks.samplers.runs import about
from benchmarks.simulation import highway_env_reference as reference
from benchmarks.simulation.throughput import CAR_FOLLOWING, CUT_IN, HIGHWAY
from benchmarks.simulation.timing import seconds
from rare_envs.scenarios import VEHICLE_LENGTH, Others, Parameter, Scenario, State, straight
from rare_envs.threads import use_one_thread

BATCHES = (1, 10, 100, 1000, 10_000)
SCENARIOS = {"car-following": CAR_FOLLOWING, "cut-in": CUT_IN, "highway, learned drivers": HIGHWAY}
CORES = ("torch", "numba")
VEHICLES = (2, 4, 8, 16, 32)
VEHICLE_BATCH = 1000
DIMENSIONS = (2, 6, 20, 60, 200, 428)
SIMULATIONS = 6000
METHODS = {"two-stage": samplers.TwoStage(), "adss": samplers.AdaptiveSubsetSimulation(), "mc": samplers.MonteCarlo()}
GAP = 30.0
"""Between the vehicles of a queue [m]."""
TICKS = 100


def queue(vehicles: int) -> Scenario:
    """Return a scenario of an ego behind a queue in one lane that keeps its speed."""

    def initial(x: torch.Tensor) -> State:
        place = (GAP + VEHICLE_LENGTH) * torch.arange(vehicles, dtype=x.dtype, device=x.device)
        rest = torch.zeros(len(x), vehicles, dtype=x.dtype, device=x.device)
        return State(x=rest + place, y=rest, heading=rest, speed=rest + x[:, :1], theta=x[:, :0])

    def others(state: State, dt: float) -> Others:
        moved = state.x[:, 1:] + state.speed[:, 1:] * dt
        return Others(moved, state.y[:, 1:], state.heading[:, 1:], state.speed[:, 1:])

    return Scenario(
        name=f"queue_{vehicles}",
        road=straight(lanes=1),
        vehicle_names=("ego", *(f"vehicle_{number}" for number in range(1, vehicles))),
        horizon=TICKS / 10,
        parameters=(Parameter("speed", "m/s", 5.0, 30.0, "of all"),),
        bases={"chosen": {"alpha": [4.0], "beta": [4.0]}},
        initial=initial,
        others=others,
        driven=lambda state, action, dt: others(state, dt),
    )


def measure_batches(repeat: int) -> list[dict[str, Any]]:
    """Return seconds a rollout of each scenario, core and batch."""
    rows = []
    for name, env_id in SCENARIOS.items():
        for core in CORES:
            problem = rare_envs.DrivingProblem(env_id, core=core)
            x = problem.base.sample(BATCHES[-1], np.random.default_rng(0))
            batches = BATCHES[:-1] if env_id == HIGHWAY else BATCHES
            problem.evaluate(x[:1])  # compiles
            taken = [seconds(lambda n=n, problem=problem, x=x: problem.evaluate(x[:n]), repeat) / n for n in batches]
            rows.append({"scenario": name, "core": core, "batches": batches, "seconds": taken})
    return rows


def measure_vehicles(repeat: int) -> list[dict[str, Any]]:
    """Return seconds a rollout with each number of vehicles, ours by torch and HighwayEnv's."""
    ours, theirs = [], []
    for vehicles in VEHICLES:
        env_id = f"benchmark/Queue{vehicles}-v0"
        rare_envs.register_scenario(env_id, queue(vehicles))
        problem = rare_envs.DrivingProblem(env_id, core="torch")
        x = problem.base.sample(VEHICLE_BATCH, np.random.default_rng(0))
        problem.evaluate(x[:1])
        ours.append(seconds(lambda problem=problem, x=x: problem.evaluate(x), repeat) / len(x))
        speed = float(x[0, 0])
        theirs.append(
            seconds(lambda n=vehicles, v=speed: reference.drive_road(reference.queue_road(n, v, GAP), TICKS), repeat)
        )
    return [
        {"simulator": f"torch, {VEHICLE_BATCH:,} at once", "vehicles": VEHICLES, "seconds": ours},
        {"simulator": "HighwayEnv", "vehicles": VEHICLES, "seconds": theirs},
    ]


def measure_methods(repeat: int) -> list[dict[str, Any]]:
    """Return seconds of a method's own for a half-space with p = 1e-3 in each dimension."""
    rows = []
    for name, method in METHODS.items():
        taken = []
        for dim in DIMENSIONS:
            problem = samplers.FunctionProblem(lambda x: 3.0902 - x.sum(axis=1) / np.sqrt(x.shape[1]), dim)
            samplers.estimate(problem, method, seed=0, max_sim=SIMULATIONS)
            taken.append(
                seconds(lambda p=problem, m=method: samplers.estimate(p, m, seed=1, max_sim=SIMULATIONS), repeat)
            )
        rows.append({"method": name, "dimensions": DIMENSIONS, "seconds": taken})
    return rows


def draw_figure(found: dict[str, Any], path: Path) -> None:
    """Draw three panels: batch, vehicles, dimension."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12.0, 3.8), layout="constrained")
    for number, row in enumerate(found["batches"]):
        style = "-" if row["core"] == "numba" else "--"
        label = f"{row['scenario']}, {row['core']}"
        left.plot(row["batches"], row["seconds"], "o" + style, color=f"C{number // len(CORES)}", ms=4, label=label)
    left.set(xscale="log", yscale="log", xlabel="rollouts in a call", ylabel="processor time of a rollout [s]")
    for row in found["vehicles"]:
        middle.plot(row["vehicles"], row["seconds"], "o-", ms=4, label=row["simulator"])
    middle.set(xscale="log", yscale="log", xlabel="vehicles", ylabel="processor time of a rollout [s]")
    middle.set_xticks(VEHICLES, labels=map(str, VEHICLES))
    middle.minorticks_off()
    for row in found["methods"]:
        right.plot(row["dimensions"], row["seconds"], "o-", ms=4, label=row["method"])
    right.set(
        xscale="log", yscale="log", xlabel="dimension of x", ylabel=f"own time of {SIMULATIONS:,} simulations [s]"
    )
    for axes in (left, middle, right):
        axes.legend(frameon=False, fontsize=7)
        axes.grid(alpha=0.3)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


@use_one_thread()
def main(
    out: Annotated[Path | None, typer.Option(help="Write the record here.")] = None,
    figure: Annotated[Path | None, typer.Option(help="Draw it here.")] = None,
    record: Annotated[Path | None, typer.Option("--from", help="Draw of this record, without measuring.")] = None,
    repeat: int = 3,
) -> None:
    """Measure, write and draw."""
    if record is None:
        found: dict[str, Any] = {
            "machine": about(),
            "batches": measure_batches(repeat),
            "vehicles": measure_vehicles(repeat),
            "methods": measure_methods(repeat),
        }
    else:
        found = json.loads(record.read_text())
    if out is not None:
        out.write_text(json.dumps(found, indent=2) + "\n")
    if figure is not None:
        draw_figure(found, figure)


if __name__ == "__main__":
    typer.run(main)
