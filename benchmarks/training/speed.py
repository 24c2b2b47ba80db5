"""How much faster do egos train with the present settings than with those of before, and are they as good?

    python -m benchmarks.training.speed

Both train for 200,000 steps with each of 8 seeds, in turn; the egos drive the same 2,048 fresh episodes of each
scenario, and p is estimated in the cut-in. Speeds are by the time of the processor. Differences are of pairs with one
training seed, and their intervals Student's. Writes benchmarks/results/training_speed.json.
"""

from __future__ import annotations

import json
import os
import platform
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any
from unittest import mock

import gymnasium as gym
import numpy as np
import torch
import typer
from scipy import stats

import agents
import rare_envs
import samplers
from benchmarks import RESULTS
from rare_envs.files import replace_text
from rare_envs.startup import use_one_thread
from training import ego_training, train_ego
from training.ego_training import HYPERPARAMETERS, Hyperparameters

RESULT = RESULTS / "training_speed.json"
STEPS, EPISODES, FIRST_SEED = 200_000, 2_048, 100
CUT_IN, ALL = ("rare_envs/CutIn-v0",), ("rare_envs/CutIn-v1", "rare_envs/HardBrake-v0")
CASES = {"ppo": ("ppo", CUT_IN), "ppo all": ("ppo", ALL), "sac": ("sac", CUT_IN), "dqn": ("dqn", CUT_IN)}
"""Algorithms and where they train; "all" is what `train-ego all` trains in."""
_OFF_POLICY = {"gamma": 0.98, "batch_size": 1024, "train_freq": 1, "gradient_steps": 8, "learning_rate": 1e-3}
_ON_POLICY = {"gamma": 0.98, "gae_lambda": 0.95}
_PPO = {**_ON_POLICY, "n_steps": 32, "batch_size": 2048, "n_epochs": 10, "learning_rate": 1e-3}
_DQN = {"exploration_fraction": 0.3, "exploration_final_eps": 0.02, "target_update_interval": 4096}
OLD: Mapping[str, Hyperparameters] = MappingProxyType(
    {
        "ppo": Hyperparameters(_PPO, {"net_arch": {"pi": [32, 32], "vf": [64, 64]}, "log_std_init": -1.5}),
        "sac": Hyperparameters(_OFF_POLICY, {"net_arch": [64, 64]}),
        "dqn": Hyperparameters({**_OFF_POLICY, **_DQN}, {"net_arch": [64, 64]}, discrete=True),
    }
)
"""Settings of before."""
SETTINGS = {"old": OLD, "new": HYPERPARAMETERS}


@dataclass(frozen=True)
class Trained:
    """A training and its ego."""

    case: str
    settings: str
    seed: int
    cpu_seconds: float
    wall_seconds: float | None
    returns: tuple[float, ...]
    """Mean return of deterministic driving in each scenario trained in."""
    p: float
    """In CutIn-v0 under its default base."""
    p_error: float
    """Standard error of the natural logarithm of p, as the estimate states it."""


def mean_return(ego: Any, env_id: str) -> float:
    """Return the mean return of the first episodes of a batch with seed 123, driven without exploration."""
    env = gym.make_vec(env_id, EPISODES, action="discrete" if ego.algorithm == "dqn" else "continuous")
    total, running = np.zeros(EPISODES), np.ones(EPISODES, dtype=bool)
    observation, _ = env.reset(seed=123)
    while running.any():
        observation, reward, terminated, truncated, _ = env.step(ego.predict(observation, deterministic=True)[0])
        total += np.where(running, reward, 0.0)
        running &= ~(terminated | truncated)
    return float(total.mean())


def train(case: str, settings: str, seed: int, folder: Path) -> tuple[Path, float, float]:
    """Train an ego in a new folder; return its file, and seconds of the processor and of the clock."""
    algo, ids = CASES[case]
    with mock.patch.object(ego_training, "HYPERPARAMETERS", SETTINGS[settings]):
        cpu, wall = time.process_time(), time.perf_counter()
        path = train_ego(ids, algo, STEPS, seed, out=folder / "ego.zip", progress=False)
        return path, time.process_time() - cpu, time.perf_counter() - wall


