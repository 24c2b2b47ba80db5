"""An ensemble of drivers around a trained one, and the distribution of their last layers.

    python -m training.imitation.ensemble runs/mgail --members 32 --out mgail.safetensors

A member continues the training of the base: from the base's weights, with the base's critic, optimisers and losses as
they were at its end, and with the trunk frozen. Members differ by chance alone: each draws its scenes from the base's
with repetition, both those that it drives in and those that its driving is compared with. Any other difference (new
critics, other weights of the losses) would move all members the same way, and their mean away from the base.

Scenes of one recording overlap in vehicles and time, and a run is short. So the spread says how far the last layer can
move without loss; it is no posterior. The metadata record how far a member moves within its run, how far members are
from each other, and how far their mean is from the base.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import track
from torch import Tensor

from agents import LearnedDriver, read_driver, read_provenance, save_driver
from agents.learned.networks import head_weights
from rare_envs.files import replace_file
from rare_envs.threads import use_one_thread
from samplers.problem import FloatArray
from training.command_line import report_errors, run_command
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.critic import Critic
from training.imitation.algorithms.expert_pairs import Pairs
from training.imitation.algorithms.learner import Learner, run_updates
from training.imitation.datasets import load_scenes
from training.imitation.fit import CHECKPOINT, UPDATE_RULES, Data, prepare_data
from training.imitation.run_folder import DRIVER, read_training_settings
from training.imitation.weight_fit import FOLDS, fit_weights


@dataclass(frozen=True)
class Ensemble:
    """Settings of an ensemble.

    Raises:
        ValueError: There are too few members to fit a distribution, or too few updates.
    """

    members: int = 32
    updates: int = 60
    """Number of updates of each member."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.members < 2 * FOLDS:
            raise ValueError(f"Expected {2 * FOLDS} or more members to fit a distribution, got {self.members}.")
        if self.updates < 2:
            raise ValueError(f"Expected 2 or more updates of each member, got {self.updates}.")


class Member(NamedTuple):
    """A trained member."""

    weights: FloatArray
    """Weights of its last layer, shape (404,)."""
    within: FloatArray
    """Standard deviation of each weight over the second half of its run, shape (404,)."""


def member_config(base: Config, ensemble: Ensemble) -> Config:
    """Return the base's settings with all schedules at their ends."""
    # fields by name
    last: dict[str, Any] = {name: (getattr(base, name)[1],) * 2 for name in ("horizon", "age", "drivers")}
    clone_weight = (base.clone_weight[1], base.clone_weight[1])
    return replace(base, updates=ensemble.updates, warm_up=0, clone_weight=clone_weight, **last)


