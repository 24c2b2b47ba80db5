"""Dense networks of Stable-Baselines3: read from policies part by part, and queried layer by layer.

A policy is read only if it is known to the last part: exact classes, no methods or hooks put in their place. Any other
is left to its own `predict`, which sets the mode of every module, copies the observations and makes a distribution
whose mean it takes: with 25 observations that takes six times as long as the layers.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from types import FunctionType
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import linear

from rare_envs.egos.wrappers import WrappedPolicy

Activation = Literal["tanh", "relu"]
ACTIVATIONS: dict[type[nn.Module], Activation] = {nn.Tanh: "tanh", nn.ReLU: "relu"}
_APPLIED: dict[str, Callable[[Tensor], Tensor]] = {"tanh": lambda x: x.sigmoid_().sub_(0.5), "relu": torch.relu_}
"""Half of the tangent of half of a value, or the larger of 0 and it."""
SB3 = "stable_baselines3"
_Layers = tuple[tuple[Tensor, Tensor], ...]


class NotCompiled(ValueError):
    """There is no compiled rollout; the message says why."""


@dataclass(frozen=True, eq=False)
class DensePolicy:
    """A policy that is a network of dense layers on the `features` observation, without memory or noise.

    It is made anew for each rollout, with present weights. Only one that is clipped alone is queried; all are compiled.
    """

    layers: _Layers
    """Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer, first to last."""
    activation: Activation
    """Between the layers; there is none behind the last."""
    chooses: bool = False
    """Whether the outputs are scores of `rare_envs.control.actions.DISCRETE_ACTIONS`, of which the largest is taken;
    else they are acceleration and steering."""
    clip: tuple[Tensor, Tensor] | None = None
    """Bounds to which acceleration and steering are clipped, shape (2,) each."""
    rescale: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    """Bounds that are then mapped to [-1, 1], shape (2,) each; None for those that are so already."""
    normalisation: tuple[NDArray[np.float64], NDArray[np.float64], float] | None = None
    """Mean and standard deviation of the observations, shape (F,) each, by which they are normalised before they are
    clipped to plus or minus the last; None for observations as they are."""
    policy: Any = None
    """Whose `predict` this one stands for."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """Return mean actions for observations (B, F), clipped; where they are not finite, what `policy` does then."""
        rows = np.ascontiguousarray(observation)  # torch takes no negative strides
        with torch.no_grad():
            actions = self.decide(torch.from_numpy(rows)).numpy()
        if not np.isfinite(actions).all():
            return self.policy.predict(
                observation, state=state, episode_start=episode_start, deterministic=deterministic
            )
        return actions, state

    def decide(self, observation: Tensor) -> Tensor:
        """Return mean actions (B, 2) for observations (B, F), clipped, not finite where they are; all on its device."""
        assert self.clip is not None
        values = observation.float().flatten(1)  # rows of HighwayEnv's kinematics, one for each vehicle
        for weights, biases in self._doubled[:-1]:
            values = _APPLIED[self.activation](linear(values, weights, biases))
        actions = linear(values, *self._doubled[-1])
        return torch.where(actions.isfinite(), actions.clamp(*self.clip), actions)

    @cached_property
    def _doubled(self) -> _Layers:
        """Layers whose hidden ones give twice their sums and take half of their tangents, without rounding."""
        if self.activation == "relu":
            return self.layers
        last = len(self.layers) - 1
        return tuple(
            (weights * (2 if place > 0 else 1) * (2 if place < last else 1), biases * (2 if place < last else 1))
            for place, (weights, biases) in enumerate(self.layers)
        )

    def to(self, device: torch.device) -> DensePolicy:
        """Return it with its weights on a device."""
        layers: _Layers = tuple((weights.to(device), biases.to(device)) for weights, biases in self.layers)
        clip = None if self.clip is None else (self.clip[0].to(device), self.clip[1].to(device))
        return replace(self, layers=layers, clip=clip)

    def equals(self, other: Any) -> bool:
        """Return whether another that is clipped alone has the same numbers on the same device."""
        if not isinstance(other, DensePolicy) or other.activation != self.activation:
            return False
        mine, its = ((*sum(each.layers, ()), *(each.clip or ())) for each in (self, other))
        return len(mine) == len(its) and all(torch.equal(one, two) for one, two in zip(mine, its, strict=True))


def read_dense_policy(policy: Any) -> DensePolicy:
    """Return the network of a policy with its present weights, or raise NotCompiled.

    A `PPO`, `A2C` or `DQN` of Stable-Baselines3 or one of their policies, with dense layers between which are
    hyperbolic tangents or rectifiers, behind `VecNormalize` or not; or an ego whose class has `predict` and `same_as`,
    a policy that gives the same actions for the same observations.
    """
    if type(policy) is WrappedPolicy and not policy.stacks:
        dense = read_dense_policy(policy.policy)
        normalisation = dense.normalisation if policy.normalise is None else _read_statistics(policy.normalise)
        return replace(dense, rescale=policy.bounds or dense.rescale, normalisation=normalisation)
    own = vars(type(policy))
    if "same_as" in own and "predict" in own:  # of one class: a subclass may predict in another way
        return read_dense_policy(policy.same_as)
    if not type(policy).__module__.startswith(f"{SB3}."):
        raise NotCompiled(f"the ego, a {type(policy).__name__}, is not compiled")
    return _read_network(policy)


def _read_network(policy: Any) -> DensePolicy:
    """Return the network of an algorithm of Stable-Baselines3, or of its policy."""
    from stable_baselines3 import A2C, DQN, PPO
    from stable_baselines3.common import distributions, torch_layers
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.dqn.policies import DQNPolicy, QNetwork

    if type(policy) in (A2C, DQN, PPO):
        _refuse_changed(policy)
        policy = policy.policy
    parts: list[Any]
    if type(policy) is ActorCriticPolicy and type(policy.mlp_extractor) is torch_layers.MlpExtractor:
        features, parts = policy.pi_features_extractor, [policy.mlp_extractor.policy_net, policy.action_net]
        known = (distributions.DiagGaussianDistribution, distributions.CategoricalDistribution)
        plain = type(policy.action_dist) in known and not policy.squash_output
        _refuse_changed(policy.action_dist)
    elif type(policy) is DQNPolicy and type(policy.q_net) is QNetwork:
        features, parts, plain = policy.q_net.features_extractor, [policy.q_net.q_net], True
    else:
        raise NotCompiled(f"the ego, with a {type(policy).__name__}, is not compiled")
    if not plain or type(features) is not torch_layers.FlattenExtractor:
        raise NotCompiled(f"the ego, with a {type(policy).__name__} of other parts than dense layers, is not compiled")
    for module in policy.modules():
        _refuse_changed(module)
    in_turn = [part if type(part) is nn.Sequential else (part,) for part in parts]
    layers, activation = _read_layers([module for modules in in_turn for module in modules])
    space = policy.action_space
    chooses = isinstance(space, spaces.Discrete) and int(space.start) == 0
    clip = (torch.from_numpy(space.low), torch.from_numpy(space.high)) if isinstance(space, spaces.Box) else None
    if clip is None and not chooses:
        raise NotCompiled(f"an ego that acts in {space} is not compiled")
    return DensePolicy(layers, activation, chooses, clip)


def _read_layers(modules: list[Any]) -> tuple[_Layers, Activation]:
    """Return weights and biases of layers, between which is the same activation."""
    layers, between = modules[::2], {type(module) for module in modules[1::2]}
    good = len(modules) % 2 and all(type(layer) is nn.Linear and layer.bias is not None for layer in layers)
    if not good or len(between) > 1 or not between <= set(ACTIVATIONS):
        names = ", ".join(type(module).__name__ for module in modules)
        raise NotCompiled(f"an ego with the layers {names} is not compiled")
    tensors = tuple((layer.weight.detach().cpu(), layer.bias.detach().cpu()) for layer in layers)
    if any(each.dtype != torch.float32 for layer in tensors for each in layer):
        raise NotCompiled("an ego with weights that are not in single precision is not compiled")
    return tensors, ACTIVATIONS[between.pop()] if between else "relu"


def _refuse_changed(part: Any) -> None:
    """Raise NotCompiled where a method of an object has been replaced, or a module has a hook."""
    own = vars(part)
    replaced = any(isinstance(getattr(type(part), name, None), FunctionType) for name in own)
    if replaced or own.get("_forward_hooks") or own.get("_forward_pre_hooks"):
        raise NotCompiled(f"an ego with a {type(part).__name__} that was changed is not compiled")


def _read_statistics(normalise: Any) -> tuple[Any, Any, float] | None:
    """Return mean, deviation and bound of observations by `VecNormalize`'s method; None if it leaves them."""
    statistics: Any = getattr(normalise, "__self__", None)  # of a function, none
    module = sys.modules.get(f"{SB3}.common.vec_env.vec_normalize")
    if module is None or type(statistics) is not module.VecNormalize or normalise.__name__ != "normalize_obs":
        raise NotCompiled("an ego behind a normalisation of its own is not compiled")
    changed = vars(statistics).keys() & {"normalize_obs", "_normalize_obs"}
    if not changed and not statistics.norm_obs:
        return None
    moments = statistics.obs_rms
    if changed or not hasattr(moments, "mean"):
        raise NotCompiled("an ego behind a VecNormalize that was changed is not compiled")
    return moments.mean, np.sqrt(moments.var + statistics.epsilon), float(statistics.clip_obs)


def find_inference(policy: Any) -> Any:
    """Return what gives a policy's actions soonest, behind its wrappers: its layers alone, or the policy itself."""
    if type(policy) is WrappedPolicy and not policy.stacks:
        return replace(policy, policy=find_inference(policy.policy))
    try:
        dense = read_dense_policy(policy)
    except NotCompiled:
        return policy
    on_cpu = str(getattr(getattr(policy, "same_as", policy), "device", "cpu")) == "cpu"  # of SB3 all have one
    if dense.clip is None or dense.rescale or dense.normalisation or not on_cpu:  # discrete actions, or wrapped twice
        return policy
    return replace(dense, policy=policy)
