"""Header of a Stable-Baselines3 `.zip`: settings and algorithm, read without unpickling anything.

The archive has a member `data`: JSON with simple values as they are and other values as
`{":type:": ..., "__module__": ..., ":serialized:": <pickle>}`. Names of settings and the policy's module are enough to
tell the algorithms apart.
"""

from __future__ import annotations

import importlib
import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from rare_envs.plugins import did_you_mean

CORE_ALGORITHMS = ("ppo", "a2c", "sac", "td3", "ddpg", "dqn")  # in stable_baselines3
CONTRIB_CLASSES = {  # in sb3_contrib, an optional package: name -> class
    "recurrent_ppo": "RecurrentPPO",
    "maskable_ppo": "MaskablePPO",
    "trpo": "TRPO",
    "tqc": "TQC",
    "qrdqn": "QRDQN",
    "crossq": "CrossQ",
    "ars": "ARS",
}

POLICY_MODULES = {  # start of the policy's module -> algorithm; "common" policies serve several
    "stable_baselines3.sac.": "sac",
    "stable_baselines3.td3.": "td3",  # DDPG is TD3 with other settings, and acts alike
    "stable_baselines3.dqn.": "dqn",
    "sb3_contrib.common.recurrent.": "recurrent_ppo",
    "sb3_contrib.ppo_recurrent.": "recurrent_ppo",
    "sb3_contrib.common.maskable.": "maskable_ppo",
    "sb3_contrib.ppo_mask.": "maskable_ppo",
    "sb3_contrib.tqc.": "tqc",
    "sb3_contrib.qrdqn.": "qrdqn",
    "sb3_contrib.crossq.": "crossq",
    "sb3_contrib.ars.": "ars",
}

SETTINGS_OF_ALGORITHM = (  # a setting that only this algorithm has; the first that is present decides
    ("top_quantiles_to_drop_per_net", "tqc"),
    ("cg_max_steps", "trpo"),
    ("n_delta", "ars"),
    ("clip_range", "ppo"),
    ("target_policy_noise", "td3"),
    ("target_entropy", "sac"),
    ("exploration_initial_eps", "dqn"),
    ("gae_lambda", "a2c"),  # on-policy, and none of the above: A2C with RMSprop or Adam
)


MAX_UNPACKED, MAX_RATIO = 64 * 2**20, 20
"""Bytes that any archive may unpack to, and the factor by which a larger one may grow: Stable-Baselines3 stores its
members uncompressed, so 20 refuses no policy."""


MAX_VALUES = 1_000_000
"""Values in the settings of a model."""


class ArchiveTooLarge(ValueError):
    """An archive that would take far more memory than its own size."""


def read_header(file: Path | BinaryIO, name: str | None = None) -> dict[str, Any]:
    """Read the settings of a saved model without opening its pickles.

    Args:
        file: A file that exists, or its content.
        name: Its name in messages; the path when None.

    Returns:
        The entries of the member `data`, and "version" (of Stable-Baselines3).

    Raises:
        ValueError: The file is not a zip, is damaged, or is not a model of Stable-Baselines3.
    """
    name = str(file) if name is None else name
    if not zipfile.is_zipfile(file):
        raise ValueError(f"{name!r} is not a zip file (or is cut short); expected a model saved by Stable-Baselines3.")
    try:
        with zipfile.ZipFile(file) as archive:
            _check_size(archive, name)
            members = set(archive.namelist())
            header = _parse_settings(archive.read("data"), name) if "data" in members else None
            version = _read_text(archive, members, "_stable_baselines3_version")
    except ArchiveTooLarge:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, RuntimeError, RecursionError, OSError) as error:
        raise ValueError(f"{name!r} is damaged ({error}); save the model again.") from error
    if not isinstance(header, dict) or "policy.pth" not in members or "policy_class" not in header:
        raise ValueError(
            f"{name!r} is a zip file but not a Stable-Baselines3 model: it lacks its members "
            "'data' and 'policy.pth'. Write it with model.save(path)."
        )
    return {**header, "version": version}


