"""Needs of egos: what an ego is, what it needs of its world, and which observation and actions fit its spaces.

An ego may have `predict` (Stable-Baselines3's), `act` (a `Driver`, with `needs_lidar` if it reads lidar features by
itself), or `in_world` and `noise_columns`: it becomes a driver only in a world, with noise of its own, maybe around
another `ego`.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch.distributions import Distribution

from rare_envs.control.actions import DISCRETE_ACTIONS
from rare_envs.control.idm import IDM
from rare_envs.egos.human import HUMAN_EGOS
from rare_envs.egos.reference import REFERENCE_EGOS
from rare_envs.egos.wrappers import find_action_bounds, find_frame_stacking
from rare_envs.plugins import check_predict, is_policy, refuse_ego
from rare_envs.simulation.observation import ELSEWHERE, OBSERVATIONS, map_kinds, observation_space, read_kinds
from rare_envs.simulation.world import World


@dataclass(frozen=True)
class EgoNeeds:
    """Needs of an ego, and its statements about itself; `resolve` finds it out."""

    observations: tuple[str, ...] = ("features",)
    """Kinds of observation that its space fits, each as `observation.read_kinds` writes it; one where it declares
    none."""
    lidar: bool = False
    """Whether it reads `Episode.perception` by itself, whatever is observed."""
    dt: float | None = None
    """The tick [s] that it was made for; None for any."""
    action_space: Any = None
    """The space of its actions, as it declares it; None if it does not."""
    queries_policy: bool = False
    """Whether a policy with `predict` decides, be it behind other parts of the ego."""
    varies: bool = False
    """Whether it says that its answers differ from run to run, by randomness that is not part of x."""
    noise: Any = None
    """Its part that has noise in x: an object whose `noise_columns` says of a world how many columns; None without."""
    observation_space: Any = None
    """The space of its observations, as it declares it; None if it does not."""
    notes: tuple[str, ...] = ()
    """How its files were read, where they can be read in several ways."""

    @property
    def observation(self) -> str:
        """The first kind of observation that fits, "features" if none does."""
        return self.observations[0] if self.observations else "features"

    def noise_columns(self, world: World) -> int:
        """Return how many columns of x are its own noise, the last ones."""
        return 0 if self.noise is None else int(self.noise.noise_columns(world))


@dataclass(frozen=True)
class FunctionEgo:
    """A function from observations to actions as an ego."""

    function: Callable[[Any], Any]
    """Maps observations of B scenarios, (B, ...) or several of that kind by name, to actions, (B, 2) in [-1, 1] or
    whole numbers (B,)."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """Stable-Baselines3's `predict`; the function has no memory."""
        actions = read_output(self.function(observation))
        try:
            return np.asarray(actions), state
        except ValueError:  # parts of several shapes, as of (actions, None)
            raise ValueError(_ONE_OUTPUT.format(got=f"{len(actions)} outputs")) from None


@dataclass(frozen=True)
class ModuleEgo:
    """A torch module from observations to actions as an ego: in evaluation mode, without gradients."""

    module: torch.nn.Module
    """Maps observations of B scenarios to what `read_output` takes; float tensors in its dtype."""
    observation_space: Any = None
    action_space: Any = None
    """Spaces of observations and actions, if it has them."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """Stable-Baselines3's `predict`; the module has no memory."""
        return self.decide(observation).numpy(force=True), state

    def decide(self, observation: Any) -> torch.Tensor:
        """Return actions for observations of B rows, arrays or tensors, by the module on its own device."""
        with contextlib.suppress(NotImplementedError):  # a program of torch.export has one mode
            self.module.eval()
        parameter = next(self.module.parameters(), torch.empty(0))
        shown = map_kinds(lambda part: torch.as_tensor(part).to(parameter), observation)
        with torch.no_grad():
            try:
                actions: torch.Tensor = read_output(self.module(shown))
            except AssertionError as error:
                if "Guard failed" not in str(error):
                    raise
                words = "Expected a program that was exported with a dynamic batch (dynamic_shapes of torch.export)"
                raise ValueError(f"{words} for such observations, got one of fixed sizes: {error}.") from None
        return actions


