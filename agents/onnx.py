"""ONNX files as egos, graphs from observations to actions with or without a memory, and exports of policies to them.

Stable-Baselines3's own export has the bare network. Here normalisation of observations, frames stacked behind it, the
squashed or clipped action and a recurrent policy's memory are part of the graph.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Collection, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from agents.files import MAX_NETWORK_BYTES, report_missing_file
from agents.saved_ego import SavedEgo
from rare_envs.control.actions import DISCRETE_ACTIONS
from rare_envs.egos.needs import read_output
from rare_envs.files import open_ordinary, replace_file
from rare_envs.plugins import one_line
from rare_envs.startup import advise_install

_MOST_ENTRIES = 2**24
"""Numbers of an input, of one row or of as many as the file fixes."""
METADATA_KEY = "rare_envs"
"""Entry of a file's metadata in which `export_onnx` describes observations and actions."""
_TYPES = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
}
_MASK_TYPES = {**_TYPES, "tensor(bool)": np.bool_, "tensor(int8)": np.int8, "tensor(int64)": np.int64}
_MASK = re.compile(r"action_masks?")
"""Inputs that say which actions are allowed, in files of ML-Agents and sb3-contrib."""
_ACTIONS = re.compile(r"(.*[_.])?actions?", re.IGNORECASE)
"""Names of actions, in files of Stable-Baselines3, ML-Agents and Isaac Lab."""
_TURNS = {"next", "new", "prev", "previous", "in", "out", "ins", "outs", "input", "output", "last"}
"""Words by which the names of a memory before and after a tick differ."""
_LEAST_PIXELS = 16
"""A shorter first axis of three is that of colours, if the others are no shorter."""
_TRIED_SIZES = (2, 3)
"""Batches on which a file is tried when it is read; one that takes both takes any."""
ACTION_TOLERANCE = 1e-5
"""Largest difference between actions of the policy and of its export: single precision rounds by about 1e-7 in each of
a few layers."""
TRIAL_TICKS, TRIAL_BATCHES = 20, (1, 7, 64)
"""Ticks and batch sizes of the comparison: a memory builds up, and sizes differ from that of the trace."""
TRIAL_RANGE = 10.0
"""Observations of the comparison lie within +-this where a space has wider bounds: VecNormalize clips there."""


