"""Files of learned drivers: one safetensors file each, with everything that decides how it drives.

The tensors are those of the network, with its scaling and the cap of its log standard deviation. If the last layer's
weights have a distribution, its mean and the non-zero entries of its precision follow. The rest is JSON in the header:
features, noise colour, limits of the actions, the rule of collision avoidance and the lane changes if it has them, and
where the driver comes from. Reading a file runs no code in it.
"""

import difflib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from agents.learned.collision_avoidance import CollisionAvoidance
from agents.learned.driver import LearnedDriver, RuleDriver
from agents.learned.lane_changes import LaneChanges
from agents.learned.networks import (
    ACTION_SIZE,
    FEATURE_CLIP,
    FEATURE_SIZE,
    HEAD_SIZE,
    AutoregressiveNoise,
    Policy,
    Scaling,
)
from agents.learned.weight_distribution import WeightDistribution
from agents.names import LANE_CHANGING, RULE_BASED, SHIPPED_DRIVERS, SHIPPED_EGOS, read_settings
from rare_envs.control.lane_changing import LaneChangingDriver
from rare_envs.files import parse_json_object, replace_file
from rare_envs.plugins import did_you_mean
from rare_envs.sensors.lidar import FEATURES

SUFFIX = ".safetensors"
FORMAT = 1
"""Version of the header."""
_HEADER = "driver"
"""The header's one entry: several would be written in no fixed order, and equal drivers not as equal bytes."""
_POLICY, _WEIGHTS = "policy.", "weights."


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of a driver: data, training and measured quality.

    Example:
        >>> Provenance(kind="gail", command="python train.py", data="own recordings", data_licence="CC0").metrics
        {}
    """

    kind: str
    """Training method, such as "mgail"."""
    command: str
    """Command that repeats the training."""
    data: str
    """Recordings that it was trained on."""
    data_licence: str
    """Of the data; the driver is passed on under its terms."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """Measured quality: names to numbers, or to names and numbers."""
    ensemble: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the fit of the distribution of its weights."""


@dataclass(frozen=True)
class DriverSettings:
    """What can be set in the name of a shipped driver."""

    rules: bool = True
    """Whether its rules bound its actions and change lanes."""