def _list_calls(module: torch.nn.Module) -> Iterator[dict[str, Any]]:
    """Yield the constant arguments, by name, of each operation in programs of torch.export and TorchScript."""
    for part in module.modules():
        if isinstance(part, torch.fx.GraphModule):
            for node in part.graph.nodes:
                schema = getattr(node.target, "_schema", None)
                names = [argument.name for argument in getattr(schema, "arguments", ())]
                yield {**dict(zip(names, node.args, strict=False)), **node.kwargs}
        elif graph := getattr(part, "inlined_graph", None):
            for node in (node for kind in _TRAINED for node in graph.findAllNodes(f"aten::{kind}")):
                names = [argument.name for argument in torch._C.parse_schema(node.schema()).arguments]
                yield dict(zip(names, (given.toIValue() for given in node.inputs()), strict=False))


_TRAINED = "dropout feature_dropout alpha_dropout feature_alpha_dropout batch_norm lstm gru rnn_tanh rnn_relu".split()
"""Operations that do something else in training, as TorchScript names them."""


def _was_exported_in_training(module: torch.nn.Module) -> bool:
    """Return whether a program, or one inside, keeps its dropout or the statistics of each batch in evaluation."""
    return any(
        (given.get("train") is True or given.get("training") is True) and given.get("dropout", given.get("p")) != 0
        for given in _list_calls(module)
    )


_ONE_OUTPUT = (
    "Expected a network that gives actions, or a tuple of tensors, actions and values (B, 1), got {got}; put a module "
    "around it that gives actions alone (the mean of PPO, tanh of SAC's), or an object with predict if it has a memory."
)


def read_output(output: Any) -> Any:
    """Return the actions in what a network gives: of five scores the best, of a distribution the mode, not the values.

    Values are what stands, (B, 1), behind the actions in a pair; other pairs could be mean and deviation, whose mean
    some algorithms squash: a ValueError says so.
    """
    parts = output if isinstance(output, tuple | list) else ()
    pair = isinstance(output, tuple) and any(isinstance(part, torch.Tensor | Distribution) for part in parts)
    if pair or any(isinstance(part, Distribution) or getattr(part, "ndim", 0) > 1 for part in parts):
        output, *others = parts
        several = isinstance(output, tuple | list) or len(others) != 1
        if not pair or several or getattr(others[0], "ndim", 0) != 2 or others[0].shape[1] != 1:
            raise ValueError(_ONE_OUTPUT.format(got=f"{len(parts)} outputs"))
    if isinstance(output, Distribution):
        try:
            output = output.mode
        except NotImplementedError:  # as of a squashed one
            got = f"a {type(output).__name__} whose mode is not known"
            raise ValueError(_ONE_OUTPUT.format(got=got)) from None
    output = output.detach() if isinstance(output, torch.Tensor) else output
    if getattr(output, "ndim", 0) != 2:
        return output
    columns, real = output.shape[1], "float" in str(output.dtype)  # an array's, a tensor's, JAX's
    if real:
        return output.argmax(1) if columns == len(DISCRETE_ACTIONS) else output
    return output[:, 0] if columns == 1 else output


def wrap_callable(ego: Any) -> Any:
    """Return a policy for a plain function or a torch module, and any other ego as it is."""
    if isinstance(ego, type) or not callable(ego) or is_policy(ego):
        return ego
    if any(hasattr(ego, name) for name in ("act", "in_world")):  # a driver, or an ego of worlds, that has __call__ too
        return ego
    declared = (getattr(ego, f"{name}_space", None) for name in ("observation", "action"))
    if not isinstance(ego, torch.nn.Module):
        return FunctionEgo(ego)
    called = type(ego).__call__ is torch.nn.Module.__call__
    if called and getattr(ego.forward, "__func__", None) is torch.nn.Module.forward:
        parts = ", ".join(dict(ego.named_children()))
        part = f"the part of it that acts ({parts}), or " if parts else ""
        found = f"{type(ego).__name__} without; return {part}a function from observations to actions"
        raise ValueError(f"Expected a module with forward, got {found}.")
    if _was_exported_in_training(ego):
        words = "Expected a program of evaluation mode, got one of training mode"
        raise ValueError(f"{words}: eval() before torch.export or torch.jit.trace.")
    return ModuleEgo(ego, *declared)


