"""Export of a saved Stable-Baselines3 policy to ONNX, from raw observations to actions ready to be used.

Stable-Baselines3's own export has the bare network. Here normalisation of observations, frames stacked behind it, the
squashed or clipped action and a recurrent policy's memory are part of the graph.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn

from agents.onnx.ego import METADATA_KEY, OnnxEgo
from agents.sb3.saved_ego import SavedEgo
from rare_envs.files import replace_file

ACTION_TOLERANCE = 1e-5
"""Largest difference between actions of the policy and of its export: single precision rounds by about 1e-7 in each of
a few layers."""
TRIAL_TICKS, TRIAL_BATCHES = 20, (1, 7, 64)
"""Ticks and batch sizes of the comparison: a memory builds up, and sizes differ from that of the trace."""
TRIAL_RANGE = 10.0
"""Observations of the comparison lie within +-this where a space has wider bounds: VecNormalize clips there."""


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
    """Return an action space as JSON, from which `agents.onnx.ego` rebuilds it."""
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
