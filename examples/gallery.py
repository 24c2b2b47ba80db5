"""Write docs/gallery.md: a failure in each scenario, an adversary at work, and what was drawn.

    python -m examples.gallery

The failures are what a search from wide draws of the base distribution finds with the default ego within seconds.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from PIL import Image

import rare_envs
from examples import adversary
from rare_envs.scenarios import SCENARIOS
from rare_envs.study import Drive, drive_again, write_film

COLOURS = 64
"""Colours of a picture in a GIF."""
WIDE = 2.5
"""Draws are taken this many times as far from the mean, in standard normal space, to meet failures."""
NARROW = 480
"""Width of the pictures [pixels]."""
HEAD = """# Gallery

What failures look like; every picture on this page was drawn by `python -m examples.gallery`. Green is the ego, blue
the lead, orange the cutter, grey other vehicles; who has crashed has a red outline, a vehicle that an agent drives a
purple one. Above the road are time, speed, gap and time to collision, below it the measure over time: of the moment
(grey) and of the episode so far (black). `rare-envs replay RUN --failure 0 --out clip.gif` draws the same for what
your run has found.

```python
import numpy as np

import rare_envs
from rare_envs.study import drive_again, write_film

problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", horizon=2.0)
drive = drive_again(problem, np.array([30.0, 24.0, 28.0, 1.7, 40.0, 3.9]))
write_film("clip.gif", drive, width=480)
print(drive.f, drive.crash["kind"], f"{drive.crash['closing_speed']:.2f} m/s")
```

```text
-1.0 side 1.33 m/s
```
"""


def worst(env_id: str, draws: int, seed: int = 0) -> Drive:
    """The drive with the least f of some wide draws."""
    problem = rare_envs.DrivingProblem(env_id, noise="fixed")
    u = np.random.default_rng(seed).standard_normal((draws, problem.dim))
    sizes = problem.space.sizes
    own = sum(size for name, size in zip(problem.space.names, sizes, strict=True) if name != "weights")
    u[:, :own] *= WIDE
    x = problem.space.from_standard_normal(u)
    f = problem.evaluate(x)
    drives = [drive_again(problem, x[row]) for row in np.argsort(f, kind="stable")[:20]]
    return max(drives, key=lambda drive: len(drive.episodes))  # of the worst, the one that takes longest


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
    pictures = [
        Image.fromarray(frame).resize(
            (NARROW, round(frame.shape[0] * NARROW / frame.shape[1])), Image.Resampling.LANCZOS
        )
        for frame in frames
        if frame is not None
    ]
    shown = [picture.quantize(COLOURS) for picture in pictures]
    durations = [100] * (len(shown) - 1) + [1000]
    shown[0].save(out, save_all=True, append_images=shown[1:], duration=durations, loop=0, optimize=True)
    return (
        f"The cutter learned to make the rule-based ego crash: in {rates[1]:.0%} of {n:,} scenarios instead of "
        f"{rates[0]:.2%}. That is [no probability](agents.md#an-adversary)."
    )


def main(
    docs: Annotated[Path, typer.Option(help="Folder of the page.")] = Path("docs"),
    draws: Annotated[int, typer.Option(help="Wide draws for each scripted scenario.")] = 20_000,
    steps: Annotated[int, typer.Option(help="Of the adversary's training; 0 leaves it out.")] = 200_000,
) -> None:
    """Draw everything and write the page."""
    torch.set_num_threads(1)
    images = docs / "images"
    images.mkdir(parents=True, exist_ok=True)
    parts = [HEAD]
    for env_id, scenario in SCENARIOS.items():
        if not env_id.endswith("-v0"):
            continue  # versions of a scenario look alike
        drive = worst(env_id, draws if scenario.drivers is None else draws // 100)
        name = f"gallery_{scenario.name}.gif"
        write_film(images / name, drive, width=NARROW, every=2)
        crash = drive.crash
        what = (
            f"no crash, f = {drive.f:.2f} s"
            if crash is None
            else f"{crash['kind']}, {crash['closing_speed']:.1f} m/s closing"
        )
        parts.append(f"## {env_id}\n\n![{scenario.name}: {what}](images/{name})\n\n{what}\n")
        print(f"{env_id}: {what}")
    if steps:
        words = attack(steps, images / "gallery_adversary.gif")
        parts.append(
            f"## An adversary\n\n![The cutter crashes into the ego](images/gallery_adversary.gif)\n\n{words}\n"
        )
    (docs / "gallery.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
