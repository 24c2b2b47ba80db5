"""Command line of imitation training.

    python -m training.imitation.train --data FOLDER --method mgail --seed 0 --out runs/mgail
    python -m training.imitation.train --highd FOLDER --recording 01 --out runs/highd

Writes into the folder `driver.safetensors` (see `agents.load_driver`), `training.json` (source and settings) and a
checkpoint. The same command on the same folder takes up a training that was stopped, to the same weights.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import Enum
from typing import Annotated

import typer

from rare_envs.threads import use_one_thread
from training.command_line import (
    DriverTrainingOptions,
    LocationOption,
    RecordingOptions,
    RunFolderOption,
    report_errors,
    run_command,
    spread_options,
)
from training.imitation.algorithms.config import Config
from training.imitation.datasets import Source
from training.imitation.run_folder import NOISES, train_driver


class TrainingNoise(str, Enum):
    """Noises, as an option of the command line."""

    HUMAN = "human"
    WHITE = "white"


DEFAULTS = Config()
Count = Annotated[int, typer.Option(min=1)]
Number = Annotated[float, typer.Option()]
TickRange = Annotated[tuple[int, int], typer.Option(help="First and last value.")]
WeightRange = Annotated[tuple[float, float], typer.Option(help="First and last value.")]


@dataclass(frozen=True, kw_only=True)
class SourceOptions(RecordingOptions):
    """Options that name the source of recorded scenes."""

    location: LocationOption = None
    recording: Annotated[list[str] | None, typer.Option(help="Of highD, such as 01; may be repeated.")] = None
    seconds: Annotated[float, typer.Option(help="Length of the scenes of such files [s].")] = Source.seconds

    def source(self) -> Source:
        """Return the one source that is given.

        Raises:
            ValueError: None is given, or several are.
        """
        return Source(*self.kind_and_path(), self.location, tuple(self.recording or ()), self.seconds)


@dataclass(frozen=True, kw_only=True)
class ConfigOptions(DriverTrainingOptions):
    """Every setting of a training; training/imitation/algorithms/config.py says what they mean."""

    noise: Annotated[TrainingNoise, typer.Option(help="Coloured as people's, or white.")] = TrainingNoise.HUMAN
    epochs: Annotated[int, typer.Option(min=0, help="Of behaviour cloning.")] = DEFAULTS.epochs
    batch: Count = DEFAULTS.batch
    clone_rate: Number = DEFAULTS.clone_rate
    weight_decay: Number = DEFAULTS.weight_decay
    log_std_cap: Number = DEFAULTS.log_std_cap
    pools: Count = DEFAULTS.pools
    scenes: Count = DEFAULTS.scenes
    horizon: TickRange = DEFAULTS.horizon
    age: TickRange = DEFAULTS.age
    drivers: TickRange = DEFAULTS.drivers
    critic_weight: Number = DEFAULTS.critic_weight
    clone_weight: WeightRange = DEFAULTS.clone_weight
    anneal: Number = DEFAULTS.anneal
    collision_weight: Number = DEFAULTS.collision_weight
    edge_weight: Number = DEFAULTS.edge_weight
    brake_weight: Number = DEFAULTS.brake_weight
    headway_weight: Number = DEFAULTS.headway_weight
    lane_weight: Number = DEFAULTS.lane_weight
    speed_weight: Number = DEFAULTS.speed_weight
    policy_rate: Number = DEFAULTS.policy_rate
    critic_rate: Number = DEFAULTS.critic_rate
    last_rate: Number = DEFAULTS.last_rate
    critic_steps: Count = DEFAULTS.critic_steps
    critic_batch: Count = DEFAULTS.critic_batch
    memory: Count = DEFAULTS.memory
    warm_up: Annotated[int, typer.Option(min=0, help="Rounds of the critic alone.")] = DEFAULTS.warm_up
    gradient_penalty: Number = DEFAULTS.gradient_penalty
    credit: Number = DEFAULTS.credit
    discount: Number = DEFAULTS.discount
    gae: Number = DEFAULTS.gae
    clip: Number = DEFAULTS.clip
    ppo_epochs: Count = DEFAULTS.ppo_epochs
    ppo_batch: Count = DEFAULTS.ppo_batch
    value_rate: Number = DEFAULTS.value_rate

    def config(self) -> Config:
        """Return the settings.

        Raises:
            ValueError: A setting is outside its range.
        """
        # fields by name
        values = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in ("noise", "device")}
        return Config(**{**values, "method": self.method.value, "colour": NOISES[self.noise.value]})


@spread_options
@use_one_thread()
def main(
    out: RunFolderOption,
    recordings: SourceOptions,
    options: ConfigOptions,
    log: Annotated[bool, typer.Option("--log", help="Write TensorBoard logs into the folder.")] = False,
) -> None:
    """Train a driver from recorded traffic. training/imitation/algorithms/config.py says what the settings mean."""
    with report_errors("train"):
        path = train_driver(recordings.source(), options.config(), out, log=log, progress=True, device=options.device)
    print(f"Saved {path}. Next: agents.load_driver({str(path)!r})")


if __name__ == "__main__":
    run_command(main)
