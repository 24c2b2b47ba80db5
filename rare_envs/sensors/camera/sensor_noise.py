"""Sensor noise: a function of key, tick, viewer and pixel, so that nothing is random but the key.

A 32-bit hash of these gives four bytes; their sum, centred and scaled, has mean 0, variance 1 and is nearly normal
(the Irwin-Hall distribution of four terms, which ends at 3.5 standard deviations).
"""

import numpy as np
import torch
from torch import Tensor

from rare_envs.sensors.camera.weather import CameraContext

_STEP = -1640531535
"""2^32 over the golden ratio, as int32: Weyl's sequence spreads consecutive numbers."""
_FACTORS = (0x7FEB352D, 0x846CA68B - 2**32)
"""Of a mixing function with low bias: Wellons, "Prospecting for hash functions", 2018 (lowbias32)."""
_EVEN, _BOTH = 0x00FF00FF, 0x00010001
_MEAN, _DEVIATION = 4 * 127.5, (4 * (256**2 - 1) / 12) ** 0.5


def draw_pixel_noise(context: CameraContext, values: int) -> Tensor:
    """Return the noise of one picture for each of B cameras, shape (B, values), mean 0 and variance 1."""
    key = context.weather.key.to(torch.int32)
    for number in (context.tick, torch.full_like(context.tick, context.viewer)):
        key = _mix(key + (number.to(torch.int32) + 1) * _STEP)
    place = torch.arange(values, dtype=torch.int32, device=key.device) * _STEP
    return add_bytes_unsigned(key, place) if key.device.type == "cpu" else add_bytes(key, place)


def add_bytes(key: Tensor, place: Tensor) -> Tensor:
    """Return the scaled sums of bytes for keys (B,) and places (V,), int32 both, shape (B, V)."""
    bits = _mix(place + key[:, None])
    pairs = (bits >> 8).bitwise_and_(_EVEN).add_(bits.bitwise_and_(_EVEN))  # bytes 0 + 1 and 2 + 3
    return (pairs.mul_(_BOTH) >> 16).sub(_MEAN).div_(_DEVIATION)


def _mix(bits: Tensor) -> Tensor:
    """Scramble 32-bit integers, in place; multiplication wraps around."""
    bits.bitwise_xor_((bits >> 16).bitwise_and_(0xFFFF)).mul_(_FACTORS[0])
    bits.bitwise_xor_((bits >> 15).bitwise_and_(0x1FFFF)).mul_(_FACTORS[1])
    return bits.bitwise_xor_((bits >> 16).bitwise_and_(0xFFFF))


def add_bytes_unsigned(key: Tensor, place: Tensor) -> Tensor:
    """Return the same as `add_bytes`, bit for bit, in half of its time on a processor.

    torch has no shifts of unsigned integers, and a picture at a time stays in the cache.
    """
    noise = np.empty((len(key), len(place)), dtype=np.float32)
    keys, places = (each.numpy().view(np.uint32) for each in (key, place))
    bits, moved = np.empty_like(places), np.empty_like(places)
    for mixed, row in zip(keys, noise, strict=True):
        np.add(places, mixed, out=bits)
        for shift, factor in zip((16, 15), _FACTORS, strict=True):
            bits ^= np.right_shift(bits, shift, out=moved)
            bits *= np.uint32(factor % 2**32)
        bits ^= np.right_shift(bits, 16, out=moved)
        np.bitwise_and(np.right_shift(bits, 8, out=moved), _EVEN, out=moved)
        bits &= _EVEN
        bits += moved  # bytes 0 + 1 and 2 + 3
        bits *= np.uint32(_BOTH)
        np.right_shift(bits, 16, out=bits)
        np.subtract(bits.view(np.int32), np.float32(_MEAN), out=row, dtype=np.float32, casting="unsafe")
        row /= np.float32(_DEVIATION)
    return torch.from_numpy(noise)
