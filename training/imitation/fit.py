"""Fitting a driver to recorded scenes, from data to the last update."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from agents.learned.networks import Policy
from training.data.scenes import TrafficScene
from training.imitation.algorithms.behaviour_cloning import clone_policy, make_seeded
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.critic import Critic
from training.imitation.algorithms.expert_pairs import Pairs, collect_pairs
from training.imitation.algorithms.gail import update_gail
from training.imitation.algorithms.learner import Learner, Update, run_updates
from training.imitation.algorithms.mgail import update_mgail
from training.imitation.progress import progress_bar, tensorboard_logs
from training.imitation.traffic.recording import Recording, stack_scenes

UPDATES: dict[str, Update] = {"gail": update_gail, "mgail": update_mgail}
CHECKPOINT_INTERVAL = 50
"""Updates between checkpoints."""
CHECKPOINT = "checkpoint.pt"
"""Its name in the folder of a training."""


@dataclass(frozen=True)
class Data:
    """Recorded traffic, ready for trainings."""

    recording: Recording
    pairs: Pairs
    test: Recording | None
    """None if there are too few scenes to keep some apart."""


def prepare_data(scenes: Sequence[TrafficScene], test: Sequence[TrafficScene] = ()) -> Data:
    """Stack scenes and pair what was seen with what was done in them.

    Raises:
        ValueError: If nobody follows anybody in any scene.
    """
    if not scenes:
        raise ValueError("Expected scenes to learn from, got none.")
    recording = stack_scenes(scenes)
    pairs = collect_pairs(recording)
    if not len(pairs.scene):
        raise ValueError("Nobody follows anybody in these scenes, so there is nothing to learn.")
    return Data(recording, pairs, stack_scenes(test) if test else None)


def make_learner(data: Data, config: Config, among: torch.Tensor | None = None) -> Learner:
    """Everything of a training before its first update: a cloned policy, a new critic.

    Args:
        data: Recorded traffic.
        config: Settings.
        among: Scenes that are driven, the oftener listed the oftener, shape (k,); None for all that have pairs.
    """
    generator = torch.Generator().manual_seed(config.seed)
    policy = clone_policy(data.pairs, config, generator)
    critic = make_seeded(Critic, generator)
    among = torch.unique(data.pairs.scene) if among is None else among
    return Learner(config, data.recording, among, data.pairs, policy, critic, generator)


def train_learner(
    learner: Learner,
    out: Path | None = None,
    log: bool = False,
    progress: bool = False,
    every: int = CHECKPOINT_INTERVAL,
) -> Policy:
    """Make the updates of a training.

    The policy is the one after the last update, never the best of several.

    Args:
        learner: As `make_learner` makes it.
        out: Folder of the checkpoint; a training that is found there is taken up. None keeps nothing.
        log: Write TensorBoard logs there.
        progress: Show a bar on standard error.
        every: Updates between checkpoints.

    Raises:
        ValueError: If logs are asked for and TensorBoard is not installed.
    """
    if learner.config.method == "bc":
        if out is not None:
            learner.save(out / CHECKPOINT)
        return learner.policy
    if out is not None and (out / CHECKPOINT).exists():
        learner.load(out / CHECKPOINT)
    with progress_bar(learner, progress) as show, tensorboard_logs(out if log else None, learner.update) as write:
        for entry in run_updates(learner, UPDATES[learner.config.method]):
            show(learner, entry)
            write(learner, entry)
            if out is not None and (learner.update % every == 0 or learner.update == learner.config.updates):
                learner.save(out / CHECKPOINT)
    return learner.policy
