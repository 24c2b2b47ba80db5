"""How fast is it? Ratios within one run on one core against HighwayEnv's objects doing the same, and EnvPool's.

    python -m benchmarks.simulation.throughput [--out build/throughput.json]

Rates are work divided by process time, the two sides of a ratio in turn. Floors are ratios too, so that they hold on a
slow machine as on a fast one; exits with 1 if one is missed.
"""

import json
import resource
import shutil
import subprocess
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

import rare_envs
import samplers
from benchmarks import seconds
from benchmarks.samplers.runs import about
from benchmarks.simulation import envpool_pair
from benchmarks.simulation import highway_env_reference as reference
from rare_envs.simulation.world import rollout
from rare_envs.startup import use_one_thread

OUT = Path("build/throughput.json")
"""Where the result goes by default."""
LEAST_ESTIMATES = 5
"""Of which the median is judged: one in three is repeated under the pool of the refits."""
CAR_FOLLOWING, CUT_IN, HIGHWAY = (f"rare_envs/{name}-v0" for name in ("CarFollowing", "CutIn", "Highway"))
CUT_IN_V1 = "rare_envs/CutIn-v1"
HORIZON = 20.0
"""Episodes of 200 ticks, as in the published baselines."""
TICKS = 200
ROADS = {
    CAR_FOLLOWING: reference.car_following_road,
    CUT_IN: reference.cut_in_road,
    CUT_IN_V1: lambda row: reference.cut_in_road(row[:6]),  # as many vehicles, whose script is simpler
}
FLOORS = {
    "car_following_idm": 1000.0,
    "car_following_idm_compiled": 20000.0,
    "cut_in_idm": 1000.0,
    "cut_in_idm_compiled": 8000.0,
    "cut_in_v1_idm": 300.0,
    "cut_in_v1_idm_compiled": 2000.0,
    "car_following_ppo": 400.0,
    "car_following_ppo_compiled": 700.0,
    "env_step": 20.0,
    "vec_step": 1000.0,
    "vec_step_cut_in": 1000.0,
    "vec_step_cut_in_v1": 500.0,
    "envpool_step_decision": 0.1,
    "envpool_step_tick": 0.3,
    "envpool_policy_decision": 0.5,
    "envpool_policy_tick": 4.0,
    "highway_1": 1.0,
    "highway_64": 30.0,
    "highway_256": 150.0,
    "highway_512": 200.0,
    "highway_1024": 200.0,
}
"""Least ratios to HighwayEnv, or to EnvPool's C++ of it."""
CORES = {"torch": "", "numba": "_compiled"}
"""Cores, and endings of the names of their results."""
BATCHES = (1, 64, 256, 512, 1024)
"""Batch sizes of the highway."""
CEILINGS = {
    "camera_64": 40.0,
    "camera_64_weather": 45.0,
    "answer_car_following": 20.0,
    "answer_cut_in": 8.0,
    "memory": 2.0,
    "highway_memory": 2.0,
}
"""Largest ratios: of a camera's time to that of lidar (15 in O'Kelly et al., 2018, networks included), of an estimate's
to that of its simulations in one call of torch; and the memory of a million cut-ins, and of 1,024 highways [GiB]."""
ANSWER_SIMULATIONS = 6000
ANSWER_BASES = {CAR_FOLLOWING: "us101-gap", CUT_IN: "us101-15-offsets"}
"""Bases under which some of the simulations of an estimate fail."""


def ppo(env_id: str) -> Any:
    """Return an untrained SB3 PPO policy of the default size; its speed does not depend on its weights."""
    from stable_baselines3 import PPO

    return PPO("MlpPolicy", gym.make(env_id), device="cpu", seed=0)


def rollout_ratio(env_id: str, core: str, rounds: int, reference_rollouts: int = 10) -> dict[str, float]:
    """Compare rollouts with the IDM ego, 16384 at a time, with HighwayEnv's."""
    problem = rare_envs.DrivingProblem(env_id, horizon=HORIZON, core=core)
    x = problem.base.sample(16_384, np.random.default_rng(0))
    problem.evaluate(x[:1])  # compiles
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(len(x) / seconds(lambda: problem.evaluate(x)))
        some = x[:reference_rollouts]
        theirs.append(
            len(some) / seconds(lambda some=some: [reference.drive_road(ROADS[env_id](row), TICKS) for row in some])
        )
    return _compare_rates(ours, theirs)