def load_driver(name: str | PathLike[str]) -> LearnedDriver | RuleDriver | LaneChangingDriver:
    """Load a driver by its name or from its file.

    Args:
        name: "mgail" or "gail", which are shipped, and "imitation", which was trained to be an ego; "mgail?rules=0", it
            without its rules; "idm", the rule-based driver, and "idm+mobil", which changes lanes too; or the path of a
            file that `save_driver` wrote.

    Returns:
        A `LearnedDriver`, or a `RuleDriver` or `LaneChangingDriver` with its default parameters.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The name is none of these, or the file is no driver.

    Example:
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
    if text == LANE_CHANGING:
        return LaneChangingDriver()
    shipped, _, query = text.partition("?")
    if shipped in (*SHIPPED_DRIVERS, *SHIPPED_EGOS):
        settings = DriverSettings(**read_settings(DriverSettings, query))
        with resources.as_file(resources.files("agents") / "data" / f"{shipped}{SUFFIX}") as path:
            driver = read_driver(path)
        return driver if settings.rules else driver.without_rules()
    if text.endswith(SUFFIX) or Path(text).is_file():
        return read_driver(text)
    names = (*SHIPPED_DRIVERS, *SHIPPED_EGOS, RULE_BASED, LANE_CHANGING)
    hint = did_you_mean(text.lower(), names)
    if Path(f"{text}{SUFFIX}").is_file():
        hint = f" (did you mean {text + SUFFIX!r}?)"
    raise ValueError(f"Unknown driver {text!r}{hint}; expected {', '.join(map(repr, names))} or a path to a {SUFFIX}.")


def save_driver(driver: LearnedDriver, provenance: Provenance, path: str | PathLike[str]) -> Path:
    """Write a driver to one file; an interrupted call leaves no partial file.

    Args:
        driver: The driver.
        provenance: Its origin; numbers, strings, lists and mappings only.
        path: Ends with .safetensors.

    Returns:
        The path.

    Raises:
        ValueError: If the path has another ending, or something is NaN or infinite.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     origin = Provenance(kind="gail", command="-", data="-", data_licence="CC0")
        ...     path = save_driver(load_driver("gail"), origin, Path(folder) / "mine.safetensors")
        ...     print(read_driver(path).name, read_provenance(path).data_licence)
        gail CC0
    """
    path = Path(path)
    tensors = {_POLICY + name: value.detach().cpu().contiguous() for name, value in driver.policy.state_dict().items()}
    if driver.weights is not None:
        arrays = driver.weights.to_arrays()
        tensors |= {_WEIGHTS + name: torch.from_numpy(np.array(value)) for name, value in arrays.items()}
    header = {
        "format": FORMAT,
        "name": driver.name,
        "features": FEATURES,
        "feature_clip": FEATURE_CLIP,
        "log_std_cap": float(driver.policy.log_std_cap),
        "colour": asdict(driver.colour),
        "acceleration": driver.acceleration,
        "yaw_rate": driver.yaw_rate,
        "avoidance": None if driver.avoidance is None else asdict(driver.avoidance),
        "hard_braking": driver.hard_braking,
        "changes": None if driver.changes is None else asdict(driver.changes),
        "radius": None if driver.weights is None else driver.weights.radius,
        **asdict(provenance),
    }
    return write_file(path, tensors, _HEADER, header)


def read_driver(path: str | PathLike[str]) -> LearnedDriver:
    """Read a driver that `save_driver` wrote, onto the CPU and without gradients.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a safetensors file, lacks something, has a tensor of the wrong shape or type, or was made
            for other features; the message says which.

    Example:
        >>> from importlib import resources
        >>> read_driver(resources.files("agents") / "data" / "gail.safetensors").acceleration
        (-8.0, 4.0)
    """
    path = Path(path)
    header, tensors = read_file(path)
    _check_header(header, path)
    check_finite(tensors, path)
    policy = _policy(tensors, path)
    rule, changes = header.get("avoidance"), header.get("changes")  # earlier files have none
    try:
        return LearnedDriver(
            policy,
            colour=AutoregressiveNoise.from_json(header["colour"]),
            acceleration=header["acceleration"],
            yaw_rate=header["yaw_rate"],
            weights=_weights(tensors, header["radius"], path),
            avoidance=None if rule is None else CollisionAvoidance(**rule),
            hard_braking=header.get("hard_braking", 1.0),
            changes=None if changes is None else LaneChanges(**changes),
            name=header["name"],
        )
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"{str(path)!r} is no usable driver: {error}") from None


def read_provenance(path: str | PathLike[str]) -> Provenance:
    """Read the origin of a driver; raises as `read_driver` does.

    Example:
        >>> from importlib import resources
        >>> read_provenance(resources.files("agents") / "data" / "gail.safetensors").kind
        'gail'
    """
    path = Path(path)
    header, _ = read_file(path)
    require(header, (f.name for f in fields(Provenance)), path)
    return Provenance(**{f.name: header[f.name] for f in fields(Provenance)})


# --- files of any kind --------------------------------------------------------------------------


def write_file(path: Path, tensors: Mapping[str, Tensor], entry: str, header: Mapping[str, Any]) -> Path:
    """Write tensors and a header to a file; an interrupted call leaves no partial file.

    Args:
        path: Ends with .safetensors.
        tensors: By name.
        entry: What the file holds, such as "driver": the header's one name.
        header: Numbers, strings, lists and mappings only.

    Raises:
        ValueError: If the path has another ending, or something is NaN or infinite.
    """
    if path.suffix != SUFFIX:
        raise ValueError(f"Expected a path that ends with {SUFFIX}, got {str(path)!r}.")
    check_finite(tensors, path)
    content = safetensors.torch.save(dict(tensors), {entry: json.dumps(header, allow_nan=False)})
    with replace_file(path) as draft:
        draft.write_bytes(content)
    return path


def read_file(path: Path, entry: str = _HEADER) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read header and tensors of a file that `write_file` wrote.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no safetensors file, or has no such entry in its header.
    """
    if not path.is_file():
        near = [] if not path.parent.is_dir() else sorted(each.name for each in path.parent.glob(f"*{SUFFIX}"))
        near = difflib.get_close_matches(path.name, near, n=3) or near[:3]
        raise FileNotFoundError(f"No {entry} at {str(path)!r}{'; there are ' + ', '.join(near) if near else ''}.")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(entry)
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError) as error:
        pickled = " It looks like a file of torch.save; such files can run code and are not read." * _is_zip(path)
        raise ValueError(f"{str(path)!r} is not a safetensors file, or is damaged: {error}.{pickled}") from None
    if text is None:
        raise ValueError(f"{str(path)!r} holds tensors but no {entry}: save drivers with agents.save_driver.")
    return parse_json_object(text, f"The header of {str(path)!r}"), tensors