_COLOUR_CHANNELS = (3, 6, 9, 12)
"""Channels of one to four coloured frames side by side."""


def find_fitting_kinds(observed: Any, vehicles: int = 1) -> tuple[str, ...]:
    """Return the kinds of observation that fit the space of a policy, among so many vehicles; none if nothing does.

    A `Dict` names the kinds, such as "camera+speed"; other spaces are known by their shape, and pictures of any size
    are those of the camera. Several frames fit only if no single one does.
    """
    if isinstance(observed, spaces.Dict):
        names = set(observed.spaces)
        return (read_kinds(sorted(names)),) if names and names <= set(OBSERVATIONS) else ()
    if find_picture_size(observed):
        return ("camera",)
    found = {kind: find_frame_stacking(observation_space(vehicles, kind), observed) for kind in OBSERVATIONS}
    single = tuple(kind for kind, frames in found.items() if frames == (1, False))
    unlike = ("speed", "kinematics")  # whose multiples are other observations: of one number, or features of HighwayEnv
    return single or tuple(kind for kind, frames in found.items() if frames is not None and kind not in unlike)


def find_picture_size(observed: Any) -> tuple[int, int] | None:
    """Return the height and width of the coloured pictures of a space, or of its part "camera"; None without such.

    Channels, the shorter axis, are first or last.
    """
    observed = observed.spaces.get("camera") if isinstance(observed, spaces.Dict) else observed
    shape = getattr(observed, "shape", None)  # whatever a user's ego declares
    if not isinstance(shape, tuple) or getattr(observed, "dtype", None) != np.uint8 or len(shape) not in (3, 4):
        return None
    first = shape[-3] < shape[-1]
    height, width = shape[-2:] if first else shape[-3:-1]
    return (int(height), int(width)) if shape[-3 if first else -1] in _COLOUR_CHANNELS else None


def choose_observation(needs: EgoNeeds, vehicles: int) -> str:
    """Return the kinds of observation of an ego for which nobody names them, in a scenario with so many vehicles."""
    if len(needs.observations) == 1:
        return needs.observations[0]
    if needs.observations:
        fitting = " and ".join(needs.observations)
        raise ValueError(f"The ego's observations fit {fitting}: say which by observation=... (--observation).")
    known = {kind: observation_space(vehicles, kind).shape for kind in OBSERVATIONS}
    given = ", ".join(f"{kind} {shape}" for kind, shape in known.items())
    other = ELSEWHERE if len(getattr(needs.observation_space, "shape", None) or ()) > 1 else ""
    raise ValueError(
        f"The ego expects observations {needs.observation_space}, the environment gives one of {given}; train it on "
        f"one of these{other}."
    )


def choose_action(action_space: Any, observation: str) -> str:
    """Return the kind of actions if nobody names it; with HighwayEnv's kinematics its policies' fit two kinds."""
    if "kinematics" not in observation.split("+"):
        return "continuous"
    if isinstance(action_space, spaces.Box) and action_space.shape == (2,):
        raise ValueError(
            "The ego's two actions fit two kinds: acceleration and steering up to 5 m/s^2 and 0.1 rad each tick "
            "(action='continuous', --action continuous), and HighwayEnv's ContinuousAction, pi/4 rad for a second, "
            "which drives in HighwayEnv's environments alone (rare_envs.highway_env_problem, rare-envs estimate "
            "highway-fast-v0); say which."
        )
    if takes_indices(action_space):
        raise ValueError(
            "The ego's actions 0 to 4 fit two kinds: HighwayEnv's meta-actions (action='meta', --action meta; or the "
            "environment's id with -kinematics), of target speeds 20, 25 and 30 m/s (no file tells; others by "
            "env_config in HighwayEnv's ids), and five accelerations (action='discrete', --action discrete); say which."
        )
    return "continuous"


def takes_indices(action_space: Any) -> bool:
    """Return whether actions are numbers from 0 to 4, which meta-actions are and accelerations by index too."""
    known = isinstance(action_space, spaces.Discrete) and int(action_space.n) == len(DISCRETE_ACTIONS)
    return known and int(action_space.start) == 0


