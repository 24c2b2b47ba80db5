"""Sensor noise: a function of key, tick, viewer and pixel, so that nothing is random but the key.

A 32-bit hash of these gives four bytes; their sum, centred and scaled, has mean 0, variance 1 and is nearly normal
(the Irwin-Hall distribution of four terms, which ends at 3.5 standard deviations).
"""

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
    noise = torch.empty(len(key), values, device=key.device)
    at_once = 1 if key.device.type == "cpu" else max(len(key), 1)  # one picture stays in the cache of a processor
    for mixed, rows in zip(torch.split(key, at_once), torch.split(noise, at_once), strict=True):
        bits = _mix(place + mixed[:, None])
        pairs = (bits >> 8).bitwise_and_(_EVEN).add_(bits.bitwise_and_(_EVEN))  # bytes 0 + 1 and 2 + 3
        total = pairs.mul_(_BOTH) >> 16
        torch.sub(total, _MEAN, out=rows).div_(_DEVIATION)
    return noise


def _mix(bits: Tensor) -> Tensor:
    """Scramble 32-bit integers, in place; multiplication wraps around."""
    bits.bitwise_xor_((bits >> 16).bitwise_and_(0xFFFF)).mul_(_FACTORS[0])
    bits.bitwise_xor_((bits >> 15).bitwise_and_(0x1FFFF)).mul_(_FACTORS[1])
    return bits.bitwise_xor_((bits >> 16).bitwise_and_(0xFFFF))
