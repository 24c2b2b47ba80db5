"""How much slower is an ego behind a socket than in the simulation's own process?

    OMP_NUM_THREADS=1 python -m benchmarks.simulation.remote_latency

The same PPO policy (two layers of 64) drives the same scenarios in process, over ZeroMQ in another process on this
machine, and as `process:`; repeats alternate, so that what else the machine does hits all alike.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO

import agents
import rare_envs
import training
from rare_envs.threads import use_one_thread

ENV = "rare_envs/CutIn-v0"


def saved_policy(folder: Path) -> Path:
    """Save an untrained policy; weights do not matter for speed."""
    path = folder / "ego.zip"
    PPO("MlpPolicy", training.sb3_vec_env(ENV, 2), n_steps=8, batch_size=16, seed=0, device="cpu").save(path)
    return path


@use_one_thread()
def measure_latency(batch: int, repeats: int) -> dict[str, Any]:
    """Return rollouts per second of each way, medians over the repeats, and the ratio of in-process to remote."""
    with tempfile.TemporaryDirectory() as folder:
        path = saved_policy(Path(folder))
        words = [
            sys.executable,
            "-m",
            "rare_envs.study.cli.app",
            "serve-ego",
            str(path),
            "--bind",
            "tcp://127.0.0.1:*",
        ]
        with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as server:
            assert server.stderr is not None
            address = server.stderr.readline().split(" at ")[1].split(";")[0]
            egos = {
                name: agents.load_ego(spec)
                for name, spec in {"in process": str(path), "tcp": address, "process:": f"process:{path}"}.items()
            }
            problems = {name: rare_envs.DrivingProblem(ENV, ego=ego) for name, ego in egos.items()}
            x = problems["tcp"].base.sample(batch, np.random.default_rng(0))
            f = {name: problem.evaluate(x) for name, problem in problems.items()}  # once to warm up
            seconds: dict[str, list[float]] = {name: [] for name in problems}
            for _ in range(repeats):
                for name, problem in problems.items():
                    begun = time.perf_counter()
                    problem.evaluate(x)
                    seconds[name].append(time.perf_counter() - begun)
            server.terminate()
    median = {name: float(np.median(times)) for name, times in seconds.items()}
    return {
        "batch": batch,
        "repeats": repeats,
        "rollouts_per_second": {name: batch / value for name, value in median.items()},
        "times_in_process": {name: value / median["in process"] for name, value in median.items()},
        "same_f": all(np.array_equal(values, f["in process"]) for values in f.values()),
    }


def main() -> None:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    print(json.dumps(measure_latency(arguments.batch, arguments.repeats), indent=2))


if __name__ == "__main__":
    main()