AMBIGUOUS = (
    "the ego's actions 0 to 4 were taken as five accelerations; one that was trained in HighwayEnv needs "
    "action='meta' (--action meta)"
)
"""HighwayEnv's meta-actions and our discrete ones are both numbers from 0 to 4, and their spaces are equal."""
TAKEN_AS_ACCELERATIONS = (
    "the ego's actions 0 to 4 were taken as five accelerations; --action discrete says so without this note, and one "
    "that was trained with action='meta' needs --action meta"
)
"""Likewise for policies without HighwayEnv's observation, which rarely have its actions."""
RESCALED = (
    "the ego's actions, between {low} and {high}, are mapped to [-1, 1] as RescaleAction does; if they are in units of "
    "their own, put a function of yours around it"
)
"""A policy's bounds do not say whether they are those of a wrapper or units."""
DRIVES_ITSELF = "the ego accelerates and steers by itself: action={action!r} (--action {action}) changes nothing for it"
"""Scripts and learned drivers have no actions of another kind."""


class EgoWarning(UserWarning):
    """An ego's actions can be taken in two ways or are not of the kind that was named, or statistics seem to miss."""


def name_ambiguities(action_space: Any, kinds: Collection[str]) -> tuple[str, ...]:
    """Return in how many ways a policy's actions can be taken, with these observations and "continuous" actions."""
    found = []
    if takes_indices(action_space):
        found.append(AMBIGUOUS if "kinematics" in kinds else TAKEN_AS_ACCELERATIONS)
    bounds = find_action_bounds(action_space)
    if bounds is not None:  # as people write them: float32 makes 0.10000000149011612 of 0.1
        low, high = ([float(f"{value:.4g}") for value in bound] for bound in bounds)
        found.append(RESCALED.format(low=low, high=high))
    return tuple(found)


RULE_BASED_EGOS: Mapping[str, Any] = MappingProxyType({"idm": IDM(), **HUMAN_EGOS, **REFERENCE_EGOS})
"""Egos that are known by a name."""


def resolve(ego: Any, vehicles: int = 1) -> EgoNeeds:
    """Return what an ego needs, among so many vehicles; a wrapping one what the inner one needs, and own noise."""
    # The ego may be anybody's object, such as a Stable-Baselines3 model: it may declare these or not.
    ego = find_rule_based(ego)
    if hasattr(ego, "in_world"):
        inner = resolve(ego.ego, vehicles) if hasattr(ego, "ego") else EgoNeeds()
        return replace(inner, noise=ego)
    if is_policy(ego):
        check_predict(ego)
    lidar = hasattr(ego, "act") and bool(getattr(ego, "needs_lidar", False))
    observed = getattr(ego, "observation_space", None)
    return EgoNeeds(
        observations=EgoNeeds.observations if observed is None else find_fitting_kinds(observed, vehicles),
        lidar=lidar,
        dt=getattr(ego, "dt", None),
        action_space=getattr(ego, "action_space", None),
        queries_policy=is_policy(ego) and not lidar,
        varies=getattr(ego, "deterministic", None) is False,
        observation_space=observed,
        notes=tuple(map(str, ego.notes)) if isinstance(getattr(ego, "notes", None), tuple) else (),
    )


def find_rule_based(ego: Any) -> Any:
    """Return the driver that a rule-based ego's name means, a policy for a plain function, any other ego as it is."""
    ego = RULE_BASED_EGOS.get(ego, ego) if isinstance(ego, str) else wrap_callable(ego)
    if isinstance(ego, str | type):  # a class has the attributes of its egos
        refuse_ego(ego, known=tuple(RULE_BASED_EGOS))
    return ego


LOADER = "agents.loading"
"""Module whose `load_ego` does it. It stands above this package and is named as a string, as entry points are."""


def load_named_ego(ego: Any, trust: bool = False) -> Any:
    """Return the ego that a name or file stands for, see `agents.load_ego`, and any other ego as it is."""
    if not isinstance(ego, str | Path) or ego in RULE_BASED_EGOS:
        return ego
    return importlib.import_module(LOADER).load_ego(ego, trust=trust)
