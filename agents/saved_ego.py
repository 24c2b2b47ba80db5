"""Policies saved by Stable-Baselines3: a `.zip`, in a folder or on the Hugging Face Hub, and the statistics beside it.

Both hold pickles. They are opened by `agents.safe_pickle`, so that a file from somewhere else cannot run code. One
that needs classes of its author's own is opened as Stable-Baselines3 does, and only if the caller trusts it.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.files import report_missing_file
from agents.safe_pickle import TRUST, TRUST_ADVICE, ForbiddenObject, find_origin_risks, open_pickle
from agents.sb3_archive import build_policy, check_space, find_algorithm, read_archive
from rare_envs.egos.wrappers import STATS_ADVICE, UNBOUNDED, WrappedPolicy, find_stacking
from rare_envs.files import read_bytes
from rare_envs.plugins import one_line
from rare_envs.simulation.observation import BEHIND, VIEW, observation_space
from rare_envs.startup import advise_install

HUB_PREFIX = "hf:"
"""Beginning of the names of policies of the Hub."""
_HUB_NAME = re.compile(r"hf:([\w-][\w.-]*)/([\w-][\w.-]*)(?:/([\w-][\w.-]*\.zip))?(?:@([\w-][\w.-]*))?")
_NOT_MODELS = ("train_eval_metrics.zip", "replay.zip")
"""Files that RL Zoo puts beside a model."""
_MAX_STATISTICS = 2**25
"""Largest file of statistics [bytes]."""
_NAMES = ("vecnormalize", "vec_normalize")
"""Names of files of statistics: Stable-Baselines3's callbacks and RL Zoo write the first, its examples the second."""
LAST, ORIGINAL = "_last_obs", "_last_original_obs"
"""Entries of a `.zip`: the last observations of its training, and such from before `VecNormalize`."""
_BEYOND = 1e-3
"""Observations beyond the bounds by less are rounding."""
_APART = 0.01
"""Differences of distances along the road, 2 m of 200, that a bend does not make."""
_STEP = 0.5
"""A change of the observations of ordinary environments in one step is smaller; `VecNormalize` moves some by more."""
_FASTEST = 0.6
"""Speed of an ego in Kinematics, 48 m/s of 80: HighwayEnv's stay below, and cosines of headings are above."""
CONFIG_ADVICE = "test it in HighwayEnv's own environment with the config of its training (env_config)"
SBX_ADVICE = "name module:function, whose function returns sbx.PPO.load(FILE), say (docs/egos.md)"
OUTLYING = 5.0
"""Standard deviations of the training; observations beyond are unlike those that the ego was trained on."""


