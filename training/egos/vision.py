"""Training of the ego `vision`: imitation of a rule-based driver, with corrections where the network itself drives.

    python -m training.egos.vision --out runs/vision

Round 0 imitates the expert in its own drives. In each later round the network drives, mixed with the expert less and
less, the expert labels the pictures, and the network learns from those of all rounds: DAgger. An interrupted training
resumes after the last finished round, to the same weights.

References:
    Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
    learning", AISTATS 2011.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress
from torch import nn

from agents import Provenance
from agents.vision import PILOTNET_HIDDEN_UNITS, PilotNet, VisionEgo, save_vision
from rare_envs.files import replace_file
from rare_envs.threads import use_one_thread
from training.command_line import RunFolderOption, report_errors, run_command
from training.egos.expert_driver import AUXILIARY_SIZE
from training.egos.image_dataset import LabelledPictures, collect, concatenate, mirror
from training.egos.nominal_driving import judge_all_cases
from training.imitation.train import CHECKPOINT, check_folder, write_settings

FILE = "vision.safetensors"
JUDGE_SEED = 2026
"""Seed of the drives that evaluate the result, which no training uses."""


@dataclass(frozen=True)
class VisionConfig:
    """Settings of the training.

    Example:
        >>> VisionConfig(rounds=2).all_visits
        80000
        >>> VisionConfig(recorded_share=1.5)
        Traceback (most recent call last):
        ...
        ValueError: Expected recorded_share of at most 1, got 1.5.
    """

    seed: int = 0
    rounds: int = 5
    """Of DAgger, after the first imitation."""
    first_drives: int = 56
    """Situations in which the expert drives."""
    drives: int = 7
    """Situations of each later round."""
    rows: int = 24
    """Scenarios of a situation."""
    first_ticks: int = 100
    """Length of a scenario in which the expert drives."""
    ticks: int = 120
    """Length of the others."""
    first_recorded_share: float = 0.1
    """Share of the moments that are recorded."""
    recorded_share: float = 0.2
    """Likewise in later rounds."""
    noise: float = 1.0
    """See `training.egos.image_dataset.collect`."""
    mixing: float = 0.5
    """In round k the expert decides at a share `mixing`^k of the ticks."""
    first_visits: int = 40_000
    """Pictures that are learned from before the first round, with repetition."""
    visits: int = 20_000
    """Likewise after each round."""
    batch: int = 32
    rate: float = 1e-3
    """Of Adam, falling as a cosine to a hundredth."""
    truth_weight: float = 0.5
    """Of the second task, see `training.egos.expert_driver.auxiliary_targets`."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)  # a field by its name
            low = 0 if each.name in ("seed", "rounds", "noise", "mixing", "truth_weight") else None
            if not (value >= low if low is not None else value > 0) or not math.isfinite(value):
                raise ValueError(f"Expected {each.name} {'of at least 0' if low == 0 else 'above 0'}, got {value!r}.")
        for name in ("first_recorded_share", "recorded_share", "mixing"):
            if getattr(self, name) > 1:  # a field by its name
                raise ValueError(f"Expected {name} of at most 1, got {getattr(self, name)!r}.")

    @property
    def all_visits(self) -> int:
        """Pictures that are learned from in all."""
        return self.first_visits + self.rounds * self.visits


