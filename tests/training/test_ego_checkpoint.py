"""A training that was killed goes on from its checkpoint and ends with the ego of an undisturbed one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import training.ego_training
from agents import load_ego
from training import train_ego
from training.ego_checkpoint import load_checkpoint

ENV = "rare_envs/CutIn-v0"
ROWS = 8
OFF_POLICY = ("sac", "td3", "dqn")


def weights(path: Path) -> torch.Tensor:
    ego: Any = load_ego(path)
    return torch.cat([value.flatten().double() for value in ego.model.policy.state_dict().values()])


class Stopped(Exception):
    """Stands for whatever ends a training."""


def stop_after(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Let the writing of checkpoint `count` be the last thing that a training does."""
    written, save = [0], training.ego_training.save_checkpoint

    def save_and_stop(*arguments: Any) -> None:
        save(*arguments)
        written[0] += 1
        if written[0] == count:
            raise Stopped

    monkeypatch.setattr(training.ego_training, "save_checkpoint", save_and_stop)


@pytest.mark.parametrize(("algo", "steps", "checkpoint"), [("ppo", 480, 2), *((a, 160, 11) for a in OFF_POLICY)])
def test_a_resumed_training_ends_alike(
    algo: str, steps: int, checkpoint: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped half-way, with updates, and new scenarios for episodes that ended (after 0.8 s), before and after."""
    common: dict[str, Any] = {"algo": algo, "steps": steps, "num_envs": ROWS, "progress": False, "horizon": 0.8}
    whole = train_ego(ENV, out=tmp_path / "whole.zip", **common)
    stop_after(monkeypatch, checkpoint)
    with pytest.raises(Stopped):
        train_ego(ENV, out=tmp_path / "ego.zip", checkpoint_interval=0.0, **common)
    monkeypatch.undo()
    assert not (tmp_path / "ego.zip").exists()
    with pytest.raises(ValueError, match=r"There is an unfinished training in .* go on with --resume"):
        train_ego(ENV, out=tmp_path / "ego.zip", **common)
    with pytest.raises(ValueError, match=r"with other arguments \(seed=0\)"):
        train_ego(ENV, out=tmp_path / "ego.zip", resume=True, **{**common, "seed": 1})
    np.random.seed(5)  # noqa: NPY002  (what another process would have drawn of the global generators)
    torch.manual_seed(5)
    resumed = train_ego(ENV, out=tmp_path / "ego.zip", resume=True, **common)
    assert torch.equal(weights(resumed), weights(whole))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ego.zip", "whole.zip"]


def test_there_has_to_be_something_to_resume(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="There is no training to resume"):
        train_ego(ENV, out=tmp_path / "ego.zip", resume=True)


@pytest.mark.parametrize("content", [b"", b"noise", b"PK\x03\x04", b"\x80\x02cos\nsystem\n."])
def test_damaged_checkpoints_are_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "ego.checkpoint").write_bytes(content)
    with pytest.raises(ValueError, match="it is damaged or no checkpoint; remove it") as caught:
        load_checkpoint(tmp_path / "ego.checkpoint", {})
    assert "\n" not in str(caught.value)


def test_an_ego_stays_while_the_next_one_cannot_be_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from stable_baselines3 import PPO

    def fail(self: PPO, path: Path) -> None:
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    (tmp_path / "ego.zip").write_bytes(b"earlier")
    monkeypatch.setattr(PPO, "save", fail)
    with pytest.raises(OSError, match="No space left"):
        train_ego(ENV, steps=64, num_envs=4, out=tmp_path / "ego.zip", progress=False)
    assert (tmp_path / "ego.zip").read_bytes() == b"earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["ego.zip"]


PROGRAM = """
import sys
from training import train_ego
train_ego("rare_envs/CutIn-v0", "a2c", 20_000, num_envs=8, out=sys.argv[1], progress=False, checkpoint_interval=0.0,
          resume=sys.argv[2] == "resume")
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_training_is_taken_up(tmp_path: Path) -> None:
    """Killed three times at different moments, one of them perhaps while a checkpoint is written."""
    whole = train_ego(ENV, "a2c", 20_000, num_envs=8, out=tmp_path / "whole.zip", progress=False)
    out, checkpoint = tmp_path / "ego.zip", tmp_path / "ego.checkpoint"
    for delay in (0.1, 0.73, 1.31):
        how = "resume" if checkpoint.exists() else "begin"
        with subprocess.Popen([sys.executable, "-c", PROGRAM, str(out), how]) as process:
            while not checkpoint.exists() and process.poll() is None:
                time.sleep(0.05)
            time.sleep(delay + (5.0 if how == "resume" else 0.0))
            process.send_signal(signal.SIGKILL)
    assert checkpoint.exists()
    assert not out.exists()
    subprocess.run([sys.executable, "-c", PROGRAM, str(out), "resume"], check=True)
    assert torch.equal(weights(out), weights(whole))
