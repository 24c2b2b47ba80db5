"""Loading of egos by name, file, address or function, and of drivers of the traffic by name or file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from os import PathLike
from os.path import isfile
from pathlib import Path
from typing import Any, Final, Protocol, cast, runtime_checkable
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from agents import files
from agents.files import ADAPTER_ADVICE, RULE_BASED, SHIPPED_DRIVERS, SHIPPED_EGOS, SUFFIX, VISION
from agents.imperfect_stack import NoisyEgo, Stack
from agents.learned.driver import LearnedDriver, LearnedEgo, RuleDriver, read_driver
from agents.learned.networks import HUMAN_NOISE
from agents.saved_ego import HUB_PREFIX, find_hub_model, load_saved_ego
from agents.vision import load_vision
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.egos.needs import RULE_BASED_EGOS, wrap_callable
from rare_envs.plugins import EgoGone, did_you_mean, is_policy, make_object, names_object, refuse_ego
from rare_envs.startup import advise_install

EGO_NAMES = (*RULE_BASED_EGOS, *SHIPPED_EGOS, VISION, *SHIPPED_DRIVERS)
EXPECTED_EGO: Final = (
    f"{', '.join(map(repr, EGO_NAMES))}, a path to a {SUFFIX} or "
    "Stable-Baselines3 .zip, hf:USER/REPOSITORY, "
    "an .onnx file, module:function, tcp://host:port, or process:EGO for one of these in a process of its own, "
    "noisy:EGO for one behind the imperfections of a full stack"
)
EGO_SUFFIXES = (".zip", ".onnx", SUFFIX)
"""How the files of egos end."""
WEIGHTS_SUFFIXES = (".pt", ".pth", ".pt2", ".bin", ".ckpt", ".cleanrl_model", ".pkl", ".pickle", ".msgpack")
"""How files end that code of the user's opens."""