@dataclass(frozen=True)
class SavedEgo:
    """A Stable-Baselines3 policy read from a file, with its observation statistics if it has any.

    Example:
        >>> import tempfile, numpy as np
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

    policy: Any
    """The Stable-Baselines3 policy, on the CPU."""
    algorithm: str
    """Name of the algorithm that trained it, such as "ppo"."""
    path: Path
    """The `.zip`."""
    policy_kwargs: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Arguments of the policy's class beside spaces and schedule."""
    statistics: Any = None
    """Its `VecNormalize` statistics, or None; observations pass through them first."""
    statistics_path: Path | None = None
    """The file of the statistics, or None."""
    header: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Settings of the file, their pickles closed."""
    left_out: Path | None = None
    """A file of statistics beside it that is not its own, by what its file says; None if there is none."""

    @property
    def observation_space(self) -> Any:
        """Observations of the policy; those of single frames if they were normalised one by one."""
        return self.policy.observation_space if self.frames is None else self.statistics.observation_space

    @property
    def action_space(self) -> Any:
        """The action space that the policy was trained on."""
        return self.policy.action_space

    @property
    def frames(self) -> tuple[int, bool] | None:
        """Frames stacked behind `VecNormalize`, as `rare_envs.egos.wrappers.find_stacking` says; None without."""
        if self.statistics is None or self.statistics.observation_space.shape == self.policy.observation_space.shape:
            return None
        return find_stacking(self.statistics.observation_space.shape, self.policy.observation_space.shape)

    @cached_property
    def same_as(self) -> Any:
        """The policy behind its statistics and stacks: it acts as this does; compiled rollouts read its network."""
        if self.statistics is None:
            return self.policy
        return WrappedPolicy(self.policy, self.statistics.normalize_obs, *(self.frames or ()))

    @property
    def notes(self) -> tuple[str, ...]:
        """Which statistics beside it are left out."""
        if self.left_out is None:
            return ()
        why = "the ego's own file says that it was trained without VecNormalize"
        how = "stats: FILE in a file for --config, or load_ego(path, stats=FILE), applies it"
        return (f"{self.left_out} is not applied: {why}; {how}",)

    def find_normalisation_doubt(self, expected: Any) -> str:
        """Return what is wrong with its statistics for an environment's space of observations; "" if nothing seems."""
        if self.statistics is not None:
            why = describe_foreign_statistics(self.header, self.statistics, self.policy.observation_space)
            other = f"the VecNormalize statistics {self.statistics_path} seem to be those of another ego"
            return f"{other}: {why}; {STATS_ADVICE}" if why else ""
        last = _open_observation(self.header, LAST)
        if missing := describe_missing_statistics(self.header, last, self.policy.observation_space, expected):
            return f"the ego has no VecNormalize statistics, but {missing}; {STATS_ADVICE}"
        if getattr(last, "shape", ())[1:] == expected.shape == observation_space(2, "kinematics").shape:
            what = describe_other_kinematics(last)
            return f"the observations of the ego's training were {what}; {CONFIG_ADVICE}" if what else ""
        return ""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch; see `agents.Ego.predict`."""
        actions, state = self.same_as.predict(observation, state, episode_start, deterministic)
        return actions, state


def load_saved_ego(path: Path, algo: str | None, trust: bool = False, stats: str | Path | None = None) -> SavedEgo:
    """Return the policy of a `.zip`; arguments as of `agents.load_ego`.

    Without trust it is refused because of its content, or because other users may write to it or its statistics.
    """
    if not path.exists():
        raise report_missing_file(path)
    if path.is_dir():
        raise ValueError(f"Expected a Stable-Baselines3 .zip, got the folder {str(path)!r}.")
    statistics_path = find_statistics(path) if stats is None else Path(stats)
    if statistics_path is not None and not statistics_path.exists():
        raise FileNotFoundError(f"No VecNormalize statistics at {str(statistics_path)!r}.")
    if not trust and (risks := find_origin_risks(path, statistics_path)):
        raise ValueError(f"Will not open it: {'; '.join(risks)}; {TRUST_ADVICE}.")
    header, weights = read_archive(path)
    name = find_algorithm(header, algo, str(path))
    try:
        policy, policy_kwargs = build_policy(name, header, weights, trust)
    except Exception as error:  # a damaged or foreign file can raise anything at all
        if weights is None:
            why = str(error) if isinstance(error, ForbiddenObject) else one_line(error)
            raise ValueError(f"Cannot load {str(path)!r}, a model of sbx: {why}; {SBX_ADVICE}.") from error
        if isinstance(error, ForbiddenObject):
            raise ValueError(f"Will not load {str(path)!r}: {error}; {TRUST}.") from error
        contrib = "pip install sb3-contrib" if "sb3_contrib" in str(error) else "needs a package that is not installed"
        raise ValueError(
            f"Cannot load {str(path)!r} as {name.upper()} (saved by Stable-Baselines3 {header['version']}): "
            f"{one_line(error)}. The file is damaged, {contrib}, or holds another algorithm (name it with algo)."
        ) from error
    ego = SavedEgo(policy, name, path, policy_kwargs, header=header)
    if statistics_path is None:
        return ego
    try:
        statistics = load_statistics(statistics_path, policy.observation_space, trust)
    except ValueError:
        if stats is not None or not saw_originals(header):
            raise
        return replace(ego, left_out=statistics_path)
    if stats is None and saw_originals(header, statistics):
        return replace(ego, left_out=statistics_path)
    return replace(ego, statistics=statistics, statistics_path=statistics_path)


# --- statistics of VecNormalize -------------------------------------------------------------------


def find_statistics(path: Path) -> Path | None:
    """Return the file of the `VecNormalize` statistics of a model, or None."""
    return next((file for file in _list_places(path) if file.is_file()), None)


def _list_places(path: Path) -> Iterator[Path]:
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


def load_statistics(path: Path, observation_space: Any, trust: bool) -> Any:
    """Return the `VecNormalize` statistics of a file; trust runs whatever code is in it."""
    from stable_baselines3.common.vec_env import VecNormalize

    what = f"VecNormalize statistics {str(path)!r}"
    elsewhere = "move the file away if it does not belong to this ego"
    try:
        statistics = open_pickle(read_bytes(path, _MAX_STATISTICS), trust)
        if not isinstance(statistics, VecNormalize):
            raise TypeError(f"expected VecNormalize, got {type(statistics).__name__}")
        # what it has not without an environment, or does not normalise: its class would look for these forever
        vars(statistics).update(training=False, class_attributes={}, returns=np.zeros(1))
        vars(statistics).setdefault("obs_rms", None)
        check_space(statistics.observation_space)
        theirs, ours = statistics.observation_space.shape or (), observation_space.shape or ()
        fits = find_stacking(theirs, ours) is not None
        whole = not fits or _normalises(statistics)
    except ForbiddenObject as error:
        raise ValueError(f"Will not read the {what}: {error}; {TRUST}.") from error
    except Exception as error:  # a damaged pickle can raise anything at all
        raise ValueError(f"Cannot read the {what}: {one_line(error)}. Save them again, or {elsewhere}.") from error
    if not fits:
        raise ValueError(f"{what} are for observations of shape {theirs}, the ego's have {ours}; {elsewhere}.")
    if not whole:
        raise ValueError(f"{what} are damaged; save them again.")
    return statistics


def _normalises(statistics: Any) -> bool:
    """Return whether statistics normalise an observation to finite numbers of its shape."""
    seen = statistics.observation_space.sample()
    with np.errstate(all="ignore"):
        shown = statistics.normalize_obs(seen)
    if isinstance(seen, dict):
        return all(np.shape(shown[name]) == seen[name].shape and np.isfinite(shown[name]).all() for name in seen)
    return bool(np.shape(shown) == seen.shape and np.isfinite(shown).all())


def describe_missing_statistics(header: Mapping[str, Any], last: Any, own: Any, expected: Any) -> str:
    """Return why the last observations and the own space of a policy seem normalised; "" if nothing does."""
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
    return ""


def describe_other_kinematics(seen: NDArray[Any]) -> str:
    """Return which setting of HighwayEnv's Kinematics is not its default in observations (B, 5, 5); "" if none is."""
    ego, others = seen[:, 0], seen[:, 1:][seen[:, 1:, 0] > 0]
    if np.abs(seen).max() > 1.0 + _BEYOND:
        return "not normalised (normalize)" if np.abs(ego[:, 3:]).max() > 1.0 + _BEYOND else "not clipped (clip)"
    if not np.isin(seen[..., 0], (0, 1)).all() or ego[:, 3].max() > _FASTEST:
        return "of other features than presence, x, y, vx, vy (features)"
    if len(others) and others[:, 3].min() > ego[:, 3].max() / 2 > 0:  # relative speeds that are as large are not found
        return "not relative to the ego (absolute)"
    if len(others) and others[:, 1].min() < -BEHIND / VIEW - _APART:
        return "of vehicles behind the ego too (see_behind)"
    far = np.where(seen[:, 1:, 0] > 0, np.abs(seen[:, 1:, 1]), np.inf)
    return "not sorted by distance (order)" if (far[:, 1:] < far[:, :-1] - _APART).any() else ""


