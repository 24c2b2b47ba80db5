"""Files of the ego `vision`: the network's weights and their origin."""

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
from agents.vision.ego import LAG, OBSERVATION, VisionEgo
from agents.vision.pilotnet import HEIGHT, WIDTH, PilotNet

_ENTRY = "vision"
_FORMAT: Mapping[str, Any] = {"format": 1, "observation": OBSERVATION, "picture": [HEIGHT, WIDTH], "lag": LAG}
"""Observation that a network was trained for; a file with another one is refused."""


def load_vision(name: str | PathLike[str] = VISION) -> VisionEgo:
    """Load the ego `vision`, or one from a file that `save_vision` wrote.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: It holds something else, or was made for other pictures.

    Example:
        >>> sorted(load_vision().observation_space)
        ['camera', 'speed']
    """
    if str(name) == VISION:
        with resources.as_file(resources.files("agents") / "data" / f"{VISION}{SUFFIX}") as path:
            return VisionEgo(_read_network(path))
    return VisionEgo(_read_network(Path(name)))


def save_vision(network: PilotNet, provenance: Provenance, path: str | PathLike[str]) -> Path:
    """Write a network to one file.

    Raises:
        ValueError: If the path has another ending than .safetensors, or a weight is NaN or infinite.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     origin = Provenance(kind="untrained", command="-", data="-", data_licence="CC0")
        ...     path = save_vision(PilotNet(), origin, Path(folder) / "mine.safetensors")
        ...     print(read_vision_provenance(path).kind, type(load_vision(path)).__name__)
        untrained VisionEgo
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    return write_file(Path(path), tensors, _ENTRY, {**_FORMAT, **asdict(provenance)})


def read_vision_provenance(path: str | PathLike[str]) -> Provenance:
    """Read the origin of a network; raises as `load_vision` does.

    Example:
        >>> from importlib import resources
        >>> read_vision_provenance(resources.files("agents") / "data" / "vision.safetensors").kind
        'imitation of a driver by rule with on-policy corrections (DAgger), corrected'
    """
    header, _ = read_file(Path(path), _ENTRY)
    require(header, (f.name for f in fields(Provenance)), Path(path))
    return Provenance(**{f.name: header[f.name] for f in fields(Provenance)})


def holds_vision(path: str | PathLike[str]) -> bool:
    """Return whether a file holds a network with a camera; False if it cannot be read."""
    try:
        with safe_open(path, framework="pt") as file:
            return _ENTRY in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def _read_network(path: Path) -> PilotNet:
    """Read a network onto the CPU, without gradients."""
    header, tensors = read_file(path, _ENTRY)
    for name, ours in _FORMAT.items():
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
