"""How fast is it? Ratios within one run on one core against HighwayEnv's objects doing the same.

    python -m benchmarks.simulation.throughput [--out result.json]

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
from benchmarks.simulation import highway_env_reference as reference
from rare_envs.simulation.rollout import rollout
from rare_envs.threads import use_one_thread

CAR_FOLLOWING, CUT_IN, HIGHWAY = (f"rare_envs/{name}-v0" for name in ("CarFollowing", "CutIn", "Highway"))
HORIZON = 20.0
"""Episodes of 200 ticks, as in the published baselines."""
TICKS = 200
ROADS = {CAR_FOLLOWING: reference.car_following_road, CUT_IN: reference.cut_in_road}
FLOORS = {
    "car_following_idm": 800.0,
    "cut_in_idm": 700.0,
    "car_following_ppo": 300.0,
    "env_step": 5.0,
    "adss_latency": 10.0,
    "highway_1": 1.0,
    "highway_64": 30.0,
    "highway_256": 100.0,
    "highway_512": 100.0,
    "highway_1024": 100.0,
}
"""Least ratios to HighwayEnv."""
REAL_TIME = {1: 60.0, 64: 600.0, 256: 3000.0, 512: 3000.0, 1024: 3000.0}
"""Batch sizes of the highway and the least multiples of real time on one core."""
CAMERA_REAL_TIME = 15.0
"""Least multiple of real time on one core of 64 highways whose egos look at pictures of 66 x 200, ten a second."""
PAPERS_SLOW_DOWN = 15.0
"""Of simulations with a camera against those without, in O'Kelly et al. (2018), networks included."""
MEMORY_LIMIT = 2.0
"""Of a million cut-ins, and of 1,024 highways, in one call [GiB]."""


def seconds(work: Callable[[], object], repeat: int = 1) -> float:
    """Return the process time [s] of one call, the least of several."""
    best = float("inf")
    for _ in range(repeat):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def ppo(env_id: str) -> Any:
    """Return an untrained SB3 PPO policy of the default size; its speed does not depend on its weights."""
    from stable_baselines3 import PPO

    return PPO("MlpPolicy", gym.make(env_id), device="cpu", seed=0)


def rollout_ratio(env_id: str, rounds: int, reference_rollouts: int = 10) -> dict[str, float]:
    """Compare rollouts with the IDM ego, 16384 at a time, with HighwayEnv's."""
    problem = rare_envs.DrivingProblem(env_id, horizon=HORIZON)
    x = problem.base.sample(16_384, np.random.default_rng(0))
    problem.evaluate(x[:100])
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(len(x) / seconds(lambda: problem.evaluate(x)))
        some = x[:reference_rollouts]
        theirs.append(
            len(some) / seconds(lambda some=some: [reference.drive_road(ROADS[env_id](row), TICKS) for row in some])
        )
    return _compare_rates(ours, theirs)


def policy_ratio(rounds: int) -> dict[str, float]:
    """Compare car following with an SB3 PPO ego, 4096 rollouts at a time, with `predict` in HighwayEnv's loop."""
    model = ppo(CAR_FOLLOWING)
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model, horizon=HORIZON)
    x = problem.base.sample(4_096, np.random.default_rng(0))
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(len(x) / seconds(lambda: problem.evaluate(x)))
        theirs.append(3 / seconds(lambda: [_drive_by_policy(model, row) for row in x[:3]]))
    return _compare_rates(ours, theirs)


def _drive_by_policy(model: Any, x: np.ndarray[Any, Any]) -> None:
    """Drive HighwayEnv's vehicles, a plain one by the policy on the same observation."""
    from highway_env.vehicle.kinematics import Vehicle

    road = reference.car_following_road(x)
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
    """Compare one `env.step` of `gym.make` with HighwayEnv's with two vehicles and the same frequencies."""
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
    return _compare_rates([a for a, _ in pairs], [b for _, b in pairs])


def latency_ratio() -> dict[str, float]:
    """Compare one subset simulation of the cut-in with the IDM ego with as many rollouts of HighwayEnv's objects."""
    problem = rare_envs.DrivingProblem(CUT_IN)
    samplers.estimate(problem, samplers.AdaptiveSubsetSimulation(), seed=1)
    start = time.process_time()
    result = samplers.estimate(problem, samplers.AdaptiveSubsetSimulation(), seed=0)
    ours = time.process_time() - start
    x = problem.base.sample(20, np.random.default_rng(0))
    theirs = seconds(
        lambda: [reference.drive_road(reference.cut_in_road(row), problem.world.clock.ticks) for row in x]
    ) / len(x)
    return {
        "seconds": ours,
        "n_sim": result.n_sim,
        "reference_seconds": theirs * result.n_sim,
        "ratio": theirs * result.n_sim / ours,
    }


def measure_highway(batch: int, rounds: int) -> dict[str, float]:
    """Compare Highway-v0, the IDM ego and five learned drivers, with HighwayEnv's six IDM vehicles and lidar."""
    problem = rare_envs.DrivingProblem(HIGHWAY, measure="lidar_ttc")
    seconds_of_traffic = problem.world.clock.seconds
    x = problem.base.sample(batch, np.random.default_rng(0))
    problem.evaluate(x)
    repeat = 1 if batch > 64 else 3
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(batch * seconds_of_traffic / seconds(lambda: problem.evaluate(x), repeat))
        road = reference.highway_road(x[0])
        theirs.append(
            seconds_of_traffic / seconds(lambda road=road: reference.drive_looking(road, problem.world.clock.ticks))
        )
    return {**_compare_rates(ours, theirs), "batch": batch}


