"""Training of a driver on recorded scenes, from data to the last update."""

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

CPU = torch.device("cpu")
UPDATE_RULES: dict[str, Update] = {"gail": update_gail, "mgail": update_mgail}
"""Update of each adversarial method."""
CHECKPOINT_INTERVAL = 50
"""Number of updates between checkpoints."""
CHECKPOINT = "checkpoint.pt"
"""Name of the checkpoint in the folder of a training."""


@dataclass(frozen=True)
class Data:
    """Recorded traffic, prepared for trainings.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> data.test is None
        True
    """

    recording: Recording
    pairs: Pairs
    test: Recording | None
    """Scenes for tests; None if there are too few to keep some."""


def prepare_data(scenes: Sequence[TrafficScene], test: Sequence[TrafficScene] = ()) -> Data:
    """Return scenes as one recording, with the pairs of features and actions in them.

    Args:
        scenes: Scenes to learn from.
        test: Scenes kept for tests.

    Raises:
        ValueError: There is no scene, or nobody follows anybody in any of them.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> data.recording.x.shape, data.pairs.features.shape
        (torch.Size([3, 40, 9]), torch.Size([708, 51]))
    """
    if not scenes:
        raise ValueError("Expected scenes to learn from, got none.")
    recording = stack_scenes(scenes)
    pairs = collect_pairs(recording)
    if not len(pairs.scene):
        raise ValueError("Nobody follows anybody in these scenes, so there is nothing to learn.")
    return Data(recording, pairs, stack_scenes(test) if test else None)


def make_learner(data: Data, config: Config, among: torch.Tensor | None = None, device: torch.device = CPU) -> Learner:
    """Return a training before its first update: a cloned policy and a new critic.

    Args:
        data: Recorded traffic.
        config: Settings.
        among: Scenes that are driven, with repetition, shape (k,); None for all that have pairs.
        device: Where it is trained.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> learner = make_learner(data, Config(epochs=1))
        >>> learner.update
        0
    """
    generator = torch.Generator().manual_seed(config.seed)
    recording = Recording(*(field.to(device) for field in data.recording))
    pairs = Pairs(*(field.to(device) for field in data.pairs))
    policy = clone_policy(pairs, config, generator)
    critic = make_seeded(Critic, generator).to(device)
    among = torch.unique(pairs.scene) if among is None else among.to(device)
    return Learner(config, recording, among, pairs, policy, critic, generator)


def train_learner(
    learner: Learner,
    out: Path | None = None,
    log: bool = False,
    progress: bool = False,
    every: int = CHECKPOINT_INTERVAL,
) -> Policy:
    """Make the remaining updates of a training and return its policy.

    The policy is that after the last update, never the best of several.

    Args:
        learner: A training, as `make_learner` returns it.
        out: Folder of the checkpoint; a training found there is resumed. None keeps no checkpoint.
        log: Write TensorBoard logs to the folder.
        progress: Show a bar on standard error.
        every: Number of updates between checkpoints.

    Raises:
        ValueError: Logs are to be written and TensorBoard is not installed.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> policy = train_learner(make_learner(data, Config(updates=1, epochs=1, scenes=2, warm_up=0)))
        >>> mean, log_std = policy(data.pairs.features)
        >>> mean.shape
        torch.Size([708, 2])
    """
    if out is not None and (out / CHECKPOINT).exists():
        learner.load(out / CHECKPOINT)
    with progress_bar(learner, progress) as show, tensorboard_logs(out if log else None, learner.update) as write:
        for entry in run_updates(learner, UPDATE_RULES[learner.config.method]):
            show(learner, entry)
            write(learner, entry)
            if out is not None and (learner.update % every == 0 or learner.update == learner.config.updates):
                learner.save(out / CHECKPOINT)
    return learner.policy