def _check_size(archive: zipfile.ZipFile, name: str) -> None:
    """Refuse an archive that would fill the memory."""
    unpacked = sum(member.file_size for member in archive.infolist())
    assert archive.fp is not None
    packed = archive.fp.seek(0, io.SEEK_END)  # not the sum over members, which may share their bytes
    if unpacked > max(MAX_UNPACKED, MAX_RATIO * packed):
        raise ArchiveTooLarge(
            f"{name!r} would unpack from {packed / 1e6:.1f} to {unpacked / 1e6:,.0f} MB; no policy does that."
        )


def _parse_settings(content: bytes, name: str) -> Any:
    """Return the JSON of the settings.

    Raises:
        ArchiveTooLarge: It has more values than any policy: each takes some 50 times its two letters in memory.
    """
    if content.count(b",") + content.count(b"[") + content.count(b"{") > MAX_VALUES:
        raise ArchiveTooLarge(f"{name!r} has more than {MAX_VALUES:,} values in its settings; no policy does that.")
    return json.loads(content)


def _read_text(archive: zipfile.ZipFile, members: set[str], name: str) -> str:
    return archive.read(name).decode().strip() if name in members else "unknown"


def find_algorithm(header: Mapping[str, Any], path: Path) -> str:
    """Return the name of the algorithm of a saved model.

    Args:
        header: From `read_header`.
        path: The file, for messages.

    Returns:
        One of `CORE_ALGORITHMS` or `CONTRIB_CLASSES`.

    Raises:
        ValueError: No algorithm fits.
    """
    policy = header.get("policy_class")
    module = str(policy.get("__module__", "")) if isinstance(policy, dict) else ""
    for start, name in POLICY_MODULES.items():
        if module.startswith(start):
            return name
    for setting, name in SETTINGS_OF_ALGORITHM:
        if setting in header:
            return name
    raise ValueError(
        f"Cannot tell which algorithm saved {str(path)!r} (policy from {module or 'unknown'!r}); "
        f"name it with algo: {', '.join((*CORE_ALGORITHMS, *CONTRIB_CLASSES))}."
    )


def find_algorithm_class(name: str, path: Path) -> Any:
    """Return the class of an algorithm.

    Args:
        name: One of `CORE_ALGORITHMS` or `CONTRIB_CLASSES`.
        path: The file that needs it, for messages.

    Returns:
        The class, with its `load`.

    Raises:
        ValueError: The name is unknown, or its package is not installed.
    """
    if name in CORE_ALGORITHMS:
        return getattr(importlib.import_module("stable_baselines3"), name.upper())  # a class by its name
    if name in CONTRIB_CLASSES:
        try:
            return getattr(importlib.import_module("sb3_contrib"), CONTRIB_CLASSES[name])  # likewise
        except ImportError as error:
            raise ValueError(
                f"{str(path)!r} holds {CONTRIB_CLASSES[name]}, which needs a package that is not "
                "installed: pip install sb3-contrib."
            ) from error
    known = (*CORE_ALGORITHMS, *CONTRIB_CLASSES)
    raise ValueError(f"Unknown algorithm {name!r}{did_you_mean(name, known)}; expected one of {', '.join(known)}.")


def make_training_stubs() -> dict[str, Any]:
    """Return stand-ins for the entries that only training needs.

    Passed as `custom_objects` of `load`, they keep schedules, noise and buffers of a saved model closed. Those pickles
    break between versions of Python, a replay buffer would allocate its full memory, and a seed would reset the global
    generators. Entries that a model lacks are ignored.
    """
    return {
        "seed": None,
        "learning_rate": 0.0,
        "lr_schedule": None,
        "clip_range": 0.0,
        "clip_range_vf": None,
        "exploration_schedule": None,
        "delta_std_schedule": None,
        "weights": None,
        "action_noise": None,
        "n_envs": 1,
        "n_steps": 1,
        "buffer_size": 1,
        "optimize_memory_usage": False,
        "replay_buffer_class": None,
        "replay_buffer_kwargs": {},
        "rollout_buffer_class": None,
        "rollout_buffer_kwargs": {},
        "ep_info_buffer": None,
        "ep_success_buffer": None,
        "_last_obs": None,
        "_last_episode_starts": None,
        "_last_original_obs": None,
        "_last_lstm_states": None,
    }