@runtime_checkable
class Ego(Protocol):
    """Policy that drives the ego vehicle: Stable-Baselines3's `predict`, called on whole batches.

    Example:
        >>> import agents, numpy as np
        >>> class Coasting:
        ...     def predict(self, observation, state=None, episode_start=None, deterministic=True):
        ...         return np.zeros((len(observation), 2), np.float32), None
        >>> isinstance(Coasting(), agents.Ego)
        True
    """

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch.

        Args:
            observation: Observations of B scenarios, shape (B, F).
            state: Memory of a recurrent policy from the step before; None at the start.
            episode_start: Rows that begin a new episode, shape (B,).
            deterministic: Take the mean (or best) action, without exploration noise.

        Returns:
            Actions, shape (B, 2) in [-1, 1] or (B,) integers, and the memory to pass on.
        """
        ...


def load_ego(
    spec: str | Path, algo: str | None = None, trust: bool = False, stats: str | Path | None = None
) -> Ego | LearnedEgo | str:
    """Load an ego by its name, file, address or function.

    Args:
        spec: "idm"; "human", an attentive human driver, or "human:no-headway-rule", who looks away for as long as it
            likes; "cc_human", "alks", "fsm" or "rss", reference drivers (`rare_envs.egos.reference`); all with other
            parameters as "idm?time_headway=2&exponent=2" (fields of `rare_envs.IDM` and
            `rare_envs.control.human_driver.HumanDriverModel`; a longer `reaction_time` alone makes contacts 100 to 300
            times as frequent, which people's are not); "imitation", the shipped ego with lidar; "vision", PilotNet on
            the front camera; "mgail" or "gail", drivers of the traffic, by their mean actions ("mgail?rules=0" by its
            network alone); a path to a `.safetensors` with one of these kinds, to a `.zip` saved by Stable-Baselines3,
            or to an `.onnx` file (`agents.onnx.OnnxEgo` has its form); "hf:USER/REPOSITORY", such a `.zip` of the
            Hugging Face Hub; `module:function`, a function that returns an ego (modules in the working directory are
            found), called without arguments, with file="a.pt" for "module:function?file=a.pt"; `tcp://host:port` for an
            ego in another program (docs/egos.md); `process:EGO`, any of these files and functions in a process of its
            own, which is ended and started again if the ego hangs or dies; `noisy:EGO`, any ego behind the
            imperfections of a full stack (`agents.imperfect_stack.Stack`).
        algo: Algorithm of a `.zip`, such as "ppo"; recognised from the file when None.
        trust: Open the pickles in a `.zip` as Stable-Baselines3 does, which runs any code in them. Without it
            a file that needs code of its author's is refused, and one to which everybody may write.
        stats: File of the `VecNormalize` statistics of a `.zip`; None to look for one beside it, such as
            `<name>_vecnormalize.pkl` or `vecnormalize.pkl`.

    Returns:
        Names of rule-based egos as they stand, with settings an `IDM`, a `HumanEgo` or a `ReferenceEgo`; a
        `LearnedEgo`, else an object with `predict`. A `.zip` gives a `SavedEgo`, whose `observation_space` and
        `action_space` are the policy's.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The spec is none of these, is damaged, fails or is not trusted; or algo or stats is given for
            something that is no `.zip`.

    Example:
        >>> import numpy as np
        >>> from agents import load_ego
        >>> load_ego("idm")
        'idm'
        >>> ego = load_ego("imitation")
        >>> ego.predict(np.zeros((2, 51), np.float32))[0].shape
        (2, 2)
        >>> load_ego("imitatoin")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: Unknown ego 'imitatoin' (did you mean 'imitation'?); expected ...
    """
    text = str(spec)
    kind = find_ego_kind(text)
    if kind == "unknown":
        raise ValueError(f"Unknown ego {text!r}{suggest_ego(text)}; expected {EXPECTED_EGO}.")
    for name, value in (("algo", algo), ("stats", stats)):
        if value is not None and kind not in ("zip", "hub", "noisy", "process"):
            raise ValueError(
                f"Expected {name} for a Stable-Baselines3 .zip only, got {str(value)!r} for {text!r}; leave it out."
            )
    return cast(Ego, KINDS[kind][1](text, algo, trust, stats))


def find_ego_kind(spec: str) -> str:
    """Return the kind of ego of a name, file, address or function, one of `KINDS`, or "unknown"."""
    return next((kind for kind, (is_one, _) in KINDS.items() if is_one(spec)), "unknown")


def names_function(spec: str) -> bool:
    """Return whether a name has the form of `module:function`, which a file may have too."""
    return names_object(spec) and spec.partition(":")[0] not in RULE_BASED_EGOS


def _is_function(spec: str) -> bool:
    """Return whether a name is a function, whatever file its settings name, and not a file of such a name."""
    return names_function(spec) and not isfile(spec) and ("?" in spec or not spec.endswith(EGO_SUFFIXES))


_WRAPPERS = {"noisy:": {each.name for each in fields(Stack)}, "process:": {"timeout", "patience"}}
"""What stands around another ego, and its settings."""


def split_wrapper(spec: str) -> tuple[str, str]:
    """Return the ego inside "noisy:EGO?settings" or "process:EGO?settings", and the settings of what is around it.

    They stand behind the last "?" and are the inner ego's if one is none of the wrapper's and the ego takes such.
    """
    wrapper, _, inner = spec.partition(":")
    ego, _, query = inner.rpartition("?")
    names = {each.partition("=")[0] for each in query.split("&")}
    own = names <= _WRAPPERS[f"{wrapper}:"] or not _takes_settings(ego, names)
    return (ego, query) if "?" in inner and own and not isfile(inner) else (inner, "")


def _takes_settings(ego: str, names: set[str]) -> bool:
    """Return whether settings may be those of an ego, which has none yet or stands inside others."""
    if rule_based := RULE_BASED_EGOS.get(ego):
        return any(hasattr(getattr(rule_based, "model", rule_based), name) for name in names)
    shipped = ego in (*SHIPPED_DRIVERS, *SHIPPED_EGOS)
    return ego.startswith((*_WRAPPERS,)) or ("?" not in ego and (shipped or "://" in ego or _is_function(ego)))


def strip_prefixes(spec: str) -> str:
    """Return the ego inside `noisy:` and `process:`, without their settings."""
    while spec.startswith((*_WRAPPERS,)):
        spec, _ = split_wrapper(spec)
    return spec


def suggest_ego(text: str) -> str:
    """Return a hint at the ego that a misspelt name may mean: a known name or a `.zip` saved nearby."""
    saved = Path(f"{text}.zip")
    if saved.is_file():
        return f" (did you mean {str(saved)!r}?)"
    if text and Path(text).is_dir():
        near = sorted(path.name for path in Path(text).iterdir() if path.suffix in EGO_SUFFIXES)
        return f" (a folder; name a file in it: {', '.join(near[:5])})" if near else " (a folder without egos)"
    missing = " (there is no such file)" if Path(text).suffix or "/" in text else ""
    return did_you_mean(text, EGO_NAMES) or missing


# --- kinds --------------------------------------------------------------------------------------


def _load_rule_based(text: str, *_: Any) -> Any:
    """Return a name as it stands; with settings behind it, the driver that has them."""
    name, mark, query = text.partition("?")
    if not mark:
        return text
    try:
        ego = RULE_BASED_EGOS[name]
        if hasattr(ego, "model"):  # a human or reference driver
            return replace(ego, model=replace(ego.model, **_read_settings(type(ego.model), query)))
        return replace(ego, **_read_settings(type(ego), query))
    except ValueError as error:
        raise ValueError(f"The ego {text!r}: {error}") from None


def _load_noisy(text: str, *how: Any) -> NoisyEgo:
    """Return any ego behind the imperfections of a full stack."""
    inner, settings = _require_inner_ego(text)
    stack = Stack(**_read_settings(Stack, settings))
    return NoisyEgo(load_ego(inner, *how), stack)


def _load_elsewhere(text: str, *how: Any) -> Any:
    """Connect to an ego in another program, or in a process of its own."""
    try:
        from agents.remote.client import connect, isolate
    except ImportError as error:
        raise ValueError(f"{text!r} needs pyzmq and msgpack: {advise_install('remote')}.") from error
    try:
        return isolate(*_require_inner_ego(text), *how) if text.startswith("process:") else connect(text)
    except EgoGone as error:
        raise ValueError(str(error)) from error


def _load_onnx(text: str, *_: Any) -> Any:
    """Return the ego in an ONNX file, whose reader is optional."""
    from agents.onnx import OnnxEgo

    return OnnxEgo(Path(text))


def _refuse_url(text: str, *_: Any) -> Any:
    raise ValueError(f"Will not load an ego from {text!r}: download the file, look where it comes from, name it.")


def _refuse_weights(text: str, *_: Any) -> Any:
    raise ValueError(f"Code of yours opens a file such as {text!r}: {ADAPTER_ADVICE.format(file=text)}.")


def _make_ego(spec: str, *_: Any) -> Any:
    """Return what `module:name` gives: "idm" or an object with `predict`; a plain function is wrapped in one."""
    ego = wrap_callable(make_object(spec, "ego"))
    rule_based = isinstance(ego, str) and ego == RULE_BASED  # an array, say, compares element by element
    if not rule_based and not is_policy(ego):
        refuse_ego(ego, f"from {spec!r}")
    return ego


KINDS: dict[str, tuple[Callable[[str], bool], Callable[..., Any]]] = {
    "process": (lambda spec: spec.startswith("process:"), _load_elsewhere),
    "noisy": (lambda spec: spec.startswith("noisy:"), _load_noisy),
    "hub": (
        lambda at: at.startswith(HUB_PREFIX),
        lambda at, *how: load_saved_ego(cast(Path, find_hub_model(at)), *how),
    ),
    "remote": (lambda spec: spec.startswith(("tcp://", "ipc://")), _load_elsewhere),
    "function": (_is_function, _make_ego),
    "url": (lambda spec: "://" in spec, _refuse_url),
    "rule": (lambda spec: spec.partition("?")[0] in RULE_BASED_EGOS, _load_rule_based),
    "vision": (
        lambda spec: spec == VISION or (spec.endswith(SUFFIX) and files.holds_vision(spec)),
        lambda text, *_: load_vision(text),
    ),
    "learned": (
        lambda spec: spec.partition("?")[0] in (*SHIPPED_DRIVERS, *SHIPPED_EGOS) or spec.endswith(SUFFIX),
        lambda text, *_: LearnedEgo(cast(LearnedDriver, load_driver(text))),
    ),
    "onnx": (lambda spec: spec.endswith(".onnx"), _load_onnx),
    "weights": (lambda spec: spec.endswith(WEIGHTS_SUFFIXES) and isfile(spec), _refuse_weights),
    "zip": (
        lambda spec: spec.endswith(".zip") or isfile(spec),  # of too long a name too
        lambda text, *how: load_saved_ego(Path(text), *how),
    ),
}
"""Kinds of ego, the first that holds of a name counts: whether it does, and how the ego is loaded."""


def _require_inner_ego(text: str) -> tuple[str, str]:
    """Return the ego behind "noisy:" or "process:", and the settings of these."""
    kind, _, inner = text.partition(":")
    if not inner.partition("?")[0]:
        raise ValueError(f"Expected an ego behind {kind + ':'!r}, such as {kind}:model.zip, got {text!r}.")
    return split_wrapper(text)


_SETTINGS: dict[type, tuple[str, Callable[[float], bool]]] = {
    float: ("a finite number >= 0", math.isfinite),
    int: ("a whole number >= 0", float.is_integer),
    bool: ("1 (yes) or 0 (no)", (0.0, 1.0).__contains__),
}
"""Types of the settings in a name: what is expected, and whether a number >= 0 is it."""


def _read_settings(kind: type, query: str) -> dict[str, Any]:
    """Return numbers for fields of a dataclass from "name=value&name=value"; of true or false, from 1 or 0."""
    known = {each.name: type(each.default) for each in fields(kind) if isinstance(each.default, int | float)}
    given: dict[str, Any] = {}
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in known:
            raise ValueError(f"Unknown setting {name!r}{did_you_mean(name, known)}; expected {', '.join(known)}.")
        if name in given:
            raise ValueError(f"Expected {name} once, got it again as {text!r}.")
        expected, is_one = _SETTINGS[known[name]]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not value >= 0 or not is_one(value):
            raise ValueError(f"Expected {name} to be {expected}, got {text!r}.")
        given[name] = known[name](value)
    return given


def load_driver(name: str | PathLike[str]) -> LearnedDriver | RuleDriver | LaneChangingDriver:
    """Load a driver by its name or from its file.

    The names are "mgail" and "gail", which are shipped, and "imitation", which was trained to be an ego;
    "mgail?rules=0", it without its rules; "idm", the rule-based driver, and "idm+mobil", which changes lanes too. A
    file is one that `save_driver` wrote. A ValueError says that the name is none of these, or the file no driver.

    Example:
        >>> from agents import load_driver
        >>> load_driver("gail").name
        'gail'
        >>> load_driver("mgail?rules=0").changes is None
        True
        >>> load_driver("idm").noisy
        False
    """
    text = str(name)
    if text == RULE_BASED:
        return RuleDriver()
    if text == files.LANE_CHANGING:
        return LaneChangingDriver()
    shipped, _, query = text.partition("?")
    if shipped in (*SHIPPED_DRIVERS, *SHIPPED_EGOS):
        if query not in ("", "rules=0", "rules=1"):
            raise ValueError(f"Expected {shipped} or {shipped}?rules=0, got {text!r}.")
        driver = read_driver(files.SHIPPED / f"{shipped}{SUFFIX}")
        if query != "rules=0":
            return driver
        return replace(driver, colour=HUMAN_NOISE, avoidance=None, hard_braking=1.0, changes=None)
    if text.endswith(SUFFIX) or Path(text).is_file():
        return read_driver(text)
    names = (*SHIPPED_DRIVERS, *SHIPPED_EGOS, RULE_BASED, files.LANE_CHANGING)
    saved = Path(f"{text}{SUFFIX}")
    hint = f" (did you mean {str(saved)!r}?)" if saved.is_file() else did_you_mean(text, names)
    raise ValueError(f"Unknown driver {text!r}{hint}; expected {', '.join(map(repr, names))} or a path to a {SUFFIX}.")
