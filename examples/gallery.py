"""Draw every picture of the pages anew but for those of `examples/demo.py`, all in the same colours.

    python -m examples.gallery

Crashes in the scenarios and an adversary at work (docs/environments.md), the highway, and what a camera sees. The
crashes are what a search from wide draws of the base distribution finds with the default ego within seconds.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from PIL import Image

import rare_envs
from examples import adversary, camera, clip
from rare_envs.scenarios import SCENARIOS
from rare_envs.study import Drive, drive_again, write_film
from rare_envs.study.plots import save_gif

WIDE = 2.5
"""Draws are taken this many times as far from the mean, in standard normal space, to meet failures."""
CANDIDATES, IN_VIEW, LEAST_SECONDS = 40, 60.0, 2.0
"""Worst drives of which one is shown: with everybody in view at the start [m], of some length [s]."""
NARROW = 700
"""Width of the pictures [pixels]."""


def worst(env_id: str, draws: int, seed: int = 0) -> Drive:
    """The crash of some wide draws that is best to look at."""
    problem = rare_envs.DrivingProblem(env_id, noise="fixed")
    u = np.random.default_rng(seed).standard_normal((draws, problem.dim))
    sizes = problem.space.sizes
    own = sum(size for name, size in zip(problem.space.names, sizes, strict=True) if name != "weights")
    u[:, :own] *= WIDE
    x = problem.space.from_standard_normal(u)
    f = problem.evaluate(x)
    drives = [drive_again(problem, x[row]) for row in np.argsort(f, kind="stable")[:CANDIDATES]]
    return max(drives, key=rank)


def rank(drive: Drive) -> tuple[bool, float]:
    """Whether all is to be seen for a while, and how fast the two of the crash close."""
    ahead = float((drive.position[0, :, 0] - drive.position[0, 0, 0]).max())
    seen = ahead < IN_VIEW and float(drive.time[-1]) > LEAST_SECONDS
    return seen, 0.0 if drive.crash is None else float(drive.crash["closing_speed"])


def attack(steps: int, out: Path) -> str:
    """Train an adversary, draw one of its successes, and say how often it succeeds."""
    env_id, n = "rare_envs/CutIn-v0", 2000
    model = adversary.train(env_id, "cutter", steps)
    rates = [adversary.collisions(env_id, policies, n, seed=1) / n for policies in ({}, {"cutter": model})]
    env = rare_envs.parallel_env(env_id, agents=["cutter"], render_mode="rgb_array")
    for seed in range(50):
        observations, _ = env.reset(seed=seed)
        frames, hit = [env.render()], False
        while env.agents and not hit:
            action, _ = model.predict(observations["cutter"], deterministic=True)
            observations, *_, infos = env.step({"cutter": action})
            frames.append(env.render())
            hit = infos["cutter"]["collision"]
        if hit and len(frames) > 15:
            break
    size = NARROW, round(frames[0].shape[0] * NARROW / frames[0].shape[1])
    pictures = [Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS) for frame in frames]
    with out.open("wb") as file:
        save_gif(file, pictures, 1.0 / env.metadata["render_fps"])
    return f"the ego crashes in {rates[1]:.0%} of {n:,} scenarios instead of {rates[0]:.2%}"


def main(
    images: Annotated[Path, typer.Option(help="Folder of the pictures.")] = Path("docs/images"),
    draws: Annotated[int, typer.Option(help="Wide draws for each scripted scenario.")] = 20_000,
    steps: Annotated[int, typer.Option(help="Of the adversary's training; 0 leaves it out.")] = 200_000,
) -> None:
    """Draw everything and say what is to be seen."""
    torch.set_num_threads(1)
    images.mkdir(parents=True, exist_ok=True)
    for env_id, scenario in SCENARIOS.items():
        if scenario.drivers is not None or not env_id.endswith("-v0"):
            continue  # wide draws find no crash among learned drivers; versions of a scenario look alike
        drive = worst(env_id, draws)
        assert drive.crash is not None, env_id
        write_film(images / f"gallery_{scenario.name}.gif", drive, width=NARROW)
        print(f"{env_id}: {drive.crash['kind']}, {drive.crash['closing_speed']:.1f} m/s closing")
    camera.main(images)
    clip.main(still=images / "highway.png", at=3.0)
    if steps:
        print(f"An adversary: {attack(steps, images / 'gallery_adversary.gif')}")


if __name__ == "__main__":
    typer.run(main)
