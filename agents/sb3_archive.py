"""The `.zip` of a Stable-Baselines3 policy: its settings, its algorithm, and the policy built from class and weights.

The archive has a member `data`: JSON with simple values as they are and other values as
`{":type:": ..., "__module__": ..., ":serialized:": <pickle>}`, and members `*.pth` with tensors. Names of settings and
the policy's module are enough to tell the algorithms apart. Of the pickles those that the policy is made of are opened,
by `agents.safe_pickle`, and `policy.pth` by torch's own reader of weights. The file also says how large the networks
are, so a network of more numbers than the file holds is refused as it is built, before its memory is written to.

sbx (Stable-Baselines3 in JAX) keeps the whole policy in `data`, in a pickle with functions of JAX. Of it the layers of
the acting network are read, and put into the policy of Stable-Baselines3 that acts alike; nothing else is made.
"""

from __future__ import annotations

import base64
import contextlib
import io
import math
import pickle
import zipfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from gymnasium import spaces
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from agents.safe_pickle import ForbiddenObject, Note, make, open_pickle, read_notes, require
from rare_envs.files import MAX_MEMBERS, parse_json_object, read_members
from rare_envs.plugins import did_you_mean


class Algorithm(NamedTuple):
    """How the files of an algorithm are known: by the module of their policy, or by a setting."""

    policies: tuple[str, ...] = ()
    """Beginnings of the policy's module; "common" policies serve several."""
    setting: str = ""
    """One that only this algorithm has, of those that come later here."""
    takes_sde: bool = False
    """Whether its policy is told of gSDE by an argument of its own."""


ALGORITHMS = {
    "ppo": Algorithm(("sbx.ppo.",), "clip_range", takes_sde=True),
    "tqc": Algorithm(("sb3_contrib.tqc.", "sbx.tqc."), "top_quantiles_to_drop_per_net"),
    "trpo": Algorithm((), "cg_max_steps", takes_sde=True),
    "ars": Algorithm(("sb3_contrib.ars.",), "n_delta"),
    "td3": Algorithm(("stable_baselines3.td3.", "sbx.td3."), "target_policy_noise"),
    "ddpg": Algorithm(),  # TD3 with other settings, which acts alike
    "sac": Algorithm(("stable_baselines3.sac.", "sbx.sac."), "target_entropy"),
    "dqn": Algorithm(("stable_baselines3.dqn.", "sbx.dqn."), "exploration_initial_eps"),
    "a2c": Algorithm((), "gae_lambda", takes_sde=True),  # on-policy, and none of the above
    "recurrent_ppo": Algorithm(("sb3_contrib.common.recurrent.", "sb3_contrib.ppo_recurrent."), takes_sde=True),
    "maskable_ppo": Algorithm(("sb3_contrib.common.maskable.", "sb3_contrib.ppo_mask.")),
    "qrdqn": Algorithm(("sb3_contrib.qrdqn.",)),
    "crossq": Algorithm(("sb3_contrib.crossq.", "sbx.crossq.")),
}
MAX_OBSERVED = 2**22
"""Most numbers of an observation, and most actions to choose from."""
_SPARE = 1_000, 2**20
"""Parameters, and numbers in them, that building a policy may take beside twice those in the file."""
_MAX_NOTES = 2**18
"""Bytes of the pickle that names the tensors in a member: some 100 for each, and each byte may become 60."""
_PER_BYTE = 8
"""Bytes of tensors for each byte of a member, which tensors may share."""


