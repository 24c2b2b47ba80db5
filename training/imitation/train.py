"""Train a driver from recorded traffic.

    python -m training.imitation.train --data FOLDER --method mgail --seed 0 --out runs/mgail
    python -m training.imitation.train --highd FOLDER --recording 01 --out runs/highd

Writes into the folder `driver.safetensors` (see `agents.load_driver`), `training.json` (source and settings) and a
checkpoint. The same command on the same folder takes up a training that was stopped, to the same weights.
"""

from __future__ import annotations

import sys
from dataclasses import fields
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from training.imitation.algorithms.config import Config
from training.imitation.datasets import Source
from training.imitation.run_folder import COLOURS, train_driver


class Method(str, Enum):
    """Ways to learn."""

    BC = "bc"
    GAIL = "gail"
    MGAIL = "mgail"


class Noise(str, Enum):
    """Colours of the drivers' noise."""

    HUMAN = "human"
    WHITE = "white"


D = Config()
Count = Annotated[int, typer.Option(min=1)]
Number = Annotated[float, typer.Option()]
Whole = Annotated[tuple[int, int], typer.Option(help="First and last value.")]
Ends = Annotated[tuple[float, float], typer.Option(help="First and last value.")]


def command(
    out: Annotated[Path, typer.Option(help="Folder; a training that was stopped in it is taken up.")],
    data: Annotated[Path | None, typer.Option(help="Folder with the compact tables of US 101.")] = None,
    ngsim: Annotated[Path | None, typer.Option(help="Or a raw NGSIM file, CSV or text.")] = None,
    highd: Annotated[Path | None, typer.Option(help="Or a folder with highD's files.")] = None,
    location: Annotated[str | None, typer.Option(help="Of an NGSIM file that has several.")] = None,
    recording: Annotated[list[str] | None, typer.Option(help="Of highD, such as 01; may be repeated.")] = None,
    seconds: Annotated[float, typer.Option(help="Length of the scenes of such files [s].")] = Source.seconds,
    log: Annotated[bool, typer.Option("--log", help="Write TensorBoard logs into the folder.")] = False,
    method: Annotated[Method, typer.Option(help="How to learn.")] = Method.MGAIL,
    seed: Annotated[int, typer.Option(help="The same seed gives the same weights.")] = D.seed,
    updates: Annotated[int, typer.Option(min=1, help="After behaviour cloning.")] = D.updates,
    noise: Annotated[Noise, typer.Option(help="Coloured as people's, or white.")] = Noise.HUMAN,
    epochs: Annotated[int, typer.Option(min=0, help="Of behaviour cloning.")] = D.epochs,
    batch: Count = D.batch,
    clone_rate: Number = D.clone_rate,
    weight_decay: Number = D.weight_decay,
    log_std_cap: Number = D.log_std_cap,
    lateral_weight: Count = D.lateral_weight,
    pools: Count = D.pools,
    scenes: Count = D.scenes,
    horizon: Whole = D.horizon,
    age: Whole = D.age,
    drivers: Whole = D.drivers,
    critic_weight: Number = D.critic_weight,
    clone_weight: Ends = D.clone_weight,
    anneal: Number = D.anneal,
    collision_weight: Number = D.collision_weight,
    edge_weight: Number = D.edge_weight,
    brake_weight: Number = D.brake_weight,
    headway_weight: Number = D.headway_weight,
    lane_weight: Number = D.lane_weight,
    speed_weight: Number = D.speed_weight,
    policy_rate: Number = D.policy_rate,
    critic_rate: Number = D.critic_rate,
    last_rate: Number = D.last_rate,
    critic_steps: Count = D.critic_steps,
    critic_batch: Count = D.critic_batch,
    memory: Count = D.memory,
    warm_up: Annotated[int, typer.Option(min=0, help="Rounds of the critic alone.")] = D.warm_up,
    gradient_penalty: Number = D.gradient_penalty,
    credit: Number = D.credit,
    learned_model: Annotated[bool, typer.Option(help="MGAIL: gradient of a learned model.")] = D.learned_model,
    model_rate: Number = D.model_rate,
    model_steps: Count = D.model_steps,
    discount: Number = D.discount,
    gae: Number = D.gae,
    clip: Number = D.clip,
    ppo_epochs: Count = D.ppo_epochs,
    ppo_batch: Count = D.ppo_batch,
    value_rate: Number = D.value_rate,
) -> None:
    """Train a driver from recorded traffic. training/imitation/algorithms/config.py says what the settings mean."""
    words: dict[str, Any] = dict(locals())
    words |= {"method": method.value, "colour": COLOURS[noise.value]}
    torch.set_num_threads(1)  # at these sizes more threads cost more than they give
    try:
        source = source_of(data, ngsim, highd, location, recording, seconds)
        config = Config(**{option.name: words[option.name] for option in fields(Config)})
        path = train_driver(source, config, out, log=log, progress=True)
    except ValueError as error:
        print(f"train: {error}", file=sys.stderr)
        raise typer.Exit(2) from None
    print(f"Saved {path}. Next: agents.load_driver({str(path)!r})")


def source_of(
    data: Path | None,
    ngsim: Path | None,
    highd: Path | None,
    location: str | None = None,
    recording: list[str] | None = None,
    seconds: float = Source.seconds,
) -> Source:
    """The one source that is named.

    Raises:
        ValueError: If none is, or several are.
    """
    named = [(kind, path) for kind, path in (("data", data), ("ngsim", ngsim), ("highd", highd)) if path is not None]
    if len(named) != 1:
        raise ValueError("Expected one of --data FOLDER, --ngsim FILE and --highd FOLDER.")
    return Source(*named[0], location, tuple(recording or ()), seconds)


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(command)
    app()