class Training:
    """State of a training: network, optimiser and recorded pictures; changed in place, and saved after each round."""

    def __init__(self, config: VisionConfig, out: Path) -> None:
        self.config, self.out = config, out
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = PilotNet()
            self.probe = nn.Linear(PILOTNET_HIDDEN_UNITS, AUXILIARY_SIZE)
        self.parameters = [*self.network.parameters(), *self.probe.parameters()]
        self.optimiser = torch.optim.Adam(self.parameters, config.rate)
        self.round = 0
        """Next round."""
        self.visited = 0
        self.recorded: list[LabelledPictures] = []

    def resume(self) -> None:
        """Resume a training that was interrupted in the folder."""
        path = self.out / CHECKPOINT
        if not path.is_file():
            return
        saved = torch.load(path, weights_only=True)
        self.network.load_state_dict(saved["network"])
        self.probe.load_state_dict(saved["probe"])
        self.optimiser.load_state_dict(saved["optimiser"])
        self.round, self.visited = saved["round"], saved["visited"]
        self.recorded = [
            LabelledPictures(*torch.load(self._recorded_path(k), weights_only=True)) for k in range(self.round)
        ]

    def do_round(self) -> Iterator[str]:
        """Collect pictures, train, and save; yield a progress line after each part of the work."""
        rng = np.random.default_rng((self.config.seed, self.round))
        parts = []
        for part in self._collect(rng):
            parts.append(part)
            yield f"round {self.round}: {sum(len(each.speed) for each in parts)} pictures taken"
        self.recorded.append(concatenate(parts))
        with replace_file(self._recorded_path(self.round)) as draft:
            torch.save(tuple(self.recorded[-1]), draft)
        yield from self._learn(rng)
        self.round += 1
        state = {
            "network": self.network.state_dict(),
            "probe": self.probe.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "round": self.round,
            "visited": self.visited,
        }
        with replace_file(self.out / CHECKPOINT) as draft:
            torch.save(state, draft)

    def _recorded_path(self, number: int) -> Path:
        """Return the file of the pictures of a round."""
        return self.out / f"pictures_{number}.pt"

    def _collect(self, rng: np.random.Generator) -> Iterator[LabelledPictures]:
        config, first = self.config, self.round == 0
        return collect(
            None if first else self.network,
            1.0 - config.mixing**self.round,
            drives=config.first_drives if first else config.drives,
            rows=config.rows,
            ticks=config.first_ticks if first else config.ticks,
            recorded_share=config.first_recorded_share if first else config.recorded_share,
            noise=config.noise if first else 0.0,
            rng=rng,
        )

    def _learn(self, rng: np.random.Generator) -> Iterator[str]:
        config, data = self.config, concatenate(self.recorded)
        left = config.visits if self.round else config.first_visits
        losses: list[list[float]] = []
        while left > 0:
            for group in self.optimiser.param_groups:
                group["lr"] = config.rate * (0.505 + 0.495 * math.cos(math.pi * self.visited / config.all_visits))
            size = min(config.batch, left)
            some = data.rows(torch.from_numpy(rng.integers(0, len(data.speed), size)))
            losses.append(self._step(mirror(some, torch.from_numpy(rng.random(size) < 0.5))))
            left, self.visited = left - size, self.visited + size
            if len(losses) % 20 == 0 or left <= 0:
                mean = np.mean(losses[-100:], axis=0)
                words = ", ".join(f"{name} {value:.4f}" for name, value in zip(LOSSES, mean, strict=True))
                yield f"round {self.round}: {words}"

    def _step(self, some: LabelledPictures) -> list[float]:
        hidden = self.network.hidden(some.picture, some.earlier, some.speed)
        error = nn.functional.smooth_l1_loss(self.network.out(hidden), some.expert, reduction="none", beta=0.5)
        truth = nn.functional.smooth_l1_loss(self.probe(hidden), some.truth)
        loss = error.mean() + self.config.truth_weight * truth
        self.optimiser.zero_grad()
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(self.parameters, 5.0)
        self.optimiser.step()
        return [*error.detach().mean(0).tolist(), truth.item()]


LOSSES = ("acceleration", "turn", "truths")


def train_vision_ego(config: VisionConfig, out: Path, progress: bool = False) -> PilotNet:
    """Train the ego, from the start or from an interrupted training in the folder.

    Args:
        config: Settings.
        out: Folder; it is made if there is none. It takes the pictures too, about 53 kB each.
        progress: Show a bar on standard error.

    Returns:
        The network.

    Raises:
        ValueError: The folder cannot be made, or holds a training with other settings.

    Example:
        >>> import tempfile
        >>> config = VisionConfig(
        ...     rounds=0, first_drives=1, rows=1, first_ticks=2, first_recorded_share=1.0, first_visits=2, batch=2
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     type(train_vision_ego(config, Path(folder))).__name__
        'PilotNet'
    """
    settings = json.dumps(asdict(config), indent=1)
    check_folder(out, settings)
    write_settings(out, settings)
    training = Training(config, out)
    training.resume()
    with Progress(console=Console(stderr=True), disable=not progress) as bar:
        task = bar.add_task("", total=config.all_visits, completed=training.visited)
        while training.round <= config.rounds:
            for words in training.do_round():
                bar.update(task, completed=training.visited, description=words)
    return training.network.eval().requires_grad_(False)


def make_provenance(config: VisionConfig, metrics: dict[str, Any]) -> Provenance:
    """Return the origin of a network, for the header of its file."""
    return Provenance(
        kind="imitation of a driver by rule with on-policy corrections (DAgger)",
        command=f"python -m training.egos.vision --out OUT --seed {config.seed} --rounds {config.rounds}",
        data="Pictures of this project's own simulations; nothing was recorded on a road.",
        data_licence="that of the project",
        metrics=metrics,
    )


@use_one_thread()
def main(
    out: RunFolderOption,
    seed: Annotated[int, typer.Option(help="Of everything that is random.")] = VisionConfig.seed,
    rounds: Annotated[int, typer.Option(help="Of corrections.")] = VisionConfig.rounds,
    judged: Annotated[int, typer.Option(help="Minutes of driving in each kind of ordinary traffic to judge it.")] = 0,
) -> None:
    """Train the ego `vision`, and write it to OUT/vision.safetensors."""
    with report_errors("vision"):
        config = VisionConfig(seed=seed, rounds=rounds)
        network = train_vision_ego(config, out, progress=True)
    metrics = judge_all_cases(VisionEgo(network), judged, JUDGE_SEED) if judged else {}
    print(f"Wrote {save_vision(network, make_provenance(config, metrics), out / FILE)}.")


if __name__ == "__main__":
    run_command(main)
