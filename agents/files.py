"""Egos and drivers by name: the names, settings in them, and safetensors files with a header of JSON.

A file holds the tensors of a network, and in its header one entry, "driver" or "vision", with everything else that
decides how it drives and where it comes from. Reading a file runs no code in it.
"""

from __future__ import annotations

import difflib
import json
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from itertools import zip_longest
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from rare_envs.files import open_ordinary, parse_json_object, replace_file

RULE_BASED = "idm"
"""The Intelligent Driver Model with lane keeping."""
LANE_CHANGING = "idm+mobil"
"""The same with lane changes by MOBIL; a driver of the traffic."""
VISION, SHIPPED_EGOS, SHIPPED_DRIVERS = "vision", ("imitation",), ("mgail", "gail")
"""Shipped networks: the ego with a camera, drivers that were trained to be egos, drivers of the traffic."""
SHIPPED, SUFFIX = Path(__file__).parent / "data", ".safetensors"
"""Folder of the shipped files, and how files of networks end."""
ADAPTER_ADVICE = (
    "write a function that builds the network and loads it, and name module:function?file={file} (docs/egos.md, "
    "Policies from elsewhere), or export it to ONNX"
)
"""What to do with a file of weights alone."""
DRIVER_ENTRY, VISION_ENTRY = "driver", "vision"
"""A header's one entry: several would be written in no fixed order, and equal drivers not as equal bytes."""

MAX_NETWORK_BYTES, MAX_HEADER_BYTES = 2**28, 2**20
"""Bytes of a file, and of its header with the list of its tensors: the shipped ones have a hundredth of that."""

Network = TypeVar("Network", bound=nn.Module)


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of a driver: data, training and measured quality.

    Example:
        >>> from agents import Provenance
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


def report_missing_file(path: Path, what: str = "ego") -> FileNotFoundError:
    """Return the error for a file that does not exist, with files that a mistyped path may have meant."""
    names = sorted(entry.name for entry in path.parent.glob(f"*{path.suffix}"))
    near = difflib.get_close_matches(path.name, names, n=3, cutoff=0.5) or names[:3]
    if not path.parent.is_dir():
        hint = f": the folder {str(path.parent)!r} does not exist"
    elif not near:
        hint = f": the folder {str(path.parent)!r} has no {path.suffix}"
    else:
        hint = f"; in that folder: {', '.join(near)}"
    return FileNotFoundError(f"No {what} at {str(path)!r}{hint}.")


# --- safetensors ---------------------------------------------------------------------------------


def write_file(path: Path, tensors: Mapping[str, Tensor], entry: str, header: Mapping[str, Any]) -> Path:
    """Write tensors and a header of an entry to a .safetensors; an interrupted call leaves no partial file."""
    if path.suffix != SUFFIX:
        raise ValueError(f"Expected a path that ends with {SUFFIX}, got {str(path)!r}.")
    _check_finite(tensors, path)
    kept = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    content = safetensors.torch.save(kept, {entry: json.dumps(header, allow_nan=False)})
    with replace_file(path) as draft:
        draft.write_bytes(content)
    return path


def read_file(path: Path, *entries: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the header of the first of some entries that a file has, and its tensors."""
    if not path.exists():
        raise report_missing_file(path, entries[0])
    _check_header(path)
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError) as error:
        raise _no_safetensors(path, str(error)) from None
    texts = [header[entry] for entry in entries if entry in header]
    if not texts:
        advice = f"save drivers with agents.save_driver; for another policy {ADAPTER_ADVICE.format(file=path)}"
        raise ValueError(f"{str(path)!r} holds tensors but no {entries[0]}: {advice}.")
    _check_finite(tensors, path)
    return parse_json_object(texts[0], f"The header of {str(path)!r}"), tensors


def _no_safetensors(path: Path, why: str) -> ValueError:
    """Return the error for a file of another format, or a damaged one."""
    pickled = " It looks like a file of torch.save; such files can run code and are not read."
    return ValueError(
        f"{str(path)!r} is not a safetensors file, or is damaged: {why}.{pickled * zipfile.is_zipfile(path)}"
    )


def _check_header(path: Path) -> None:
    """Refuse what is no ordinary file, and one that is larger than a network, or has a larger list of its tensors."""
    with open_ordinary(path, MAX_NETWORK_BYTES) as file:
        size = int.from_bytes(file.read(8), "little")
    if size > MAX_HEADER_BYTES:
        raise _no_safetensors(path, f"a header of {size:,} bytes")


def holds_vision(path: str | PathLike[str]) -> bool:
    """Return whether a file holds a network with a camera; False if it cannot be read."""
    try:
        _check_header(Path(path))
        with safe_open(path, framework="pt") as file:
            return VISION_ENTRY in (file.metadata() or {})
    except (SafetensorError, OSError, ValueError):
        return False


def read_provenance(path: str | PathLike[str]) -> Provenance:
    """Read the origin of a driver, or of a network with a camera.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds neither, or does not say.

    Example:
        >>> from importlib import resources
        >>> from agents import read_provenance
        >>> read_provenance(resources.files("agents") / "data" / "gail.safetensors").kind
        'gail'
    """
    path = Path(path)
    header, _ = read_file(path, DRIVER_ENTRY, VISION_ENTRY)
    names = [each.name for each in fields(Provenance)]
    require(header, names, path)
    return Provenance(**{name: header[name] for name in names})


def check_form(header: Mapping[str, Any], form: Mapping[str, Any], path: Path) -> None:
    """Refuse a file that was made for another form: other features, other pictures, a later version."""
    require(header, form, path)
    for name, ours in form.items():
        theirs = header[name]
        if theirs != ours:
            if isinstance(theirs, list) and isinstance(ours, list):
                theirs, ours = next((a, b) for a, b in zip_longest(theirs, ours) if a != b)
            raise ValueError(f"{str(path)!r} has {name} {theirs!r:.50} where this version reads {ours!r:.50}.")


def read_network(make: Callable[[], Network], tensors: Mapping[str, Tensor], path: Path, prefix: str = "") -> Network:
    """Return a network with the tensors of a file that begin with a prefix, on the CPU and without gradients."""
    with torch.device("meta"):  # shapes only: initial weights would be drawn from the global generator
        network = make()
    expected = {prefix + name: value for name, value in network.state_dict().items()}
    require(tensors, expected, path)
    for name, value in expected.items():
        shape, own = tuple(tensors[name].shape), tensors[name].dtype
        if (shape, own) != (tuple(value.shape), value.dtype):
            wanted = f"shape {tuple(value.shape)} and {value.dtype}"
            raise ValueError(f"{str(path)!r}: expected {name} of {wanted}, got {shape} and {own}.")
    network.load_state_dict({name.removeprefix(prefix): tensors[name] for name in expected}, assign=True)
    return network.eval().requires_grad_(False)


def require(present: Mapping[str, Any], names: Iterable[str], path: Path) -> None:
    """Refuse a file that lacks one of the names."""
    missing = [name for name in names if name not in present]
    if missing:
        raise ValueError(f"{str(path)!r} lacks {', '.join(missing)}; save the driver again with agents.save_driver.")


def _check_finite(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Refuse tensors with NaN or infinite entries."""
    wrong = [name for name, value in tensors.items() if not bool(torch.isfinite(value).all())]
    if wrong:
        raise ValueError(f"{str(path)!r}: expected finite numbers, got inf or NaN in {', '.join(wrong)}.")
