"""The `.zip` of a Stable-Baselines3 policy: its settings, its algorithm, and the model built from it without its code.

The archive has a member `data`: JSON with simple values as they are and other values as
`{":type:": ..., "__module__": ..., ":serialized:": <pickle>}`, and members `*.pth` with tensors. Names of settings and
the policy's module are enough to tell the algorithms apart. The pickles are opened by `agents.safe_pickle`, the
tensors by torch's own reader of weights; what they hold goes to Stable-Baselines3 in a new archive of our own. The file
also says how large the networks are, and Stable-Baselines3 builds them before it compares them with the tensors, so a
network of more numbers than the file holds is refused as it is built.
"""

from __future__ import annotations

import base64
import io
import json
import math
import pickle
import pkgutil
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import torch
from gymnasium import spaces
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from agents.safe_pickle import ForbiddenObject, open_pickle, require
from rare_envs.plugins import did_you_mean


class Algorithm(NamedTuple):
    """Where an algorithm is, and how its files are known: by the module of their policy, or by a setting."""

    package: str
    name: str
    policies: tuple[str, ...] = ()
    """Beginnings of the policy's module; "common" policies serve several."""
    setting: str = ""
    """One that only this algorithm has, of those that come later here."""


ALGORITHMS = {
    "ppo": Algorithm("stable_baselines3", "PPO", (), "clip_range"),
    "tqc": Algorithm("sb3_contrib", "TQC", ("sb3_contrib.tqc.",), "top_quantiles_to_drop_per_net"),
    "trpo": Algorithm("sb3_contrib", "TRPO", (), "cg_max_steps"),
    "ars": Algorithm("sb3_contrib", "ARS", ("sb3_contrib.ars.",), "n_delta"),
    "td3": Algorithm("stable_baselines3", "TD3", ("stable_baselines3.td3.",), "target_policy_noise"),
    "ddpg": Algorithm("stable_baselines3", "DDPG"),  # TD3 with other settings, which acts alike
    "sac": Algorithm("stable_baselines3", "SAC", ("stable_baselines3.sac.",), "target_entropy"),
    "dqn": Algorithm("stable_baselines3", "DQN", ("stable_baselines3.dqn.",), "exploration_initial_eps"),
    "a2c": Algorithm("stable_baselines3", "A2C", (), "gae_lambda"),  # on-policy, and none of the above
    "recurrent_ppo": Algorithm(
        "sb3_contrib", "RecurrentPPO", ("sb3_contrib.common.recurrent.", "sb3_contrib.ppo_recurrent.")
    ),
    "maskable_ppo": Algorithm("sb3_contrib", "MaskablePPO", ("sb3_contrib.common.maskable.", "sb3_contrib.ppo_mask.")),
    "qrdqn": Algorithm("sb3_contrib", "QRDQN", ("sb3_contrib.qrdqn.",)),
    "crossq": Algorithm("sb3_contrib", "CrossQ", ("sb3_contrib.crossq.",)),
}
MAX_UNPACKED, MAX_RATIO = 64 * 2**20, 20
"""Bytes that any archive may unpack to, and the factor by which a larger one may grow: Stable-Baselines3 stores its
members uncompressed, so 20 refuses no policy."""
MAX_VALUES = 1_000_000
"""Values in the settings of a model."""
MAX_OBSERVED = 2**22
"""Most numbers of an observation, and most actions to choose from."""
SPARE_NUMBERS, SPARE_TENSORS = 2**24, 10_000
"""Numbers and tensors that building may take beside a multiple of those in the file: buffers, initial values."""
_PER_HELD = 8
"""Numbers and tensors that building may take for each in the file (networks, initial values, optimisers), and bytes of
tensors for each byte of a member, which tensors may share."""
_FACTORY = re.compile(
    r"aten\.(new_)?(empty|zeros|ones|full|rand|randn|randint|arange|eye|randperm|linspace)(_strided)?\b"
)
"""Operations of torch that make a tensor of a size that they are told."""
_STATE_MEMBER = re.compile(r"(?!pytorch_variables|tensors)[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*\.pth")
"""Members with tensors, but for those that only training needs."""


class ArchiveTooLarge(ValueError):
    """An archive that would take far more memory than its own size."""