def _has_original_observations(header: Mapping[str, Any], last: Any) -> bool:
    """Return whether a file keeps observations from before `VecNormalize`; with a replay buffer, by their scale."""
    if header.get(ORIGINAL) is None or not _keeps_replays(header):
        return header.get(ORIGINAL) is not None
    original = _open_observation(header, ORIGINAL)
    if isinstance(original, dict) and isinstance(last, dict):
        return any(_is_rescaled(last[key], original[key]) for key in original.keys() & last.keys())
    return _is_rescaled(last, original)


def _keeps_replays(header: Mapping[str, Any]) -> bool:
    """Return whether an algorithm has a replay buffer: then it keeps original observations without `VecNormalize` too.

    Of `VecNormalize` they are those of the last step, else of the one before; without a buffer, of the first step.
    """
    return "learning_starts" in header


def saw_originals(header: Mapping[str, Any], statistics: Any = None) -> bool:
    """Return whether a file says that its policy was trained on observations as they are, without `VecNormalize`.

    With a replay buffer the last observations are then nearer to the original ones than to those behind statistics.
    """
    last = _open_observation(header, LAST)
    if last is None or ORIGINAL not in header:  # never trained, or it does not tell
        return False
    if header[ORIGINAL] is None or not _keeps_replays(header):
        return header[ORIGINAL] is None
    original = _open_observation(header, ORIGINAL)
    if _has_original_observations(header, last) or original is None:
        return False
    return statistics is None or _distance(last, original) < _distance(last, _normalise(original, statistics))


def describe_foreign_statistics(header: Mapping[str, Any], statistics: Any, own: Any) -> str:
    """Return why statistics seem not to be those of a policy with its own space, by its file; "" if nothing says so."""
    if not statistics.norm_obs:
        return ""
    if saw_originals(header, statistics):
        return "its file says that it was trained without VecNormalize"
    theirs, (last, original) = statistics.observation_space, (_open_observation(header, at) for at in (LAST, ORIGINAL))
    if isinstance(own, spaces.Box) and isinstance(theirs, spaces.Box) and own.shape == theirs.shape and own != theirs:
        return "they are of an environment whose observations have other bounds"
    if original is None or last is None:
        return ""
    expected = _normalise(original, statistics)
    if _keeps_replays(header) and _distance(last, expected) > _STEP:
        return "they do not lead from the original to the last observations of its training"
    if isinstance(expected, np.ndarray) and _distance(expected, np.zeros_like(expected)) > OUTLYING:
        return f"the first observations of its training are over {OUTLYING:g} standard deviations off"
    return ""


