"""Commands `train-ego` and `train-drivers`: policies trained and saved."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rare_envs.study.cli.options import (
    JsonOption,
    NoiseChoice,
    SeedOption,
    TrustOption,
    WorldOptions,
    read_count,
    read_environment,
)
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, as_bad_input
from rare_envs.threads import use_one_thread
from training.command_line import DriverTrainingOptions, RecordingOptions, RunFolderOption, spread_options

if TYPE_CHECKING:
    from rare_envs.study.corpus.retraining import RetrainingPlan
    from training import Retraining


@spread_options
@use_one_thread()
def train_ego_command(
    options: WorldOptions,
    env: Annotated[
        str | None,
        typer.Argument(
            metavar="[ENV]",
            help="Environment, such as rare_envs/CutIn-v0; --from-failures tells it.",
            callback=read_environment,
        ),
    ] = None,
    algo: Annotated[
        str | None,
        typer.Option(
            help="Stable-Baselines3 algorithm; --from-failures tells it.",
            show_default="ppo",
        ),
    ] = None,
    steps: Annotated[
        int, typer.Option(help="Environment steps to train for.", parser=read_count, metavar="INTEGER")
    ] = 200_000,
    out: Annotated[Path, typer.Option(help="File to save the ego in.")] = Path("ego.zip"),
    seed: SeedOption = 0,
    num_envs: Annotated[int, typer.Option(help="Episodes that run side by side.")] = 256,
    device: Annotated[
        str,
        typer.Option(
            help="Where to simulate and to train: cpu, or a GPU (cuda, cuda:1).",
        ),
    ] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a training that was interrupted.")] = False,
    from_failures: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN",
            help="Train the ego of this run of rare-envs estimate on, with its failures among ordinary scenarios; "
            "repeated, the ego of the last run with the failures of all.",
        ),
    ] = None,
    failure_share: Annotated[
        float, typer.Option(help="Share of episodes that begin in a failure, with --from-failures.")
    ] = 0.25,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train an ego on the batched simulation and save it for `rare-envs estimate --ego`.

    A new one in ENV, or by --from-failures the ego of a run, in the world of that run.
    """
    from training import train_ego
    from training.ego_training import HYPERPARAMETERS

    if from_failures:
        plan = _read_plan(from_failures, failure_share, trust, env, algo, options)
        env, algo, world, retraining = plan.env_id, plan.algo, dict(plan.world), plan.retraining
        noise, next_seed = NoiseChoice.of(world["noise"]), plan.next_seed
    elif env is None:
        raise BadInput("Expected an environment, such as rare_envs/CutIn-v0, or --from-failures RUN; rare-envs list.")
    else:
        algo, noise, retraining, next_seed = algo or "ppo", options.noise, None, None
        asked = {"observation": options.observation or "features", "action": options.action or "continuous"}
        world = {**options.arguments(), **asked}
    place: dict[str, Any] = {} if device == "cpu" else {"device": device}
    with as_bad_input(ValueError, OSError):
        path = train_ego(
            env,
            algo=algo,
            steps=steps,
            out=out,
            seed=seed,
            num_envs=num_envs,
            resume=resume,
            retraining=retraining,
            **world,
            **place,
        )
    if as_json:
        answer = {"ego": str(path), "env_id": env, "algo": algo, "steps": steps, "seed": seed, **world}
        print_json(answer | ({} if retraining is None else _describe_retraining(retraining)))
        return
    if HYPERPARAMETERS[algo].discrete and options.action is None:
        world["action"] = "discrete"  # which is what the algorithm made of it
    seed_words = "" if next_seed is None else f" --seed {next_seed}"
    words = f"rare-envs estimate {env} --ego {shlex.quote(str(path))}{_estimate_options(world, noise)}{seed_words}"
    print(f"Saved {path}. Next: {words}")


def _read_plan(
    runs: list[Path], share: float, trust: bool, env: str | None, algo: str | None, options: WorldOptions
) -> RetrainingPlan:
    """Return how to train on with the failures of runs."""
    from rare_envs.study.corpus.retraining import plan_retraining

    if options != WorldOptions():
        raise BadInput("The world of --from-failures is that of the run: leave --base, --drivers and the like out.")
    with keep_stdout_for_the_answer():
        plan = plan_retraining(runs, share, trust)
    for name, given, own in (("ENV", env, plan.env_id), ("--algo", algo, plan.algo)):
        if given not in (None, own):
            raise BadInput(f"Expected {name} {own}, that of the run in {str(runs[-1])!r}, got {given!r}; leave it out.")
    return plan


def _describe_retraining(retraining: Retraining) -> dict[str, Any]:
    failures, share = len(retraining.failures), retraining.share
    return {"retrained": str(retraining.ego), "failures": failures, "failure_share": share}


def _estimate_options(world: dict[str, Any], noise: NoiseChoice) -> str:
    """Return the options with which `estimate` makes the world that an ego was trained in."""
    usual = {"noise": NoiseChoice.ON.value, "observation": "features", "action": "continuous", "collisions": "ego"}
    values = {**world, "noise": noise.value, "weather": None}
    told = {name: str(value) for name, value in values.items() if value not in (None, usual.get(name))}
    words = "".join(f" --{name} {shlex.quote(value)}" for name, value in told.items())
    return words + (" --weather" if world["weather"] else "")


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
        path = train_driver(Source(*recordings.kind_and_path()), config, out, progress=True, device=options.device)
    if as_json:
        print_json({"driver": str(path), "method": method, "seed": options.seed})
    else:
        print(f"Saved {path}. Load it with agents.load_driver({str(path)!r}).")
