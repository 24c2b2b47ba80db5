"""Policies saved by Stable-Baselines3: a `.zip`, and the `VecNormalize` statistics beside it.

Both hold pickles. They are opened by `agents.sb3.safe_pickle`, so that a file from somewhere else cannot run code. One
that needs classes of its author's own is opened as Stable-Baselines3 does, and only if the caller trusts it.
"""

from __future__ import annotations

import base64
import difflib
import io
import pickle
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.sb3.file_trust import check_origin
from agents.sb3.safe_pickle import ForbiddenObject, open_pickle
from agents.sb3.zip_header import find_algorithm, find_algorithm_class, make_training_stubs, read_header
from rare_envs.egos.wrappers import FrameStackedPolicy, NormalisedPolicy, find_stacking
from rare_envs.plugins import one_line

TRUST = "if you trust where the file comes from, load it with trust=True (--trust)"
"""Advice on a file that was not opened."""


@dataclass(frozen=True)
class SavedEgo:
    """A Stable-Baselines3 policy read from a file, with its observation statistics if it has any.

    Example:
        >>> import tempfile
        >>> from stable_baselines3 import PPO
        >>> from agents import load_ego
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu").save(f"{folder}/ego.zip")
        ...     ego = load_ego(f"{folder}/ego.zip")
        >>> ego.algorithm, ego.observation_space.shape, ego.statistics
        ('ppo', (3,), None)
        >>> ego.predict(np.zeros((5, 3), np.float32))[0].shape
        (5, 1)
    """

    model: Any
    """The Stable-Baselines3 algorithm, on the CPU."""
    algorithm: str
    """Its name, such as "ppo"."""
    path: Path
    """The `.zip`."""
    statistics: Any = None
    """Its `VecNormalize` statistics, or None; observations pass through them first."""
    statistics_path: Path | None = None
    """The file of the statistics, or None."""

    @property
    def observation_space(self) -> Any:
        """Observations of the policy; those of single frames if they were normalised one by one."""
        return self.model.observation_space if self.frames is None else self.statistics.observation_space

    @property
    def action_space(self) -> Any:
        """The action space that the policy was trained on."""
        return self.model.action_space

    @property
    def frames(self) -> tuple[int, bool] | None:
        """Frames stacked behind `VecNormalize`, as `rare_envs.egos.wrappers.find_stacking` says; None without."""
        if self.statistics is None or self.statistics.observation_space.shape == self.model.observation_space.shape:
            return None
        return find_stacking(self.statistics.observation_space.shape, self.model.observation_space.shape)

    @cached_property
    def policy(self) -> Any:
        """The model behind its statistics and stacks."""
        policy = self.model if self.frames is None else FrameStackedPolicy(self.model, *self.frames)
        return policy if self.statistics is None else NormalisedPolicy(policy, self.statistics.normalize_obs)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch; see `agents.Ego.predict`."""
        actions, state = self.policy.predict(observation, state, episode_start, deterministic)
        return actions, state


def load_saved_ego(path: Path, algo: str | None, trust: bool = False) -> SavedEgo:
    """Read a `.zip`: its header first, then its weights, then its statistics.

    Args:
        path: The file.
        algo: Its algorithm; found in the file if None.
        trust: Open its pickles as Stable-Baselines3 does, which runs whatever code is in them.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It is no model, is damaged, or needs trust: because of its content, or because other users may write
            to it or its statistics (`agents.sb3.file_trust`).

    Example:
        >>> load_saved_ego(Path("no/such/ego.zip"), None)
        Traceback (most recent call last):
        ...
        FileNotFoundError: No ego at 'no/such/ego.zip': the folder 'no/such' does not exist.
    """
    if not path.exists():
        raise FileNotFoundError(f"No ego at {str(path)!r}{_suggest_file(path)}.")
    if not path.is_file():
        raise ValueError(f"Expected a Stable-Baselines3 .zip, got the folder {str(path)!r}.")
    statistics_path = find_statistics(path)
    if not trust:
        check_origin(path, statistics_path)
    header = read_header(path)
    name = algo.lower() if algo is not None else find_algorithm(header, path)
    algorithm = find_algorithm_class(name, path)
    model = _load_model(algorithm, name, header, path, trust)
    statistics = None if statistics_path is None else _load_statistics(statistics_path, model.observation_space, trust)
    return SavedEgo(model, name, path, statistics, statistics_path)


def _suggest_file(path: Path) -> str:
    """Return a hint at files in the same folder that a mistyped path may have meant."""
    if not path.parent.is_dir():
        return f": the folder {str(path.parent)!r} does not exist"
    names = sorted(entry.name for entry in path.parent.glob("*.zip"))
    near = difflib.get_close_matches(path.name, names, n=3, cutoff=0.5) or names[:3]
    if not near:
        return f": the folder {str(path.parent)!r} has no .zip"
    return f"; in that folder: {', '.join(near)}"


def _load_model(algorithm: Any, name: str, header: Mapping[str, Any], path: Path, trust: bool) -> Any:
    """Build the algorithm and load the saved weights."""
    given = make_training_stubs()
    try:
        content = path.read_bytes()  # once, so that what is loaded is what was looked at
        if not trust:
            given = {**open_objects(read_header(io.BytesIO(content), str(path)), set(given)), **given}
        return algorithm.load(io.BytesIO(content), device="cpu", custom_objects=given)
    except ForbiddenObject as error:
        raise ValueError(f"Will not load {str(path)!r}: {error}; {TRUST}.") from error
    except Exception as error:  # a damaged or foreign pickle can raise anything at all
        version = header.get("version", "unknown")
        raise ValueError(
            f"Cannot load {str(path)!r} as {name.upper()} (saved by Stable-Baselines3 {version}): "
            f"{one_line(error)}. The file is damaged, needs a package that is not installed, or "
            "holds another algorithm (name it with algo)."
        ) from error


def open_objects(header: Mapping[str, Any], without: set[str]) -> dict[str, Any]:
    """Open the pickled entries of a model's settings safely.

    Raises:
        ForbiddenObject: One names a class or function that is not listed; the message names the entry.
    """
    opened = {}
    for key, value in header.items():
        if key in without or not isinstance(value, dict) or ":serialized:" not in value:
            continue
        try:
            opened[key] = open_pickle(base64.b64decode(str(value[":serialized:"])))
        except ForbiddenObject as error:
            raise ForbiddenObject(f"in its {key!r} {error}") from error
    return opened


# --- statistics --------------------------------------------------------------------------------


def _statistics_candidates(path: Path) -> Iterator[Path]:
    """Yield the places where `VecNormalize` statistics of a model are kept, most specific first."""
    folder, stem = path.parent, path.stem
    yield folder / f"{stem}_vecnormalize.pkl"
    checkpoint = re.fullmatch(r"(.+)_(\d+_steps)", stem)  # Stable-Baselines3's CheckpointCallback
    if checkpoint:
        yield folder / f"{checkpoint[1]}_vecnormalize_{checkpoint[2]}.pkl"
    yield folder / stem / "vecnormalize.pkl"  # RL Zoo: Env-v0_1/Env-v0.zip, Env-v0_1/Env-v0/
    run = re.fullmatch(r"(.+)_\d+", folder.resolve().name)  # RL Zoo: Env-v0_1/best_model.zip
    if run:
        yield folder / run[1] / "vecnormalize.pkl"
    yield folder / "vecnormalize.pkl"


def find_statistics(path: Path) -> Path | None:
    """Return the file of the `VecNormalize` statistics of a model, or None."""
    return next((file for file in _statistics_candidates(path) if file.is_file()), None)


def _load_statistics(path: Path, observation_space: Any, trust: bool) -> Any:
    """Read `VecNormalize` statistics and check that they fit the policy."""
    from stable_baselines3.common.vec_env import VecNormalize

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
    if find_stacking(statistics.observation_space.shape or (), observation_space.shape) is None:
        raise ValueError(
            f"VecNormalize statistics {str(path)!r} are for observations of shape "
            f"{statistics.observation_space.shape}, the ego's have {observation_space.shape}; "
            "move the file away if it does not belong to this ego."
        )
    statistics.training = False
    return statistics
