"""Train a driver from recorded traffic.

    python -m training.imitation.train --data FOLDER --method mgail --seed 0 --out runs/mgail

Training that was interrupted goes on where its last checkpoint left off, to the same weights.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from agents.networks import Policy
from training.data.scenes import Scene
from training.imitation import gail, mgail
from training.imitation.clone import clone
from training.imitation.config import Config
from training.imitation.critic import Critic
from training.imitation.expert import Pairs, expert_pairs
from training.imitation.learner import Learner, Log, Update, train
from training.imitation.recording import Recording, stack

UPDATES: dict[str, Update] = {"gail": gail.update, "mgail": mgail.update}
EVERY = 50
"""Updates between checkpoints."""


def prepare(scenes: Sequence[Scene], config: Config) -> Learner:
    """Everything of a training before its first update: the record, its pairs, a cloned policy, a new critic."""
    recording = stack(scenes)
    return learner_of(recording, expert_pairs(recording), torch.arange(len(scenes)), config)


def learner_of(recording: Recording, pairs: Pairs, among: torch.Tensor, config: Config) -> Learner:
    """As `prepare`, from what has been prepared; `among` are the scenes to drive."""
    generator = torch.Generator().manual_seed(config.seed)
    policy = clone(pairs, config, generator)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        critic = Critic()
    return Learner(config, recording, among, pairs, policy, critic, generator)


def fit(
    learner: Learner, out: Path | None = None, log: bool = False, progress: bool = False, every: int = EVERY
) -> Policy:
    """Make the updates of a training.

    Args:
        learner: As `prepare` makes it.
        out: Folder of the checkpoint; a training that is found there is taken up. None keeps nothing.
        log: Write TensorBoard logs there.
        progress: Show a bar on standard error.
        every: Updates between checkpoints.

    Raises:
        ValueError: If the folder holds a training with other settings.
    """
    if learner.config.method == "bc":
        return learner.policy
    if out is not None:
        _take_up(learner, out)
    with _bar(learner, progress) as show, _writer(out if log else None) as write:

        def after(learner: Learner, entry: Log) -> None:
            show(learner, entry)
            write(learner, entry)
            if out is not None and (learner.update % every == 0 or learner.update == learner.config.updates):
                learner.save(out / "checkpoint.pt")

        return train(learner, UPDATES[learner.config.method], after)


def _take_up(learner: Learner, out: Path) -> None:
    """Note the settings in a folder, or check that they are those of the training in it and take it up."""
    out.mkdir(parents=True, exist_ok=True)
    settings = json.dumps(asdict(learner.config), indent=1)
    noted = out / "config.json"
    if not noted.exists():
        noted.write_text(settings + "\n")
    elif json.loads(noted.read_text()) != json.loads(settings):
        raise ValueError(f"{str(out)!r} holds a training with other settings; choose another folder or remove it.")
    if (out / "checkpoint.pt").exists():
        learner.load(out / "checkpoint.pt")


After = Callable[[Learner, Log], None]


@contextlib.contextmanager
def _bar(learner: Learner, show: bool) -> Iterator[After]:
    """A progress bar on standard error."""
    if not show:
        yield lambda learner, entry: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=learner.config.updates, completed=learner.update)

        def after(learner: Learner, entry: Log) -> None:
            text = ", ".join(f"{name} {entry[name]:.3f}" for name in ("collision", "edge", "critic") if name in entry)
            bar.update(task, completed=learner.update, description=text)

        yield after


@contextlib.contextmanager
def _writer(folder: Path | None) -> Iterator[After]:
    """TensorBoard logs."""
    if folder is None:
        yield lambda learner, entry: None
        return
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError("Logs need TensorBoard: pip install tensorboard.") from error
    writer: Any = SummaryWriter(str(folder))

    def after(learner: Learner, entry: Log) -> None:
        for name, value in entry.items():
            writer.add_scalar(name, value, learner.update)
        writer.add_scalar("vehicle_steps", learner.simulated, learner.update)

    try:
        yield after
    finally:
        writer.close()
