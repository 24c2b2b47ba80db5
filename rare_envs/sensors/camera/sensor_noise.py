"""Sensor noise: a function of key, tick, viewer and pixel, so that nothing is random but the key.

A 32-bit hash of these gives four bytes; their sum, centred and scaled, has mean 0, variance 1 and is nearly normal
(the Irwin-Hall distribution of four terms, which ends at 3.5 standard deviations).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.sensors.camera.noise_bytes import WEYL_STEP, add_bytes, add_bytes_unsigned, mix_bits
from rare_envs.sensors.camera.weather import CameraContext

Words: TypeAlias = NDArray[np.uint32]
MANY_CAMERAS = 16
"""So many cameras at once are worth the half second in which numba is imported."""


def draw_pixel_noise(context: CameraContext, values: int) -> Tensor:
    """Return the noise of one picture for each of B cameras, shape (B, values), mean 0 and variance 1."""
    key = context.weather.key.to(torch.int32)
    for number in (context.tick, torch.full_like(context.tick, context.viewer)):
        key = mix_bits(key + (number.to(torch.int32) + 1) * WEYL_STEP)
    place = torch.arange(values, dtype=torch.int32, device=key.device) * WEYL_STEP
    if key.device.type != "cpu":
        return add_bytes(key, place)
    if len(key) >= MANY_CAMERAS or "numba" in sys.modules:
        compiled = _find_compiled_noise()
        if compiled is not None:
            return torch.from_numpy(compiled(*(each.numpy().view(np.uint32) for each in (key, place))))
    return add_bytes_unsigned(key, place)


@cache
def _find_compiled_noise() -> Callable[[Words, Words], NDArray[np.float32]] | None:
    """Return the compiled function; None where numba is missing or does not work."""
    sample = np.random.default_rng(0).integers(0, 2**32, 128, dtype=np.uint32)
    signed = torch.from_numpy(sample.view(np.int32))
    try:
        from rare_envs.sensors.camera.compiled_noise import add_bytes_compiled

        same = np.array_equal(add_bytes_compiled(sample, sample), add_bytes_unsigned(signed, signed).numpy())
    except Exception:  # a compiler may raise anything, and is not needed
        return None
    return add_bytes_compiled if same else None
