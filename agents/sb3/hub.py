"""Policies of the Hugging Face Hub in the layout of huggingface_sb3: a `.zip`, and its statistics beside it.

A model with its statistics in the Hub's cache on this machine is taken as it is, without a connection. Whatever else
is there may be part of a repository (huggingface_sb3's `load_from_hub` keeps the `.zip` alone): the library
huggingface_hub completes it, at the commit that is there, so that a resumed run keeps its ego. The files are opened as
any other `.zip`, so that they cannot run code.
"""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path
from typing import NamedTuple

from agents.sb3.statistics import find_statistics
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

    def find_snapshot(self) -> Path:
        """Return the folder of its files in the cache, named by their commit; it need not be there."""
        folder = find_hub_cache() / f"models--{self.user}--{self.repository}"
        pointer = folder / "refs" / self.revision
        commit = pointer.read_text(encoding="utf-8").strip() if pointer.is_file() else self.revision
        return folder / "snapshots" / commit


def find_cached_model(text: str) -> Path | None:
    """Return the file of a policy in the cache; None if it is not there. Nothing is downloaded.

    Args:
        text: Name of an ego, "hf:USER/REPOSITORY".

    Raises:
        ValueError: It is no such name, or the repository has several models.
    """
    name = HubName.read(text)
    snapshot = name.find_snapshot()
    models = _list_models(snapshot)
    there = name.file in models if name.file else bool(models)
    return _choose_model(snapshot, name, text) if there else None


def find_hub_model(text: str) -> Path:
    """Return the file of a policy, downloaded if it or its statistics are not in the cache.

    Without a connection or the library, a model in the cache is taken, with a warning if it has no statistics there.

    Args:
        text: Name of an ego, "hf:USER/REPOSITORY".

    Raises:
        ValueError: It is no such name, cannot be downloaded, or the repository has several models, or none.
    """
    name = HubName.read(text)
    cached = name.find_snapshot()
    wanted = cached / (name.file or f"{name.repository}.zip")
    if wanted.is_file() and find_statistics(wanted) is not None:
        return wanted
    try:
        import huggingface_hub
    except ImportError as error:
        reason = "huggingface_hub is not installed (pip install 'rare-envs[hub]')"
        if (model := _take_cached(text, reason)) is not None:
            return model
        raise ValueError(
            f"{text!r} is not in the cache {str(find_hub_cache())!r}; to download it pip install 'rare-envs[hub]', or "
            "download the .zip yourself and name its path."
        ) from error
    known = cached.is_dir()
    repository, revision = f"{name.user}/{name.repository}", cached.name if known else name.revision
    try:
        snapshot = huggingface_hub.snapshot_download(
            repo_id=repository,
            revision=revision,
            allow_patterns=["*.zip", "*.pkl"],
            cache_dir=str(find_hub_cache()),
        )
    except Exception as error:  # of the connection, of the library, or there is no such repository
        incomplete = type(error).__name__ == "IncompleteSnapshotError"  # the library knows which files are missing
        if known and not incomplete and (model := _take_cached(text, one_line(error))) is not None:
            return model
        raise ValueError(f"Cannot download {text!r}: {one_line(error)}") from error
    model = _choose_model(Path(snapshot), name, text)
    if known and find_statistics(model) is None:
        try:  # without a connection the library returns what is there, and does not tell
            huggingface_hub.file_exists(repository, "vec_normalize.pkl", revision=revision)
        except Exception as error:
            _warn_of_statistics(text, one_line(error))
    return model


def _take_cached(text: str, reason: str) -> Path | None:
    """Return a model of the cache that cannot be compared with the Hub, or None; warn if it has no statistics."""
    model = find_cached_model(text)
    if model is not None and find_statistics(model) is None:
        _warn_of_statistics(text, reason)
    return model


def _warn_of_statistics(text: str, reason: str) -> None:
    warnings.warn(
        f"{text!r} is taken from the cache, which has no VecNormalize statistics of it, and the Hub cannot tell "
        f"whether it has any: {reason}. If it was trained behind VecNormalize, its results here are wrong.",
        stacklevel=4,
    )


def find_hub_cache() -> Path:
    """Return the folder of the Hub's cache, which its environment variables name as the library reads them."""
    if "HF_HUB_CACHE" in os.environ:
        return Path(os.environ["HF_HUB_CACHE"])
    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "huggingface"
    return Path(os.environ.get("HF_HOME", home)) / "hub"


def _list_models(snapshot: Path) -> list[str]:
    return sorted(path.name for path in snapshot.glob("*.zip") if path.name not in NOT_MODELS)


def _choose_model(snapshot: Path, name: HubName, text: str) -> Path:
    """Return the model of a snapshot: the one that is named, or that has the repository's name, or the only one."""
    models = _list_models(snapshot)
    wanted = name.file or f"{name.repository}.zip"
    if wanted in models:
        return snapshot / wanted
    if name.file is None and len(models) == 1:
        return snapshot / models[0]
    known = ", ".join(models) or "none"
    raise ValueError(
        f"Expected a model as hf:{name.user}/{name.repository}/FILE.zip for {text!r}; its files are {known}."
    )
