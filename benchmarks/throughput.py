"""How fast is it? Ratios within one run on one core against HighwayEnv's objects doing the same.

    python -m benchmarks.throughput [--out result.json]

Rates are work divided by process time, the two sides of a ratio in turn. Exits with 1 if a floor is missed.
"""

import json
import os
import resource
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
from benchmarks import highway_env_reference as reference

CAR_FOLLOWING, CUT_IN = rare_envs.ENV_IDS
HORIZON = 20.0
"""Episodes of 200 ticks, as in the published baselines."""
TICKS = 200
ROADS = {CAR_FOLLOWING: reference.car_following, CUT_IN: reference.cut_in}
FLOORS = {
    "car_following_idm": 800.0,
    "cut_in_idm": 700.0,
    "car_following_ppo": 300.0,
    "env_step": 5.0,
    "adss_latency": 10.0,
}


def seconds(work: Callable[[], object], repeat: int = 1) -> float:
    """Process time [s] of one call, the least of several."""
    best = float("inf")
    for _ in range(repeat):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def ppo(env_id: str) -> Any:
    """An untrained SB3 PPO policy of the default size; its speed does not depend on its weights."""
    from stable_baselines3 import PPO

    return PPO("MlpPolicy", gym.make(env_id), device="cpu", seed=0)


def rollout_ratio(env_id: str, rounds: int, reference_rollouts: int = 10) -> dict[str, float]:
    """Rollouts with the IDM ego, 16384 at a time, against HighwayEnv's."""
    problem = rare_envs.DrivingProblem(env_id, horizon=HORIZON)
    x = problem.base.sample(16_384, np.random.default_rng(0))
    problem.evaluate(x[:100])
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(len(x) / seconds(lambda: problem.evaluate(x)))
        some = x[:reference_rollouts]
        theirs.append(
            len(some) / seconds(lambda some=some: [reference.drive(ROADS[env_id](row), TICKS) for row in some])
        )
    return _rates(ours, theirs)


def policy_ratio(rounds: int) -> dict[str, float]:
    """Car-following with an SB3 PPO ego, 4096 rollouts at a time, against `predict` in HighwayEnv's loop."""
    model = ppo(CAR_FOLLOWING)
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model, horizon=HORIZON)
    x = problem.base.sample(4_096, np.random.default_rng(0))
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(len(x) / seconds(lambda: problem.evaluate(x)))
        theirs.append(3 / seconds(lambda: [_drive_by_policy(model, row) for row in x[:3]]))
    return _rates(ours, theirs)


def _drive_by_policy(model: Any, x: np.ndarray[Any, Any]) -> None:
    """HighwayEnv's vehicles, a plain one driven by the policy on the same observation."""
    from highway_env.vehicle.kinematics import Vehicle

    road = reference.car_following(x)
    ego = Vehicle(road, [0.0, 0.0], 0.0, x[0])
    road.vehicles[0] = ego
    lead = road.vehicles[1]
    for _ in range(TICKS):
        (x_ego, y_ego), (x_lead, y_lead) = ego.position, lead.position
        relative_speed = lead.speed * np.cos(lead.heading) - ego.speed * np.cos(ego.heading)
        features = [ego.speed / 30, y_ego / 4, ego.heading / 0.1, (x_lead - x_ego - 5) / 50, relative_speed / 10]
        features += [(y_lead - y_ego) / 4, lead.speed * np.sin(lead.heading) / 2]
        action, _ = model.predict(np.clip(np.array(features, np.float32), -5, 5), deterministic=True)
        road.act()
        ego.act({"acceleration": 5.0 * float(action[0]), "steering": 0.1 * float(action[1])})
        road.step(0.1)


def step_ratio(steps: int) -> dict[str, float]:
    """One `env.step` of `gym.make` against HighwayEnv's with two vehicles and the same frequencies."""
    import highway_env  # noqa: F401  (registers its ids)

    ours = gym.make(CAR_FOLLOWING)
    config = {
        "vehicles_count": 1,
        "simulation_frequency": 10,
        "policy_frequency": 10,
        "duration": 1e9,
        "action": {"type": "ContinuousAction"},
    }
    theirs = gym.make("highway-v0", config=config, disable_env_checker=True)

    def drive(env: Any, action: Any) -> None:
        env.reset(seed=0)
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    still = np.zeros(2, np.float32)
    pairs = [
        (steps / seconds(lambda: drive(ours, still)), steps / seconds(lambda: drive(theirs, still))) for _ in range(3)
    ]
    return _rates([a for a, _ in pairs], [b for _, b in pairs])


def latency_ratio() -> dict[str, float]:
    """One subset simulation of the cut-in with the IDM ego against as many rollouts of HighwayEnv's objects."""
    problem = rare_envs.DrivingProblem(CUT_IN)
    samplers.estimate(problem, samplers.AdaptiveSubsetSimulation(), seed=1)
    start = time.process_time()
    result = samplers.estimate(problem, samplers.AdaptiveSubsetSimulation(), seed=0)
    ours = time.process_time() - start
    x = problem.base.sample(20, np.random.default_rng(0))
    theirs = seconds(lambda: [reference.drive(reference.cut_in(row), problem.world.ticks) for row in x]) / len(x)
    return {
        "seconds": ours,
        "n_sim": result.n_sim,
        "reference_seconds": theirs * result.n_sim,
        "ratio": theirs * result.n_sim / ours,
    }


def memory(rollouts: int = 1_000_000) -> dict[str, float]:
    """Peak memory of this process after a million cut-in rollouts in one call."""
    problem = rare_envs.DrivingProblem(CUT_IN)
    x = problem.base.sample(rollouts, np.random.default_rng(0))
    elapsed = seconds(lambda: problem.evaluate(x))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"rollouts": rollouts, "seconds": elapsed, "peak_gib": peak}


def _rates(ours: list[float], theirs: list[float]) -> dict[str, float]:
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
    return {
        "per_second": float(np.median(ours)),
        "reference_per_second": float(np.median(theirs)),
        "ratio": float(np.median(ratios)),
        "ratio_min": min(ratios),
        "ratio_max": max(ratios),
    }


def main(
    rounds: int = 5,
    out: Annotated[Path | None, typer.Option(help="Write the result here as JSON.")] = None,
    with_memory: Annotated[bool, typer.Option(help="Also run a million rollouts.")] = True,
) -> None:
    """Measure everything, print a table, and fail if a floor is missed."""
    torch.set_num_threads(1)
    results: dict[str, dict[str, float]] = {
        "car_following_idm": rollout_ratio(CAR_FOLLOWING, rounds),
        "cut_in_idm": rollout_ratio(CUT_IN, rounds),
        "car_following_ppo": policy_ratio(rounds),
        "env_step": step_ratio(500),
        "adss_latency": latency_ratio(),
    }
    for name, row in results.items():
        print(f"{name:20s} {row['ratio']:8.0f} times HighwayEnv (floor {FLOORS[name]:.0f})")
    if with_memory:
        results["memory"] = memory()
        print(f"{'memory':20s} {results['memory']['peak_gib']:8.2f} GiB (limit 2)")
    if out is not None:
        machine = {"cpus": os.cpu_count(), "torch": torch.__version__}
        out.write_text(json.dumps({"machine": machine, "results": results}, indent=2) + "\n")
    missed = [name for name, floor in FLOORS.items() if results[name]["ratio"] < floor]
    if missed or (with_memory and results["memory"]["peak_gib"] > 2.0):
        print(f"Missed: {', '.join(missed) or 'memory'}")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
