"""A clip of six learned drivers on the highway, drawn by HighwayEnv's graphics.

    python examples/clip.py --out clip.gif                    # 20 s as a moving picture
    python examples/clip.py --still docs/images/highway.png   # one moment of it

Prints what happened: who left the road, the first crash, how fast they were.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from PIL import Image

import agents
import rare_envs
from rare_envs.envs.rendering import Renderer
from rare_envs.simulation import drive
from rare_envs.traffic import describe_crash


def main(
    out: Annotated[Path | None, typer.Option(help="GIF to write.")] = None,
    still: Annotated[Path | None, typer.Option(help="PNG to write.")] = None,
    at: Annotated[float, typer.Option(help="Moment of the PNG [s].")] = 5.0,
    seconds: Annotated[float, typer.Option(help="Length of the clip [s].")] = 20.0,
    drivers: Annotated[
        str, typer.Option(help="As for rare-envs estimate: mgail, mgail?rules=0, idm or a file, say.")
    ] = "mgail",
    ego: Annotated[str, typer.Option(help="An ego as for rare-envs estimate.")] = "mgail",
    env: Annotated[str, typer.Option(help="Environment.")] = "rare_envs/Highway-v0",
    seed: int = 0,
) -> None:
    """Drive one scenario drawn from the base distribution and draw it."""
    problem = rare_envs.DrivingProblem(env, ego=agents.load_ego(ego), drivers=drivers, horizon=seconds)
    x = torch.from_numpy(problem.base.sample(1, np.random.default_rng(seed))).float()
    road = problem.world.scenario.road
    renderer, frames, off = Renderer(problem.world), [], 0
    with torch.inference_mode():
        for tick, episode in enumerate(drive(problem.world.with_statistics(), problem.driver, x)):
            image = renderer.draw(episode, tick * problem.world.clock.dt)
            if out is not None:
                frames.append(Image.fromarray(image).quantize(64))
            if still is not None and tick == round(at / problem.world.clock.dt):
                Image.fromarray(image).save(still)
            off += int(road.off_road(episode.state.y).sum())
    if out is not None:
        frames[0].save(out, save_all=True, append_images=frames[1:], duration=100, loop=0)
    speed, crash = episode.state.speed[0], describe_crash(episode.statistics.crash)
    print(
        f"seed {seed}: {off} vehicle-steps off the road, {crash['kind'] if crash else 'no crash'}, "
        f"speeds after {seconds:g} s from {float(speed.min()):.1f} to {float(speed.max()):.1f} m/s"
    )


if __name__ == "__main__":
    typer.run(main)
