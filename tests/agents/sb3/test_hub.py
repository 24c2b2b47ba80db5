"""Policies of the Hugging Face Hub, from a local folder in the form of its cache."""

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

from agents import load_ego
from agents.loading import find_ego_kind
from agents.saved_ego import SavedEgo, find_cached_model, find_hub_model
from rare_envs.study.question import find_named_files

NAME, COMMIT = "hf:somebody/ppo-Pendulum-v1", "0123abc"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    return tmp_path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `package_to_hub` of huggingface_sb3 and RL Zoo upload."""
    folder = tmp_path_factory.mktemp("uploaded")
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    env.reset()
    PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu").save(folder / "ppo-Pendulum-v1.zip")
    env.save(str(folder / "vec_normalize.pkl"))
    (folder / "train_eval_metrics.zip").write_bytes(b"PK")
    (folder / "README.md").write_text("A card.")
    return folder


def fill(cache: Path, files: Path) -> Path:
    """Put files into the cache as the library does: blobs, and links to them in a snapshot."""
    repository = cache / "models--somebody--ppo-Pendulum-v1"
    snapshot = repository / "snapshots" / COMMIT
    for folder in (snapshot, repository / "blobs", repository / "refs"):
        folder.mkdir(parents=True)
    (repository / "refs" / "main").write_text(COMMIT)
    for number, path in enumerate(sorted(files.iterdir())):
        (repository / "blobs" / str(number)).write_bytes(path.read_bytes())
        (snapshot / path.name).symlink_to(repository / "blobs" / str(number))
    return snapshot


@pytest.mark.parametrize("name", [NAME, f"{NAME}@main", f"{NAME}@{COMMIT}", f"{NAME}/ppo-Pendulum-v1.zip"])
def test_a_policy_in_the_cache_is_loaded_without_a_connection(name: str, cache: Path, files: Path) -> None:
    snapshot = fill(cache, files)
    ego = load_ego(name)
    assert isinstance(ego, SavedEgo)
    assert (ego.algorithm, ego.path) == ("ppo", snapshot / "ppo-Pendulum-v1.zip")
    assert ego.statistics_path == snapshot / "vec_normalize.pkl"
    assert ego.predict(np.zeros((2, 3), np.float32))[0].shape == (2, 1)
    assert find_ego_kind(name) == "hub"
    assert find_named_files(name) == [ego.path]  # so that a run knows the file by its content


def test_what_is_not_there_is_downloaded_where_the_library_is_installed(
    cache: Path, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_cached_model(NAME) is None and find_named_files(NAME) == []
    with pytest.raises(ValueError, match=r"is not in the cache .*pip install 'rare-envs\[hub\]'"):
        load_ego(NAME)
    asked: list[dict[str, Any]] = []

    def download(**arguments: Any) -> str:
        asked.append(arguments)
        return str(fill(cache, files))

    install(monkeypatch, download)
    found = find_hub_model(f"{NAME}@main")
    assert found == find_hub_model(NAME) == find_cached_model(NAME)
    (once,) = asked
    assert (once["repo_id"], once["revision"]) == ("somebody/ppo-Pendulum-v1", "main")
    assert once["allow_patterns"] == ["*.zip", "*.pkl"] and once["cache_dir"] == str(cache)


def install(monkeypatch: pytest.MonkeyPatch, download: Any, file_exists: Any = None) -> None:
    """Put a stand-in in the place of the library."""
    library = SimpleNamespace(snapshot_download=download, file_exists=file_exists)
    monkeypatch.setitem(sys.modules, "huggingface_hub", library)


def test_part_of_a_repository_is_completed_at_its_commit(
    cache: Path, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`load_from_hub` of huggingface_sb3 keeps the `.zip` alone; others have only looked at the card."""
    snapshot = fill(cache, files)
    asked: list[str] = []

    def download(revision: str, **_: Any) -> str:
        asked.append(revision)
        for path in files.iterdir():
            (snapshot / path.name).unlink(missing_ok=True)
            (snapshot / path.name).write_bytes(path.read_bytes())
        return str(snapshot)

    install(monkeypatch, download)
    for missing in (["vec_normalize.pkl"], ["vec_normalize.pkl", "ppo-Pendulum-v1.zip", "train_eval_metrics.zip"]):
        for name in missing:
            (snapshot / name).unlink()
        assert (find_cached_model(NAME) is None) == (len(missing) == 3)
        assert load_ego(NAME).statistics_path == snapshot / "vec_normalize.pkl"
    assert asked == [COMMIT, COMMIT]  # a later revision is another ego, which a resumed run must not get


def test_what_may_lack_its_statistics_is_told_where_the_hub_does_not_answer(
    cache: Path, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = fill(cache, files)
    (snapshot / "vec_normalize.pkl").unlink()

    def fail(*_: Any, **__: Any) -> Any:
        raise ConnectionError("no route")

    def find_missing(**_: Any) -> str:
        raise type("IncompleteSnapshotError", (OSError,), {})("missing vec_normalize.pkl")

    with pytest.warns(UserWarning, match=r"no VecNormalize statistics of it.*pip install 'rare-envs\[hub\]'"):
        assert find_hub_model(NAME) == snapshot / "ppo-Pendulum-v1.zip"
    for download in (fail, lambda **_: str(snapshot)):  # the library returns what is there, without a word
        install(monkeypatch, download, file_exists=fail)
        with pytest.warns(UserWarning, match="no VecNormalize statistics of it.*no route"):
            assert find_hub_model(NAME) == snapshot / "ppo-Pendulum-v1.zip"
    install(monkeypatch, find_missing)
    with pytest.raises(ValueError, match=r"^Cannot download .*missing vec_normalize\.pkl"):
        find_hub_model(NAME)
    install(monkeypatch, lambda **_: str(snapshot), file_exists=lambda *_, **__: False)  # it has none on the Hub
    assert find_hub_model(NAME) == snapshot / "ppo-Pendulum-v1.zip"


def test_a_download_that_fails_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def download(**_: Any) -> str:
        raise ConnectionError("no\nroute")

    install(monkeypatch, download)
    with pytest.raises(ValueError, match=r"^Cannot download 'hf:somebody/ppo-Pendulum-v1': .*no route"):
        load_ego(NAME)


def test_a_name_of_another_form_is_refused() -> None:
    for text in ("hf:somebody", "hf:../x/y", "hf:a/b/../c.zip", "hf:a/b@../c", "hf:a/b/c.pkl"):
        with pytest.raises(ValueError, match="Expected hf:USER/REPOSITORY"):
            find_cached_model(text)


def test_several_models_need_a_file(cache: Path, files: Path) -> None:
    snapshot = fill(cache, files)
    (snapshot / "ppo-Pendulum-v1.zip").rename(snapshot / "first.zip")
    assert find_hub_model(NAME) == snapshot / "first.zip"
    (snapshot / "second.zip").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"/FILE.zip for .* its files are first.zip, second.zip\.$"):
        load_ego(NAME)
