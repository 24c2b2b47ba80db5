"""Egos in ONNX files: a graph from observations to actions, with or without a memory."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.missing_file import report_missing_file
from rare_envs.control.actions import DISCRETE_ACTIONS
from rare_envs.plugins import one_line

METADATA_KEY = "rare_envs"
"""Entry of a file's metadata in which `agents.onnx.export` describes observations and actions."""
_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}


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
        """Metadata that `agents.onnx.export` wrote into the file; empty for other files."""
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
