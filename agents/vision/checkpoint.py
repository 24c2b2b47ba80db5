"""The ego `vision` in one file: the network's weights and where they come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open

from agents.learned.checkpoints import SUFFIX, Provenance, check_finite, check_tensor, read_file, require, write_file
from agents.names import VISION
from agents.vision.ego import LAG, SEES, VisionEgo
from agents.vision.pilotnet import HEIGHT, WIDTH, PilotNet

_ENTRY = "vision"
_FORM: Mapping[str, Any] = {"format": 1, "observation": SEES, "picture": [HEIGHT, WIDTH], "lag": LAG}
"""What a network was made for; another one cannot be read."""


def load_vision(name: str | PathLike[str] = VISION) -> VisionEgo:
    """The ego `vision`, or one from a file that `save_vision` wrote.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It holds something else, or was made for other pictures.
    """
    if str(name) == VISION:
        with resources.as_file(resources.files("agents") / "data" / f"{VISION}{SUFFIX}") as path:
            return VisionEgo(_network(path))
    return VisionEgo(_network(Path(name)))


def save_vision(network: PilotNet, provenance: Provenance, path: str | PathLike[str]) -> Path:
    """Write a network to one file.

    Raises:
        ValueError: If the path has another ending than .safetensors, or a weight is NaN or infinite.
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    return write_file(Path(path), tensors, _ENTRY, {**_FORM, **asdict(provenance)})


def read_vision_provenance(path: str | PathLike[str]) -> Provenance:
    """Where a network comes from; errors as in `load_vision`."""
    header, _ = read_file(Path(path), _ENTRY)
    require(header, (f.name for f in fields(Provenance)), Path(path))
    return Provenance(**{f.name: header[f.name] for f in fields(Provenance)})


def holds_vision(path: str | PathLike[str]) -> bool:
    """Whether a file holds a network that sees; False if it cannot be read."""
    try:
        with safe_open(path, framework="pt") as file:
            return _ENTRY in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def _network(path: Path) -> PilotNet:
    header, tensors = read_file(path, _ENTRY)
    for name, ours in _FORM.items():
        if header.get(name) != ours:
            raise ValueError(f"{str(path)!r} has {name} {header.get(name)!r}; this version reads {ours!r}.")
    check_finite(tensors, path)
    with torch.device("meta"):  # shapes only: initial weights would be drawn from the global generator
        network = PilotNet()
    expected = network.state_dict()
    require(tensors, expected, path)
    for name, value in expected.items():
        check_tensor(name, tensors[name], tuple(value.shape), torch.float32, path)
    network.load_state_dict({name: tensors[name] for name in expected}, assign=True)
    return network.arrange().eval().requires_grad_(False)