def _normalise(original: Any, statistics: Any) -> Any:
    """Return observations behind statistics; None where they are of another shape."""
    try:
        return statistics.normalize_obs(original)
    except Exception:  # they are of another environment
        return None


def _distance(one: Any, other: Any) -> float:
    """Return the median over rows of the largest difference of observations; infinite where their shapes differ."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return max(_distance(one[key], other[key]) for key in one)
    if not isinstance(one, np.ndarray) or not isinstance(other, np.ndarray) or one.shape != other.shape or not one.size:
        return np.inf
    return float(np.median(np.abs(one.astype(float) - other.astype(float)).reshape(len(one), -1).max(axis=1)))


def _is_rescaled(last: Any, original: Any) -> bool:
    """Return whether most rows of `last` are far from those of `original`, in no column equal and other than 0."""
    if not isinstance(last, np.ndarray) or not isinstance(original, np.ndarray) or last.shape != original.shape:
        return False
    if not last.size or last.dtype.kind != "f" or original.dtype.kind != "f":
        return False
    before, after = original.reshape(len(original), -1), last.reshape(len(last), -1)
    kept = ((before == after) & (before != 0.0)).any(axis=1)
    return bool(np.median(~kept & (np.abs(after - before).max(axis=1) > _STEP)) > 0.5)


def _open_observation(header: Mapping[str, Any], name: str) -> Any:
    """Return the observations in an entry of a file's settings; None if there are none."""
    entry = header.get(name)
    try:
        return open_pickle(base64.b64decode(str(entry[":serialized:"]))) if isinstance(entry, dict) else None
    except Exception:  # nothing depends on it but a warning
        return None


# --- the Hugging Face Hub -------------------------------------------------------------------------


def find_hub_model(text: str, download: bool = True) -> Path | None:
    """Return the file of a policy "hf:USER/REPOSITORY"; None if it is not in the cache and nothing is to be downloaded.

    A model with its statistics in the Hub's cache is taken without a connection. Whatever else is there may be part of
    a repository (huggingface_sb3's `load_from_hub` keeps the `.zip` alone) and is completed at the commit that is
    there, so that a resumed run keeps its ego.
    """
    found = _HUB_NAME.fullmatch(text)
    if found is None:
        raise ValueError(f"Expected hf:USER/REPOSITORY, and /FILE.zip or @REVISION behind it if need be, got {text!r}.")
    user, repository, file, revision = found.groups()
    try:
        import huggingface_hub
    except ImportError as error:
        if not download:
            return None
        raise ValueError(
            f"{text!r} needs huggingface_hub: {advise_install('hub')}, or download the .zip yourself and name it."
        ) from error

    def fetch(revision: str | None, **how: Any) -> Path:
        kinds, place = ["*.zip", "*.pkl"], f"{user}/{repository}"
        return Path(huggingface_hub.snapshot_download(place, revision=revision, allow_patterns=kinds, **how))

    try:
        cached = fetch(revision, local_files_only=True)
    except Exception:  # it is not there, or only in part
        cached = None
    model = None if cached is None else _choose_model(cached, repository, file)
    if not download or (model is not None and find_statistics(model) is not None):
        return model
    try:
        snapshot = fetch(revision if cached is None else cached.name)
    except Exception as error:  # of the connection, of the library, or there is no such repository
        raise ValueError(f"Cannot download {text!r}: {one_line(error)}") from error
    chosen = _choose_model(snapshot, repository, file)
    if chosen is None:
        names = ", ".join(_list_models(snapshot)) or "none"
        raise ValueError(f"Expected a model as hf:{user}/{repository}/FILE.zip for {text!r}; its files are {names}.")
    return chosen


def _choose_model(snapshot: Path, repository: str, file: str | None) -> Path | None:
    """Return the model of a snapshot: the one that is named, or that has the repository's name, or the only one."""
    models = _list_models(snapshot)
    wanted = file or f"{repository}.zip"
    if wanted in models:
        return snapshot / wanted
    return snapshot / models[0] if file is None and len(models) == 1 else None


def _list_models(snapshot: Path) -> list[str]:
    """Return the names of the models in a folder."""
    return sorted(path.name for path in snapshot.glob("*.zip") if path.name not in _NOT_MODELS)
