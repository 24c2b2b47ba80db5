"""Checkpoints of trainings: files of tensors, numbers and text only, which are read without running code.

That of an ego holds everything that decides the further course of its training, so that a resumed one ends alike: the
model with its optimisers, counters and replay buffer, the batch of episodes that is under way, and the states of all
random generators.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rare_envs.files import open_ordinary, replace_file
from rare_envs.plugins import one_line

CHECKPOINT_FORMAT = 4
"""Version of the file."""
COUNTERS = "num_timesteps _n_updates _episode_num _n_calls exploration_rate _current_progress_remaining".split()
"""Attributes of a model that count, where its algorithm has them."""


class TrainingInterrupted(KeyboardInterrupt):
    """A training was interrupted; the message says what is kept and how to go on."""


def write_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Write the state of a training; an interruption or an OSError leaves the file of before."""
    try:
        with replace_file(path) as draft:
            torch.save(state, draft)
    except RuntimeError as error:  # torch's word for a full disk
        raise OSError(f"Cannot write {str(path)!r}: {one_line(error)}") from error


def read_checkpoint(path: Path, entries: Sequence[str], device: torch.device | str = "cpu") -> dict[str, Any]:
    """Return the state that `write_checkpoint` wrote, which is to have some entries; a ValueError if it is damaged."""
    try:
        open_ordinary(path).close()
        state: dict[str, Any] = torch.load(path, weights_only=True, map_location=device)
        if not state.keys() >= {*entries}:
            raise ValueError("it lacks some of the state")
    except Exception as error:  # a damaged file can raise anything at all
        raise ValueError(f"Cannot resume {str(path)!r}: it is damaged or no checkpoint; remove it.") from error
    return state


def save_checkpoint(path: Path, arguments: Mapping[str, Any], model: Any) -> None:
    """Write a checkpoint of a model in a `training.sb3_vec_env` at a rollout's beginning, with JSON-ready arguments."""
    monitor = model.get_env()
    names, variables = model._get_torch_save_params()
    state = {
        "format": CHECKPOINT_FORMAT,
        "arguments": json.dumps(arguments, sort_keys=True),
        "parameters": {name: attrgetter(name)(model).state_dict() for name in names},
        "variables": {name: value.detach() for name in variables if (value := attrgetter(name)(model)) is not None},
        "counters": {name: float(vars(model)[name]) for name in COUNTERS if name in vars(model)},
        "last": [_to_tensors(model._last_obs), _to_tensors(model._last_episode_starts)],
        "replay": _replay_state(vars(model).get("replay_buffer")),
        "environments": [batch.unwrapped.export_state() for batch in monitor.venv.batches],
        "monitor": _to_tensors({"returns": monitor.episode_returns, "lengths": monitor.episode_lengths}),
        "generators": _generator_states(model),
    }
    write_checkpoint(path, state)


def load_checkpoint(path: Path, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Read a checkpoint of the training with these arguments; a ValueError if it is another's, or damaged."""
    state = read_checkpoint(path, ("arguments", "format"))
    version = state["format"]
    try:
        begun = dict(json.loads(state["arguments"]))
    except (ValueError, TypeError) as error:
        raise ValueError(f"Cannot resume {str(path)!r}: it is damaged or no checkpoint; remove it.") from error
    if version != CHECKPOINT_FORMAT:
        raise ValueError(f"{str(path)!r} is a checkpoint of another version of this program; remove it.")
    given = json.loads(json.dumps(arguments))
    other = sorted(name for name in {*begun, *given} if begun.get(name) != given.get(name))
    if other:
        was = ", ".join(f"{name}={begun.get(name)!r}" for name in other)
        raise ValueError(f"{str(path)!r} is of a training with other arguments ({was}); give the same, or remove it.")
    return state


def restore_model(model: Any, state: Mapping[str, Any]) -> None:
    """Bring a new model, whose environment has been reset once, to the state of a checkpoint, which has to fit."""
    try:
        for name, parameters in state["parameters"].items():
            attrgetter(name)(model).load_state_dict(parameters)
        for name, value in state["variables"].items():
            attrgetter(name)(model).data.copy_(value)
        for name, value in state["counters"].items():
            kind = type(vars(model)[name])
            setattr(model, name, kind(value))
        model._last_obs, model._last_episode_starts = (_to_arrays(one) for one in state["last"])
        _restore_replay(vars(model).get("replay_buffer"), state["replay"])
        monitor = model.get_env()
        for batch, episodes in zip(monitor.venv.batches, state["environments"], strict=True):
            batch.unwrapped.restore_state(episodes)
        monitor.episode_returns[:] = _to_arrays(state["monitor"])["returns"]
        monitor.episode_lengths[:] = _to_arrays(state["monitor"])["lengths"]
        _restore_generators(model, state["generators"])
    except (KeyError, RuntimeError, TypeError, AttributeError) as error:
        raise ValueError(
            f"The checkpoint is of another model ({error}): remove it, or train with its arguments."
        ) from error


def _to_tensors(value: Any) -> Any:
    """Return arrays, also in mappings, as tensors."""
    if isinstance(value, Mapping):
        return {name: _to_tensors(part) for name, part in value.items()}
    return torch.from_numpy(np.array(value))


def _to_arrays(value: Any) -> Any:
    """Return tensors, also in mappings, as arrays."""
    if isinstance(value, Mapping):
        return {name: _to_arrays(part) for name, part in value.items()}
    return value.numpy().copy()


def _replay_arrays(buffer: Any) -> dict[str, Any]:
    """Return views of the filled rows of the arrays of a replay buffer, those in mappings as "name/key"."""
    filled = buffer.buffer_size if buffer.full else buffer.pos
    nested = {name: value for name, value in vars(buffer).items() if isinstance(value, dict)}
    parts = {f"{name}/{key}": part for name, value in nested.items() for key, part in value.items()}
    return {name: part[:filled] for name, part in {**vars(buffer), **parts}.items() if isinstance(part, np.ndarray)}


def _replay_state(buffer: Any) -> dict[str, Any] | None:
    """Return the filled part of a replay buffer; None without one."""
    if buffer is None:
        return None
    return {"pos": buffer.pos, "full": buffer.full, **_to_tensors(_replay_arrays(buffer))}


def _restore_replay(buffer: Any, state: Mapping[str, Any] | None) -> None:
    if buffer is None or state is None:
        return
    buffer.pos, buffer.full = state["pos"], state["full"]
    for name, view in _replay_arrays(buffer).items():
        view[:] = state[name].numpy()


def _generator_states(model: Any) -> dict[str, Any]:
    """Return the states of the generators that a training draws from."""
    kind, key, *counts = np.random.get_state()  # noqa: NPY002  (Stable-Baselines3 draws from it)
    version, words, gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "numpy": [str(kind), _to_tensors(np.asarray(key, dtype=np.int64)), *(float(count) for count in counts)],
        "python": [version, list(words), gauss],
        "actions": json.dumps(model.action_space.np_random.bit_generator.state),
    }


def _restore_generators(model: Any, states: Mapping[str, Any]) -> None:
    torch.set_rng_state(states["torch"])
    kind, key, position, has_gauss, gauss = states["numpy"]
    np.random.set_state((kind, key.numpy().astype(np.uint32), int(position), int(has_gauss), gauss))  # noqa: NPY002
    version, words, spare = states["python"]
    random.setstate((version, tuple(words), spare))
    model.action_space.np_random.bit_generator.state = json.loads(states["actions"])