def simulate_by_operators(problem: rare_envs.DrivingProblem, x: NDArray[np.float64]) -> Tensor:
    """Return f of scenarios x (n, d) as torch simulates them in one call."""
    with torch.inference_mode():
        return rollout(problem.world, problem.driver, torch.from_numpy(x).float()).f


def measure_answer(env_id: str, rounds: int) -> dict[str, float]:
    """Compare an estimate by the default method with its 6,000 simulations in one call of torch's operators."""
    base = ANSWER_BASES[env_id]
    problem = rare_envs.DrivingProblem(env_id, base=base)
    plain = rare_envs.DrivingProblem(env_id, base=base, core="torch")
    x = problem.base.sample(ANSWER_SIMULATIONS, np.random.default_rng(0))
    samplers.estimate(problem, seed=0, max_sim=ANSWER_SIMULATIONS)  # imports and compiles
    simulate_by_operators(plain, x)
    answers, calls = [], []
    for seed in range(max(rounds, LEAST_ESTIMATES)):
        answers.append(seconds(lambda seed=seed: samplers.estimate(problem, seed=seed, max_sim=ANSWER_SIMULATIONS)))
        calls.append(seconds(lambda: simulate_by_operators(plain, x), repeat=3))
    ratios = np.divide(answers, calls)
    return {
        "seconds": float(np.median(answers)),
        "call_seconds": float(np.median(calls)),
        "slow_down": float(np.median(ratios)),
        "slow_down_max": float(ratios.max()),
        "compiled": float(problem.core == "numba"),
    }


def policy_ratio(core: str, rounds: int) -> dict[str, float]:
    """Compare car following with an SB3 PPO ego, 4096 rollouts at a time, with `predict` in HighwayEnv's loop."""
    model = ppo(CAR_FOLLOWING)
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING, ego=model, horizon=HORIZON, core=core)
    x = problem.base.sample(4_096, np.random.default_rng(0))
    problem.evaluate(x[:1])  # compiles
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
        features += [5.0, 0.0, 0.0, 0.0]  # where a second vehicle would be: far ahead, as fast
        action, _ = model.predict(np.clip(np.array(features, np.float32), -5, 5), deterministic=True)
        road.act()
        ego.act({"acceleration": 5.0 * float(action[0]), "steering": 0.1 * float(action[1])})
        road.step(0.1)


def batch_step_ratio(env_id: str, steps: int, num_envs: int = 256) -> dict[str, float]:
    """Compare steps of `gym.make_vec`, with random actions and the episodes that these end, with HighwayEnv's."""
    batch, theirs = gym.make_vec(env_id, num_envs), highway_env_pair()
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (steps, num_envs, 2)).astype(np.float32)

    def drive_batch() -> None:
        batch.reset(seed=0)
        for action in actions:
            batch.step(action)

    drive_batch()  # compiles, and reads what new episodes are drawn from
    pairs = [
        (num_envs * steps / seconds(drive_batch), steps / seconds(lambda: _drive_env(theirs, steps))) for _ in range(3)
    ]
    return _compare_rates([a for a, _ in pairs], [b for _, b in pairs])


def highway_env_pair() -> Any:
    """Return HighwayEnv's environment with two vehicles and our frequencies."""
    import highway_env  # noqa: F401  (registers its ids)

    config = {
        "vehicles_count": 1,
        "simulation_frequency": 10,
        "policy_frequency": 10,
        "duration": 1e9,
        "action": {"type": "ContinuousAction"},
    }
    return gym.make("highway-v0", config=config, disable_env_checker=True)


def _drive_env(env: Any, steps: int) -> None:
    """Step an environment straight on, with new episodes where one ends."""
    env.reset(seed=0)
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
        if terminated or truncated:
            env.reset()