class Cruise:
    """An ego that looks and does nothing, so that the time of a drive is that of traffic and sensors."""

    def predict(self, observation: Any, state: Any = None, **_: Any) -> Any:
        """Neither accelerates nor steers."""
        return np.zeros((len(observation), 2)), state


def measure_camera(batch: int, rounds: int, weather: bool = False) -> dict[str, float]:
    """Compare a camera with lidar as the ego's sensor, in Highway-v0 with five learned drivers."""
    rates: dict[str, list[float]] = {}
    problems = {
        kind: rare_envs.DrivingProblem(HIGHWAY, ego=Cruise(), observation=kind, weather=weather)
        for kind in ("camera", "lidar")
    }
    for problem in problems.values():
        problem.evaluate(problem.base.sample(2, np.random.default_rng(0)))
    for _ in range(rounds):
        for kind, problem in problems.items():
            x = problem.base.sample(batch, np.random.default_rng(0))
            work = seconds(lambda problem=problem, x=x: problem.evaluate(x))  # type: ignore[misc]
            rates.setdefault(kind, []).append(batch * problem.world.clock.seconds / work)
    return {
        "per_second": float(np.median(rates["camera"])),
        "lidar_per_second": float(np.median(rates["lidar"])),
        "slow_down": float(np.median(np.divide(rates["lidar"], rates["camera"]))),
        "batch": batch,
    }


def highway_memory(rollouts: int = 1024) -> dict[str, float]:
    """Return the peak memory of this process after 1,024 rollouts of the highway in one batch."""
    problem = rare_envs.DrivingProblem(HIGHWAY, measure="lidar_ttc")
    x = torch.from_numpy(problem.base.sample(rollouts, np.random.default_rng(0))).float()
    with torch.inference_mode():
        elapsed = seconds(lambda: rollout(problem.world, problem.driver, x))
    return {"rollouts": rollouts, "seconds": elapsed, "peak_gib": _peak_gib()}


def _peak_gib() -> float:
    """Return the peak memory of this process [GiB]; `ru_maxrss` may be that of the process which started it."""
    status = Path("/proc/self/status")
    if not status.exists():  # not Linux
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    words = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(words.split()[1]) / 2**20


def memory(rollouts: int = 1_000_000) -> dict[str, float]:
    """Return the peak memory of this process after a million cut-in rollouts in one call."""
    problem = rare_envs.DrivingProblem(CUT_IN)
    x = problem.base.sample(rollouts, np.random.default_rng(0))
    elapsed = seconds(lambda: problem.evaluate(x))
    return {"rollouts": rollouts, "seconds": elapsed, "peak_gib": _peak_gib()}


def _compare_rates(ours: list[float], theirs: list[float]) -> dict[str, float]:
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
    return {
        "per_second": float(np.median(ours)),
        "reference_per_second": float(np.median(theirs)),
        "ratio": float(np.median(ratios)),
        "ratio_min": min(ratios),
        "ratio_max": max(ratios),
    }


@use_one_thread()
def main(
    rounds: int = 5,
    out: Annotated[Path | None, typer.Option(help="Write the result here as JSON.")] = None,
    with_memory: Annotated[bool, typer.Option(help="Also run a million rollouts.")] = True,
    only_highway: Annotated[bool, typer.Option(help="Leave the other scenarios out.")] = False,
    only_camera: Annotated[bool, typer.Option(help="The camera on the highway alone.")] = False,
) -> None:
    """Measure everything, print a table, and fail if a floor is missed."""
    results: dict[str, dict[str, float]] = {}
    if not only_camera:
        results = {"highway_memory": highway_memory()}  # first: a peak stays
        results |= {f"highway_{batch}": measure_highway(batch, rounds) for batch in REAL_TIME}
    results["camera_64"], results["camera_64_weather"] = (
        measure_camera(64, rounds),
        measure_camera(64, rounds, weather=True),
    )
    if not (only_highway or only_camera):
        results["car_following_idm"] = rollout_ratio(CAR_FOLLOWING, rounds)
        results["cut_in_idm"] = rollout_ratio(CUT_IN, rounds)
        results["car_following_ppo"] = policy_ratio(rounds)
        results["env_step"] = step_ratio(500)
        results["adss_latency"] = latency_ratio()
        if with_memory:
            results["memory"] = memory()
    missed = []
    for name, row in results.items():
        if "peak_gib" in row:
            print(f"{name:20s} {row['peak_gib']:8.2f} GiB (limit {MEMORY_LIMIT:g})")
            missed += [name] * (row["peak_gib"] > MEMORY_LIMIT)
            continue
        if "slow_down" in row:
            print(
                f"{name:20s} {row['per_second']:8.0f} times real time (floor {CAMERA_REAL_TIME:g}), "
                f"{row['slow_down']:.0f} times slower than lidar ({PAPERS_SLOW_DOWN:g} in O'Kelly et al.)"
            )
            missed += [name] * (row["per_second"] < CAMERA_REAL_TIME)
            continue
        floor = FLOORS.get(name, 0.0)
        line = f"{name:20s} {row['ratio']:8.0f} times HighwayEnv (floor {floor:g})"
        if "batch" in row:
            least = REAL_TIME[int(row["batch"])]
            line += f", {row['per_second']:,.0f} times real time (floor {least:g})"
            missed += [f"{name} in real time"] * (row["per_second"] < least)
        print(line)
        missed += [name] * (row["ratio"] < floor)
    if out is not None:
        machine = {"cpus": os.cpu_count(), "load": os.getloadavg(), "torch": torch.__version__}
        out.write_text(json.dumps({"machine": machine, "results": results}, indent=2) + "\n")
    if missed:
        print(f"Missed: {', '.join(missed)}")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
