"""Devices: where torch simulates, how much at once, and what values there cost to make and to look at.

A processor's values are at hand. To look at one of a GPU is to wait until everything before it is computed, and no
recorded rollout can do it (`rare_envs.simulation.cuda_graphs`), so there both ways of a branch are computed.
"""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import torch
from torch import Tensor


def find_device(name: str) -> torch.device:
    """Return a device by its name, "cpu", "cuda" or "cuda:1"; a ValueError if it is not there."""
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise ValueError(f"Expected device 'cpu', 'cuda' or 'cuda:1', got {name!r}.")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        found = torch.cuda.device_count()
        raise ValueError(f"device={name!r} is not here: torch {torch.__version__} sees {found} GPUs; take 'cpu'.")
    return device


@cache  # never forgotten: recorded rollouts read it where it is
def _make_constant(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # made under it they could not be used for gradients later
        return torch.tensor(values, dtype=dtype, device=device)


@cache  # likewise
def _make_scalars(numbers: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    return tuple(_make_constant(number, dtype, device) for number in numbers)


@cache  # likewise
def _draw(shape: tuple[int, ...], seed: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(shape, generator=generator, dtype=torch.float64).to(device, dtype)


def constant(values: Any, like: Tensor) -> Tensor:
    """Return numbers as a tensor with dtype and device of another, made once; nobody may write to it."""
    return _make_constant(values, like.dtype, like.device)


def scalars(numbers: tuple[float, ...], like: Tensor) -> tuple[Tensor, ...]:
    """Return numbers as tensors of shape (), made once, as `constant`; floating-point ones whatever `like` has.

    An operation with a few rows takes half as long with such a tensor as with a number, of which torch makes one.
    """
    dtype = like.dtype if like.is_floating_point() else torch.get_default_dtype()
    return _make_scalars(numbers, dtype, like.device)


def indices(numbers: tuple[int, ...], like: Tensor) -> Tensor:
    """Return indices, int64, on the device of a tensor, made once, as `constant`."""
    return _make_constant(numbers, torch.int64, like.device)


def fixed_draws(shape: tuple[int, ...], seed: int, like: Tensor) -> Tensor:
    """Return one sequence of standard normal draws, made once, the same on every device, like a tensor."""
    return _draw(shape, seed, like.dtype, like.device)


def move_to(device: torch.device, thing: Any) -> Any:
    """Return a driver or a policy on a device, if it has anything there (`to`), else itself."""
    if isinstance(thing, torch.nn.Module):  # which moves itself: the caller's stays where it is
        thing = copy.deepcopy(thing)
    to = getattr(thing, "to", None)  # anybody's object
    return to(device) if callable(to) else thing


def can_look(value: Tensor) -> bool:
    """Return whether a value is at hand."""
    return value.is_cpu


def may_hold(condition: Tensor) -> bool:
    """Return whether a condition may hold anywhere: False only where it is seen that it does not."""
    return not can_look(condition) or bool(condition.any())


def are_zero(*values: Tensor) -> bool:
    """Return whether all of these are 0, if that is soon known and nothing is differentiated with respect to them.

    Cars that go straight on in the middle of a lane then need no trigonometry; the result is the same.
    """
    if torch.is_grad_enabled() or not can_look(values[0]):
        return False
    return not any(value.count_nonzero() for value in values)  # of a tensor sooner than `any`


RULE_TILE = 16384
"""Rollouts that a rule-based ego drives at once: the number at which eager torch is fastest."""
POLICY_TILE = 4096
"""Likewise with a policy; fixed, because matrix products round differently by batch size."""
LIDAR_TILE = 512
"""Likewise with lidar, or a measure that keeps whole episodes: small enough for all of it to stay in the cache."""
CAMERA_TILE = 128
"""Likewise with a policy that takes pictures: its layers' values for all of them have to fit into memory."""

GPU_TILES = 16
"""Times as many rollouts at once on a GPU, which takes about as long for few as for thousands."""

RULE_CHUNK = 4096
"""Rollouts of a rule-based ego that a worker makes at once: enough for torch, and some for each of several workers."""
POLICY_CHUNK = 256
"""Likewise with a policy, which is slower."""
