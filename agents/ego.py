"""Egos by name: the rule-based driver, learned drivers, Stable-Baselines3 files, functions that make an ego.

A Stable-Baselines3 `.zip` holds pickled objects beside its weights, and so do `VecNormalize`
statistics: loading either can run code that its author put there. Load files that you trust.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import os
import pickle
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from agents.checkpoints import SHIPPED, SUFFIX, load_driver
from agents.learned import LearnedDriver, LearnedEgo
from agents.sb3_zip import algorithm_class, algorithm_of, read_header, weights_only_objects
from rare_envs.space import did_you_mean

RULE_BASED: Final = "idm"
EXPECTED = f"'idm', {', '.join(map(repr, SHIPPED))}, a path to a {SUFFIX} or Stable-Baselines3 .zip, or module:function"


@runtime_checkable
class Ego(Protocol):
    """What drives the ego vehicle: Stable-Baselines3's `predict`, called on whole batches."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch.

        Args:
            observation: Observations of B scenarios, shape (B, F).
            state: Memory of a recurrent policy from the step before; None at the start.
            episode_start: Rows that begin a new episode, shape (B,).
            deterministic: Act by the mean (or best) action, without exploration noise.

        Returns:
            Actions, shape (B, 2) in [-1, 1] or (B,) integers, and the memory to pass on.
        """
        ...


@dataclass(frozen=True)
class SavedEgo:
    """A Stable-Baselines3 policy read from a file, with its observation statistics if it has any.

    Attributes:
        model: The Stable-Baselines3 algorithm, on the CPU.
        algorithm: Its name, such as "ppo".
        path: Where it came from.
        statistics: Its `VecNormalize` statistics, or None; observations pass through them first.
        statistics_path: Where the statistics came from, or None.
    """

    model: Any
    algorithm: str
    path: Path
    statistics: Any = None
    statistics_path: Path | None = None

    @property
    def observation_space(self) -> Any:
        """The observation space that the policy was trained on."""
        return self.model.observation_space

    @property
    def action_space(self) -> Any:
        """The action space that the policy was trained on."""
        return self.model.action_space

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch; see `Ego.predict`."""
        if self.statistics is not None:
            observation = self.statistics.normalize_obs(observation)
        actions, state = self.model.predict(observation, state, episode_start, deterministic)
        return actions, state


def load_ego(spec: str | Path, algo: str | None = None) -> Ego | LearnedEgo | Literal["idm"]:
    """Find an ego by what a user would type.

    Args:
        spec: "idm"; "mgail", "gail" or "bc", or a path to a `.safetensors`, for a learned driver, which as ego acts by
            its mean actions; a path to a `.zip` saved by Stable-Baselines3; or `module:function`, a function
            without arguments that returns an ego (modules in the working directory are found).
        algo: Algorithm of a `.zip`, such as "ppo"; recognised from the file when None. Only a `.zip` has one.

    Returns:
        "idm" as it stands, a `LearnedEgo`, else an object with `predict`. A `.zip` gives a `SavedEgo`, whose
        `observation_space` and `action_space` are those of the policy. `VecNormalize` statistics
        saved beside a `.zip` are applied to its observations: `<name>_vecnormalize.pkl`,
        `vecnormalize.pkl`, or where RL Zoo and Stable-Baselines3's checkpoints put them.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The spec is none of these, the file is not a model of Stable-Baselines3 or no driver or is
            damaged, the function is missing, fails or returns something without `predict`, or
            algo is given for something that is no `.zip`.
    """
    text = str(spec)
    learned = text in SHIPPED or text.endswith(SUFFIX)
    if text != RULE_BASED and not learned and (text.endswith(".zip") or Path(text).is_file()):
        return _load_zip(Path(text), algo)
    factory = ":" in text and "/" not in text
    if text != RULE_BASED and not learned and not factory:
        raise ValueError(f"Unknown ego {text!r}{_suggest_ego(text)}; expected {EXPECTED}.")
    if algo is not None:
        raise ValueError(f"Expected algo for a Stable-Baselines3 .zip only, got {algo!r} for {text!r}; leave it out.")
    if learned:
        return LearnedEgo(cast(LearnedDriver, load_driver(text)))
    return _call_factory(text) if factory else RULE_BASED


def _suggest_ego(text: str) -> str:
    """A "did you mean" for a misspelt ego: a driver by name or a `.zip` saved nearby."""
    saved = Path(f"{text}.zip")
    if saved.is_file():
        return f" (did you mean {str(saved)!r}?)"
    return did_you_mean(text.lower(), [RULE_BASED, *SHIPPED])


# --- Stable-Baselines3 files -------------------------------------------------------------------


