"""Dense networks of Stable-Baselines3 queried layer by layer: the actions of `predict` without its way to the network.

`predict` sets the mode of every module, copies the observations and makes a distribution whose mean it takes. With 25
observations that takes six times as long as the layers. Rectifiers give the bits of `predict`. Hyperbolic tangents are
computed as logistic functions, tanh v = 2 (s(2 v) - 1/2), which torch has 3.5 times as fast; the factors stand in the
weights. Actions then differ from those of `predict` by rounding, a few times as much as these do between batches of two
sizes. The speeds are those of 4,096 rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import linear

from rare_envs.egos.sb3.dense_networks import read_dense_policy
from rare_envs.egos.wrappers import NormalisedPolicy, RescaledPolicy
from rare_envs.simulation.compiled.failures import NotCompiled

_ACTIVATIONS = {"tanh": lambda doubled: doubled.sigmoid_().sub_(0.5), "relu": torch.relu_}
_Layers = tuple[tuple[Tensor, Tensor], ...]


@dataclass(frozen=True, eq=False)
class DenseInference:
    """A policy with continuous actions that is dense layers; it is made anew for each rollout, with present weights."""

    policy: Any
    """Whose `predict` this one stands for."""
    layers: _Layers
    """Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer, first to last."""
    activation: str
    """Between the layers, "tanh" or "relu"."""
    low: Tensor
    """Bounds of the actions, shape (2,)."""
    high: Tensor

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Return mean actions for observations (B, F), clipped; where they are not finite, what `policy` does then."""
        with torch.no_grad():
            rows = np.ascontiguousarray(observation)  # torch takes no negative strides
            actions = self._apply(torch.from_numpy(rows))
        if not np.isfinite(actions.numpy()).all():
            answer: tuple[NDArray[Any], Any] = self.policy.predict(
                observation, state=state, episode_start=episode_start, deterministic=deterministic
            )
            return answer
        return actions.clamp(self.low, self.high).numpy(), state

    def decide(self, observation: Tensor) -> Tensor:
        """Return mean actions (B, 2) for observations (B, F), clipped, NaN where they are; all on its device."""
        return self._apply(observation).clamp(self.low, self.high)

    def to(self, device: torch.device) -> DenseInference:
        """Return it with its weights on a device."""
        layers: _Layers = tuple((weights.to(device), biases.to(device)) for weights, biases in self.layers)
        return replace(self, layers=layers, low=self.low.to(device), high=self.high.to(device))

    def equals(self, other: Any) -> bool:
        """Return whether another has the same numbers on the same device."""
        if not isinstance(other, DenseInference) or other.activation != self.activation:
            return False
        mine, its = ((*sum(each.layers, ()), each.low, each.high) for each in (self, other))
        return len(mine) == len(its) and all(torch.equal(one, two) for one, two in zip(mine, its, strict=True))

    def _apply(self, observation: Tensor) -> Tensor:
        """Return the outputs of the last layer."""
        between, values = _ACTIVATIONS[self.activation], observation.float()
        for weights, biases in self.layers[:-1]:
            values = between(linear(values, weights, biases))
        return linear(values, *self.layers[-1])


def find_inference(policy: Any) -> Any:
    """Return what gives a policy's actions soonest: its layers alone, or the policy itself where it is anything else.

    Args:
        policy: Has Stable-Baselines3's `predict`; it may stand behind wrappers.

    Example:
        >>> import gymnasium, rare_envs
        >>> from stable_baselines3 import PPO
        >>> model = PPO("MlpPolicy", gymnasium.make("rare_envs/CarFollowing-v0"), device="cpu")
        >>> type(find_inference(model)).__name__, find_inference("anything else")
        ('DenseInference', 'anything else')
    """
    if type(policy) in (RescaledPolicy, NormalisedPolicy):
        return replace(policy, policy=find_inference(policy.policy))
    try:
        dense = read_dense_policy(policy)
    except NotCompiled:
        return policy
    on_cpu = str(getattr(getattr(policy, "same_as", policy), "device", "cpu")) == "cpu"  # of SB3 all have one
    if dense.clip is None or dense.rescale or dense.normalisation or not on_cpu:  # discrete actions, or wrapped twice
        return policy
    layers: _Layers = tuple((torch.from_numpy(weights), torch.from_numpy(biases)) for weights, biases in dense.layers)
    if dense.activation == "tanh":
        layers = _scale_for_tangents(layers)
    return DenseInference(policy, layers, dense.activation, *map(torch.from_numpy, dense.clip))


def _scale_for_tangents(layers: _Layers) -> _Layers:
    """Return layers of which the hidden ones give twice their sums and take half of their tangents.

    Both are powers of 2, so that nothing is rounded.
    """
    last = len(layers) - 1
    return tuple(
        (weights * (2 if place > 0 else 1) * (2 if place < last else 1), biases * (2 if place < last else 1))
        for place, (weights, biases) in enumerate(layers)
    )
