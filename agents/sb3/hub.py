"""Policies of the Hugging Face Hub in the layout of huggingface_sb3: a `.zip`, and its statistics beside it.

A snapshot in the Hub's cache on this machine is taken as it is, without a connection; only what is not there is
downloaded, by the library huggingface_hub. The files are opened as any other `.zip`, so that they cannot run code.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

from rare_envs.plugins import one_line

HUB_PREFIX = "hf:"
"""Beginning of the names of such egos."""
NOT_MODELS = ("train_eval_metrics.zip", "replay.zip")
"""Files that RL Zoo puts beside a model."""
_NAME = re.compile(r"hf:([\w-][\w.-]*)/([\w-][\w.-]*)(?:/([\w-][\w.-]*\.zip))?(?:@([\w-][\w.-]*))?")


class HubName(NamedTuple):
    """Place of a policy on the Hub.

    Example:
        >>> HubName.read("hf:sb3/ppo-CartPole-v1@main")
        HubName(user='sb3', repository='ppo-CartPole-v1', file=None, revision='main')
    """

    user: str
    repository: str
    file: str | None
    revision: str

    @classmethod
    def read(cls, text: str) -> HubName:
        """Return the place that a name of an ego stands for.

        Raises:
            ValueError: It has another form.
        """
        found = _NAME.fullmatch(text)
        if found is None:
            raise ValueError(
                f"Expected hf:USER/REPOSITORY, and /FILE.zip or @REVISION behind it if need be, got {text!r}."
            )
        user, repository, file, revision = found.groups()
        return cls(user, repository, file, revision or "main")


def find_cached_model(text: str) -> Path | None:
    """Return the file of a policy in the cache; None if it is not there. Nothing is downloaded.

    Args:
        text: Name of an ego, "hf:USER/REPOSITORY".

    Raises:
        ValueError: It is no such name, or the repository has several models, or none.
    """
    name = HubName.read(text)
    folder = find_hub_cache() / f"models--{name.user}--{name.repository}"
    pointer = folder / "refs" / name.revision
    commit = pointer.read_text(encoding="utf-8").strip() if pointer.is_file() else name.revision
    snapshot = folder / "snapshots" / commit
    return _choose_model(snapshot, name, text) if snapshot.is_dir() else None


def find_hub_model(text: str) -> Path:
    """Return the file of a policy, downloaded if it is not in the cache.

    Args:
        text: Name of an ego, "hf:USER/REPOSITORY".

    Raises:
        ValueError: It is no such name, cannot be downloaded, or the repository has several models, or none.
    """
    cached = find_cached_model(text)
    if cached is not None:
        return cached
    name, cache = HubName.read(text), find_hub_cache()
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise ValueError(
            f"{text!r} is not in the cache {str(cache)!r}; to download it pip install 'rare-envs[hub]', or download "
            "the .zip yourself and name its path."
        ) from error
    try:
        snapshot = snapshot_download(
            repo_id=f"{name.user}/{name.repository}",
            revision=name.revision,
            allow_patterns=["*.zip", "*.pkl"],
            cache_dir=str(cache),
        )
    except Exception as error:  # of the connection, of the library, or there is no such repository
        raise ValueError(f"Cannot download {text!r}: {one_line(error)}") from error
    return _choose_model(Path(snapshot), name, text)


def find_hub_cache() -> Path:
    """Return the folder of the Hub's cache, which its environment variables name as the library reads them."""
    if "HF_HUB_CACHE" in os.environ:
        return Path(os.environ["HF_HUB_CACHE"])
    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "huggingface"
    return Path(os.environ.get("HF_HOME", home)) / "hub"


def _choose_model(snapshot: Path, name: HubName, text: str) -> Path:
    """Return the model of a snapshot: the one that is named, or that has the repository's name, or the only one."""
    models = sorted(path.name for path in snapshot.glob("*.zip") if path.name not in NOT_MODELS)
    wanted = name.file or f"{name.repository}.zip"
    if wanted in models:
        return snapshot / wanted
    if name.file is None and len(models) == 1:
        return snapshot / models[0]
    known = ", ".join(models) or "none"
    raise ValueError(
        f"Expected a model as hf:{name.user}/{name.repository}/FILE.zip for {text!r}; its files are {known}."
    )