def step_ratio(steps: int) -> dict[str, float]:
    """Compare one `env.step` of `gym.make` with HighwayEnv's with two vehicles and the same frequencies."""
    ours, theirs = gym.make(CAR_FOLLOWING), highway_env_pair()
    pairs = [
        (steps / seconds(lambda: _drive_env(ours, steps)), steps / seconds(lambda: _drive_env(theirs, steps)))
        for _ in range(3)
    ]
    return _compare_rates([a for a, _ in pairs], [b for _, b in pairs])


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
    problem = rare_envs.DrivingProblem(HIGHWAY, measure="lidar_ttc", core="torch")
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
    out: Annotated[Path, typer.Option(help="Write the result here as JSON.")] = OUT,
    with_memory: Annotated[bool, typer.Option(help="Also run a million rollouts.")] = True,
    only_camera: Annotated[bool, typer.Option(help="The camera on the highway alone.")] = False,
    only_envpool: Annotated[bool, typer.Option(help="EnvPool's HighwayEnv alone.")] = False,
) -> None:
    """Measure everything, print a table, and fail if a floor is missed."""
    results: dict[str, dict[str, float]] = {}
    everything = not (only_camera or only_envpool)
    if everything:
        results = {"highway_memory": highway_memory()}  # first: a peak stays
        for batch in BATCHES:
            results[f"highway_{batch}"] = measure_highway(batch, rounds)
    if not only_envpool:
        results["camera_64"] = measure_camera(64, rounds)
        results["camera_64_weather"] = measure_camera(64, rounds, weather=True)
    if everything:
        for name, env_id in (("car_following", CAR_FOLLOWING), ("cut_in", CUT_IN), ("cut_in_v1", CUT_IN_V1)):
            for core, ending in CORES.items():
                results[f"{name}_idm{ending}"] = rollout_ratio(env_id, core, rounds)
            if env_id in ANSWER_BASES:
                results[f"answer_{name}"] = measure_answer(env_id, rounds)
        for core, ending in CORES.items():
            results[f"car_following_ppo{ending}"] = policy_ratio(core, rounds)
        results["env_step"] = step_ratio(500)
        results["vec_step"] = batch_step_ratio(CAR_FOLLOWING, 200)
        results["vec_step_cut_in"] = batch_step_ratio(CUT_IN, 200)
        results["vec_step_cut_in_v1"] = batch_step_ratio(CUT_IN_V1, 200)
        if with_memory:
            results["memory"] = memory()
    if envpool_pair.is_installed() and not only_camera:
        for name, rates in envpool_pair.measure_all(rounds).items():
            results[name] = _compare_rates(rates["ours"], rates["theirs"])
    elif not only_camera:
        print("EnvPool is not installed: no comparison with it.")
    missed = [name for name, row in results.items() if not judge(name, row)]
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps({"machine": describe_run(), "results": results}, indent=2) + "\n")
    print(f"Wrote {out}")
    if missed:
        print(f"Missed: {', '.join(missed)}")
        raise typer.Exit(1)


def describe_run() -> dict[str, Any]:
    """Return the machine, the versions and the commit; an empty one outside a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude", "*"]
    has_git = shutil.which("git") is not None
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() if has_git else ""
    return about(torch=torch.__version__, rare_envs=rare_envs.__version__, commit=commit)


def judge(name: str, row: dict[str, float]) -> bool:
    """Print a row of the table; return whether it keeps its floor or ceiling."""
    if "peak_gib" in row:
        value, limit, words = row["peak_gib"], CEILINGS[name], "GiB"
        kept = value <= limit
    elif "slow_down" in row:
        what = "the time of lidar" if name.startswith("camera") else "the time of one call of torch"
        value, limit, words = row["slow_down"], CEILINGS[name], f"times {what}"
        kept = value <= limit
    else:
        value, limit = row["ratio"], FLOORS[name]
        words = "times EnvPool" if name.startswith("envpool") else "times HighwayEnv"
        kept = value >= limit
    further = f", {row['per_second']:,.0f} times real time" if "batch" in row else ""
    print(f"{name:28s} {value:8.3g} {words} ({'floor' if name in FLOORS else 'ceiling'} {limit:g}){further}")
    return kept


if __name__ == "__main__":
    typer.run(main)