def _load_zip(path: Path, algo: str | None) -> SavedEgo:
    """Read a `.zip`: what it says of itself first, then its weights, then its statistics."""
    if not path.exists():
        raise FileNotFoundError(f"No ego at {str(path)!r}{_suggest_file(path)}.")
    if not path.is_file():
        raise ValueError(f"Expected a Stable-Baselines3 .zip, got the folder {str(path)!r}.")
    header = read_header(path)
    name = algo.lower() if algo is not None else algorithm_of(header, path)
    algorithm = algorithm_class(name, path)
    model = _load_model(algorithm, name, header, path)
    found = _find_statistics(path)
    statistics = None if found is None else _load_statistics(found, model.observation_space)
    return SavedEgo(model, name, path, statistics, found)


def _suggest_file(path: Path) -> str:
    """Names in the same folder that a mistyped path may have meant."""
    if not path.parent.is_dir():
        return f": the folder {str(path.parent)!r} does not exist"
    names = sorted(entry.name for entry in path.parent.glob("*.zip"))
    near = difflib.get_close_matches(path.name, names, n=3, cutoff=0.5) or names[:3]
    if not near:
        return f": the folder {str(path.parent)!r} has no .zip"
    return f"; in that folder: {', '.join(near)}"


def _load_model(algorithm: Any, name: str, header: Mapping[str, Any], path: Path) -> Any:
    """Build the algorithm and put the saved weights in."""
    try:
        return algorithm.load(path, device="cpu", custom_objects=weights_only_objects())
    except Exception as error:  # a damaged or foreign pickle can raise anything at all
        version = header.get("version", "unknown")
        raise ValueError(
            f"Cannot load {str(path)!r} as {name.upper()} (saved by Stable-Baselines3 {version}): "
            f"{_one_line(error)}. The file is damaged, needs a package that is not installed, or "
            "holds another algorithm (name it with algo)."
        ) from error


def _statistics_candidates(path: Path) -> Iterator[Path]:
    """Places where `VecNormalize` statistics of a model are kept, most specific first."""
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


def _find_statistics(path: Path) -> Path | None:
    return next((found for found in _statistics_candidates(path) if found.is_file()), None)


def _load_statistics(path: Path, observation_space: Any) -> Any:
    """Read `VecNormalize` statistics and check that they fit the policy."""
    from stable_baselines3.common.vec_env import VecNormalize

    try:
        with path.open("rb") as file:
            statistics = pickle.load(file)
    except Exception as error:  # a damaged pickle can raise anything at all
        raise ValueError(
            f"Cannot read the VecNormalize statistics {str(path)!r}: {_one_line(error)}. "
            "Save them again, or move the file away if it does not belong to this ego."
        ) from error
    if not isinstance(statistics, VecNormalize):
        raise ValueError(
            f"Expected VecNormalize statistics in {str(path)!r}, got {type(statistics).__name__}; "
            "move the file away if it does not belong to this ego."
        )
    if statistics.observation_space.shape != observation_space.shape:
        raise ValueError(
            f"VecNormalize statistics {str(path)!r} are for observations of shape "
            f"{statistics.observation_space.shape}, the ego's have {observation_space.shape}; "
            "move the file away if it does not belong to this ego."
        )
    statistics.training = False
    return statistics


# --- functions that make an ego ----------------------------------------------------------------


def _call_factory(spec: str) -> Ego | Literal["idm"]:
    """Import `module:function` and call it."""
    module_name, _, function_name = spec.partition(":")
    if not module_name or not function_name:
        raise ValueError(f"Expected module:function, got {spec!r}.")
    try:
        with _working_directory_first():
            module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # the module is the user's: anything may happen in it
        raise ValueError(f"Cannot import {module_name!r} for the ego {spec!r}: {_one_line(error)}.") from error
    function = getattr(module, function_name, None)
    if not callable(function):
        names = [name for name in vars(module) if callable(getattr(module, name))]
        raise ValueError(f"{module_name!r} has no function {function_name!r}{did_you_mean(function_name, names)}.")
    try:
        ego = function()
    except (Exception, SystemExit) as error:  # likewise
        raise ValueError(f"{spec!r} failed to make an ego: {_one_line(error)}.") from error
    rule_based = isinstance(ego, str) and ego == RULE_BASED  # an array, say, compares element by element
    if not rule_based and not callable(getattr(ego, "predict", None)):
        raise ValueError(f"Expected {spec!r} to return 'idm' or an object with predict, got {type(ego).__name__}.")
    return cast("Ego | Literal['idm']", ego)


@contextlib.contextmanager
def _working_directory_first() -> Iterator[None]:
    """Find modules in the working directory, as `python -m` does and console scripts do not."""
    here = os.getcwd()
    sys.path.insert(0, here)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove(here)


def _one_line(error: BaseException) -> str:
    """An exception as one line without a full stop."""
    words = " ".join(str(error).split()).rstrip(".")
    kind = type(error).__name__
    return f"{kind}: {words[:200]}" if words else kind
