"""Logs of a training, with TensorBoard and without it."""

import pytest

from tests.training.imitation.synthetic_scenes import TINY, tiny
from training.imitation.datasets import Source
from training.imitation.fit import make_learner, train_learner
from training.imitation.run_folder import train_driver


def test_logs_go_to_tensorboard(data, tmp_path):
    pytest.importorskip("tensorboard", reason="the extra logs is optional")
    train_learner(make_learner(data, tiny(updates=2)), tmp_path, log=True)
    assert list(tmp_path.glob("events.out.*"))


def test_logs_without_tensorboard_are_refused(data, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ValueError, match=r"rare-envs\[logs\]"):
        train_learner(make_learner(data, tiny(updates=1)), tmp_path, log=True)
    with pytest.raises(ValueError, match=r"rare-envs\[logs\]"):  # before the data are even looked for
        train_driver(Source("data", tmp_path / "nowhere"), TINY, tmp_path / "run", log=True)
