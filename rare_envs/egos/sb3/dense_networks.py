"""Dense networks read from policies of Stable-Baselines3, for compiled rollouts.

A policy is read only if it is known to the last part: exact classes, no methods or hooks put in their place. Any other
is left to its own `predict`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from torch import nn

from rare_envs.egos.wrappers import NormalisedPolicy, RescaledPolicy
from rare_envs.simulation.compiled.dense_policy import Activation, DensePolicy
from rare_envs.simulation.compiled.failures import NotCompiled

ACTIVATIONS: dict[type[nn.Module], Activation] = {nn.Tanh: "tanh", nn.ReLU: "relu"}
SB3 = "stable_baselines3"


@runtime_checkable
class RenamedPolicy(Protocol):
    """An ego whose `predict` is that of another policy.

    Example:
        >>> from types import SimpleNamespace
        >>> isinstance(SimpleNamespace(same_as=None), RenamedPolicy), isinstance(object(), RenamedPolicy)
        (True, False)
    """

    @property
    def same_as(self) -> Any:
        """A policy that gives the same actions for the same observations."""


def read_dense_policy(policy: Any) -> DensePolicy:
    """Return the network of a policy with its present weights.

    Args:
        policy: A `PPO`, `A2C` or `DQN` of Stable-Baselines3 or one of their policies, with dense layers between which
            are hyperbolic tangents or rectifiers, behind `VecNormalize` or not; or a `RenamedPolicy`.

    Raises:
        NotCompiled: It is none of these; the message says what it is.

    Example:
        >>> import gymnasium, rare_envs
        >>> from stable_baselines3 import PPO
        >>> model = PPO("MlpPolicy", gymnasium.make("rare_envs/CarFollowing-v0"), device="cpu")
        >>> [weight.shape for weight, _ in read_dense_policy(model).layers]
        [(64, 7), (64, 64), (2, 64)]
    """
    if type(policy) is RescaledPolicy:
        return replace(read_dense_policy(policy.policy), rescale=(policy.low, policy.high))
    if type(policy) is NormalisedPolicy:
        return replace(read_dense_policy(policy.policy), normalisation=_read_statistics(policy.normalise))
    own = vars(type(policy))
    if "same_as" in own and "predict" in own:  # of one class: a subclass may predict in another way
        return read_dense_policy(policy.same_as)
    if not type(policy).__module__.startswith(f"{SB3}."):
        raise NotCompiled(f"the ego, a {type(policy).__name__}, is not compiled")
    return _read_network(_read_model(policy))


def _read_model(model: Any) -> Any:
    """Return the policy of an algorithm of Stable-Baselines3; a policy as it is."""
    from stable_baselines3 import A2C, DQN, PPO

    if type(model) not in (A2C, DQN, PPO):
        return model
    _refuse_changed(model)
    return model.policy


def _read_network(policy: Any) -> DensePolicy:
    from stable_baselines3.common import distributions, torch_layers
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.dqn.policies import DQNPolicy, QNetwork

    parts: list[Any]
    if type(policy) is ActorCriticPolicy and type(policy.mlp_extractor) is torch_layers.MlpExtractor:
        features, parts = policy.pi_features_extractor, [policy.mlp_extractor.policy_net, policy.action_net]
        known = (distributions.DiagGaussianDistribution, distributions.CategoricalDistribution)
        plain = type(policy.action_dist) in known and not policy.squash_output
    elif type(policy) is DQNPolicy and type(policy.q_net) is QNetwork:
        features, parts, plain = policy.q_net.features_extractor, [policy.q_net.q_net], True
    else:
        raise NotCompiled(f"the ego, with a {type(policy).__name__}, is not compiled")
    if not plain or type(features) is not torch_layers.FlattenExtractor:
        raise NotCompiled(f"the ego, with a {type(policy).__name__} of other parts than dense layers, is not compiled")
    for module in policy.modules():
        _refuse_changed(module)
    layers, activation = _read_layers([module for part in parts for module in _unpack(part)])
    space = policy.action_space
    chooses = isinstance(space, spaces.Discrete) and int(space.start) == 0
    clip = (space.low, space.high) if isinstance(space, spaces.Box) else None
    if clip is None and not chooses:
        raise NotCompiled(f"an ego that acts in {space} is not compiled")
    return DensePolicy(layers, activation, chooses, clip)


def _unpack(module: Any) -> Iterator[Any]:
    yield from module if type(module) is nn.Sequential else (module,)


def _read_layers(modules: list[Any]) -> tuple[tuple[Any, ...], Activation]:
    """Return weights and biases of layers, between which is the same activation."""
    layers, between = modules[::2], {type(module) for module in modules[1::2]}
    good = len(modules) % 2 and all(type(layer) is nn.Linear and layer.bias is not None for layer in layers)
    if not good or len(between) > 1 or not between <= set(ACTIVATIONS):
        names = ", ".join(type(module).__name__ for module in modules)
        raise NotCompiled(f"an ego with the layers {names} is not compiled")
    arrays = tuple((layer.weight.numpy(force=True), layer.bias.numpy(force=True)) for layer in layers)
    if any(array.dtype != np.float32 for layer in arrays for array in layer):
        raise NotCompiled("an ego with weights that are not in single precision is not compiled")
    return arrays, ACTIVATIONS[between.pop()] if between else "relu"


def _refuse_changed(part: Any) -> None:
    """Raise NotCompiled where a method of an object has been replaced, or a module has a hook."""
    own = vars(part)
    replaced = own.keys() & {"predict", "_predict", "forward", "extract_features", "get_distribution"}
    if replaced or own.get("_forward_hooks") or own.get("_forward_pre_hooks"):
        raise NotCompiled(f"an ego with a {type(part).__name__} that was changed is not compiled")


def _read_statistics(normalise: Any) -> tuple[Any, Any, float]:
    """Return mean, standard deviation and bound of the observations of `VecNormalize`, from its method."""
    statistics: Any = getattr(normalise, "__self__", None)  # of a function, none
    module = sys.modules.get(f"{SB3}.common.vec_env.vec_normalize")
    if module is None or type(statistics) is not module.VecNormalize or normalise.__name__ != "normalize_obs":
        raise NotCompiled("an ego behind a normalisation of its own is not compiled")
    moments = statistics.obs_rms
    if vars(statistics).keys() & {"normalize_obs", "_normalize_obs"} or not hasattr(moments, "mean"):
        raise NotCompiled("an ego behind a VecNormalize that was changed is not compiled")
    deviation = np.sqrt(moments.var + statistics.epsilon)
    return moments.mean, deviation, float(statistics.clip_obs)