class OnnxEgo:
    """A policy in an ONNX file, run by onnxruntime on the CPU.

    The observations are the input named obs..., else the first: shape (B, ...), of pictures with the channels first or
    last. The actions are the output named so, else the only one of their form: (B, 2) in [-1, 1] (acceleration and
    steering, clipped by the environment), (B,) or (B, 1) integers, or (B, 5) scores of which the best counts. Further
    inputs are a memory, and so are the outputs of like names (the actions too), or else as many further outputs in the
    same order: zeros at the start of an episode, then what the output of the tick before was. Masks of actions allow
    all. Other outputs, such as values, are left alone. A batch size that the file fixes is kept to, in portions.
    """

    def __init__(self, path: Path) -> None:
        """Read the file and try it on blank observations; refuse a graph of another form."""
        if not path.exists():
            raise report_missing_file(path)
        open_ordinary(path, MAX_NETWORK_BYTES).close()
        try:
            import onnxruntime
        except ImportError as error:
            raise ValueError(f"{str(path)!r} needs onnxruntime: {advise_install('onnx')}.") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # its errors are raised, too
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own exceptions have no common class
            raise ValueError(f"Cannot load {str(path)!r} as ONNX: {one_line(error)}.") from error
        self.path, inputs, outputs = path, self._session.get_inputs(), self._session.get_outputs()
        for port in inputs:
            if math.prod(size for size in port.shape if isinstance(size, int)) > _MOST_ENTRIES:
                at_most = f"of at most {_MOST_ENTRIES:,} numbers, got {port.shape}"
                raise ValueError(f"Expected input {port.name!r} of {str(path)!r} to be {at_most}.")
        self._masks = [port for port in inputs if _MASK.fullmatch(port.name)]
        inputs = [port for port in inputs if port not in self._masks]
        if not inputs or not outputs:
            raise ValueError(f"Expected {str(path)!r} to have an input (observations) and an output (actions).")
        self._inputs = sorted(inputs, key=lambda port: not port.name.lower().startswith("obs"))
        batch = next(iter(self._inputs[0].shape), None)
        self._axes = [_find_batch_axis(port, batch, path) for port in self._inputs]
        memories = [_name_part(port) for port in self._inputs[1:]]
        actions = _choose_actions(outputs, memories, path)
        others = [port for port in outputs if port != actions]
        self._outputs = [actions, *_pair_memory(self._inputs[1:], others, actions, path)]
        self.fixed_batch: int | None = None
        self._tried = self._try_sizes(batch)
        shape = self._blank(0)[0].shape[1:]
        self._channels_first = len(shape) == 3 and shape[0] < _LEAST_PIXELS <= min(shape[1:])
        shape = (*shape[1:], shape[0]) if self._channels_first else shape
        self.observation_space = spaces.Box(-np.inf, np.inf, shape, np.float32)  # the file tells no bounds

    @cached_property
    def action_space(self) -> spaces.Space[Any] | None:
        """Space of one action, as `export_onnx` described it or by its form; None if the file does not tell."""
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY, "{}")
        try:
            action = json.loads(text)["action"]
            if "n" in action:
                return spaces.Discrete(int(action["n"]))
            return spaces.Box(np.float32(action["low"]), np.float32(action["high"]), dtype=np.float32)
        except (ValueError, TypeError, KeyError):  # a file from elsewhere
            if _are_scores(self._tried.shape):
                return spaces.Discrete(len(DISCRETE_ACTIONS))
            numbers = self._tried.dtype.kind == "f"
            return spaces.Box(-np.inf, np.inf, self._tried.shape[1:], np.float32) if numbers else None

    @property
    def notes(self) -> tuple[str, ...]:
        """Which output is taken as the actions if there are others than a memory, and what masks are."""
        file, taken = self.path.name, [port.name for port in self._outputs]
        others = [port.name for port in self._session.get_outputs() if port.name not in taken]
        chosen = f"the output {taken[0]!r} of {file} is taken as the actions, not {', '.join(map(repr, others))}"
        masks = [f"the input {port.name!r} of {file} allows every action" for port in self._masks]
        return (*([chosen] if others else []), *masks)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch; see `agents.Ego.predict`. The graph is always deterministic."""
        observation = np.asarray(observation)
        if self._channels_first:
            observation = np.moveaxis(observation, -1, 1)
        memory = self._blank(len(observation))[1:] if state is None else state
        if state is not None and episode_start is not None and np.any(episode_start):
            anew = np.asarray(episode_start, dtype=bool)
            memory = [np.where(anew.reshape(-1, *[1] * (part.ndim - 1)), 0, part) for part in memory]
        action, *memory = self._run([observation, *memory])
        return read_output(action), tuple(memory) or None

    def _blank(self, rows: int) -> list[NDArray[Any]]:
        """Return inputs of zeros for so many rows, which are along the first axis."""
        shapes = [[size for at, size in enumerate(port.shape) if at != axis] for port, axis in self._ports]
        return [np.zeros((rows, *shape)) for shape in shapes]

    @property
    def _ports(self) -> Iterator[tuple[Any, int]]:
        """The inputs, each with the axis of its rows."""
        return zip(self._inputs, self._axes, strict=True)

    def _try_sizes(self, batch: Any) -> NDArray[Any]:
        """Find the batch size that the file fixes, if any, and return actions; refuse a file that answers to none."""
        declared = [size for port in self._outputs for size in port.shape[:1] if isinstance(size, int)]
        fixed = [batch] if isinstance(batch, int) else [None, *declared, 1]
        found = list[Exception]()
        for self.fixed_batch in fixed:
            try:
                for size in _TRIED_SIZES:
                    action, *_ = self._run(self._blank(size))
                return action
            except Exception as error:  # likewise
                found.append(error)
        raise ValueError(f"Cannot run {str(self.path)!r} on a batch of blank observations: {one_line(found[0])}.")

    def _run(self, values: list[NDArray[Any]]) -> list[NDArray[Any]]:
        """Return the outputs for all rows, in portions if the file fixes the batch size; the last row fills up."""
        rows = len(values[0])
        size = self.fixed_batch or rows
        portions = []
        for first in range(0, max(rows, 1), max(size, 1)):
            taken = np.arange(first, first + size).clip(max=rows - 1)
            feed = {
                port.name: np.ascontiguousarray(np.moveaxis(value[taken], 0, axis), _TYPES[port.type])
                for value, (port, axis) in zip(values, self._ports, strict=True)
            }
            feed |= {port.name: np.ones((size, *port.shape[1:]), _MASK_TYPES[port.type]) for port in self._masks}
            parts = self._session.run([port.name for port in self._outputs], feed)
            portions.append(
                [np.moveaxis(part, axis, 0) for part, axis in zip(parts, (0, *self._axes[1:]), strict=True)]
            )
            for port, part in zip(self._outputs, portions[-1], strict=True):
                if len(part) != size:
                    raise ValueError(f"the output {port.name!r} has shape {part.shape} for {size} rows")
        return [np.concatenate(parts)[:rows] for parts in zip(*portions, strict=True)]


def _find_batch_axis(port: Any, batch: Any, path: Path) -> int:
    """Return the axis of an input along which its rows are, the one of no fixed size, if any; else a ValueError."""
    free = [axis for axis, size in enumerate(port.shape) if not isinstance(size, int)]
    rows = batch if isinstance(batch, int) else 1
    free = free or [axis for axis, size in enumerate(port.shape[:2]) if size == rows][:1]
    if port.type not in _TYPES or len(port.shape) < 2 or len(free) != 1:
        raise ValueError(
            f"Expected input {port.name!r} of {str(path)!r} to be numbers of shape (batch, fixed sizes), got "
            f"{port.type} {port.shape}."
        )
    return free[0]


def _choose_actions(outputs: Sequence[Any], memories: Sequence[tuple[str, ...]], path: Path) -> Any:
    """Return the output that has the actions: the one named so (means first), else the only one of their form.

    Outputs named like an input of a memory are set aside, but "actions" beside "prev_actions" are the actions.
    """
    free = [port for port in outputs if _name_part(port) not in memories]
    named = [port for port in outputs if _ACTIONS.fullmatch(port.name)]
    sure = [port for port in named if port in free or _name_part(port) == _name_part(port, dropped=())]
    sure.sort(key=lambda port: "deterministic" not in port.name)

    def fits(port: Any) -> bool:
        sizes = list((port.shape or [])[1:])
        return sizes in ([], [1]) if "int" in port.type else sizes == [2] or _are_scores(port.shape or [])

    fitting = sure or [*named, *filter(fits, free)] or free or list(outputs)
    if not sure and len(fitting) > 1:
        raise ValueError(
            f"Expected one output of {str(path)!r} to be the actions, got {', '.join(port.name for port in fitting)}; "
            "export it with one, named actions (the mean of PPO, tanh of SAC's)."
        )
    return fitting[0]


def _pair_memory(inputs: Sequence[Any], outputs: Sequence[Any], actions: Any, path: Path) -> list[Any]:
    """Return the outputs that inputs of a memory come from, by their names but for "next", say, or by their order."""
    named = [actions] if _ACTIONS.fullmatch(actions.name) else []
    for ending in ("", r"\d+|n?s?|x"):  # h0 and c0 become h1 and c1, hn and cn; prev_action is of actions
        by_name = {_name_part(port, ending): port for port in (*named, *outputs)}
        found = {_name_part(port, ending): by_name.get(_name_part(port, ending)) for port in inputs}
        if None not in found.values() and len(found) == len(inputs):
            return [*found.values()]
    if len(inputs) != len(outputs):
        names = " and ".join(str([port.name for port in ports]) for ports in (inputs, outputs))
        raise ValueError(
            f"Expected {str(path)!r} to have one input (observations) and one output (actions), and after them a "
            f"memory, as many inputs as outputs or of like names; got {names} beside the first."
        )
    return list(outputs)


def _name_part(port: Any, ending: str = "", dropped: Collection[str] = _TURNS) -> tuple[str, ...]:
    """Return the words of a name of a memory, without those and endings that tell its input and output apart."""
    words = re.split(r"[^a-z0-9]+", port.name.lower())
    return tuple(re.sub(rf"(?<=.)({ending})$", "", word) for word in words if word not in dropped)


def _are_scores(shape: Any) -> bool:
    """Return whether an output of a shape (B, ...) holds one score for each discrete action."""
    return list(shape[1:]) == [len(DISCRETE_ACTIONS)]


# --- export -------------------------------------------------------------------------------------------


class _Graph(nn.Module):
    """The graph: raw observations and memory to actions and memory, batch first throughout."""

    def __init__(self, ego: SavedEgo) -> None:
        super().__init__()
        self.policy = ego.policy
        self.policy.set_training_mode(False)
        self.recurrent = hasattr(self.policy, "lstm_actor")  # sb3_contrib's policies have no common class
        self.frames = 1 if ego.frames is None else ego.frames[0]
        self.mean: Tensor | None = None
        statistics = ego.statistics
        if statistics is not None and statistics.norm_obs:
            self.mean = torch.as_tensor(statistics.obs_rms.mean, dtype=torch.float64)
            self.scale = torch.as_tensor(np.sqrt(statistics.obs_rms.var + statistics.epsilon), dtype=torch.float64)
            self.clip = float(statistics.clip_obs)

    def memory(self, features: int, batch: int) -> list[Tensor]:
        """Return a memory of zeros for observations (B, features)."""
        parts = []
        if self.frames > 1:
            parts.append(torch.zeros(batch, (self.frames - 1) * features))
        if self.recurrent:
            layers, _, hidden = self.policy.lstm_hidden_state_shape
            parts += [torch.zeros(batch, layers, hidden), torch.zeros(batch, layers, hidden)]
        return parts

    def forward(self, observation: Tensor, *memory: Tensor) -> tuple[Tensor, ...]:
        """Return the action and the new memory."""
        seen = observation
        if self.mean is not None:  # in double precision, as VecNormalize does
            seen = ((seen.double() - self.mean) / self.scale).clamp(-self.clip, self.clip).float()
        carried: tuple[Tensor, ...] = ()
        if self.frames > 1:
            seen = torch.cat((memory[0], seen), dim=1)
            carried = (seen[:, observation.shape[1] :],)
        if self.recurrent:
            states = (memory[-2].transpose(0, 1).contiguous(), memory[-1].transpose(0, 1).contiguous())
            starts = torch.zeros(seen.shape[0])  # a memory of zeros is what an episode starts with
            action, states = self.policy._predict(seen, states, starts, deterministic=True)
            carried = (*carried, *(state.transpose(0, 1) for state in states))
        else:
            action = self.policy._predict(seen, deterministic=True)
        return (self._finish_action(action), *carried)

    def _finish_action(self, action: Tensor) -> Tensor:
        """Return the action as `predict` gives it: unsquashed or clipped to the space."""
        space = self.policy.action_space
        if not isinstance(space, spaces.Box):
            return action
        low, high = torch.as_tensor(space.low), torch.as_tensor(space.high)
        if self.policy.squash_output:
            return low + 0.5 * (action + 1.0) * (high - low)
        return torch.minimum(torch.maximum(action, low), high)


def export_onnx(ego: SavedEgo, path: Path, seed: int = 0) -> tuple[float, int]:
    """Write a policy as ONNX, if over several ticks and batch sizes of random observations it acts as the policy.

    Return the largest difference of actions, and the number of observations that were compared.
    """
    try:
        import onnx
    except ImportError as error:
        raise ValueError(f"Exporting needs onnx and onnxruntime: {advise_install('onnx')}.") from error
    space, action = ego.observation_space, ego.action_space
    if not isinstance(space, spaces.Box) or (ego.frames is not None and (ego.frames[1] or len(space.shape) != 1)):
        raise ValueError(f"Cannot export a policy that observes {space}; expected one Box of numbers.")
    discrete = isinstance(action, spaces.Discrete)
    bounds = {"n": int(action.n)} if discrete else {"low": action.low.tolist(), "high": action.high.tolist()}
    description = {"algorithm": ego.algorithm, "observation": list(space.shape), "action": bounds}
    with replace_file(path) as draft:
        _trace(ego, draft)
        model = onnx.load(str(draft))
        model.metadata_props.add(key=METADATA_KEY, value=json.dumps(description))
        onnx.save(model, str(draft))
        difference, count = compare_actions(ego, OnnxEgo(draft), np.random.default_rng(seed))
        if not difference <= ACTION_TOLERANCE:
            raise ValueError(f"The exported graph acts differently, by up to {difference:.2g}; nothing was written.")
    return difference, count


def _trace(ego: SavedEgo, path: Path) -> None:
    """Write the graph by tracing; `compare_actions` checks it."""
    graph, space = _Graph(ego).eval(), ego.observation_space
    memory = graph.memory(space.shape[0], 2)
    names = [f"memory_{part}" for part in range(len(memory))]
    inputs, outputs = ["observation", *names], ["action", *(f"next_{name}" for name in names)]
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tracer warns of branches that do not depend on the observation
        try:
            torch.onnx.export(
                graph,
                (torch.zeros(2, *space.shape), *memory),
                path,
                input_names=inputs,
                output_names=outputs,
                dynamic_axes={port: {0: "batch"} for port in (*inputs, *outputs)},
                dynamo=False,
            )
        except Exception as error:  # torch has many, without a common class
            raise ValueError(f"Cannot export a policy of class {type(ego.policy).__name__}: {error}") from error


def compare_actions(policy: Any, other: Any, rng: np.random.Generator) -> tuple[float, int]:
    """Return the largest difference of two egos' actions on random observations, and their number; each remembers."""
    space, worst, count = policy.observation_space, 0.0, 0
    low, high = (np.clip(bound, -TRIAL_RANGE, TRIAL_RANGE) for bound in (space.low, space.high))
    for batch in TRIAL_BATCHES:
        states: list[Any] = [None, None]
        for tick in range(TRIAL_TICKS):
            observation = rng.uniform(low, high, (batch, *space.shape)).astype(np.float32)
            actions = []
            for which, ego in enumerate((policy, other)):
                action, states[which] = ego.predict(observation, states[which], np.full(batch, tick == 0), True)
                actions.append(np.asarray(action, dtype=np.float64))
            worst, count = max(worst, float(np.abs(actions[0] - actions[1]).max())), count + batch
    return worst, count
