"""How fast is a GPU? Rollouts, steps and estimates on it, beside one core of the processor of the same machine.

    python -m benchmarks.devices.gpu --out benchmarks/results/gpu.json

Rates are wall times, the least of some repetitions, with the scenarios copied to the GPU and f copied back: simulated
vehicles times ticks a second. Exits with 1 if a goal is missed.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import torch
import typer

import rare_envs
import samplers
from benchmarks import seconds
from benchmarks.samplers.runs import about
from benchmarks.simulation.throughput import CAR_FOLLOWING, CUT_IN, HIGHWAY, ppo
from rare_envs.devices import find_device
from rare_envs.simulation.world import rollout
from rare_envs.startup import use_one_thread

OUT = Path("build/gpu.json")
"""Where the result goes by default."""
GOALS = {"car_following": 1e7, "highway": 2e6}
"""Vehicle steps a second on an H100."""
QUESTIONS: dict[str, dict[str, Any]] = {
    "car_following": {"env_id": CAR_FOLLOWING},
    "cut_in": {"env_id": CUT_IN},
    "cut_in_ppo": {"env_id": CUT_IN, "ego": ppo},
    "cut_in_human": {"env_id": CUT_IN, "ego": "human"},
    "highway": {"env_id": HIGHWAY},
    "highway_lidar_ttc": {"env_id": HIGHWAY, "measure": "lidar_ttc", "ego": "imitation"},
    "highway_mgail": {"env_id": HIGHWAY, "drivers": "mgail"},
}
"""Problems by name."""
COMPILED = ("car_following", "cut_in", "highway")
"""Those that are compared with the compiled core as well."""
BATCHES = (25, 600, 6000, 100_000, 1_000_000)
HIGHWAY_BATCHES = (25, 256, 1024, 6000, 50_000)
CPU_BATCH, HIGHWAY_CPU_BATCH = 6000, 256
"""Rollouts that one core of the processor makes at once beside them."""
ENVIRONMENTS = (256, 4096)
"""Numbers of environments that are stepped side by side."""


def least_time(work: Callable[[], object], repeat: int = 3) -> float:
    """Return the least wall time of some calls [s]."""
    return seconds(work, repeat, time.perf_counter)


def make_problem(name: str, **where: Any) -> Any:
    """Return a problem of `QUESTIONS`, on a device or by a core."""
    given = dict(QUESTIONS[name])
    ego = given.pop("ego", "idm")
    return rare_envs.DrivingProblem(ego=ego(given["env_id"]) if callable(ego) else ego, **given, **where)


def measure_rollouts(name: str, batches: tuple[int, ...], device: str) -> dict[str, Any]:
    """Return rates by batch: as they are made, and by torch without a recording; and those of one core."""
    problem = make_problem(name, device=device)
    steps = problem.world.scenario.vehicles * problem.world.clock.ticks
    some = problem.base.sample(max(CPU_BATCH, 4096), np.random.default_rng(0))
    rows: dict[str, Any] = {}
    for batch in batches:
        x = np.tile(some, (-(-batch // len(some)), 1))[:batch]
        start = time.perf_counter()
        problem.evaluate(x)
        first = time.perf_counter() - start
        rows[str(batch)] = {
            "first_seconds": first,
            "seconds": (taken := least_time(lambda x=x: problem.evaluate(x))),
            "vehicle_steps": batch * steps / taken,
        }
    in_steps = _in_steps(problem, some[:1024], device)
    cores = {}
    for core in ("torch", "numba") if name in COMPILED else ("torch",):
        plain = make_problem(name, core=core)
        x = some[: HIGHWAY_CPU_BATCH if "highway" in name else CPU_BATCH]
        plain.evaluate(x[:25])
        cores[core] = len(x) * steps / least_time(lambda x=x, plain=plain: plain.evaluate(x), repeat=2)
    return {"batches": rows, "unrecorded_1024": 1024 * steps / in_steps, "one_core": cores}


def _in_steps(problem: Any, x: np.ndarray[Any, Any], device: str) -> float:
    """Return the time of rollouts whose operations are started one by one [s]."""
    rows = torch.from_numpy(x).float().to(device)

    @torch.inference_mode()
    def run() -> object:
        return rollout(problem.world, problem.driver, rows).f.cpu()

    run()
    return least_time(run, repeat=2)


def measure_steps(env_id: str, count: int, **where: Any) -> float:
    """Return the decisions a second of environments side by side."""
    env: Any = gym.make_vec(env_id, num_envs=count, vectorization_mode="vector_entry_point", **where)
    env.reset(seed=0)
    actions = np.zeros((count, 2), dtype=np.float32)
    env.step(actions)

    def run() -> None:
        for _ in range(20):
            env.step(actions)

    return 20 * count / least_time(run, repeat=2)


def measure_estimate(name: str, max_sim: int, **where: Any) -> dict[str, float]:
    """Return the wall time of a second estimate by two-stage [s], and what it found."""
    problem = make_problem(name, **where)
    samplers.estimate(problem, "two-stage", seed=1, max_sim=max_sim)
    start = time.perf_counter()
    found = samplers.estimate(problem, "two-stage", seed=1, max_sim=max_sim)
    return {"seconds": time.perf_counter() - start, "p": found.p, "cov": found.cov, "simulations": found.n_sim}


def run(device: str, keep: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """Measure everything.

    Args:
        device: The GPU.
        keep: Takes the result so far, after each part.
    """
    place, rollouts, steps, estimates = find_device(device), dict[str, Any](), dict[str, float](), dict[str, Any]()
    gpu = torch.cuda.get_device_name(place) if place.type == "cuda" else "none"
    result = {**about(), "gpu": gpu, "torch": torch.__version__}
    result |= {"rollouts": rollouts, "steps": steps, "estimates": estimates}
    for name in QUESTIONS:
        rollouts[name] = measure_rollouts(name, HIGHWAY_BATCHES if "highway" in name else BATCHES, device)
        best = max(row["vehicle_steps"] for row in rollouts[name]["batches"].values())
        print(f"{name:18} {best:.3g} vehicle steps a second at most", flush=True)
        keep(result)
    for where, given in (("gpu", {"device": device}), ("one core", {})):
        for env_id in (CUT_IN, HIGHWAY):
            for count in ENVIRONMENTS if env_id == CUT_IN or where == "gpu" else ENVIRONMENTS[:1]:
                steps[f"{env_id}, {count} environments, {where}"] = measure_steps(env_id, count, **given)
        keep(result)
        for name in ("cut_in", "cut_in_human"):
            estimates[f"{name}, {where}"] = measure_estimate(name, 6000, **given)
        keep(result)
    return result


def find_missed(result: dict[str, Any]) -> list[str]:
    """Return the goals that were missed, with what was reached.

    Example:
        >>> find_missed({"rollouts": {name: {"batches": {"9": {"vehicle_steps": 5e6}}} for name in GOALS}})
        ['car_following: 5e+06, goal 1e+07']
    """
    missed = []
    for name, goal in GOALS.items():
        best = max(row["vehicle_steps"] for row in result["rollouts"][name]["batches"].values())
        if best < goal:
            missed.append(f"{name}: {best:.3g}, goal {goal:.3g}")
    return missed


@use_one_thread()
def main(
    out: Annotated[Path, typer.Option(help="Where to write the result.")] = OUT,
    device: Annotated[str, typer.Option(help="The GPU.")] = "cuda",
) -> None:
    """Measure a GPU beside one core."""
    out.parent.mkdir(parents=True, exist_ok=True)

    def keep(result: dict[str, Any]) -> None:
        out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")

    result = run(device, keep)
    missed = find_missed(result)
    print("\n".join(missed) if missed else f"Every goal is reached; {out}")
    raise typer.Exit(1 if missed else 0)


if __name__ == "__main__":
    typer.run(main)
