"""`VecNormalize` statistics of a saved policy: where they lie, how they are read, and signs that they are missing."""

from __future__ import annotations

import base64
import pickle
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from agents.sb3.safe_pickle import TRUST, ForbiddenObject, open_pickle
from rare_envs.egos.wrappers import UNBOUNDED, find_stacking
from rare_envs.plugins import one_line

MAX_STATISTICS = 64 * 2**20
"""Largest file of statistics [bytes]."""
_NAMES = ("vecnormalize", "vec_normalize")
"""Names of files of statistics: Stable-Baselines3's callbacks and RL Zoo write the first, its examples the second."""
_BEYOND = 1e-3
"""Observations beyond the bounds by less are rounding."""
_STEP = 0.5
"""A change of the observations of ordinary environments in one step is smaller; `VecNormalize` moves some by more."""
_MIN_ROWS, _SPREAD, _CENTRE = 16, (0.3, 3.0), 1.5
"""From so many rows on, a standard deviation in this range and a mean of at most so much in every column are those of
normalised observations: some of the environment's own vary by far less."""


def _statistics_candidates(path: Path) -> Iterator[Path]:
    """Yield the places where `VecNormalize` statistics of a model are kept, most specific first."""
    folder, stem = path.parent, path.stem
    checkpoint = re.fullmatch(r"(.+)_(\d+_steps)", stem)  # Stable-Baselines3's CheckpointCallback
    run = re.fullmatch(r"(.+)_\d+", folder.resolve().name)  # RL Zoo: Env-v0_1/best_model.zip
    for name in _NAMES:
        yield folder / f"{stem}_{name}.pkl"
        if checkpoint:
            yield folder / f"{checkpoint[1]}_{name}_{checkpoint[2]}.pkl"
        yield folder / stem / f"{name}.pkl"  # RL Zoo: Env-v0_1/Env-v0.zip, Env-v0_1/Env-v0/
        if run:
            yield folder / run[1] / f"{name}.pkl"
    for name in _NAMES:
        yield folder / f"{name}.pkl"


def find_statistics(path: Path) -> Path | None:
    """Return the file of the `VecNormalize` statistics of a model, or None."""
    return next((file for file in _statistics_candidates(path) if file.is_file()), None)


def load_statistics(path: Path, observation_space: Any, trust: bool) -> Any:
    """Read `VecNormalize` statistics and check that they fit the policy.

    Args:
        path: The file.
        observation_space: Of the policy.
        trust: Open it as Stable-Baselines3 does, which runs whatever code is in it.

    Raises:
        ValueError: It holds something else, or is damaged, or does not fit.
        OSError: It cannot be read.
    """
    from stable_baselines3.common.vec_env import VecNormalize

    if path.stat().st_size > MAX_STATISTICS:
        raise ValueError(f"VecNormalize statistics {str(path)!r} are larger than {MAX_STATISTICS / 2**20:.0f} MiB.")
    try:
        content = path.read_bytes()
        statistics = pickle.loads(content) if trust else open_pickle(content)
    except ForbiddenObject as error:
        raise ValueError(f"Will not read the VecNormalize statistics {str(path)!r}: {error}; {TRUST}.") from error
    except Exception as error:  # a damaged pickle can raise anything at all
        raise ValueError(
            f"Cannot read the VecNormalize statistics {str(path)!r}: {one_line(error)}. "
            "Save them again, or move the file away if it does not belong to this ego."
        ) from error
    if not isinstance(statistics, VecNormalize):
        raise ValueError(
            f"Expected VecNormalize statistics in {str(path)!r}, got {type(statistics).__name__}; "
            "move the file away if it does not belong to this ego."
        )
    if not _is_whole(statistics):
        raise ValueError(f"VecNormalize statistics {str(path)!r} are damaged; save them again.")
    if find_stacking(statistics.observation_space.shape or (), observation_space.shape or ()) is None:
        raise ValueError(
            f"VecNormalize statistics {str(path)!r} are for observations of shape "
            f"{statistics.observation_space.shape}, the ego's have {observation_space.shape}; "
            "move the file away if it does not belong to this ego."
        )
    statistics.training = False
    return statistics


