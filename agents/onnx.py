"""ONNX files as egos, graphs from observations to actions with or without a memory, and exports of policies to them.

Stable-Baselines3's own export has the bare network. Here normalisation of observations, frames stacked behind it, the
squashed or clipped action and a recurrent policy's memory are part of the graph.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from agents.files import report_missing_file
from agents.saved_ego import SavedEgo
from rare_envs.control.actions import DISCRETE_ACTIONS
from rare_envs.files import replace_file
from rare_envs.plugins import one_line

METADATA_KEY = "rare_envs"
"""Entry of a file's metadata in which `export_onnx` describes observations and actions."""
_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}
ACTION_TOLERANCE = 1e-5
"""Largest difference between actions of the policy and of its export: single precision rounds by about 1e-7 in each of
a few layers."""
TRIAL_TICKS, TRIAL_BATCHES = 20, (1, 7, 64)
"""Ticks and batch sizes of the comparison: a memory builds up, and sizes differ from that of the trace."""
TRIAL_RANGE = 10.0
"""Observations of the comparison lie within +-this where a space has wider bounds: VecNormalize clips there."""


class OnnxEgo:
    """A policy in an ONNX file, run by onnxruntime on the CPU.

    The first input is the observations, shape (B, ...), float or double. The first output is the actions: (B, 2) in
    [-1, 1] (acceleration and steering, clipped by the environment), (B,) or (B, 1) integers, or (B, 5) scores of which
    the best counts. Further inputs are a memory, as many as there are further outputs, in the same order: each of
    shape (B, ...), zeros at the start of an episode, then what the output of the tick before was. A batch size that
    the file fixes at 1 is respected, row by row.

    Attributes:
        path: The file.
        observation_space: From the file.
        action_space: From the file, None if it does not tell.

    Example:
        >>> import onnx
        >>> import tempfile
        >>> from onnx import helper
        >>> ports = [helper.make_tensor_value_info(name, 1, ["batch", 2]) for name in ("observation", "action")]
        >>> nodes = [helper.make_node("Tanh", ["observation"], ["action"])]
        >>> graph = helper.make_graph(nodes, "ego", ports[:1], ports[1:])
        >>> model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     onnx.save(model, f"{folder}/ego.onnx")
        ...     ego = OnnxEgo(Path(folder) / "ego.onnx")
        >>> ego.observation_space.shape, ego.stateful, ego.fixed_batch
        ((2,), False, None)
        >>> ego.predict(np.full((1, 2), 0.5))[0].round(3)
        array([[0.462, 0.462]], dtype=float32)
    """

    def __init__(self, path: Path) -> None:
        """Read the file.

        Raises:
            FileNotFoundError: It does not exist.
            ValueError: It is no ONNX graph, or not of this form, or onnxruntime is not installed.
        """
        if not path.is_file():
            raise report_missing_file(path)
        try:
            import onnxruntime
        except ImportError as error:
            raise ValueError(f"{str(path)!r} needs onnxruntime: pip install 'rare-envs[onnx]'.") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own exceptions have no common class
            raise ValueError(f"Cannot load {str(path)!r} as ONNX: {one_line(error)}.") from error
        self.path = path
        self._inputs, self._outputs = self._session.get_inputs(), self._session.get_outputs()
        self._check()

    def _check(self) -> None:
        """Refuse a graph whose inputs and outputs are of another form."""
        memory = len(self._inputs) - 1
        if memory < 0 or memory != len(self._outputs) - 1:
            raise ValueError(
                f"Expected {str(self.path)!r} to have one input (observations) and one output (actions), and after "
                f"them a memory, as many inputs as outputs; got inputs {self._names(self._inputs)} "
                f"and outputs {self._names(self._outputs)}."
            )
        for port in self._inputs:
            if port.type not in _TYPES or not port.shape or any(not isinstance(size, int) for size in port.shape[1:]):
                raise ValueError(
                    f"Expected input {port.name!r} of {str(self.path)!r} to be float or double of shape "
                    f"(batch, fixed sizes), got {port.type} {port.shape}."
                )

    @staticmethod
    def _names(ports: Any) -> str:
        return ", ".join(port.name for port in ports) or "none"

    @cached_property
    def export_metadata(self) -> dict[str, Any]:
        """Metadata that `export_onnx` wrote into the file; empty for other files."""
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY, "{}")
        try:
            metadata = json.loads(text)
        except json.JSONDecodeError:
            return {}
        return metadata if isinstance(metadata, dict) else {}

    @property
    def observation_space(self) -> spaces.Box:
        """Space of one observation; without bounds, which the file does not tell."""
        return spaces.Box(-np.inf, np.inf, tuple(self._inputs[0].shape[1:]), np.float32)

    @property
    def action_space(self) -> spaces.Space[Any] | None:
        """Space of one action, None if the file does not tell."""
        action = self.export_metadata.get("action", {})
        if "n" in action:
            return spaces.Discrete(int(action["n"]))
        if "low" in action:
            return spaces.Box(np.float32(action["low"]), np.float32(action["high"]), dtype=np.float32)
        sizes = self._outputs[0].shape[1:]
        return spaces.Discrete(len(DISCRETE_ACTIONS)) if self._are_scores(sizes) else None

    @property
    def stateful(self) -> bool:
        """Whether it has a memory."""
        return len(self._inputs) > 1

    @property
    def fixed_batch(self) -> int | None:
        """The batch size that the file fixes, None if it takes any."""
        size = self._inputs[0].shape[0]
        return size if isinstance(size, int) else None

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch; see `agents.Ego.predict`. The graph is always deterministic."""
        observation = np.asarray(observation)
        memory = self._begin(len(observation)) if state is None else list(state)
        if state is not None and episode_start is not None and np.any(episode_start):
            anew = np.asarray(episode_start, dtype=bool)
            memory = [np.where(anew.reshape(-1, *[1] * (part.ndim - 1)), 0, part).astype(part.dtype) for part in memory]
        outputs = self._run_in_portions([observation, *memory])
        return self._read_action(outputs[0]), tuple(outputs[1:]) or None

    def _begin(self, batch: int) -> list[NDArray[Any]]:
        """Return the memory at the start of an episode: zeros."""
        return [np.zeros((batch, *port.shape[1:]), _TYPES[port.type]) for port in self._inputs[1:]]

    def _run_in_portions(self, values: list[NDArray[Any]]) -> list[NDArray[Any]]:
        """Run all rows, in portions if the file fixes the batch size; the last portion is padded with its last row."""
        size = self.fixed_batch
        if size is None:
            return self._run(values)
        portions = []
        for first in range(0, len(values[0]), size):
            rows = np.arange(first, first + size).clip(max=len(values[0]) - 1)
            portions.append(self._run([part[rows] for part in values]))
        return [np.concatenate(parts)[: len(values[0])] for parts in zip(*portions, strict=True)]

    def _run(self, values: list[NDArray[Any]]) -> list[NDArray[Any]]:
        feed = {
            port.name: np.ascontiguousarray(value, _TYPES[port.type])
            for port, value in zip(self._inputs, values, strict=True)
        }
        outputs: list[NDArray[Any]] = self._session.run(None, feed)
        return outputs

    @staticmethod
    def _are_scores(sizes: Any) -> bool:
        """Return whether an output of these sizes holds one score for each discrete action."""
        return list(sizes) == [len(DISCRETE_ACTIONS)]

    def _read_action(self, output: NDArray[Any]) -> NDArray[Any]:
        """Return actions (B, 2) or (B,) made of the first output."""
        if np.issubdtype(output.dtype, np.integer):
            return output[:, 0] if output.ndim == 2 and output.shape[1] == 1 else output
        return output.argmax(axis=1) if self._are_scores(output.shape[1:]) else output


# --- export -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExportReport:
    """Result of an export.

    Example:
        >>> ExportReport(Path("ego.onnx"), 1e-7, 1440).observations
        1440
    """

    path: Path
    """The file."""
    difference: float
    """Largest difference of its actions from those of the policy, on random observations."""
    observations: int
    """Number of observations that were compared."""


class _Graph(nn.Module):
    """The graph: raw observations and memory to actions and memory, batch first throughout."""

    def __init__(self, ego: SavedEgo) -> None:
        super().__init__()
        self.policy = ego.model.policy
        self.policy.set_training_mode(False)
        self.recurrent = hasattr(self.policy, "lstm_actor")  # sb3_contrib's policies have no common class
        self.frames = 1 if ego.frames is None else ego.frames[0]
        self.mean: Tensor | None = None
        statistics = ego.statistics
        if statistics is not None and statistics.norm_obs:
            self.mean = torch.as_tensor(statistics.obs_rms.mean, dtype=torch.float64)
            self.scale = torch.as_tensor(np.sqrt(statistics.obs_rms.var + statistics.epsilon), dtype=torch.float64)
            self.clip = float(statistics.clip_obs)

    def memory(self, observation: Any, batch: int) -> list[Tensor]:
        """Return a memory of zeros."""
        parts = []
        if self.frames > 1:
            parts.append(torch.zeros(batch, (self.frames - 1) * observation.shape[0]))
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


def export_onnx(ego: SavedEgo, path: Path, seed: int = 0) -> ExportReport:
    """Write a policy as ONNX, and compare the file with the policy over several ticks and batch sizes.

    Args:
        ego: The policy.
        path: Where to write; it is written only if the comparison holds.
        seed: Of the random observations of the comparison.

    Returns:
        The file and the largest difference.

    Raises:
        ValueError: The policy cannot be written, or the file acts differently.

    Example:
        >>> import tempfile
        >>> from stable_baselines3 import PPO
        >>> from agents import load_ego
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu").save(f"{folder}/ppo.zip")
        ...     report = export_onnx(load_ego(f"{folder}/ppo.zip"), Path(folder) / "ppo.onnx")
        ...     ego = load_ego(report.path)
        >>> report.difference < 1e-5, report.observations
        (True, 1440)
        >>> ego.predict(np.zeros((5, 3), np.float32))[0].shape
        (5, 1)
    """
    try:
        import onnx
    except ImportError as error:
        raise ValueError("Exporting needs onnx and onnxruntime: pip install 'rare-envs[onnx]'.") from error
    space = ego.observation_space
    if not isinstance(space, spaces.Box) or (ego.frames is not None and (ego.frames[1] or len(space.shape) != 1)):
        raise ValueError(f"Cannot export a policy that observes {space}; expected one Box of numbers.")
    description = {
        "algorithm": ego.algorithm,
        "observation": list(space.shape),
        "action": _describe_space(ego.action_space),
    }
    with replace_file(path) as draft:
        _trace(ego, draft)
        model = onnx.load(str(draft))
        model.metadata_props.add(key=METADATA_KEY, value=json.dumps(description))
        onnx.save(model, str(draft))
        difference, count = compare_actions(ego, OnnxEgo(draft), np.random.default_rng(seed))
        if not difference <= ACTION_TOLERANCE:
            raise ValueError(f"The exported graph acts differently, by up to {difference:.2g}; nothing was written.")
    return ExportReport(path, difference, count)


def _trace(ego: SavedEgo, path: Path) -> None:
    """Write the graph by tracing; `compare_actions` checks it."""
    graph, space = _Graph(ego).eval(), ego.observation_space
    memory = graph.memory(space, 2)
    names = [f"memory_{part}" for part in range(len(memory))]
    ports = ["observation", *names, "action", *(f"next_{name}" for name in names)]
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tracer warns of branches that do not depend on the observation
        try:
            torch.onnx.export(
                graph,
                (torch.zeros(2, *space.shape), *memory),
                path,
                input_names=ports[: 1 + len(names)],
                output_names=ports[1 + len(names) :],
                dynamic_axes={port: {0: "batch"} for port in ports},
                dynamo=False,
            )
        except Exception as error:  # torch has many, without a common class
            raise ValueError(f"Cannot export a policy of class {type(ego.model.policy).__name__}: {error}") from error


def _describe_space(space: Any) -> dict[str, Any]:
    """Return an action space as JSON, from which `OnnxEgo` rebuilds it."""
    if isinstance(space, spaces.Discrete):
        return {"n": int(space.n)}
    return {"low": space.low.tolist(), "high": space.high.tolist()}


def compare_actions(policy: Any, other: Any, rng: np.random.Generator) -> tuple[float, int]:
    """Return the largest difference between two egos' actions on random observations, and their number.

    Each ego carries its own memory from tick to tick.

    Args:
        policy: An ego with a bounded `observation_space`.
        other: The ego to compare with it.
        rng: Draws the observations.
    """
    space, worst, count = policy.observation_space, 0.0, 0
    low, high = (np.clip(bound, -TRIAL_RANGE, TRIAL_RANGE) for bound in (space.low, space.high))
    for batch in TRIAL_BATCHES:
        states: list[Any] = [None, None]
        for tick in range(TRIAL_TICKS):
            observation = rng.uniform(low, high, (batch, *space.shape)).astype(np.float32)
            start = np.full(batch, tick == 0)
            actions = []
            for which, ego in enumerate((policy, other)):
                action, states[which] = ego.predict(observation, states[which], start, True)
                actions.append(np.asarray(action, dtype=np.float64))
            worst, count = max(worst, float(np.abs(actions[0] - actions[1]).max())), count + batch
    return worst, count