def _is_zip(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) == b"PK"


def require(present: Mapping[str, Any], names: Any, path: Path) -> None:
    """Refuse a file that lacks one of the names."""
    missing = [name for name in names if name not in present]
    if missing:
        raise ValueError(f"{str(path)!r} lacks {', '.join(missing)}; save the driver again with agents.save_driver.")


def _check_header(header: Mapping[str, Any], path: Path) -> None:
    require(header, ("format", "features", "feature_clip"), path)
    if header["format"] != FORMAT:
        raise ValueError(f"{str(path)!r} has format {header['format']!r}; this version reads format {FORMAT}.")
    require(header, ("name", "colour", "acceleration", "yaw_rate", "radius"), path)
    theirs = header["features"]
    if not isinstance(theirs, list) or theirs != list(FEATURES):
        pairs = zip(theirs, FEATURES, strict=False) if isinstance(theirs, list) else []
        first = next((f"; the first difference is {a!r} for {b!r}" for a, b in pairs if a != b), "")
        count = len(theirs) if isinstance(theirs, list) else 0
        raise ValueError(f"{str(path)!r} is for {count} other features, expected the {len(FEATURES)} of today{first}.")
    if header["feature_clip"] != FEATURE_CLIP:
        raise ValueError(f"{str(path)!r} clips features at {header['feature_clip']!r}, this version at {FEATURE_CLIP}.")


def check_finite(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Refuse tensors with NaN or infinite entries."""
    wrong = [name for name, value in tensors.items() if not bool(torch.isfinite(value).all())]
    if wrong:
        raise ValueError(f"{str(path)!r}: expected finite numbers, got inf or NaN in {', '.join(wrong)}.")


def _policy(tensors: Mapping[str, Tensor], path: Path) -> Policy:
    with torch.device("meta"):  # shapes only: initial weights would be drawn from the global generator
        policy = Policy(
            Scaling(*(torch.empty(size) for size in (FEATURE_SIZE, FEATURE_SIZE, ACTION_SIZE, ACTION_SIZE)))
        )
    expected = policy.state_dict()
    require(tensors, (_POLICY + name for name in expected), path)
    state = {name: tensors[_POLICY + name] for name in expected}
    for name, value in state.items():
        check_tensor(_POLICY + name, value, tuple(expected[name].shape), torch.float32, path)
    policy.load_state_dict(state, assign=True)
    return policy.eval().requires_grad_(False)


def _weights(tensors: Mapping[str, Tensor], radius: Any, path: Path) -> WeightDistribution | None:
    if radius is None:
        return None
    names = ("mean", "rows", "columns", "precision")
    require(tensors, (_WEIGHTS + name for name in names), path)
    check_tensor(f"{_WEIGHTS}mean", tensors[f"{_WEIGHTS}mean"], (HEAD_SIZE,), torch.float64, path)
    return WeightDistribution.from_arrays({name: tensors[_WEIGHTS + name].numpy() for name in names}, radius)


def check_tensor(name: str, value: Tensor, shape: tuple[int, ...], dtype: torch.dtype, path: Path) -> None:
    """Refuse a tensor of another shape or type."""
    if tuple(value.shape) != shape or value.dtype != dtype:
        raise ValueError(
            f"{str(path)!r}: expected {name} of shape {shape} and {dtype}, got {tuple(value.shape)} and {value.dtype}."
        )
