"""The main job, end to end: train a small PPO ego, then ask how often it crashes and how.

python examples/demo.py [--steps 400000] [--out runs/demo]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import rare_envs
from rare_envs.study import Question, prepare, run, write_run
from rare_envs.study.text import print_report
from training import train_ego

ENV_ID = "rare_envs/CutIn-v0"


class RandomPolicy:
    """Acts uniformly at random."""

    def __init__(self, seed: int) -> None:
        """Seeded, so that the demo prints the same every time."""
        self.rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: NDArray[np.float32],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float64], Any]:
        """Stable-Baselines3's interface is all that an ego needs; a batch of observations comes in."""
        return self.rng.uniform(-1.0, 1.0, (len(observation), 2)), state


def random_collision_rate(n: int = 1_000, seed: int = 0) -> float:
    """Share of scenarios in which the random policy collides."""
    problem = rare_envs.DrivingProblem(ENV_ID, ego=RandomPolicy(seed))
    x = problem.base.sample(n, np.random.default_rng(seed))
    return float((problem.evaluate(x) <= 0.0).mean())


def demo(steps: int, out: Path) -> None:
    """Train an ego, estimate its collision probability, write numbers and picture, and say what to do next.

    Args:
        steps: Environment steps of training.
        out: Folder for everything that is written.
    """
    torch.set_num_threads(1)  # batches this small are slower on more
    print(f"1. Training a PPO ego in {ENV_ID} for {steps:,} steps.", flush=True)
    # torch's steps, so that the ego is the same with and without numba
    ego = train_ego(ENV_ID, algo="ppo", steps=steps, seed=0, out=out / "ego.zip", core="torch")

    print("2. Estimating how often it collides: find failures, then estimate from draws made for them.", flush=True)
    study = prepare(Question(env_id=ENV_ID, ego=str(ego), seed=0, trust=True))  # it has just been written
    report = run(study, progress=True)
    write_run(out, report)

    print()
    print_report(report, out)
    random_rate = random_collision_rate()
    print(f"for comparison: a policy that acts at random collides in {random_rate:.0%} of 1,000 scenarios")
    print("\nNext, from the folder of this repository (the commands are in .venv/bin):")
    for words, why in (
        (f"{ENV_ID} --ego {ego} --method mc --max-sim 1000000", "check the number by plain Monte Carlo"),
        (f"{ENV_ID} --out runs/idm", "the same question for the rule-based ego"),
        (f"{ENV_ID} --ego {ego} --base highway", "the same ego in free-flowing traffic"),
    ):
        print(f"  rare-envs estimate {words}\n      {why}")
    print(f"  rare-envs train-ego {ENV_ID} --steps 1000000 --out better.zip\n      train for longer, then ask again")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--out", type=Path, default=Path("runs/demo"))
    arguments = parser.parse_args()
    demo(arguments.steps, arguments.out)