def read_archive(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """Return the settings of a saved model, their pickles closed, with the "version" that saved it; and the weights.

    Those of sbx are in the setting "policy".
    """
    name, version = repr(str(path)), "_stable_baselines3_version"
    try:
        members = read_members(path, ("data", "policy.pth", version))
        header = parse_json_object(members.get("data", b"{}").decode(), f"The member 'data' of {name}")
    except ValueError as error:
        raise ValueError(f"{error} Expected a model as Stable-Baselines3 saves it.") from error
    if ("policy.pth" not in members and "policy" not in header) or "policy_class" not in header:
        raise ValueError(
            f"{name} is a zip file but not a Stable-Baselines3 model: it lacks its members "
            "'data' and 'policy.pth'. Write it with model.save(path)."
        )
    saved_by = members.get(version, b"unknown").decode(errors="replace").strip()
    return {**header, "version": saved_by}, members.get("policy.pth")


def _policy_module(header: Mapping[str, Any]) -> str:
    """Return the module of a saved model's policy; "" if its settings do not tell."""
    policy = header.get("policy_class")
    return str(policy.get("__module__", "")) if isinstance(policy, dict) else ""


def find_algorithm(header: Mapping[str, Any], algo: str | None, name: str) -> str:
    """Return the name of the algorithm of a saved model, one of `ALGORITHMS`, from its settings or as a user says."""
    module = _policy_module(header)
    if algo is not None:
        if algo.lower() not in ALGORITHMS:
            hint = did_you_mean(algo, ALGORITHMS)
            raise ValueError(f"Unknown algorithm {algo!r}{hint}; expected one of {', '.join(ALGORITHMS)}.")
        lacks = ALGORITHMS[algo.lower()].setting
        if lacks and lacks not in header:
            raise ValueError(f"Cannot load {name!r} as {algo.upper()}: its settings have no {lacks}.")
        return algo.lower()
    by_module = [each for each, known in ALGORITHMS.items() if module.startswith(known.policies)]
    by_setting = [each for each, known in ALGORITHMS.items() if known.setting and known.setting in header]
    for each in (*by_module, *by_setting):
        return each
    raise ValueError(
        f"Cannot tell which algorithm saved {name!r} (policy from {module or 'unknown'!r}); "
        f"name it with algo: {', '.join(ALGORITHMS)}."
    )


def build_policy(
    algorithm: str, header: Mapping[str, Any], weights: bytes | None, trust: bool
) -> tuple[Any, dict[str, Any]]:
    """Return the policy of a saved model, on the CPU, and its arguments beside spaces and schedule.

    `ForbiddenObject` is raised if it holds something that may run code, or builds more than it holds; anything if it is
    damaged. With trust the pickles are opened as Stable-Baselines3 does; not those of sbx.
    """
    if weights is None:
        return _build_sbx_policy(algorithm, header)
    names = ("policy_class", "observation_space", "action_space", "policy_kwargs")
    kind, *between, given = (_open_entry(header, name, trust) for name in names)
    from stable_baselines3.common.policies import BasePolicy

    require(isinstance(kind, type) and issubclass(kind, BasePolicy), "its policy_class is no policy")
    for space in between:
        check_space(space)
    layers = given.get("net_arch")
    if isinstance(layers, list) and layers and isinstance(layers[0], dict):  # before Stable-Baselines3 1.8
        given = {**given, "net_arch": layers[0]}
    schedule = () if algorithm == "ars" else (_no_rate,)
    told = {"use_sde": header.get("use_sde") is True} if ALGORITHMS[algorithm].takes_sde else {}
    state = _read_tensors(weights, trust)
    arguments = {name: value for name, value in given.items() if name != "device"}
    with contextlib.nullcontext() if trust else _bounded_parameters(state):
        policy = kind(*between, *schedule, **told, **arguments)
    left = policy.load_state_dict(state, strict=False)
    # before 1.7 the features of actor and critic, one module of several names, were saved once
    missing = [name for name in left.missing_keys if not name.startswith(("pi_features_", "vf_features_"))]
    if missing or left.unexpected_keys:
        raise ValueError(f"its weights lack {missing[:3]} and have {left.unexpected_keys[:3]} beside")
    if header.get("use_sde") is True:  # its exploration is by the loaded deviations, as `load` of SB3 draws it
        policy.reset_noise()
    return policy, dict(given)


_SBX_NETWORKS = {
    "ppo": ("sbx.ppo.policies.PPOPolicy", "actor", "sbx.ppo.policies.Actor"),
    "sac": ("sbx.sac.policies.SACPolicy", "actor", "sbx.common.policies.SquashedGaussianActor"),
    "tqc": ("sbx.tqc.policies.TQCPolicy", "actor", "sbx.common.policies.SquashedGaussianActor"),
    "td3": ("sbx.td3.policies.TD3Policy", "actor", "sbx.td3.policies.Actor"),
    "dqn": ("sbx.dqn.policies.DQNPolicy", "qf", "sbx.dqn.policies.QNetwork"),
}
"""Policies of sbx that are dense layers: their class; where their network is, and its class."""
_SBX_ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "tanh": nn.Tanh,
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "silu": nn.SiLU,
    "leaky_relu": nn.LeakyReLU,
    "gelu": partial(nn.GELU, approximate="tanh"),
}
"""Functions of JAX, and modules that do as they do without further arguments."""