def read_header(file: Path | BinaryIO, name: str | None = None) -> dict[str, Any]:
    """Return the settings of a saved model, their pickles closed, and "version" (of Stable-Baselines3).

    The file exists, or is its content; its name in messages is the path when None.
    """
    name = str(file) if name is None else name
    if not zipfile.is_zipfile(file):
        raise ValueError(f"{name!r} is not a zip file (or is cut short); expected a model saved by Stable-Baselines3.")
    try:
        with zipfile.ZipFile(file) as archive:
            _check_size(archive, name)
            members = set(archive.namelist())
            header = _parse_settings(archive.read("data"), name) if "data" in members else None
            version = "_stable_baselines3_version"
            version = archive.read(version).decode().strip() if version in members else "unknown"
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
    """Return the JSON of the settings, unless it has more values than any policy: each takes some 100 bytes."""
    if content.count(b",") + content.count(b"[") + content.count(b"{") > MAX_VALUES:
        raise ArchiveTooLarge(f"{name!r} has more than {MAX_VALUES:,} values in its settings; no policy does that.")
    return json.loads(content)


def find_algorithm(header: Mapping[str, Any], path: Path) -> str:
    """Return the name of the algorithm of a saved model, one of `ALGORITHMS`, from its settings."""
    policy = header.get("policy_class")
    module = str(policy.get("__module__", "")) if isinstance(policy, dict) else ""
    by_module = [name for name, each in ALGORITHMS.items() if module.startswith(each.policies)]
    by_setting = [name for name, each in ALGORITHMS.items() if each.setting and each.setting in header]
    for name in (*by_module, *by_setting):
        return name
    raise ValueError(
        f"Cannot tell which algorithm saved {str(path)!r} (policy from {module or 'unknown'!r}); "
        f"name it with algo: {', '.join(ALGORITHMS)}."
    )


def find_algorithm_class(name: str, path: Path) -> Any:
    """Return the class of an algorithm, with its `load`, for a file."""
    if name not in ALGORITHMS:
        hint = did_you_mean(name, ALGORITHMS)
        raise ValueError(f"Unknown algorithm {name!r}{hint}; expected one of {', '.join(ALGORITHMS)}.")
    found = ALGORITHMS[name]
    try:
        return pkgutil.resolve_name(f"{found.package}:{found.name}")
    except ImportError as error:
        raise ValueError(
            f"{str(path)!r} holds {found.name}, which needs a package that is not installed: pip install sb3-contrib."
        ) from error


def make_training_stubs() -> dict[str, Any]:
    """Return stand-ins for the entries that only training needs, as `custom_objects` of `load`.

    Those pickles break between versions of Python, a replay buffer would allocate its full memory, and a seed would
    reset the global generators. Entries that a model lacks are ignored.
    """
    schedules = ("lr_schedule", "clip_range_vf", "exploration_schedule", "delta_std_schedule")
    buffers = ("replay_buffer_class", "rollout_buffer_class", "ep_info_buffer", "ep_success_buffer")
    last = ("_last_obs", "_last_episode_starts", "_last_original_obs", "_last_lstm_states")
    return {
        **dict.fromkeys(("seed", "action_noise", "weights", *schedules, *buffers, *last)),
        "learning_rate": 0.0,
        "clip_range": 0.0,
        "n_envs": 1,
        "n_steps": 1,
        "train_freq": 1,
        "buffer_size": 1,
        "optimize_memory_usage": False,
        "replay_buffer_kwargs": {},
        "rollout_buffer_kwargs": {},
    }


def build_model(algorithm: Any, content: bytes, name: str) -> Any:
    """Return the model of a class in the content of a `.zip`, on the CPU; its name is for messages.

    `ForbiddenObject` is raised if it holds something that may run code, or builds more than it holds; anything if it is
    damaged.
    """
    given = make_training_stubs()
    given = {**_open_objects(read_header(io.BytesIO(content), name), set(given)), **given}
    for key in ("observation_space", "action_space"):
        _check_space(given.get(key))
    clean, held = _rewrite(content)
    numbers, tensors = sum(one.numel() for one in held), len(held)
    with _BoundedTensors(SPARE_NUMBERS + _PER_HELD * numbers, SPARE_TENSORS + _PER_HELD * tensors):
        return algorithm.load(clean, device="cpu", custom_objects=given)