def train_and_judge(case: str, settings: str, seed: int) -> Trained:
    """Train an ego, drive it and estimate how often it collides."""
    with tempfile.TemporaryDirectory() as folder:
        path, cpu, wall = train(case, settings, seed, Path(folder))
        ego: Any = agents.load_ego(path)
    found = samplers.estimate(rare_envs.DrivingProblem(CUT_IN[0], ego=ego), samplers.TwoStage(), seed=0)
    returns = tuple(mean_return(ego, each) for each in CASES[case][1])
    return Trained(case, settings, seed, cpu, wall, returns, found.p, found.cov)


def differ(pairs: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Return the mean of new minus old over pairs, and its 95 % interval."""
    differences = np.subtract(*np.transpose(pairs)[::-1])
    half = stats.t.ppf(0.975, len(pairs) - 1) * differences.std(ddof=1) / len(pairs) ** 0.5
    middle = differences.mean()
    return float(middle), float(middle - half), float(middle + half)


def geometric(pairs: Sequence[tuple[float, float]]) -> list[float]:
    """Return the geometric mean of new over old, and its 95 % interval."""
    return [float(each) for each in np.exp(differ(np.log(pairs).tolist()))]


def compare(record: Mapping[str, Any], case: str) -> dict[str, Any]:
    """Return what a record says of a case: speeds, and how good the egos are."""
    rows = {(one["settings"], one["seed"]): one for one in record["trained"] if one["case"] == case}
    seeds = sorted(seed for which, seed in rows if which == "new" and ("old", seed) in rows)
    pairs = [(rows["old", seed], rows["new", seed]) for seed in seeds]
    found: dict[str, Any] = {"seeds": len(pairs)}
    if len(pairs) > 1:
        spent = [tuple(one["cpu_seconds"] for one in pair) for pair in pairs]
        found |= {f"steps per cpu second, {w}": STEPS / float(np.mean(spent, 0)[i]) for i, w in enumerate(SETTINGS)}
        found["times as fast"] = geometric([(new, old) for old, new in spent])
        returns = [tuple(float(np.mean(one["returns"])) for one in pair) for pair in pairs]
        found |= {f"return, {which}": float(np.mean([pair[i] for pair in returns])) for i, which in enumerate(SETTINGS)}
        found["return, new minus old"] = differ(returns)
        p = [(old["p"], new["p"]) for old, new in pairs]
        found |= {f"p, {which}": float(np.exp(np.log(p).mean(0)[i])) for i, which in enumerate(SETTINGS)}
        found["p, new over old"] = geometric(p)
    return found


def read(out: Path) -> dict[str, Any]:
    """Return what has been measured so far."""
    known = json.loads(out.read_text()) if out.exists() else {}
    return {"trained": known.get("trained", [])}


def write(out: Path, measured: Mapping[str, Any]) -> None:
    """Write what has been measured, and what it says."""
    about = {
        "command": "python -m benchmarks.training.speed",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, one thread; load {os.getloadavg()[0]:.0f}",
        "versions": {"rare_envs": rare_envs.__version__, "torch": torch.__version__},
        "settings": {"steps": STEPS, "episodes": EPISODES, "estimate": "TwoStage(), seed 0"},
        "comparisons": {case: compare(measured, case) for case in CASES},
    }
    replace_text(out, json.dumps(about | dict(measured), indent=1) + "\n")


@use_one_thread()
def main(
    seeds: Annotated[int, typer.Option(help="Trainings with each of the settings.")] = 8,
    case: Annotated[list[str] | None, typer.Option(help=f"Cases to measure: {', '.join(CASES)}.")] = None,
    settings: Annotated[list[str] | None, typer.Option(help="Settings to train with: old, new.")] = None,
    out: Annotated[Path, typer.Option(help="The record; what it has is not measured again.")] = RESULT,
) -> None:
    """Measure what is not measured yet, and print what it says."""
    with tempfile.TemporaryDirectory() as folder:  # compiles
        train_ego(CASES["ppo all"][1], "ppo", 64, out=Path(folder) / "ego.zip", num_envs=2, progress=False)
    for name in case or CASES:
        measured = read(out)
        done = {(one["settings"], one["seed"]) for one in measured["trained"] if one["case"] == name}
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            for which in settings or SETTINGS:
                if (which, seed) not in done:
                    measured["trained"].append(asdict(train_and_judge(name, which, seed)))
                    write(out, measured)
    print(json.dumps(json.loads(out.read_text())["comparisons"], indent=1))


if __name__ == "__main__":
    typer.run(main)
