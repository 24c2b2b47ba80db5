"""The main job, end to end: train a PPO ego, then ask how often it crashes, how, and what that is per million km.

python examples/demo.py [--steps 1000000] [--out runs/demo]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import rare_envs
from rare_envs.scenarios.registry import env_id_of
from rare_envs.study import drive_again, write_film
from rare_envs.study.replay import find_failure
from rare_envs.study.risk import SCENARIO_SET, risk
from rare_envs.study.text import print_report
from training import train_ego

ENV_ID = "rare_envs/CutIn-v1"


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
    """Train an ego, estimate its collision probabilities, write numbers and pictures, and say what to do next.

    Args:
        steps: Environment steps of training.
        out: Folder for everything that is written.
    """
    torch.set_num_threads(1)  # batches this small are slower on more
    environments = tuple(map(env_id_of, SCENARIO_SET))
    print(f"1. Training a PPO ego in {' and '.join(environments)} for {steps:,} steps.", flush=True)
    ego = train_ego(environments, algo="ppo", steps=steps, seed=0, out=out / "ego.zip", force=True)

    print("2. Estimating how often it collides: find failures, then estimate from draws made for them.", flush=True)
    found = risk(str(ego), out=out, seed=0, trust=True, progress=True, force=True)  # it has just been written

    print()
    cut_in = found.scenarios[0]
    print_report(cut_in.report, out / cut_in.name)
    random_rate = random_collision_rate()
    print(f"for comparison: a policy that acts at random collides in {random_rate:.0%} of 1,000 scenarios")
    print(f"\n{found}")
    film = out / "crash.gif"
    recorded = find_failure(out / cut_in.name, 0, trust=True)
    write_film(film, drive_again(recorded.problem, recorded.x))
    print(f"the most likely crash in a cut-in, as a film: {film}")
    print("\nNext, from the folder of this repository (the commands are in .venv/bin):")
    for words, why in (
        (f"estimate {ENV_ID} --ego {ego} --method mc --max-sim 1000000", "check the first number by plain Monte Carlo"),
        ("risk idm --out runs/idm", "the same question for the rule-based ego"),
        ("risk human --out runs/human", "and for a model of human drivers"),
        ("train-ego all --steps 2000000 --out better.zip", "train for longer, then ask again"),
    ):
        print(f"  rare-envs {words}\n      {why}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=Path("runs/demo"))
    arguments = parser.parse_args()
    demo(arguments.steps, arguments.out)