def _is_whole(statistics: Any) -> bool:
    """Return whether statistics have everything that normalising an observation reads, in the right shapes."""
    values = vars(statistics)
    space, normalise = values.get("observation_space"), values.get("norm_obs")
    numbers = all(isinstance(values.get(name), int | float | np.floating) for name in ("clip_obs", "epsilon"))
    if not isinstance(space, spaces.Space) or not isinstance(normalise, bool) or not numbers:
        return False
    if not normalise:
        return True
    moments = values.get("obs_rms")
    if isinstance(space, spaces.Dict):
        keys = values.get("norm_obs_keys")
        good = isinstance(moments, dict) and isinstance(keys, list) and set(keys) <= set(moments) & set(space.spaces)
        return good and all(_has_moments(moments[key], space[key].shape) for key in keys)
    return _has_moments(moments, space.shape)


def _has_moments(moments: Any, shape: Any) -> bool:
    mean, variance = (getattr(moments, name, None) for name in ("mean", "var"))
    if not isinstance(mean, np.ndarray) or not isinstance(variance, np.ndarray):
        return False
    return mean.shape == variance.shape == shape and bool((variance >= 0.0).all())


def describe_missing_statistics(header: Mapping[str, Any], last: Any, own: Any, expected: Any) -> str:
    """Return why a policy without statistics seems to have been trained on normalised observations; "" if nothing does.

    Args:
        header: Settings of the file.
        last: The last observations of its training, as far as the file holds them.
        own: The space of observations that it declares.
        expected: That of the environment in which it is to drive.
    """
    if _has_original_observations(header, last):
        return "its file says that it was trained behind VecNormalize"
    if not isinstance(expected, spaces.Box) or expected.dtype != np.float32 or len(expected.shape) != 1:
        return ""
    if isinstance(own, spaces.Box) and np.isinf(own.high).all() and not np.isinf(expected.high).any():
        return UNBOUNDED
    if not isinstance(last, np.ndarray) or last.dtype.kind != "f" or last.ndim != 2 or not last.size:
        return ""
    furthest = float(last.flat[np.abs(last).argmax()])
    if not expected.low.min() - _BEYOND <= furthest <= expected.high.max() + _BEYOND:
        return f"the last observations of its training reach {furthest:.3g}, beyond the bounds of those here"
    spread, centre = last.std(axis=0), np.abs(last.mean(axis=0))
    normal = bool(((_SPREAD[0] < spread) & (spread < _SPREAD[1]) & (centre < _CENTRE)).all())
    if len(last) >= _MIN_ROWS and last.shape[1] > 1 and normal:
        return "the last observations of its training have mean 0 and spread 1 in every column, or nearly so"
    return ""


def _has_original_observations(header: Mapping[str, Any], last: Any) -> bool:
    """Return whether a file keeps observations as they were before `VecNormalize`, beside the last ones.

    Algorithms with a replay buffer fill that entry without `VecNormalize` too, by the observations one step earlier,
    which are of the same scale as the last ones.
    """
    if header.get("_last_original_obs") is None or "learning_starts" not in header:
        return header.get("_last_original_obs") is not None
    original = open_last_observation(header, "_last_original_obs")
    if isinstance(original, dict) and isinstance(last, dict):
        return any(_is_rescaled(last[key], original[key]) for key in original.keys() & last.keys())
    return _is_rescaled(last, original)


def _is_rescaled(last: Any, original: Any) -> bool:
    """Return whether most rows of `last` are far from those of `original`, in no column equal and other than 0."""
    if not isinstance(last, np.ndarray) or not isinstance(original, np.ndarray) or last.shape != original.shape:
        return False
    if not last.size or last.dtype.kind != "f" or original.dtype.kind != "f":
        return False
    before, after = original.reshape(len(original), -1), last.reshape(len(last), -1)
    kept = ((before == after) & (before != 0.0)).any(axis=1)
    return bool(np.median(~kept & (np.abs(after - before).max(axis=1) > _STEP)) > 0.5)


def open_last_observation(header: Mapping[str, Any], name: str = "_last_obs") -> Any:
    """Return the last observations of a policy's training, normalised if they were; None where the file has none.

    Args:
        header: Settings of the file.
        name: The entry; `_last_original_obs` are those before `VecNormalize`.
    """
    entry = header.get(name)
    try:
        return open_pickle(base64.b64decode(str(entry[":serialized:"]))) if isinstance(entry, dict) else None
    except Exception:  # nothing depends on it but a warning
        return None
