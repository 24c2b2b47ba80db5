"""Recordings: scenes as tensors, padded to one number of vehicles and ticks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from training.data.scenes import TrafficScene

PARKING_X = -1e4
"""Position [m] of vehicles that do not exist: beyond the range of any sensor, each `_PARKING_GAP` from the next."""
_PARKING_GAP = 300.0


class Recording(NamedTuple):
    """S scenes of at most T ticks, V vehicles and L lanes, single precision; units and frame as in `TrafficScene`.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> recording = stack_scenes(scenes_of(synthetic_traffic(seconds=5.0), seconds=5.0))
        >>> tuple(recording.x.shape), tuple(recording.edges.shape), recording.ticks.tolist()
        ((1, 49, 9), (1, 4), [49])
    """

    x: Tensor
    """Shape (S, T, V), as the next five; 0 where absent."""
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor
    yaw_rate: Tensor
    present: Tensor
    """True where a vehicle is recorded, shape (S, T, V)."""
    acts: Tensor
    """True where its acceleration and yaw rate are known, shape (S, T, V)."""
    length: Tensor
    """Shape (S, V)."""
    width: Tensor
    edges: Tensor
    """Lane boundaries from left to right [m], shape (S, L + 1); beyond the last lane the last edge is repeated."""
    ticks: Tensor
    """Number of ticks of each scene, shape (S,)."""


def stack_scenes(scenes: Sequence[TrafficScene]) -> Recording:
    """Return scenes as one recording.

    Raises:
        ValueError: There is no scene.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> scene = scenes_of(synthetic_traffic(seconds=5.0), seconds=5.0)[0]
        >>> tuple(stack_scenes([scene, scene]).x.shape)
        (2, 49, 9)
    """
    if not scenes:
        raise ValueError("Expected at least one scene, got none.")
    ticks = max(scene.x.shape[0] for scene in scenes)
    vehicles = max(scene.x.shape[1] for scene in scenes)
    lanes = max(len(scene.edges) for scene in scenes)

    def pad(name: str) -> Tensor:
        out = np.zeros((len(scenes), ticks, vehicles), dtype=np.float32)
        for row, scene in zip(out, scenes, strict=True):
            values = getattr(scene, name)  # a field by its name
            row[: values.shape[0], : values.shape[1]] = np.nan_to_num(values)
        return torch.from_numpy(out)

    def sizes(name: str, fill: float) -> Tensor:
        out = np.full((len(scenes), vehicles), fill, dtype=np.float32)
        for row, scene in zip(out, scenes, strict=True):
            values = getattr(scene, name)  # likewise
            row[: len(values)] = values
        return torch.from_numpy(out)

    present = pad("present") > 0
    known = np.zeros(present.shape, dtype=bool)
    for row, scene in zip(known, scenes, strict=True):
        whole = np.isfinite(scene.acceleration) & np.isfinite(scene.yaw_rate) & scene.present
        row[: whole.shape[0], : whole.shape[1]] = whole
    edges = [tuple(scene.edges) + (scene.edges[-1],) * (lanes - len(scene.edges)) for scene in scenes]
    return Recording(
        x=pad("x"),
        y=pad("y"),
        heading=pad("heading"),
        speed=pad("speed"),
        acceleration=pad("acceleration"),
        yaw_rate=pad("yaw_rate"),
        present=present,
        acts=torch.from_numpy(known),
        length=sizes("length", 1.0),
        width=sizes("width", 1.0),
        edges=torch.tensor(edges, dtype=torch.float32),
        ticks=torch.tensor([scene.x.shape[0] for scene in scenes]),
    )


def parking_positions(like: Tensor) -> Tensor:
    """Return x of vehicles that do not exist [m], of the shape of the given tensor, (..., V)."""
    number = torch.arange(like.shape[-1], dtype=like.dtype, device=like.device)
    return (PARKING_X - _PARKING_GAP * number).expand_as(like)