def _open_objects(header: Mapping[str, Any], without: set[str]) -> dict[str, Any]:
    """Open the pickled entries of a model's settings safely; an error names the entry."""
    opened = {}
    for key, value in header.items():
        if key in without or not isinstance(value, dict) or ":serialized:" not in value:
            continue
        try:
            opened[key] = open_pickle(base64.b64decode(str(value[":serialized:"])))
        except ForbiddenObject as error:
            raise ForbiddenObject(f"in its {key!r} {error}") from error
    return opened


def _rewrite(content: bytes) -> tuple[io.BytesIO, list[Tensor]]:
    """Return an archive of the same settings and of tensors that have been read safely, and these tensors."""
    clean, held = io.BytesIO(), list[Tensor]()
    with zipfile.ZipFile(io.BytesIO(content)) as given, zipfile.ZipFile(clean, "w") as archive:
        for member in dict.fromkeys(given.namelist()):
            if member in ("data", "_stable_baselines3_version"):
                archive.writestr(member, given.read(member))
            if _STATE_MEMBER.fullmatch(member):
                try:
                    state = _read_tensors(given.read(member))
                except ForbiddenObject as error:
                    raise ForbiddenObject(f"in its {member!r} {error}") from error
                held += _find_tensors(state)
                with archive.open(member, "w") as file:
                    torch.save(state, file)
    clean.seek(0)
    return clean, held


def _read_tensors(content: bytes) -> Any:
    """Return what a `.pth` member holds: mappings, lists, plain values and tensors that fit into it, on the CPU."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        raise ValueError("its tensors are not in the format of torch 1.6 and later")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        infos = archive.infolist()
    stored = all(info.compress_type == zipfile.ZIP_STORED for info in infos)
    fits = stored and sum(info.file_size for info in infos) <= len(content)
    require(fits, "its tensors would unpack to more than the file holds")
    try:
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:  # whose message advises to load it unsafely
        raise ValueError("its tensors are damaged, or there is something else among them") from None
    size = sum(one.numel() * one.element_size() for one in _find_tensors(state))
    require(size <= _PER_HELD * len(content), "it holds tensors larger than their storage")
    return state


def _find_tensors(value: Any) -> Iterator[Tensor]:
    """Yield the tensors in mappings and lists."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for one in value.values() if isinstance(value, Mapping) else value:
            yield from _find_tensors(one)


class _BoundedTensors(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Mode in which torch makes no more tensors and numbers than a limit."""

    def __init__(self, numbers: int, tensors: int) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._numbers, self._tensors = numbers, tensors

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if _FACTORY.match(str(func)):
            self._tensors -= 1
            self._numbers -= max((_count_numbers(one) for one in args), default=0)
            within = self._numbers >= 0 and self._tensors >= 0
            require(within, "it describes networks of more numbers than it holds")
        return func(*args, **(kwargs or {}))


def _count_numbers(argument: Any) -> int:
    """Return the numbers of a tensor of which this is the shape or the length."""
    if isinstance(argument, list | tuple) and all(isinstance(size, int) for size in argument):
        return math.prod(argument)
    return argument if isinstance(argument, int) else 0


def _check_space(space: Any, depth: int = 0) -> None:
    """Refuse a space whose parts do not go together, or of which one element would fill the memory."""
    if isinstance(space, spaces.Dict) and depth == 0:
        for part in space.spaces.values():
            _check_space(part, 1)
        return
    if isinstance(space, spaces.Box):
        good = space.low.shape == space.high.shape == space.shape and space.low.size <= MAX_OBSERVED
    elif isinstance(space, spaces.Discrete):
        good = 0 < int(space.n) <= MAX_OBSERVED
    elif isinstance(space, spaces.MultiDiscrete):
        good = 0 < int(space.nvec.sum()) <= MAX_OBSERVED
    else:
        good = isinstance(space, spaces.MultiBinary) and 0 < math.prod(space.shape) <= MAX_OBSERVED
    require(good, f"its space is none that a policy could have ({type(space).__name__})")