def _build_sbx_policy(algorithm: str, header: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the policy of Stable-Baselines3 that acts as a saved one of sbx, and its arguments beside spaces.

    Its critics, which do not act, are not those of the file.
    """
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
    from stable_baselines3.dqn.policies import DQNPolicy
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    require(algorithm in _SBX_NETWORKS, f"networks of {algorithm.upper()} are not known")
    between = [_open_entry(header, name, trust=False) for name in ("observation_space", "action_space")]
    for space in between:
        check_space(space)
    observed = [*between[0].values()] if isinstance(between[0], spaces.Dict) else [between[0]]
    require(all(isinstance(part, spaces.Box) for part in observed), "its observations are not numbers alone")
    kind, at, network = _SBX_NETWORKS[algorithm]
    saved = read_notes(base64.b64decode(str(header["policy"][":serialized:"])))
    found = saved.name, saved.state[at].name
    require(found == (kind, network), f"it has a {found[0]} with a {found[1]}, which is not known")
    activation = _name_function(saved.state[at].state["activation_fn"])
    require(activation in _SBX_ACTIVATIONS, f"its activation {activation} is not known")
    numbers = make(saved.state[f"{at}_state"].state["params"])["params"]
    layers = [numbers.pop(name) for name in [f"Dense_{place}" for place in range(len(numbers))] if name in numbers]
    beside = [name for name in numbers if name != "log_std"]
    require(not beside, f"its network has {beside[:1]}, which is not known")
    heads = 2 if kind.startswith(("sbx.sac.", "sbx.tqc.")) else 1  # mean and deviation
    widths = [len(layer["bias"]) for layer in layers[:-heads]]
    state = {f"{at}.{name}": torch.from_numpy(one) for at, layer in enumerate(layers) for name, one in layer.items()}
    critics = {"ppo": {"vf": list[int]()}, "dqn": None}.get(algorithm, {"qf": list[int]()})
    arguments = {
        "net_arch": widths if critics is None else {"pi": widths, **critics},
        "activation_fn": _SBX_ACTIVATIONS[activation],
        "normalize_images": False,
        "features_extractor_class": CombinedExtractor if isinstance(between[0], spaces.Dict) else FlattenExtractor,
    }
    classes: dict[str, Any] = {"ppo": ActorCriticPolicy, "dqn": DQNPolicy, "td3": TD3Policy}
    with _bounded_parameters(state):
        policy = classes.get(algorithm, SACPolicy)(*between, _no_rate, **arguments)
    if algorithm == "ppo":
        acting = nn.ModuleList([policy.mlp_extractor.policy_net, policy.action_net])
        if "log_std" in numbers:
            policy.load_state_dict({"log_std": torch.from_numpy(numbers["log_std"])}, strict=False)
    else:
        acting = policy.q_net if algorithm == "dqn" else policy.actor
    dense = [module for module in acting.modules() if isinstance(module, nn.Linear)]
    for module, layer in zip(dense, layers, strict=True):
        module.load_state_dict({"weight": torch.from_numpy(layer["kernel"].T), "bias": torch.from_numpy(layer["bias"])})
    return policy, arguments


def _name_function(value: Any) -> str:
    """Return the name of a function of JAX that a note refers to or holds; another's with its module."""
    if isinstance(value, type) and issubclass(value, Note):
        module, _, name = value.name.rpartition(".")
    elif not isinstance(value.state, dict):  # in the file itself
        return "of its own"
    elif "__name__" in value.state:  # of a derivative of its own
        module, name = value.state["__module__"], value.state["__name__"]
    else:  # compiled
        module, name = value.state["fun"].arguments[1]["__name__"], value.state["function_name"]
    return name if module.startswith("jax.") else f"{module}.{name}"


def _no_rate(_: float) -> float:
    """Return a learning rate of 0: nothing is learned."""
    return 0.0


def _open_entry(header: Mapping[str, Any], name: str, trust: bool) -> Any:
    """Return the value of a setting, its pickle opened."""
    entry = header.get(name, {})
    if not isinstance(entry, dict) or ":serialized:" not in entry:
        return entry
    content = base64.b64decode(str(entry[":serialized:"]))
    try:
        return open_pickle(content, trust)
    except ForbiddenObject as error:
        raise ForbiddenObject(f"in its {name!r} {error}") from error


def _read_tensors(content: bytes, trust: bool) -> dict[str, Tensor]:
    """Return the weights in a `.pth` member, which fit into it, on the CPU."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        raise ValueError("its tensors are not in the format of torch 1.6 and later")
    require(content.count(b"PK\1\2") <= MAX_MEMBERS, f"it has more than {MAX_MEMBERS:,} tensors")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        infos = archive.infolist()
    notes = [info.file_size for info in infos if info.filename.endswith(".pkl")]
    require(max(notes, default=0) <= _MAX_NOTES, "its tensors have more names than any policy")
    stored = all(info.compress_type == zipfile.ZIP_STORED for info in infos)
    fits = stored and sum(info.file_size for info in infos) <= len(content)
    require(fits, "its tensors would unpack to more than the file holds")
    try:
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=not trust)
    except pickle.UnpicklingError:  # whose message advises to load it unsafely
        raise ForbiddenObject("in its 'policy.pth' are damaged tensors, or something else among them") from None
    tensors = isinstance(state, dict) and all(isinstance(one, Tensor) for one in state.values())
    require(tensors, "its 'policy.pth' has something else than tensors")
    size = sum(one.numel() * one.element_size() for one in state.values())
    require(size <= _PER_BYTE * len(content), "it holds tensors larger than their storage")
    return dict(state)


@contextlib.contextmanager
def _bounded_parameters(state: Mapping[str, Tensor]) -> Iterator[None]:
    """Refuse in the block to build networks of more than about so many parameters and numbers."""
    most = _SPARE[0] + 2 * len(state), _SPARE[1] + 2 * sum(one.numel() for one in state.values())
    made = [0, 0]

    def count(_module: nn.Module, _name: str, parameter: Tensor | None) -> None:
        made[0] += 1
        made[1] += 0 if parameter is None else parameter.numel()
        require(made[0] <= most[0] and made[1] <= most[1], "it describes networks of more numbers than it holds")

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        handle.remove()


def check_space(space: Any, depth: int = 0) -> None:
    """Refuse a space whose parts do not go together, or of which one element would fill the memory."""
    if isinstance(space, spaces.Dict) and depth == 0:
        for part in space.spaces.values():
            check_space(part, 1)
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
