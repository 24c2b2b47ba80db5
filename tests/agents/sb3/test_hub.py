"""Policies of the Hugging Face Hub: the library's cache is a folder, and its one function a stand-in."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from agents import SavedEgo, load_ego
from agents.saved_ego import find_hub_model
from rare_envs.study.question import find_named_files

NAME, COMMIT, MODEL, STATISTICS = "hf:somebody/ppo-Pendulum-v1", "0123abc", "ppo-Pendulum-v1.zip", "vec_normalize.pkl"


class Hub:
    """The library: files of one repository on the Hub, a cache of them, and what was asked for."""

    def __init__(self, cache: Path) -> None:
        env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
        env.reset()
        PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu").save(cache / MODEL)
        env.save(str(cache / STATISTICS))
        self.files = {name: (cache / name).read_bytes() for name in (MODEL, STATISTICS)}
        self.files["train_eval_metrics.zip"] = b"PK"
        self.snapshot, self.asked, self.answers = cache / COMMIT, list[str](), True

    def fill(self, *names: str) -> None:
        self.snapshot.mkdir(exist_ok=True)
        for name in names:
            (self.snapshot / name).write_bytes(self.files[name])

    def snapshot_download(self, place: str, revision: str | None, local_files_only: bool = False, **_: Any) -> str:
        if not local_files_only:
            self.asked.append(f"{place}@{revision or 'main'}")
            if not self.answers:
                raise ConnectionError("no\nroute")
            self.fill(*self.files)
        elif not self.snapshot.is_dir():
            raise FileNotFoundError("not in the cache")
        return str(self.snapshot)


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
    hub = Hub(tmp_path)
    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(snapshot_download=hub.snapshot_download))
    return hub


@pytest.mark.parametrize("name", [NAME, f"{NAME}@main", f"{NAME}@{COMMIT}", f"{NAME}/{MODEL}"])
def test_a_policy_in_the_cache_is_loaded_without_a_connection(name: str, hub: Hub) -> None:
    hub.fill(*hub.files)
    ego = load_ego(name)
    assert isinstance(ego, SavedEgo)
    assert (ego.algorithm, ego.path, ego.statistics_path) == ("ppo", hub.snapshot / MODEL, hub.snapshot / STATISTICS)
    assert ego.predict(np.zeros((2, 3), np.float32))[0].shape == (2, 1)
    assert find_named_files(name) == [ego.path]  # so that a run knows the file by its content
    assert hub.asked == []


def test_what_is_not_there_is_downloaded_and_part_of_a_repository_completed_at_its_commit(hub: Hub) -> None:
    """`load_from_hub` of huggingface_sb3 keeps the `.zip` alone; a later revision is another ego."""
    assert find_hub_model(NAME, download=False) is None and find_named_files(NAME) == []
    assert find_hub_model(f"{NAME}@v2") == hub.snapshot / MODEL
    (hub.snapshot / STATISTICS).unlink()
    assert load_ego(NAME).statistics_path == hub.snapshot / STATISTICS  # type: ignore[union-attr]
    assert hub.asked == ["somebody/ppo-Pendulum-v1@v2", f"somebody/ppo-Pendulum-v1@{COMMIT}"]


def test_without_connection_or_library_one_line_says_so(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    hub.answers = False
    with pytest.raises(ValueError, match=r"^Cannot download 'hf:somebody/ppo-Pendulum-v1': .*no route"):
        load_ego(NAME)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ValueError, match=r"needs huggingface_hub: pip install -e \S+\[hub\]"):
        load_ego(NAME)
    assert find_named_files(NAME) == []


def test_a_name_of_another_form_or_of_several_models_is_refused(hub: Hub) -> None:
    for text in ("hf:somebody", "hf:../x/y", "hf:a/b/../c.zip", "hf:a/b@../c", "hf:a/b/c.pkl"):
        with pytest.raises(ValueError, match="Expected hf:USER/REPOSITORY"):
            load_ego(text)
    hub.files["first.zip"] = hub.files.pop(MODEL)
    assert find_hub_model(NAME) == hub.snapshot / "first.zip"
    hub.files["second.zip"] = b"PK"
    hub.fill("second.zip")
    with pytest.raises(ValueError, match=r"/FILE.zip for .* its files are first.zip, second.zip\.$"):
        load_ego(NAME)
