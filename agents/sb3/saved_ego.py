"""Policies saved by Stable-Baselines3: a `.zip`, and the `VecNormalize` statistics beside it.

Both hold pickles. They are opened by `agents.sb3.safe_pickle`, so that a file from somewhere else cannot run code. One
that needs classes of its author's own is opened as Stable-Baselines3 does, and only if the caller trusts it.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.names import report_missing_file
from agents.sb3.archive import build_model, find_algorithm, find_algorithm_class, make_training_stubs, read_header
from agents.sb3.safe_pickle import TRUST, TRUST_ADVICE, ForbiddenObject, find_origin_risks
from agents.sb3.statistics import (
    describe_missing_statistics,
    find_statistics,
    load_statistics,
    open_last_observation,
)
from rare_envs.egos.wrappers import FrameStackedPolicy, NormalisedPolicy, find_stacking
from rare_envs.plugins import one_line


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
    header: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Settings of the file, their pickles closed."""

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

    @property
    def same_as(self) -> Any:
        """A policy that acts as it does; compiled rollouts read its network."""
        return self.policy

    def find_missing_statistics(self, expected: Any) -> str:
        """Return why it seems to have been trained on normalised observations, if it has no statistics; "" if not.

        Args:
            expected: Space of the environment's observations.
        """
        if self.statistics is not None:
            return ""
        last = open_last_observation(self.header)
        return describe_missing_statistics(self.header, last, self.model.observation_space, expected)

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


def load_saved_ego(path: Path, algo: str | None, trust: bool = False, stats: str | Path | None = None) -> SavedEgo:
    """Read a `.zip`: its header first, then its weights, then its statistics.

    Args:
        path: The file.
        algo: Its algorithm; found in the file if None.
        trust: Open its pickles as Stable-Baselines3 does, which runs whatever code is in them.
        stats: The file of its `VecNormalize` statistics; None to look for one beside it.

    Raises:
        FileNotFoundError: The file, or that of the statistics, does not exist.
        ValueError: It is no model, is damaged, or needs trust: because of its content, or because other users may write
            to it or its statistics (`agents.sb3.safe_pickle.find_origin_risks`).
    """
    if not path.exists():
        raise report_missing_file(path)
    if not path.is_file():
        raise ValueError(f"Expected a Stable-Baselines3 .zip, got the folder {str(path)!r}.")
    statistics_path = find_statistics(path) if stats is None else Path(stats)
    if statistics_path is not None and not statistics_path.is_file():
        raise FileNotFoundError(f"No VecNormalize statistics at {str(statistics_path)!r}.")
    if not trust and (risks := find_origin_risks(path, statistics_path)):
        raise ValueError(f"Will not open it: {'; '.join(risks)}; {TRUST_ADVICE}.")
    header = read_header(path)
    name = algo.lower() if algo is not None else find_algorithm(header, path)
    algorithm = find_algorithm_class(name, path)
    model = _load_model(algorithm, name, header, path, trust)
    statistics = None if statistics_path is None else load_statistics(statistics_path, model.observation_space, trust)
    return SavedEgo(model, name, path, statistics, statistics_path, header)


def _load_model(algorithm: Any, name: str, header: Mapping[str, Any], path: Path, trust: bool) -> Any:
    """Build the algorithm and load the saved weights."""
    try:
        content = path.read_bytes()  # once, so that what is loaded is what was looked at
        if not trust:
            return build_model(algorithm, content, str(path))
        return algorithm.load(io.BytesIO(content), device="cpu", custom_objects=make_training_stubs())
    except ForbiddenObject as error:
        raise ValueError(f"Will not load {str(path)!r}: {error}; {TRUST}.") from error
    except Exception as error:  # a damaged or foreign pickle can raise anything at all
        version = header.get("version", "unknown")
        raise ValueError(
            f"Cannot load {str(path)!r} as {name.upper()} (saved by Stable-Baselines3 {version}): "
            f"{one_line(error)}. The file is damaged, needs a package that is not installed, or "
            "holds another algorithm (name it with algo)."
        ) from error