def train_member(
    data: Data, driver: LearnedDriver, base: Config, checkpoint: Path, ensemble: Ensemble, number: int
) -> Member:
    """Train a member.

    Args:
        data: Data that the base learned from.
        driver: The base.
        base: Settings of the base.
        checkpoint: Checkpoint of the base's training.
        ensemble: Settings of the ensemble.
        number: Number of the member; with the ensemble's seed it decides everything random.
    """
    (seed,) = np.random.SeedSequence([ensemble.seed, number]).generate_state(1)
    generator = torch.Generator().manual_seed(int(seed))
    scenes = torch.unique(data.pairs.scene)
    drawn = scenes[torch.randint(len(scenes), (len(scenes),), generator=generator)]
    pairs, config = select_scenes(data.pairs, drawn), member_config(base, ensemble)
    policy = copy.deepcopy(driver.policy)
    policy.head.requires_grad_(True)
    visited: list[Tensor] = []
    learner = Learner(config, data.recording, drawn, pairs, policy, Critic(), generator)
    learner.inherit(checkpoint)
    for _ in run_updates(learner, UPDATE_RULES[config.method]):
        visited.append(head_weights(policy).detach())
    late = torch.stack(visited[len(visited) // 2 :]).double().numpy()
    return Member(late[-1], late.std(axis=0))


def select_scenes(pairs: Pairs, drawn: Tensor) -> Pairs:
    """Return the pairs of the scenes that were drawn, as often as they were drawn."""
    rows = torch.cat([(pairs.scene == scene).nonzero().flatten() for scene in drawn])
    return Pairs(*(column[rows] for column in pairs))


def train_members(folder: Path, ensemble: Ensemble, progress: bool = False) -> list[Member]:
    """Train an ensemble around the driver in a folder; members that are kept there are not trained again.

    Raises:
        ValueError: The folder holds no finished training, or members of another driver.
    """
    source, base = read_training_settings(folder)
    driver = read_driver(folder / DRIVER)
    own = head_weights(driver.policy).double().numpy()
    kept = folder / f"members-{ensemble.updates}-{ensemble.seed}"
    kept.mkdir(exist_ok=True)
    data = prepare_data(load_scenes(source)[0])
    members = []
    for number in track(range(ensemble.members), "members", console=Console(stderr=True), disable=not progress):
        path = kept / f"{number:03}.npz"
        if not path.exists():
            member = train_member(data, driver, base, folder / CHECKPOINT, ensemble, number)
            with replace_file(path) as draft:
                np.savez(draft, base=own, weights=member.weights, within=member.within)
        with np.load(path) as saved:
            if not np.array_equal(saved["base"], own):
                raise ValueError(f"{str(path)!r} is a member around another driver; remove {str(kept)!r}.")
            members.append(Member(saved["weights"], saved["within"]))
    return members


def measure_spread(members: list[Member], base: FloatArray) -> dict[str, float]:
    """Return how far members are from each other, move within their runs, and are on average from the base."""
    weights = np.stack([member.weights for member in members])
    between, within = weights.std(axis=0, ddof=1), np.stack([member.within for member in members]).mean(axis=0)
    bias = np.abs(weights.mean(axis=0) - base)
    return {
        "between_median": float(np.median(between)),
        "between_max": float(between.max()),
        "within_median": float(np.median(within)),
        "within_max": float(within.max()),
        "bias_median": float(np.median(bias)),
        "bias_max": float(bias.max()),
        "bias_over_spread": float(np.sqrt(np.square(bias).mean() / np.square(between).mean())),
    }


def make_ensemble(folder: Path, ensemble: Ensemble, out: Path, progress: bool = False) -> Path:
    """Write a copy of the driver in a folder that has a distribution of its weights.

    Args:
        folder: Folder of a finished training.
        ensemble: Settings.
        out: File to write, `.safetensors`.
        progress: Show a bar on standard error.

    Returns:
        The file.

    Raises:
        ValueError: There is no finished training, or no distribution can be fitted.
    """
    members = train_members(folder, ensemble, progress)
    driver, provenance = read_driver(folder / DRIVER), read_provenance(folder / DRIVER)
    fit = fit_weights(np.stack([member.weights for member in members]))
    spread = measure_spread(members, head_weights(driver.policy).double().numpy())
    command = f"python -m training.imitation.ensemble RUN --members {ensemble.members} --updates {ensemble.updates}"
    about = {"command": f"{command} --seed {ensemble.seed}", **spread, **fit.metadata}
    return save_driver(replace(driver, weights=fit.distribution), replace(provenance, ensemble=about), out)


@use_one_thread()
def main(
    run: Annotated[Path, typer.Argument(help="Folder of a finished training.")],
    out: Annotated[Path, typer.Option(help="The driver with the distribution of its weights, .safetensors.")],
    members: Annotated[int, typer.Option(help="Members to train.")] = Ensemble.members,
    updates: Annotated[int, typer.Option(help="Of each member.")] = Ensemble.updates,
    seed: Annotated[int, typer.Option(help="The same seed gives the same distribution.")] = Ensemble.seed,
) -> None:
    """Train an ensemble around a driver and fit the distribution of its last layer's weights."""
    with report_errors("ensemble"):
        path = make_ensemble(run, Ensemble(members, updates, seed), out, progress=True)
    print(f"Saved {path}.")


if __name__ == "__main__":
    run_command(main)
