"""Commands `train-ego` and `train-drivers`: policies trained and saved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rare_envs.study.cli.options import EnvArgument, JsonOption, NoiseChoice, SeedOption, WorldOptions
from rare_envs.study.cli.shell import print_json
from rare_envs.study.errors import as_bad_input
from rare_envs.threads import use_one_thread
from training.command_line import DriverTrainingOptions, RecordingOptions, RunFolderOption, spread_options


@spread_options
@use_one_thread()
def train_ego_command(
    env: EnvArgument,
    options: WorldOptions,
    algo: Annotated[str, typer.Option(help="Stable-Baselines3 algorithm.")] = "ppo",
    steps: Annotated[int, typer.Option(help="Environment steps to train for.")] = 200_000,
    out: Annotated[Path, typer.Option(help="File to save the ego in.")] = Path("ego.zip"),
    seed: SeedOption = 0,
    num_envs: Annotated[int, typer.Option(help="Episodes that run side by side.")] = 256,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a training that was interrupted.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Train an ego on the batched simulation and save it for `rare-envs estimate --ego`."""
    from training import train_ego
    from training.ego_training import HYPERPARAMETERS

    asked = {"observation": options.observation or "features", "action": options.action or "continuous"}
    world = {**options.arguments(), **asked}
    with as_bad_input(ValueError, OSError):
        path = train_ego(env, algo=algo, steps=steps, out=out, seed=seed, num_envs=num_envs, resume=resume, **world)
    if as_json:
        print_json({"ego": str(path), "env_id": env, "algo": algo, "steps": steps, "seed": seed, **world})
    else:
        if HYPERPARAMETERS[algo].discrete and options.action is None:
            world["action"] = "discrete"  # which is what the algorithm made of it
        print(f"Saved {path}. Next: rare-envs estimate {env} --ego {path}{_estimate_options(world, options.noise)}")


def _estimate_options(world: dict[str, Any], noise: NoiseChoice) -> str:
    """Return the options with which `estimate` makes the world that an ego was trained in."""
    usual = {"noise": NoiseChoice.ON.value, "observation": "features", "action": "continuous"}
    values = {**world, "noise": noise.value, "weather": None}
    words = [f" --{name} {value}" for name, value in values.items() if value not in (None, usual.get(name))]
    return "".join(words) + (" --weather" if world["weather"] else "")


@spread_options
@use_one_thread()
def train_drivers_command(
    out: RunFolderOption, recordings: RecordingOptions, options: DriverTrainingOptions, as_json: JsonOption = False
) -> None:
    """Train background drivers from recorded traffic; `python -m training.imitation.train` has every setting."""
    from training.imitation.algorithms.config import Config
    from training.imitation.datasets import Source
    from training.imitation.run_folder import train_driver

    method = options.method.value
    with as_bad_input(ValueError):
        config = Config(method, options.seed, options.updates)  # type: ignore[arg-type]  # the options are its methods
        path = train_driver(Source(*recordings.kind_and_path()), config, out, progress=True)
    if as_json:
        print_json({"driver": str(path), "method": method, "seed": options.seed})
    else:
        print(f"Saved {path}. Load it with agents.load_driver({str(path)!r}).")
